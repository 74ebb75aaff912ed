"""Multiple shooting: records in windows, each from a start of its own, and a search for what all windows share.

What all windows share is left with a small system: the normal equations are block-arrow, and the starts are eliminated
window by window (Bock, Numerical treatment of inverse problems in chemical reaction kinetics, 1981; Golub and Pereyra's
projection for the linear step). A step costs as much as one simulation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import WINDOW, End
from emb_bench.experiment.experiment import Experiment
from emb_bench.information.identifiability import Spectrum
from emb_runtime.errors import UsageError

SHORTEST = 10  # Fewest samples of a window
AROUND = 8  # Samples on each side of a window's start from which its velocity is taken, where none is measured
ITERATIONS = 60  # Most steps of a search
RESTARTS = 4  # Most times that a search goes on from better starts of the windows
RESTARTED = 1e-3  # Share of the cost by which a restart has to lower it to be followed by another
HALVINGS = 12  # Most halvings of a step of a window's start
SETTLED = 4  # Steps in which the starts of windows settle for given parameters
CONVERGED = 1e-6  # Share of the cost by which a last step lowers it, at most
FOLLOWS = 0.97  # Largest correlation of neighbouring windows' scores that is reckoned with
START = ("x1_0", "x2_0")
HELD, LINEAR = "held", "linear"  # Courses of a command from its stamp to the next one
_LOST = 1e-9  # share of a start's largest singular value below which the samples do not tell it
_DAMPING = 1e-3
_MOST_DAMPING = 1e12


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


def _cost(windows: Sequence[Window]) -> float:
    return math.fsum(window.cost for window in windows)


def _moved(at: Point, shared: Floats, windows: Sequence[Window]) -> Point:
    """The shared unknowns moved, and each start to where it fits best then, to first order."""
    change = shared - at.shared
    steps = [window.inverse @ (window.errors - window.shared @ change) for window in windows]
    return Point(shared, at.starts + np.array(steps))


def settled(cut: Sequence[Problem], at: Point, weights: Sequence[Floats]) -> Point:
    """The starts moved to where they fit best, the shared unknowns as they are."""
    starts = [
        _settled(window, at.shared, start, root) for window, start, root in zip(cut, at.starts, weights, strict=True)
    ]
    return Point(at.shared, np.array(starts))


def _settled(problem: Problem, shared: Floats, start: Floats, weights: Floats) -> Floats:
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
        start, window = start + step, trial
    return start


def search(cut: Sequence[Problem], begun: Point, weights: Sequence[Floats]) -> tuple[Point, End]:
    """One local search, again from better starts of the windows as long as there are any."""
    at, end = descended(cut, begun, weights)
    evaluations = end.evaluations
    for _ in range(RESTARTS):
        again, lower = descended(cut, restarted(cut, at, begun, weights), weights)
        evaluations += lower.evaluations
        better = lower.cost < (1.0 - RESTARTED) * end.cost
        if lower.cost < end.cost:
            at, end = again, lower
        if not better:
            break
    origin = tuple((begun.shared * _units(cut)).tolist())
    return at, replace(end, start=origin, evaluations=evaluations)


def restarted(cut: Sequence[Problem], at: Point, begun: Point, weights: Sequence[Floats]) -> Point:
    """Each window at the better one of its start and of where it was seen to start, parameters unchanged.

    A window may have come to stick, or to move where the machine stuck, and nothing at its own start leads it back.
    """
    fresh = settled(cut, Point(at.shared, begun.starts), weights)
    pairs = zip(linearised(cut, at, weights), linearised(cut, fresh, weights), strict=True)
    better = np.array([new.cost < old.cost for old, new in pairs])
    return Point(at.shared, np.where(better[:, None], fresh.starts, at.starts))


def descended(
    cut: Sequence[Problem], begun: Point, weights: Sequence[Floats], most: int = ITERATIONS
) -> tuple[Point, End]:
    """One descent by Levenberg and Marquardt, damped in what the windows share."""
    at, damping, converged, evaluations, p = begun, _DAMPING, False, 1, len(begun.shared)
    low, high = (bounds[:p] for bounds in cut[0].bounds)
    windows = linearised(cut, at, weights)
    cost = _cost(windows)
    while evaluations < most and not converged:
        normal, score = np.zeros((p, p)), np.zeros(p)
        for window in windows:
            errors, columns = window.projected()
            normal += columns.T @ columns
            score += columns.T @ errors
        diagonal = np.diag(normal)
        shift = np.diag(np.where(diagonal > 0.0, diagonal, 1.0))
        lower = math.inf
        while evaluations < most and damping < _MOST_DAMPING:
            step = np.linalg.solve(normal + damping * shift, score)
            after = _moved(at, np.clip(at.shared + step, low, high), windows)
            trial = linearised(cut, after, weights)
            evaluations += 1
            lower = _cost(trial)
            if lower <= cost:
                break
            damping *= 10.0
        if not lower <= cost:
            break
        converged = cost - lower <= CONVERGED * cost
        at, windows, cost, damping = after, trial, lower, max(damping / 10.0, 1e-12)
    units = _units(cut)
    values, origin = (tuple((z * units).tolist()) for z in (at.shared, begun.shared))
    return at, End(cost, values, origin, converged or damping >= _MOST_DAMPING, evaluations)


def _units(cut: Sequence[Problem]) -> Floats:
    result: Floats = cut[0].units[: -len(START)]
    return result


def by_windows(information: Floats, scores: Floats, follows: Sequence[bool]) -> Floats:
    """Covariance from the scatter of the windows: H⁻¹ (Σ g g^T) H⁻¹, neighbours counted together.

    Args:
        information: H, shape (p, p).
        scores: g of each window, shape (m, p).
        follows: True for a window that begins where the one before it ends, length m.

    Returns:
        Shape (p, p); inf on the diagonal of unknowns that the windows do not identify.
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
