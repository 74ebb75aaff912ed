"""Estimation by the method of a given name, and once more from other records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from emb_bench.brake.quantities import command, quantity
from emb_bench.estimate.prediction import Problem, make_problem
from emb_bench.estimate.records import METHODS, STARTS, Estimate, EstimationProblem, Unknown
from emb_bench.experiment.experiment import Experiment
from emb_runtime.config.bench import Bench
from emb_runtime.config.plants import Plant
from emb_runtime.config.units import CURRENT
from emb_runtime.errors import UsageError

ALONG = ("oem", "pem")  # Methods that estimate systematic errors along
NOT_ALONG = (
    "the bench's systematic errors ([systematic]) are not estimated along by this method, and its intervals do not "
    "allow for them; --method oem does so"
)
"""Caveat of the other methods."""
GAPS = ("oem", "pem", "rls")
"""Methods that take what acted in periods whose report was lost as unknown, or leave these periods out."""


def run_method(
    name: str,
    bench: Bench,
    plant: Plant,
    records: Sequence[Experiment],
    asked: EstimationProblem,
    *,
    starts: int = STARTS,
    seed: int = 0,
) -> Estimate:
    """Estimates parameters from one record, or from several of the same brake; imports a method when it is used.

    Args:
        name: key of ``METHODS``.
        bench: noise, sample time, nominal brake, and the set of ranges in which searches begin where there is no prior.
        plant: the model.
        records: what was done and measured.
        asked: the parameters to estimate.
        starts: local searches; recursive least squares needs none and ignores them.
        seed: of the random numbers.

    Raises:
        UsageError: there is no such method, record, start or measured sample, a library that the method needs is
            missing, or it or the model cannot estimate the parameters.
        ImportError: scipy or numba is missing.
    """
    if name not in ALONG and asked.systematic:
        ideal = replace(asked, systematic={})
        e = run_method(name, bench, plant, records, ideal, starts=starts, seed=seed)
        return replace(e, caveats=(*e.caveats, NOT_ALONG))
    if absent := [name for name in asked.names if getattr(bench.brake, name, 1.0) == 0.0]:
        others = () if bench.machine is None else bench.machine.unknown
        raise UsageError(
            f"{', '.join(absent)}: zero in this bench, and a share of zero says nothing: expected --params "
            f"{','.join(others) or 'without it'}"
        )
    e = _run(name, make_problem(bench, plant, records, asked), starts, seed)
    return replace(e, caveats=(*e.caveats, *_scale(e)))


def _scale(e: Estimate) -> tuple[str, ...]:
    """Words for the scale that all parameters of a machine that is no brake share."""
    machine, names = e.bench.machine, [u.name for u in e.unknowns]
    if machine is None:
        return ()
    others = ", ".join(quantity(machine, name).name for name in ("J", "T_c", "f_v", "k_1") if name in names)
    if "k_m" in names:
        held = [name for name in ("J", "T_c", "f_v", "k_1") if name not in names and getattr(e.bench.brake, name)]
        known = ", ".join(quantity(machine, name).name for name in held)
        if not known:
            return (f"k_m, {others} scale together: without a known load only their ratios are in the recording",)
        return (f"k_m{f', {others}' if others else ''} are as right as what was given as known: {known}",)
    if machine.command in CURRENT:
        return (f"{others}: only their ratios to k_m are in the recording, and k_m was given",)
    return (f"{others} are as right as the scale of the commanded {command(machine).name}: only ratios do without it",)


def _run(name: str, problem: Problem, starts: int, seed: int) -> Estimate:
    match name:
        case "oem":
            from emb_bench.estimate import output_error

            return output_error.estimate(problem, starts=starts, seed=seed)
        case "pem":
            from emb_bench.estimate import prediction_error

            return prediction_error.estimate(problem, starts=starts, seed=seed)
        case "rls":
            from emb_bench.estimate import least_squares

            return least_squares.estimate(problem)
        case "windows":
            from emb_bench.estimate import windows

            return windows.estimate(problem, starts=starts, seed=seed)
    raise UsageError(f"no method is called '{name}'; expected one of {', '.join(METHODS)}")


def refit(e: Estimate, chosen: Sequence[int]) -> Estimate:
    """Estimates again from some of the records, by the same method.

    Output error begins where the estimate is. The model validation is not repeated: it is that of the first estimate.

    Args:
        e: the estimate.
        chosen: numbers of records, any of them as often as it is to count.
    """
    from emb_bench.estimate.output_error import finished, search, settled

    records = tuple(e.records[i] for i in chosen)
    if e.method != "oem":
        return run_method(e.method, e.bench, e.plant, records, e.asked, starts=1)
    problem = Problem(e.bench, e.plant, e.asked, records)
    known = dict(zip(e.unknowns, e.values.tolist(), strict=True))
    there = [Unknown(u.name, None if u.record is None else chosen[u.record]) for u in problem.unknowns]
    start = np.clip(np.array([known[u] for u in there]) / problem.units, *problem.bounds)
    weights = problem.weights(start)
    problem, z, end = settled(problem, *search(problem, start, weights), weights)
    return finished(problem, z, weights, (end,), validation=e.validation)
