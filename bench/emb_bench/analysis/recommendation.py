"""Recommended experiment: the further run that identifies best what the records leave open.

An unknown of interest is identified well if its least standard deviation is at most ``PRECISE`` of its value, or of a
gross error of one with a unit. If one is not, the reference excitations of a small grid are played under the shield on
the brake as it was estimated, without noise; the physical Fisher information of each is added to that of the records,
and they are ranked by the worst deviation that remains. Information adds up, so that this is what a joint estimate of
the old records and a new one has to expect (Pukelsheim, Optimal Design of Experiments, 1993, chapter 3).
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.innovations import Filter
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Unknown
from emb_bench.excitation import parse_excitation, run_excitation
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.criteria import criteria
from emb_bench.information.identifiability import GROSS, Spectrum, combination, schur_complement
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError

PRECISE = 0.01  # Largest deviation of a well identified unknown, as a share of its value or of a gross error
HELPS = 0.5  # Largest ratio of a deviation after a recommended run to the one before
BELONGS = 0.05  # Share of a direction from which on an unknown is named
SHOWN = 3  # Most pieces of advice, each of another kind of excitation
CANDIDATES = (
    ("step", 0.25, ""),
    ("step", 0.5, ""),
    ("step", 1.0, ""),
    ("ramp", 0.5, ""),
    ("ramp", 1.0, ""),
    ("square", 0.5, "period=0.05"),
    ("square", 1.0, "period=0.02"),
    ("square", 1.0, "period=0.2"),
    ("chirp", 0.5, "f1=50"),
    ("chirp", 1.0, "f1=20"),
    ("prbs", 0.5, "hold=0.02"),
    ("prbs", 1.0, "hold=0.008"),
    ("multisine", 0.5, "f1=50"),
    ("multisine", 1.0, "f1=20"),
)
"""Reference excitations that are tried: name, amplitude as a share of the current limit, and what else is chosen."""


@dataclass(frozen=True)
class Recommendation:
    """One more run and what it would bring."""

    excitation: str  # Text for :func:`emb_bench.excitation.parse_excitation`, defaults left out
    direction: str  # Combination of unknowns that the records identify worst, as a sum
    before: Mapping[str, float]
    """Least standard deviations now, by label, relative or in the unknown's unit; inf if not identified."""
    after: Mapping[str, float]  # Least standard deviations after the run, in the same form
    wanting: tuple[str, ...]  # Unknowns of interest that are not identified well enough


def advise(e: Estimate) -> tuple[Recommendation, ...]:
    """Recommends runs, best first; none if all unknowns of interest are identified well, or no candidate helps.

    None is recommended after recursive least squares, which does not use all the information in the records. The
    candidates are played on the estimated brake, inside the ranges that the shield is made for.
    """
    index = e.shared()
    names = [e.unknowns[i].name for i in index]
    matrix = e.shared_information()
    before = _deviations(matrix)
    gross = np.array([GROSS.get(name, 1.0) for name in names])
    unidentified = {finding.name for finding in e.verdict().findings if finding.why_not}
    wanting = [
        k
        for k, name in enumerate(names)
        if name in e.asked.params and (name in unidentified or before[k] > PRECISE * gross[k])
    ]
    if not wanting or e.method == "rls":
        return ()
    weakest = criteria(matrix, names, [name for name in names if name in e.asked.params]).weakest
    direction = combination({name: share for name, share in weakest.items() if abs(share) >= BELONGS})
    best: dict[str, tuple[tuple[int, float], str, Floats]] = {}
    for name, text in candidates(e.bench):
        after = _deviations(matrix + _information(e, text))
        if not (after[wanting] <= HELPS * before[wanting])[np.isfinite(after[wanting])].any():
            continue
        ratios = after[wanting] / gross[wanting]
        finite = np.isfinite(ratios)
        rank = (int((~finite).sum()), float(ratios[finite].max(initial=0.0)))
        if name not in best or rank < best[name][0]:
            best[name] = (rank, text, after)
    found = []
    for _, text, after in sorted(best.values(), key=lambda one: one[0])[:SHOWN]:
        then = dict(zip(names, after.tolist(), strict=True))
        now = dict(zip(names, before.tolist(), strict=True))
        found.append(Recommendation(text, direction, now, then, tuple(names[k] for k in wanting)))
    return tuple(found)


def candidates(bench: Bench) -> list[tuple[str, str]]:
    """Name and text of the excitations that this bench's current and time grid allow."""
    found = []
    for name, share, rest in CANDIDATES:
        text = f"{name}:amplitude={share * bench.limits.current:g}{',' if rest else ''}{rest}"
        with suppress(UsageError):
            parse_excitation(text, bench)
            found.append((name, text))
    return found


def _deviations(matrix: Floats) -> Floats:
    result: Floats = np.sqrt(np.diag(Spectrum(matrix).inverse()))
    return result


def _information(e: Estimate, text: str) -> Floats:
    """Fisher information of a run of an excitation on the unknowns that all records share; relative parameters."""
    bench, instruments = e.bench, e.plant.instruments
    brake = _inside(bench, e.theta)
    played = run_excitation(bench, parse_excitation(text, bench), e.plant.mechanics, brake, shielded=True)
    samples = np.zeros((len(played.currents), 2))
    slack = max(record.slack for record in e.records)
    record = Experiment(text, played.currents, samples, instruments.encoder_offset, 0.0, slack, True)
    problem = replace(e.problem, asked=replace(e.asked, prior=None), records=(record,))
    own = [i for i, unknown in enumerate(problem.unknowns) if unknown.record is None]
    values = dict(zip(e.unknowns, e.values.tolist(), strict=True)) | {
        Unknown(name): value for name, value in brake._asdict().items()
    }
    z = problem.nominal()
    z[own] = [values[problem.unknowns[i]] / problem.units[i] for i in own]
    z = np.clip(z, *problem.bounds)
    rows = _rows(e, problem, z)
    rows *= problem.scale(z)
    return schur_complement(rows.T @ rows, own)


def _rows(e: Estimate, problem: Problem, z: Floats) -> Floats:
    """Derivatives of the residuals, innovations under the disturbance that was found; without shared prior knowledge.

    What was known of all runs beforehand is in the information of the records already.
    """
    weights = problem.weights(z)
    if e.process_noise > 0.0 or e.load_noise > 0.0:
        played = replace(problem.records[0], samples=problem.predict(z, 0).samples)
        found = Filter(replace(problem, records=(played,)), e.process_noise, e.load_noise)
        rows = found.jacobian(z, weights, found.gains(z, weights))[1]
    else:
        rows = problem.jacobian(z, weights)[1]
    shared = [i for i, unknown in enumerate(problem.unknowns) if unknown.record is None]
    counts = np.ones(len(rows), dtype=bool)
    known = len(problem.prior_residuals(z)[0])
    counts[len(rows) - known :] = ~np.any(rows[len(rows) - known :, shared] != 0.0, axis=1)
    return rows[counts]


def _inside(bench: Bench, brake: BrakeParameters) -> BrakeParameters:
    """Nearest brake that the shield is made for: an unidentified parameter may have any value."""
    ranges = bench.range_set(bench.shield.ranges)
    rows = zip(brake, ranges.low, ranges.high, strict=True)
    return BrakeParameters(*(min(max(value, low), high) if low < high else value for value, low, high in rows))
