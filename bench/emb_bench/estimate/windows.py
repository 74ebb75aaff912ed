"""Output error over windows: multiple shooting in which each window begins where its own samples say.

A machine without a spring has no place that it returns to: an error of its friction adds up over a recording, and after
seconds the simulation is elsewhere. So a recording is cut into windows, each with the angle and the velocity at its
start as unknowns of its own: multiple shooting (Bock, Numerical treatment of inverse problems in chemical reaction
kinetics, 1981). The search goes over what all windows share, with each start where it fits best (variable projection:
Golub and Pereyra 1973; its Jacobian is Kaufman's).

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
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import OF_A_RECORD
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.method import Method
from emb_bench.estimate.model_validation import examine
from emb_bench.estimate.output_error import start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import NORMAL_95, WINDOW, End, ModelValidation
from emb_bench.estimate.search import EVALUATIONS, minimise
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.identifiability import Spectrum
from emb_runtime.errors import UsageError

SHORTEST = 10  # Fewest samples of a window
AROUND = 8  # Samples on each side of a window's start from which its velocity is taken, where none is measured
RESTARTS = 4  # Most times that a search goes on from better starts of the windows
RESTARTED = 1e-3  # Share of the cost by which a restart has to lower it to be followed by another
HALVINGS = 12  # Most halvings of a step of a window's start
STILL = 1e-9  # Share of a window's squares below which a step of its start ends the steps
SETTLED = 4  # Steps in which the starts of windows settle for given parameters
FOLLOWS = 0.97  # Largest correlation of neighbouring windows' scores that is reckoned with
START = ("x1_0", "x2_0")
HELD, LINEAR = "held", "linear"  # Courses of a command from its stamp to the next one
_LOST = 1e-9  # share of a start's largest singular value below which the samples do not tell it
FEWEST = 3  # Fewest windows for each unknown that they share: with fewer their scatter says little
JUDGED = 5000  # Samples, in whole windows, that the model is validated on: an hour has millions, and these see as much
OTHER = 4.0  # Ratio of the lengths of the windows in two estimates whose difference is counted
REFINED = 2  # Searches that are carried to their ends: those whose first steps led lowest
SHORT = 6  # Simulations of a search that is only begun
BRIEF = 20  # Samples of the shortest windows to choose from
ENOUGH = 20
"""Fewest windows for each unknown of the longest windows to choose from: the scatter of fewer is too uncertain."""


class Windows(Method):
    """Output error of all windows: the parameters that they share."""

    gaps = False

    def solve(self, problem: Problem) -> Estimate:
        """As :class:`Method`."""
        shared = problem.unknowns
        if any(unknown.record is not None for unknown in shared):
            raise UsageError(f"method windows: each window has a start of its own: leave out {', '.join(OF_A_RECORD)}")
        if window_of(problem) and course_of(problem):
            cut = _enough(problem)
            points = _points(problem, cut, start_points(problem, self.starts, self.seed))
            weights = points[0][1]
            searches = sorted((search(problem, cut, *point) for point in points), key=lambda pair: pair[1].cost)
            at, ends = searches[0][0], tuple(end for _, end in searches)
            return _finished(problem, cut, at, weights, ends, [_other(problem, at.shared) - at.shared], ())
        problem, near, moved, said = _chosen(problem, self.starts, self.seed)
        cut = windowed(problem)
        begun = begun_at(cut, near)
        weights = weights_of(cut, begun)
        at, end = search(problem, cut, begun, weights)
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


def _points(problem: Problem, cut: list[Problem], values: Sequence[Floats]) -> list[tuple[Point, list[Floats]]]:
    """Beginnings of the searches that are carried to their ends, with the weights of the samples."""
    begun = begun_at(cut, values[0])
    weights = weights_of(cut, begun)
    points = [replace(begun, shared=z) for z in values]
    if len(points) > REFINED:  # most searches are only begun
        costs = [search(problem, cut, point, weights, SHORT)[1].cost for point in points]
        points = [points[i] for i in np.argsort(costs, kind="stable")[:REFINED]]
    return [(point, weights) for point in points]


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
    points = _points(first, cut, start_points(first, starts, seed))
    searches = (search(first, cut, *point) for point in points)
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
    _, windows = settled(cut, begun, weights)
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
    at, _ = search(problem, cut, begun, weights_of(cut, begun))
    return at.shared


def _seconds(problem: Problem) -> float:
    return sum(len(record.currents) for record in problem.records) * problem.bench.timing.sample_time


def predict_windows(problem: Problem, values: Floats) -> tuple[float, float, int]:
    """Prediction of the windows of records with parameters in SI units, each from the start that fits it best.

    Returns:
        Root mean square of the angle's error [rad], χ² of the samples, and its degrees of freedom.
    """
    cut = windowed(problem)
    begun = begun_at(cut, values / problem.units)
    weights = weights_of(cut, begun)
    at = restarted(cut, settled(cut, begun, weights)[0], begun, weights)
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
    return Estimate(
        problem.solved(at.shared),
        at.shared,
        information=information,
        prior=None,
        sandwich=covariance + sum((np.outer(c, c) for c in changes), np.zeros_like(covariance)),
        validation=_validated(cut, at, weights),
        ends=ends,
        residuals=_residuals(problem, cut, at, weights),
        method="windows",
        caveats=(*said, f"each of the {len(cut)} windows of {window_of(problem):g} s has a start of its own"),
    )


def _validated(cut: Sequence[Problem], at: Point, weights: Sequence[Floats]) -> ModelValidation:
    """Tests of the model on windows spread over the records."""
    count = len(cut)
    few_enough = max(JUDGED // len(cut[0].records[0].currents), 2)
    chosen = sorted({round(k) for k in np.linspace(0, count - 1, min(count, few_enough)).tolist()})
    few = replace(cut[0], records=tuple(cut[i].records[0] for i in chosen))
    z, roots = np.concatenate([at.shared, at.starts[chosen].T.ravel()]), [weights[i] for i in chosen]
    return examine(few, z, roots, few.marginal(z, roots))


def _residuals(problem: Problem, cut: Sequence[Problem], at: Point, weights: Sequence[Floats]) -> tuple[Floats, ...]:
    """Residuals of each record in standard deviations, NaN where lost or in no window, shape (n, 2)."""
    found = {record.name: np.full(record.samples.shape, np.nan) for record in problem.records}
    for window, z, root in zip(cut, at.all(), weights, strict=True):
        name, begin, end = span_of(window)
        errors = (window.records[0].samples - window.predict(z, 0).shown) * root
        found[name][begin:end] = np.where(root > 0.0, errors, np.nan)
    return tuple(found[record.name] for record in problem.records)


@dataclass(frozen=True, eq=False)
class Window:
    """One window at a point: what it adds to the normal equations once its start is eliminated."""

    errors: Floats  # Of its samples in standard deviations, shape (m,)
    shared: Floats  # Derivatives of what is shown to the shared unknowns, shape (m, p)
    inverse: Floats  # Pseudo-inverse of the derivatives to the start, shape (2, m)
    own: Floats  # Derivatives to the start, shape (m, 2)

    @property
    def cost(self) -> float:
        """Weighted sum of squares."""
        return float(self.errors @ self.errors)

    def projected(self) -> tuple[Floats, Floats]:
        """Errors and derivatives beside what the start takes up."""
        return self._beside(self.errors), self._beside(self.shared)

    def _beside(self, columns: Floats) -> Floats:
        result: Floats = columns - self.own @ (self.inverse @ columns)
        return result


def window_of(problem: Problem) -> float:
    """Length of the windows [s]; 0 where the records are to choose it."""
    machine = problem.bench.machine
    return problem.asked.window or (machine.window if machine is not None else WINDOW)


def course_of(problem: Problem) -> str:
    """Course of a command between its stamps, ``held`` or ``linear``; empty where the records are to choose it."""
    machine = problem.bench.machine
    return problem.asked.between or (HELD if machine is None or machine.between == HELD else "")


def windowed(problem: Problem) -> list[Problem]:
    """The windows, each as a problem of its own with the angle and the velocity at its start as the last unknowns."""
    t_s = problem.bench.timing.sample_time
    length = max(round(window_of(problem) / t_s), SHORTEST)
    asked = replace(problem.asked, nuisances=(*problem.asked.nuisances, *START))
    derived = problem.plant.instruments.observer_bandwidth > 0.0
    records = [_between(record) if course_of(problem) == LINEAR else record for record in problem.records]
    cut = [window for record in records for window in _cut(record, length, t_s if derived else 0.0)]
    if not cut:
        raise UsageError(f"method windows: no window of {length} periods has {SHORTEST} samples: expected longer ones")
    return [Problem(problem.bench, problem.plant, asked, (window,)) for window in cut]


def _between(record: Experiment) -> Experiment:
    """The record with commands that go straight from stamp to stamp, of one in which they are held."""
    following = np.append(record.currents[1:], record.currents[-1:])
    return replace(record, currents=0.5 * (record.currents + following))


def _cut(record: Experiment, length: int, t_s: float) -> list[Experiment]:
    """The windows of a record; one that begins with lost samples starts from the last that was received.

    An observer's velocity lags. Where it is one, and ``t_s`` is not 0, a window starts with the slope of a parabola
    through the angles around its start: a window that starts too slow may stick where the machine did not, and then
    nothing says which way to go.
    """
    found, angle, velocity = [], record.angle, record.velocity
    every = np.concatenate([[record.angle], record.samples[:, 0]])
    for begin in range(0, len(record.currents), length):
        end = min(begin + length, len(record.currents))
        samples = record.samples[begin:end]
        received = np.flatnonzero(np.isfinite(samples).all(axis=1))
        if len(received) >= min(SHORTEST, length) and (end - begin) * 2 >= length:
            late = None if record.late is None else record.late[begin:end]
            before = float(record.currents[begin - 1]) if begin else record.before
            currents = record.currents[begin:end]
            name = f"{record.name}[{begin}:{end}]"
            speed = _slope(every, begin, t_s) if t_s else velocity
            found.append(Experiment(name, currents, samples, angle, speed, 0.0, False, late, before=before))
        if len(received):
            angle, velocity = samples[received[-1]].tolist()
    return found


def _slope(angles: Floats, at: int, t_s: float) -> float:
    """Slope of a parabola through the angles around one of them [rad/s]."""
    near = np.arange(max(at - AROUND, 0), min(at + AROUND + 1, len(angles)))
    near = near[np.isfinite(angles[near])]
    if len(near) < 3:
        return 0.0
    return float(np.polyfit((near - at) * t_s, angles[near], 2)[1])


@dataclass(frozen=True, eq=False)
class Point:
    """Values of all unknowns, scaled as in :class:`Problem`."""

    shared: Floats  # Shape (p,)
    starts: Floats  # Angle and velocity at the start of each window, shape (m, 2)

    def all(self) -> list[Floats]:
        """The unknowns of each window's problem."""
        return [np.concatenate([self.shared, start]) for start in self.starts]


def begun_at(cut: Sequence[Problem], shared: Floats) -> Point:
    """Each window at the start where it was seen."""
    return Point(shared, np.array([window.nominal()[-len(START) :] for window in cut]))


def weights_of(cut: Sequence[Problem], at: Point) -> list[Floats]:
    """Inverse standard deviations of the samples of each window, zero where they do not count, shape (n, 2)."""
    return [window.weights(z)[0] for window, z in zip(cut, at.all(), strict=True)]


def linearised(cut: Sequence[Problem], at: Point, weights: Sequence[Floats]) -> list[Window]:
    """Contribution of each window at a point."""
    found = []
    for window, z, root in zip(cut, at.all(), weights, strict=True):
        said = window.predict(z, 0)
        counts = root.ravel() > 0.0
        errors = (np.nan_to_num(window.records[0].samples - said.shown) * root).ravel()[counts]
        rows = (said.sensitivities * root[:, None]).transpose(0, 2, 1).reshape(-1, len(z))[counts] / window.scale(z)
        shared, own = rows[:, : -len(START)], rows[:, -len(START) :]
        lengths = np.linalg.norm(own, axis=0)
        unit = np.where(lengths > 0.0, lengths, 1.0)
        found.append(Window(errors, shared, np.linalg.pinv(own / unit, rcond=_LOST) / unit[:, None], own))
    return found


def settled(cut: Sequence[Problem], at: Point, weights: Sequence[Floats]) -> tuple[Point, list[Window]]:
    """The starts moved to where they fit best, the shared unknowns as they are; and the windows there."""
    found = [
        _settled(window, at.shared, start, root) for window, start, root in zip(cut, at.starts, weights, strict=True)
    ]
    return Point(at.shared, np.array([start for start, _ in found])), [window for _, window in found]


def _settled(problem: Problem, shared: Floats, start: Floats, weights: Floats) -> tuple[Floats, Window]:
    """Start of one window after damped Gauss-Newton steps, none of which raises the squares.

    Near rest a step may be far too long: what friction holds hardly tells its start.
    """

    def at(start: Floats) -> Window:
        return linearised([problem], Point(shared, start[None]), [weights])[0]

    window = at(start)
    for _ in range(SETTLED):
        step = window.inverse @ window.errors
        for _ in range(HALVINGS):
            trial = at(start + step)
            if trial.cost <= window.cost:
                break
            step = 0.5 * step
        else:
            break
        gained = window.cost - trial.cost
        start, window = start + step, trial
        if gained <= STILL * window.cost:
            break
    return start, window


def search(
    problem: Problem, cut: Sequence[Problem], begun: Point, weights: Sequence[Floats], evaluations: int = EVALUATIONS
) -> tuple[Point, End]:
    """One local search over what the windows share, again from better starts as long as there are any.

    With fewer ``evaluations`` than ``EVALUATIONS`` the search is only begun.
    """
    at, end = _descended(problem, cut, begun, weights, evaluations)
    total = end.evaluations
    for _ in range(RESTARTS if evaluations >= EVALUATIONS else 0):
        again, lower = _descended(problem, cut, restarted(cut, at, begun, weights), weights, evaluations)
        total += lower.evaluations
        better = lower.cost < (1.0 - RESTARTED) * end.cost
        if lower.cost < end.cost:
            at, end = again, lower
        if not better:
            break
    origin = tuple((begun.shared * problem.units).tolist())
    return at, replace(end, start=origin, evaluations=total)


def _descended(
    problem: Problem, cut: Sequence[Problem], begun: Point, weights: Sequence[Floats], evaluations: int
) -> tuple[Point, End]:
    at = begun

    def residuals(shared: Floats) -> tuple[Floats, Floats]:
        nonlocal at
        at, windows = settled(cut, replace(at, shared=shared), weights)
        parts = [window.projected() for window in windows]
        return np.concatenate([errors for errors, _ in parts]), -np.concatenate([columns for _, columns in parts])

    shared, end = minimise(problem, begun.shared, residuals, evaluations)
    return settled(cut, replace(at, shared=shared), weights)[0], end


def restarted(cut: Sequence[Problem], at: Point, begun: Point, weights: Sequence[Floats]) -> Point:
    """Each window at the better one of its start and of where it was seen to start, parameters unchanged.

    A window may have come to stick, or to move where the machine stuck, and nothing at its own start leads it back.
    """
    fresh, windows = settled(cut, Point(at.shared, begun.starts), weights)
    better = np.array([new.cost < old.cost for old, new in zip(linearised(cut, at, weights), windows, strict=True)])
    return Point(at.shared, np.where(better[:, None], fresh.starts, at.starts))


def by_windows(information: Floats, scores: Floats, follows: Sequence[bool]) -> Floats:
    """Covariance from the scatter of the windows: H⁻¹ (Σ g g^T) H⁻¹, neighbours counted together, shape (p, p).

    From the information H and the scores g of each window, shape (m, p); ``follows`` is True for a window that begins
    where the one before it ends. The diagonal is inf for unknowns that the windows do not identify.
    """
    m, p = scores.shape
    meat = scatter(scores, follows)
    spectrum = Spectrum(information)
    inverse = spectrum.inverse()
    inverse[spectrum.lost, spectrum.lost] = 0.0
    result: Floats = inverse @ meat @ inverse * (m / max(m - p, 1))
    result[spectrum.lost, spectrum.lost] = math.inf
    return result


def scatter(scores: Floats, follows: Sequence[bool]) -> Floats:
    """Σ g g^T of scores, those of neighbouring windows counted together (Newey and West 1987), shape (p, p).

    The scores say themselves how far they follow from each other (Andrews, Econometrica 59, 1991).
    """
    m = len(scores)
    meat: Floats = scores.T @ scores
    run = np.cumsum(~np.asarray(follows, dtype=np.bool_))
    next_to = run[1:] == run[:-1]
    squares = (scores**2).sum(axis=0)
    follow = (scores[1:][next_to] * scores[:-1][next_to]).sum(axis=0) / np.where(squares > 0.0, squares, 1.0)
    follow = np.clip(follow, -FOLLOWS, FOLLOWS)
    reach = math.floor(1.1447 * (float(np.max(4.0 * follow**2 / (1.0 - follow**2) ** 2)) * m) ** (1.0 / 3.0))
    reach = max(reach, math.floor(4.0 * (m / 100.0) ** (2.0 / 9.0)))
    for lag in range(1, min(reach, m - 1) + 1):
        together = run[lag:] == run[:-lag]
        cross = scores[lag:][together].T @ scores[:-lag][together]
        meat = meat + (1.0 - lag / (reach + 1.0)) * (cross + cross.T)
    return meat


def span_of(window: Problem) -> tuple[str, int, int]:
    """Name of the record that a window is of, and its first period and the one after its last."""
    name, _, span = window.records[0].name.removesuffix("]").rpartition("[")
    begin, end = map(int, span.split(":"))
    return name, begin, end


def follows_on(cut: Sequence[Problem]) -> list[bool]:
    """True for each window that begins where the one before it ends."""
    spans = [span_of(window) for window in cut]
    return [False, *(a[0] == b[0] and a[2] == b[1] for a, b in pairwise(spans))]
