"""Output error over windows: multiple shooting in which each window begins where its own samples say.

A machine without a spring has no place that it returns to: an error of its friction adds up over a recording, and after
seconds the simulation is elsewhere. So a recording is cut into windows, each with the angle and the velocity at its
start as unknowns of its own (:mod:`emb_bench.estimate.shooting`).

**Uncertainty.** A machine is disturbed by what no parameter stands for: ripple, friction that depends on the place.
Such residuals follow from each other for as long as a window lasts, so that a window is the unit that counts: the
covariance is H⁻¹ (Σ g g^T) H⁻¹ with the scores g of whole windows (Liang and Zeger, Biometrika 73, 1986), those of
neighbours counted together (Newey and West 1987). What is wrong in all windows alike does not show in their scatter.
But a wrong model weighs its errors otherwise in longer windows, and the right one does not (Hausman, Econometrica 46,
1978): the estimate is made again from windows of another length, and what it moves by counts as a deviation.

**Choices.** Where neither the bench nor the caller says the length of the windows, the records choose it: of lengths
each twice the one before, the one whose covariance, with what another length moves the estimate by, is the smallest.
Short windows leave little time for what disturbs the machine, long ones tell it better from the noise of the sensor.
Where it is not known how a command goes from its stamp to the next, held or straight, the likelihood chooses; if the
windows do not agree on it (Vuong, Econometrica 57, 1989), what the other course moves the estimate by counts too. What
is chosen is said with the estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import OF_A_RECORD
from emb_bench.estimate.method import Method
from emb_bench.estimate.model_validation import examine
from emb_bench.estimate.output_error import by_record, estimate_at, start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import NORMAL_95, End, Estimate, ModelValidation
from emb_bench.estimate.shooting import (
    HELD,
    LINEAR,
    START,
    Point,
    Window,
    begun_at,
    by_windows,
    course_of,
    descended,
    follows_on,
    linearised,
    restarted,
    scatter,
    search,
    settled,
    span_of,
    weights_of,
    window_of,
    windowed,
)
from emb_bench.information.identifiability import Spectrum
from emb_runtime.errors import UsageError

FEWEST = 3  # Fewest windows for each unknown that they share: with fewer their scatter says little
JUDGED = 5000  # Samples, in whole windows, that the model is validated on: an hour has millions, and these see as much
OTHER = 4.0  # Ratio of the lengths of the windows in two estimates whose difference is counted
REFINED = 2  # Searches that are carried to their ends: those whose first steps led lowest
SHORT = 6  # Simulations of a search that is only begun
BRIEF = 20  # Samples of the shortest windows to choose from
ENOUGH = 20
"""Fewest windows for each unknown of the longest windows to choose from: the scatter of fewer is too uncertain."""


class Windows(Method):
    """What all windows of the records share."""

    gaps = False

    def solve(self, problem: Problem) -> Estimate:
        """As :class:`Method`."""
        shared = problem.unknowns
        if any(unknown.record is not None for unknown in shared):
            raise UsageError(f"method windows: each window has a start of its own: leave out {', '.join(OF_A_RECORD)}")
        if window_of(problem) and course_of(problem):
            cut = _enough(problem)
            points = _points(cut, start_points(problem, self.starts, self.seed))
            searches = sorted((search(*point) for point in points), key=lambda pair: pair[1].cost)
            at, weights, ends = searches[0][0], points[0][2], tuple(end for _, end in searches)
            return _finished(problem, cut, at, weights, ends, [_other(problem, at.shared) - at.shared], ())
        problem, near, moved, said = _chosen(problem, self.starts, self.seed)
        cut = windowed(problem)
        begun = begun_at(cut, near)
        weights = weights_of(cut, begun)
        at, end = search(cut, begun, weights)
        return _finished(problem, cut, at, weights, (end,), [_other(problem, at.shared) - at.shared, *moved], said)


def _enough(problem: Problem) -> list[Problem]:
    """The windows.

    Raises:
        UsageError: there are too few for the unknowns.
    """
    cut, p = windowed(problem), len(problem.unknowns)
    if len(cut) < FEWEST * p:
        raise UsageError(
            f"method windows: {len(cut)} windows of {window_of(problem):g} s are too few for {p} unknowns, expected at "
            f"least {FEWEST * p}: shorter windows (--window) or a longer recording"
        )
    return cut


def _points(cut: list[Problem], values: Sequence[Floats]) -> list[tuple[list[Problem], Point, list[Floats]]]:
    """Beginnings of the searches that are carried to their ends."""
    begun = begun_at(cut, values[0])
    weights = weights_of(cut, begun)
    points = [replace(begun, shared=z) for z in values]
    if len(points) > REFINED:  # most searches are only begun
        short = [descended(cut, point, weights, SHORT) for point in points]
        order = sorted(range(len(points)), key=lambda i: short[i][1].cost)
        points = [points[i] for i in order[:REFINED]]
    return [(cut, point, weights) for point in points]


class _Candidate(NamedTuple):
    """An estimate with windows of one length and one course of the command, by one step of Gauss and Newton."""

    problem: Problem
    shared: Floats  # Scaled as in :class:`Problem`, shape (p,)
    covariance: Floats  # From the scatter of the windows, relative, shape (p, p)
    scale: Floats  # From relative to scaled values, shape (p,)
    costs: Floats  # Of each window, shape (m,)
    follows: list[bool]


def _chosen(problem: Problem, starts: int, seed: int) -> tuple[Problem, Floats, tuple[Floats, ...], tuple[str, ...]]:
    """Length of the windows and course of the command that the records choose.

    Returns:
        The problem with both, the shared unknowns where its search begins, what a course that the records do not tell
        from the chosen one moves them by, and the choices in words.
    """
    lengths = [window_of(problem)] if window_of(problem) else _lengths(problem)
    courses = (course_of(problem),) if course_of(problem) else (HELD, LINEAR)
    first = _with(problem, lengths[len(lengths) // 2], courses[0])
    cut = _enough(first)
    searches = (search(*point) for point in _points(cut, start_points(first, starts, seed)))
    shared = min(searches, key=lambda pair: pair[1].cost)[0].shared
    found = [_candidate(_with(problem, length, courses[0]), shared) for length in lengths]
    best = min(range(len(found)), key=lambda i: _uncertainty(found, i))
    said = []
    if len(lengths) > 1:
        every = ", ".join(f"{length:g}" for length in lengths)
        said.append(
            f"windows of {lengths[best]:g} s were chosen (tried: {every} s): they leave the parameters least uncertain "
            f"by the scatter of the windows and by what {OTHER:g} times the length changes"
        )
    one, others = found[best], tuple[Floats, ...]()
    if len(courses) > 1:
        other = _candidate(_with(problem, lengths[best], LINEAR), shared)
        apart = _apart(one, other)
        one, other = (other, one) if apart > 0.0 else (one, other)
        names = {HELD: "is held from its stamp to the next", LINEAR: "goes straight from its stamp to the next"}
        chosen = f"the command {names[course_of(one.problem)]}, as far as the record tells ({abs(apart):.1f} sigma)"
        said.append(chosen if abs(apart) > NORMAL_95 else f"{chosen}: the intervals cover the other course too")
        others = () if abs(apart) > NORMAL_95 else (other.shared - one.shared,)
    return one.problem, one.shared, others, tuple(said)


def _lengths(problem: Problem) -> list[float]:
    """Lengths of windows to choose from, each twice the one before [s]."""
    length, found = BRIEF * problem.bench.timing.sample_time, list[float]()
    while not found or ENOUGH * len(problem.unknowns) * length <= _seconds(problem):
        found.append(length)
        length *= 2.0
    return found


def _with(problem: Problem, window: float, between: str) -> Problem:
    return replace(problem, asked=replace(problem.asked, window=window, between=between))


def _candidate(problem: Problem, shared: Floats) -> _Candidate:
    """Estimate that windows lead to from shared unknowns that are near."""
    cut = windowed(problem)
    begun = begun_at(cut, shared)
    weights = weights_of(cut, begun)
    windows = linearised(cut, settled(cut, begun, weights), weights)
    information, scores, scale = _sums(problem, shared, windows)
    spectrum = Spectrum(information)
    step = np.where(spectrum.lost, 0.0, np.linalg.pinv(information, hermitian=True) @ scores.sum(axis=0)) * scale
    parts = [(errors - columns @ step, columns) for errors, columns in (window.projected() for window in windows)]
    costs = np.array([float(errors @ errors) for errors, _ in parts])
    left = np.array([columns.T @ errors for errors, columns in parts]) * scale
    follows = follows_on(cut)
    return _Candidate(problem, shared + step, by_windows(information, left, follows), scale, costs, follows)


def _uncertainty(found: Sequence[_Candidate], i: int) -> float:
    """Logarithm of the determinant of a candidate's covariance, with what another length moves it by."""
    steps = round(math.log2(OTHER))
    other = found[i + steps if i + steps < len(found) else max(i - steps, 0)]
    moved = (other.shared - found[i].shared) / found[i].scale
    sign, value = np.linalg.slogdet(found[i].covariance + np.outer(moved, moved))
    return float(value) if sign > 0.0 and math.isfinite(value) else math.inf


def _apart(one: _Candidate, other: _Candidate) -> float:
    """Difference of two courses' costs in standard deviations of the sum over windows; positive if the other is lower.

    The windows have the same samples, and each course has one estimate: neither has more freedom to fit.
    """
    lower = (one.costs - other.costs)[:, None]
    spread = float(scatter(lower - lower.mean(), one.follows)[0, 0])
    return float(lower.sum()) / math.sqrt(spread) if spread > 0.0 else 0.0


def _other(problem: Problem, shared: Floats) -> Floats:
    """The shared unknowns from windows of another length: longer ones, or shorter where those would be too few."""
    longer, shorter = (_with(problem, window_of(problem) * f, course_of(problem)) for f in (OTHER, 1.0 / OTHER))
    enough = FEWEST * len(shared) * window_of(longer) <= _seconds(problem)
    cut = windowed(longer if enough else shorter)
    begun = begun_at(cut, shared)
    at, _ = search(cut, begun, weights_of(cut, begun))
    return at.shared


def _seconds(problem: Problem) -> float:
    return sum(len(record.currents) for record in problem.records) * problem.bench.timing.sample_time


def predict_windows(problem: Problem, values: Floats) -> tuple[float, float, int]:
    """Prediction of the windows of records with given parameters, each from the start that fits it best.

    Args:
        problem: records, model and unknowns.
        values: of the unknowns, SI units.

    Returns:
        Root mean square of the angle's error [rad], χ² of the samples, and its degrees of freedom.
    """
    cut = windowed(problem)
    begun = begun_at(cut, values / problem.units)
    weights = weights_of(cut, begun)
    at = restarted(cut, settled(cut, begun, weights), begun, weights)
    squares, samples, chi2, freedom = 0.0, 0, 0.0, 0
    for window, z, root in zip(cut, at.all(), weights, strict=True):
        record = window.records[0]
        errors = (record.samples - window.predict(z, 0).shown)[record.measured]
        squares, samples = squares + float(errors[:, 0] @ errors[:, 0]), samples + len(errors)
        chi2 += float(np.sum((errors * root[record.measured]) ** 2))
        freedom += int((root > 0.0).sum()) - len(START)
    return math.sqrt(squares / samples), chi2, freedom


def _sums(problem: Problem, shared: Floats, windows: Sequence[Window]) -> tuple[Floats, Floats, Floats]:
    """Information of relative parameters, the score of each window, and the factors to scaled values."""
    p = len(problem.unknowns)
    scale = problem.scale(shared)
    parts = [window.projected() for window in windows]
    information = sum((columns.T @ columns for _, columns in parts), np.zeros((p, p))) * np.outer(scale, scale)
    return information, np.array([columns.T @ errors for errors, columns in parts]) * scale, scale


def _finished(
    problem: Problem,
    cut: Sequence[Problem],
    at: Point,
    weights: Sequence[Floats],
    ends: tuple[End, ...],
    moved: Sequence[Floats],
    said: tuple[str, ...],
) -> Estimate:
    """Estimate of what the windows share, with its information, covariance and validation."""
    information, scores, scale = _sums(problem, at.shared, linearised(cut, at, weights))
    changes = [change / scale for change in moved]
    covariance = by_windows(information, scores, follows_on(cut))
    return estimate_at(
        problem,
        at.shared,
        information=information,
        prior=None,
        sandwich=covariance + sum((np.outer(c, c) for c in changes), np.zeros_like(covariance)),
        validation=_validated(cut, at, weights),
        ends=ends,
        residuals=_residuals(problem, cut, at, weights),
        method="windows",
        caveats=(*said, *_caveats(problem, len(cut))),
    )


def _validated(cut: Sequence[Problem], at: Point, weights: Sequence[Floats]) -> ModelValidation:
    """Tests of the model on windows spread over the records."""
    p, count = len(at.shared), len(cut)
    few_enough = max(JUDGED // len(cut[0].records[0].currents), 2)
    chosen = sorted({round(k) for k in np.linspace(0, count - 1, min(count, few_enough)).tolist()})
    few = replace(cut[0], records=tuple(cut[i].records[0] for i in chosen))
    z, roots = np.concatenate([at.shared, at.starts[chosen].T.ravel()]), [weights[i] for i in chosen]
    errors, jacobian = few.jacobian(z, roots)
    found = examine(few, z, roots, by_record(errors, roots), jacobian, errors=errors)
    suspects = {s.name: replace(s, moves=s.moves[:p]) for s in found.suspects}
    return replace(found, suspects=tuple(suspects.values()), suspected=tuple(suspects[s.name] for s in found.suspected))


def _residuals(problem: Problem, cut: Sequence[Problem], at: Point, weights: Sequence[Floats]) -> tuple[Floats, ...]:
    """Residuals of each record in standard deviations, NaN where lost or in no window, shape (n, 2)."""
    found = {record.name: np.full(record.samples.shape, np.nan) for record in problem.records}
    for window, z, root in zip(cut, at.all(), weights, strict=True):
        name, begin, end = span_of(window)
        errors = (window.records[0].samples - window.predict(z, 0).shown) * root
        found[name][begin:end] = np.where(root > 0.0, errors, np.nan)
    return tuple(found[record.name] for record in problem.records)


def _caveats(problem: Problem, windows: int) -> tuple[str, ...]:
    names = problem.asked.names
    said = [f"each of the {windows} windows of {window_of(problem):g} s has a start of its own"]
    if {"coulomb_asymmetry", "current_offset"} <= {*names}:
        said.append(
            "while the machine moves, a Coulomb friction by direction and an offset of the current are one and the "
            "same number: only standstill tells them apart"
        )
    return tuple(said)
