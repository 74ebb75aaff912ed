"""One brake at a time: every candidate plays on it, with the same noise, and each run is estimated.

A run in which the brake leaves its limits ends there: on the bench, the node latches its safe stop at that sample and
reports it in the sample's own frame, and ``emb-run`` stops. Such a run is no experiment and is not estimated from.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import islice
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import Floats
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import STARTS, Estimate, EstimationProblem, Record
from emb_bench.excitation.reference import Response, run_excitation
from emb_bench.information.identifiability import Spectrum
from emb_bench.sim.node import REST_TIME, REST_TRAVEL
from emb_bench.sim.open_loop import feedback
from emb_runtime.config.bench import Bench, BrakeParameters, Ranges, parse_bench
from emb_runtime.config.plants import Mechanics, Plant
from emb_runtime.safety.shield import damped_current
from studies.comparison.candidates import Candidate

LONGEST_REST = 5.0  # Longest time that a brake is simulated after the experiment [s]

TOLD = 1.0  # Relative bound from which on a parameter is not identified, as in :mod:`emb_bench.information.criteria`

Table = NDArray[np.void]


class Job(NamedTuple):
    """One brake on one plant, and everything to play there; it travels to another process."""

    bench: str  # The text of the bench file
    candidates: tuple[Candidate, ...]
    plant: str
    model: str
    params: tuple[str, ...]
    ranges: str
    seed: int
    brake: int  # Number of the brake
    draws: int  # Draws of the noise
    optimum: bool  # True if the optimum of this very brake is searched for


class Played(NamedTuple):
    """Results on one brake."""

    table: Table  # Runs, shape (candidates, draws), with the fields of :func:`fields`
    optimum: float  # log det of the best design if the brake were known; NaN if it was not searched for


def fields(count: int) -> list[tuple[Any, ...]]:
    """Returns the numpy fields of a run in which ``count`` parameters are estimated.

    Of a run that was stopped, ``error`` and ``bound`` are NaN, ``log_det`` is −inf, and it identifies nothing.
    """
    flags = ("stopped", "home", "stopped_free", "alarm", "missed")
    numbers = ("log_det", "lambda_min", "speed", "low", "high", "seconds")
    each = [("error", "f8", (count,)), ("bound", "f8", (count,)), ("covered", "?", (count,)), ("told", "?", (count,))]
    return [*each, *((name, "?") for name in flags), *((name, "f8") for name in numbers)]


def brake_of(bench: Bench, ranges: Ranges, seed: int, number: int) -> BrakeParameters:
    """A brake, drawn uniformly from a set of ranges; the same number is the same brake, however many there are."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    return BrakeParameters(*rng.uniform(ranges.low, ranges.high).tolist())


def noise_of(bench: Bench, seed: int, number: int, draw: int) -> Floats:
    """Errors of a run's samples: angle [rad] and velocity [rad/s], shape (horizon + 1, 2).

    They depend on the brake's number and the draw only: the same for every candidate, on every plant.
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, draw)))
    errors: Floats = rng.standard_normal((bench.timing.horizon + 1, 2)) * [bench.noise.angle, bench.noise.velocity]
    return errors


def work(job: Job) -> Played:
    """Play and estimate everything on one brake.

    Raises:
        PolicyRefusedError: an actor requests a current that is not finite.
    """
    bench = _bench(job.bench)
    plant, model, asked = bench.plant(job.plant), bench.plant(job.model), EstimationProblem(job.params)
    p = brake_of(bench, bench.range_set(job.ranges), job.seed, job.brake)
    table = np.zeros((len(job.candidates), job.draws), np.dtype(fields(len(job.params))))
    best: tuple[float, Floats] = (-math.inf, np.zeros(bench.timing.horizon))
    for i, candidate in enumerate(job.candidates):
        excited = candidate.built(bench)
        for draw in range(job.draws):
            noise = noise_of(bench, job.seed, job.brake, draw)
            response = run_excitation(bench, excited, plant.mechanics, p, shielded=True, noise=noise)
            free = None if draw else run_excitation(bench, excited, plant.mechanics, p, shielded=False, noise=noise)
            row = table[i, draw]
            _judge_motion(row, bench, plant.mechanics, p, response)
            row["stopped_free"] = not free.kept if free is not None else table[i, 0]["stopped_free"]
            if row["stopped"]:
                row["error"], row["bound"], row["log_det"] = math.nan, math.nan, -math.inf
                continue
            _judge_estimate(row, bench, plant, model, asked, p, record_of(bench, response, noise))
            if row["log_det"] > best[0]:
                best = (float(row["log_det"]), response.currents)
    return Played(table, _optimum(bench, plant, job, p, best) if job.optimum else math.nan)


@cache
def _bench(text: str) -> Bench:
    return parse_bench(text, "the bench")


def record_of(bench: Bench, response: Response, noise: Floats) -> Record:
    """Returns the record of a run for an estimator: it began at rest at the origin."""
    samples = response.states[1:] + noise[1:]
    return Record("run", response.currents, samples, 0.0, 0.0, 0.0, True)


def information_at(
    bench: Bench, plant: Plant, asked: EstimationProblem, p: BrakeParameters, record: Record
) -> tuple[Floats, float]:
    """The physical FIM of a run at given parameters, relative ones, and χ² there.

    Args:
        bench: noise and sample time.
        plant: how the brake moves.
        asked: what is estimated, of the brake's parameters.
        p: the parameters; those that are not estimated have to be nominal.
        record: the run.
    """
    problem = Problem(bench, plant, asked, (record,))
    z = np.array([getattr(p, u.name) for u in problem.unknowns]) / problem.units
    residuals, jacobian = problem.jacobian(z, problem.weights(z))
    relative = jacobian * z
    return relative.T @ relative, float(residuals @ residuals)


def estimated(bench: Bench, model: Plant, record: Record, asked: EstimationProblem) -> Estimate:
    """Output error; where the model does not seem to fit, again from more starts, as anyone would."""
    first = run_method("oem", bench, model, [record], asked, starts=1)
    return first if first.validation.fits else run_method("oem", bench, model, [record], asked, starts=STARTS)


def _judge_motion(row: Any, bench: Bench, mechanics: Mechanics, p: BrakeParameters, response: Response) -> None:
    states = response.states[: end_of(bench, response) + 1]
    row["stopped"], row["home"] = not response.kept, response.kept and response.home
    row["low"], row["high"] = states[:, 0].min(), states[:, 0].max()
    row["speed"] = np.abs(states[:, 1]).max()
    row["seconds"] = (len(states) - 1) * bench.timing.sample_time + time_to_rest(bench, mechanics, p, states[-1])


def end_of(bench: Bench, response: Response) -> int:
    """The sample with which the bench ends a run: the first one outside the limits, else the experiment's last."""
    low, high = bench.limits.angle
    angle, velocity = response.states.T
    outside = (angle < low) | (angle > high) | (np.abs(velocity) > bench.limits.velocity)
    return int(outside.argmax()) if outside.any() else len(outside) - 1


def time_to_rest(bench: Bench, mechanics: Mechanics, p: BrakeParameters, state: Floats) -> float:
    """Duration of the node's stop until it reports that the brake rests [s]; at most ``LONGEST_REST``.

    Args:
        bench: the stop, and the sample time.
        mechanics: how the brake moves.
        p: the brake.
        state: angle [rad] and velocity [rad/s] when the experiment ends.
    """
    limit, t_s = bench.limits.current, bench.timing.sample_time
    damping_velocity = math.inf if bench.node.stop == "freewheel" else bench.node.damping_velocity
    stop = feedback(mechanics, p, lambda _, x2, k: damped_current(x2, limit, damping_velocity), t_s, tuple(state))
    at, since = float(state[0]), 0
    for k, (_, x1, _) in enumerate(islice(stop, math.ceil(LONGEST_REST / t_s)), 1):
        if abs(x1 - at) > REST_TRAVEL:
            at, since = x1, k
        if (k - since) * t_s >= REST_TIME:
            return k * t_s
    return LONGEST_REST


def _judge_estimate(
    row: Any, bench: Bench, plant: Plant, model: Plant, asked: EstimationProblem, p: BrakeParameters, record: Record
) -> None:
    true = np.array([getattr(p, name) for name in asked.params])
    matrix, chi2 = information_at(bench, plant, asked, p, record)
    spectrum = Spectrum(matrix)
    row["bound"] = np.sqrt(np.diag(spectrum.inverse()))
    row["told"] = row["bound"] < TOLD
    row["log_det"] = spectrum.log_det()
    row["lambda_min"] = 0.0 if spectrum.singular else np.linalg.eigvalsh(matrix)[0]
    found = estimated(bench, model, record, asked)
    intervals = found.intervals()
    row["error"] = found.values / true - 1.0
    row["covered"] = (intervals[:, 0] <= true) & (true <= intervals[:, 1])
    row["alarm"] = not found.validation.fits
    # No minimum is above the cost of the truth, where the model is the brake's: one that is was not the lowest.
    row["missed"] = plant.name == model.name and found.ends[0].cost > chi2


def _optimum(bench: Bench, plant: Plant, job: Job, p: BrakeParameters, best: tuple[float, Floats]) -> float:
    """The log det of the best design that is found for this brake, from the best run on it among others."""
    from emb_bench.design.problem import make_problem
    from emb_bench.design.search import search
    from emb_bench.information.criteria import criterion

    problem = make_problem(bench, criterion("D", job.params), job.params, model=plant.name, brake=p)
    warm = [best[1]] if math.isfinite(best[0]) else []
    return float(search(problem, starts=1, seed=job.seed, workers=1, warm=warm).best.phi)
