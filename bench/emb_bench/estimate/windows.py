"""Output error over windows by multiple shooting.

A machine without a spring does not return to a rest position: an error of the friction accumulates over a recording,
and the simulation diverges within seconds. So a recording is divided into windows, with the angle and velocity at the
start of each window as unknowns: multiple shooting (Bock, Numerical treatment of inverse problems in chemical reaction
kinetics, 1981). The search is over the shared parameters, each start at its optimum (variable projection: Golub and
Pereyra 1973, with Kaufman's Jacobian).

**Uncertainty.** Unmodelled disturbances such as ripple make the residuals of a window dependent. So the window is the
unit of the covariance H⁻¹ (Σ g g^T) H⁻¹ with the scores g of the windows (cluster-robust: Liang and Zeger, Biometrika
73, 1986), with the correlation of neighbours (Newey and West 1987). An error common to all windows does not show in
their scatter. But the estimate of a wrong model depends on the length of the windows, that of the right one does not
(Hausman, Econometrica 46, 1978): the difference to an estimate with another length is added as a deviation.

In short windows a disturbance has little effect; long ones are less sensitive to the sensors' noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import OF_AN_EXPERIMENT
from emb_bench.compiled import compiled
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.method import Method
from emb_bench.estimate.model_validation import validate
from emb_bench.estimate.output_error import start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import FEWEST_WINDOWS, End, ModelValidation
from emb_bench.estimate.search import EVALUATIONS, minimise
from emb_bench.experiment.experiment import Booleans, Experiment, Integers
from emb_bench.experiment.simulate import Trajectory, simulate_apart
from emb_bench.information.identifiability import Spectrum
from emb_bench.sim.open_loop import march
from emb_runtime.errors import UsageError

SHORTEST = 10  # Fewest samples of a window
AROUND = 8  # Samples on each side of a window's start for its velocity, with an observer
RESTARTS = 4  # Most restarts of a search from better starts of the windows
RESTARTED = 1e-3  # Relative fall of the cost below which there is no further restart
HALVINGS = 12  # Most halvings of a step of a window's start
STILL = 1e-9  # Relative fall of a window's cost below which its start has converged
SETTLED = 4  # Most Gauss-Newton steps of the starts for given parameters
FOLLOWS = 0.97  # Largest correlation of neighbouring windows' scores
START = ("x1_0", "x2_0")
_LOST = 1e-9  # share of a start's largest singular value below which the samples do not tell it

JUDGED = 5000  # Samples of the windows in the model validation: an hour has millions, which tell no more
OTHER = 4.0  # Ratio of the lengths of the windows in two estimates whose difference is counted
REFINED = 2  # Searches that are completed: those with the least cost after ``SHORT`` simulations
BATCH = 20_000  # Samples of windows that are simulated together
SHORT = 6  # Simulations of a preliminary search


class Windows(Method):
    """Output error of all windows, for the shared parameters."""

    def solve(self, problem: Problem) -> Estimate:
        """As :class:`Method`."""
        if any(unknown.experiment is not None for unknown in problem.unknowns):
            names = ", ".join(OF_AN_EXPERIMENT)
            raise UsageError(f"method windows: each window has a start of its own: leave out {names}")
        points = start_points(problem, self.starts, self.seed)
        cut = Cut(problem, points[0])
        searches = cut.searches(points)
        at = searches[0][0]
        return _finished(cut, at, tuple(end for _, end in searches), _other(problem, at.shared) - at.shared)


class Point(NamedTuple):
    """Values of all unknowns, in the coordinates of :class:`Problem`."""

    shared: Floats  # Shape (p,)
    starts: Floats  # Angle and velocity at the start of each window, shape (m, 2)


class Rows(NamedTuple):
    """Linearised windows at a point.

    The m rows of a window are its samples; rows without a sample are zero.
    """

    errors: Floats  # Of the samples in standard deviations, shape (w, m)
    shared: Floats  # Derivatives of the prediction to the shared unknowns, shape (w, m, p)
    local: Floats  # Derivatives to the starts, shape (w, m, 2)
    inverse: Floats  # Pseudo-inverses of ``local``, shape (w, 2, m)

    @property
    def costs(self) -> Floats:
        """Weighted sum of squares of each."""
        costs: Floats = np.einsum("wm,wm->w", self.errors, self.errors)
        return costs

    @property
    def steps(self) -> Floats:
        """Gauss-Newton step of each start, shape (w, 2)."""
        return _times(self.inverse, self.errors)

    def projected(self) -> tuple[Floats, Floats]:
        """Errors and derivatives with the starts projected out."""
        return self.errors - _times(self.local, self.steps), self.shared - self.local @ (self.inverse @ self.shared)

    def at(self, index: Integers | Booleans) -> Rows:
        """The rows of some windows."""
        return Rows(*(rows[index] for rows in self))

    def put(self, index: Integers | Booleans, others: Rows) -> None:
        """Replace the rows of some windows."""
        for rows, new in zip(self, others, strict=True):
            rows[index] = new


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """Product of each matrix with its vector."""
    products: Floats = (matrices @ vectors[:, :, None])[:, :, 0]
    return products


class Cut:
    """The experiments of a problem in windows, weighted at shared unknowns and measured starts."""

    def __init__(self, problem: Problem, shared: Floats) -> None:
        length = max(round(problem.window / problem.bench.timing.sample_time), SHORTEST)
        question = replace(problem.question, nuisances=(*problem.question.nuisances, *START))
        self.problem = problem
        self.spans = [span for i in range(len(problem.experiments)) for span in _spans(problem, i, length)]
        if not self.spans:
            raise UsageError(f"method windows: no window of {length} periods has {SHORTEST} samples: expected longer")
        self.windows = [
            replace(problem, question=question, experiments=(_window(problem, span),)) for span in self.spans
        ]
        self.begun = Point(shared, np.array([window.nominal()[-len(START) :] for window in self.windows]))
        self.weights = [
            window.weights(np.append(shared, start))[0]
            for window, start in zip(self.windows, self.begun.starts, strict=True)
        ]
        size = max(BATCH // length, 1)
        self.batches = [np.arange(i, min(i + size, len(self.windows))) for i in range(0, len(self.windows), size)]
        self.inside = np.arange(length) < np.array([[end - begin] for _, begin, end in self.spans])
        self.outputs = [n for n in range(2) if any(root[:, n].any() for root in self.weights)]
        self.roots = self._below(self.inside, np.concatenate(self.weights))
        self.samples = self._below(self.inside, np.concatenate([w.experiments[0].samples for w in self.windows]))

    def searches(self, values: Sequence[Floats]) -> list[tuple[Point, End]]:
        """Searches from shared unknowns, best first; most of several are preliminary only."""
        p = len(self.problem.unknowns)
        if len(self.windows) < FEWEST_WINDOWS * p:
            raise UsageError(
                f"method windows: {len(self.windows)} windows of {self.problem.window:g} s are too few for {p} "
                f"unknowns, expected at least {FEWEST_WINDOWS * p}: shorter windows (--window) or a longer recording"
            )
        if len(values) > REFINED:
            costs = [self.search(z, SHORT)[1].cost for z in values]
            values = [values[i] for i in np.argsort(costs, kind="stable")[:REFINED]]
        return sorted((self.search(z) for z in values), key=lambda pair: pair[1].cost)

    def search(self, shared: Floats, evaluations: int = EVALUATIONS) -> tuple[Point, End]:
        """One local search over the shared unknowns, with restarts from better starts of the windows.

        With fewer ``evaluations`` than ``EVALUATIONS`` there is no restart.
        """
        at, end = self._descended(self.begun._replace(shared=shared), evaluations)
        total = end.evaluations
        for _ in range(RESTARTS if evaluations >= EVALUATIONS else 0):
            again, lower = self._descended(self.restarted(at), evaluations)
            total += lower.evaluations
            better = lower.cost < (1.0 - RESTARTED) * end.cost
            if lower.cost < end.cost:
                at, end = again, lower
            if not better:
                break
        return at, replace(end, start=shared, evaluations=total)

    def _descended(self, begun: Point, evaluations: int) -> tuple[Point, End]:
        at = begun

        def residuals(shared: Floats) -> tuple[Floats, Floats]:
            nonlocal at
            at, found = self.settled(at._replace(shared=shared))
            parts = [
                np.concatenate([columns, errors[:, :, None]], axis=2) for errors, columns in map(Rows.projected, found)
            ]
            # The search needs only the normal equations: the triangular factor has the same ones, in a few rows.
            rows: Floats = np.concatenate([part.reshape(-1, part.shape[2]) for part in parts])
            root: Floats = np.asarray(np.linalg.qr(rows, "r"))
            return root[:, -1], -root[:, :-1]

        end = minimise(self.problem, begun.shared, residuals, evaluations)
        return self.settled(at._replace(shared=end.z))[0], end

    def restarted(self, at: Point) -> Point:
        """Each window at the better one of its current and its measured start, parameters unchanged.

        A window may stick where the machine moved, or move where it stuck; there the cost has no gradient back.
        """
        fresh, found = self.settled(Point(at.shared, self.begun.starts))
        pairs = zip(found, self.linearised(at), strict=True)
        better = np.concatenate([new.costs < old.costs for new, old in pairs])
        return Point(at.shared, np.where(better[:, None], fresh.starts, at.starts))

    def linearised(self, at: Point) -> list[Rows]:
        """Contributions of the windows at a point, in batches."""
        return [self._linearised(batch, at.shared, at.starts[batch]) for batch in self.batches]

    def _linearised(self, batch: Integers, shared: Floats, starts: Floats) -> Rows:
        predicted, inside, roots = self._predicted(batch, shared, starts), self.inside[batch], self.roots[batch]
        errors = np.nan_to_num(self.samples[batch] - self._below(inside, predicted.samples)) * roots
        rows = self._below(inside, predicted.sensitivities.transpose(0, 2, 1)) * roots[..., None]
        rows = rows.reshape(len(batch), -1, rows.shape[-1])
        local = rows[:, :, -len(START) :]
        lengths = np.linalg.norm(local, axis=1, keepdims=True)
        unit = np.where(lengths > 0.0, lengths, 1.0)
        inverse = np.linalg.pinv(local / unit, rcond=_LOST) / unit.transpose(0, 2, 1)
        return Rows(errors.reshape(len(batch), -1), rows[:, :, : -len(START)], local, inverse)

    def _predicted(self, batch: Integers, shared: Floats, starts: Floats) -> Trajectory:
        """Predicts windows from their starts, samples stacked."""
        one, z = self.windows[0], np.append(shared, starts[0])
        plant = replace(one.plant, mechanics=one.mechanics(z))
        parts = [self.windows[i].experiments[0] for i in batch]
        t_s = one.bench.timing.sample_time
        return simulate_apart(plant, one.at(z, 0), parts, starts, t_s, one.names(0), compiled(march))

    def _below(self, inside: Booleans, rows: Floats) -> Floats:
        """Stacked rows split by window, outputs that count only: shape (w, m, outputs, ...)."""
        apart = np.zeros((*inside.shape, len(self.outputs), *rows.shape[2:]))
        apart[inside] = rows[:, self.outputs]
        return apart

    def settled(self, at: Point) -> tuple[Point, list[Rows]]:
        """The optimal starts for given shared unknowns, and the windows linearised there."""
        found = [self._settled(batch, at.shared, at.starts[batch]) for batch in self.batches]
        return Point(at.shared, np.concatenate([starts for starts, _ in found])), [rows for _, rows in found]

    def _settled(self, batch: Integers, shared: Floats, starts: Floats) -> tuple[Floats, Rows]:
        """Starts of windows after damped Gauss-Newton steps, none of which raises the cost of a window.

        Near rest a step may be far too long: the samples of a sticking brake hardly depend on its start.
        """
        rows, going = self._linearised(batch, shared, starts), np.arange(len(batch))
        for _ in range(SETTLED):
            trying, steps, costs, gained = going, rows.at(going).steps, rows.costs, np.zeros(len(batch))
            for _ in range(HALVINGS):
                trial = self._linearised(batch[trying], shared, starts[trying] + steps)
                lower = trial.costs <= costs[trying]
                moved = trying[lower]
                starts[moved] += steps[lower]
                rows.put(moved, trial.at(lower))
                gained[moved] = costs[moved] - trial.costs[lower]
                trying, steps = trying[~lower], 0.5 * steps[~lower]
                if not len(trying):
                    break
            going = going[gained[going] > STILL * costs[going]]
            if not len(going):
                break
        return starts, rows

    def residuals(self, at: Point) -> Iterator[tuple[Span, Floats, Floats]]:
        """Span, errors of the samples [rad, rad/s] and their weights of each window, shapes (n, 2)."""
        predicted = [self._predicted(batch, at.shared, at.starts[batch]).samples for batch in self.batches]
        ends = np.cumsum([end - begin for _, begin, end in self.spans])
        apart = np.split(np.concatenate(predicted), ends[:-1])
        for window, samples, span, root in zip(self.windows, apart, self.spans, self.weights, strict=True):
            yield span, window.experiments[0].samples - samples, root

    @property
    def follows(self) -> list[bool]:
        """True for each window that begins where the one before it ends."""
        return [False, *(a[0] == b[0] and a[2] == b[1] for a, b in pairwise(self.spans))]


def _other(problem: Problem, shared: Floats) -> Floats:
    """The shared unknowns from windows of another length: longer, or shorter if there were too few."""
    seconds = sum(experiment.periods for experiment in problem.experiments) * problem.bench.timing.sample_time
    length = problem.window * OTHER
    if FEWEST_WINDOWS * len(shared) * length > seconds:
        length = problem.window / OTHER
    return Cut(replace(problem, question=replace(problem.question, window=length)), shared).search(shared)[0].shared


def predict_windows(problem: Problem, values: Floats) -> tuple[float, float, int]:
    """Prediction of the windows of experiments with parameters in SI units, each from the start that fits it best.

    Returns:
        Root mean square of the angle's error [rad], χ² of the samples, and its degrees of freedom.
    """
    cut = Cut(problem, problem.coordinates(values))
    at = cut.restarted(cut.settled(cut.begun)[0])
    squares, samples, chi2, freedom = 0.0, 0, 0.0, 0
    for _, found, root in cut.residuals(at):
        measured = np.isfinite(found).all(axis=1)
        errors = found[measured]
        squares, samples = squares + float(errors[:, 0] @ errors[:, 0]), samples + len(errors)
        chi2 += float(np.sum((errors * root[measured]) ** 2))
        freedom += int((root > 0.0).sum()) - len(START)
    return math.sqrt(squares / samples), chi2, freedom


def _sums(found: Sequence[Rows]) -> tuple[Floats, Floats]:
    """Information of the shared unknowns, and the score of each window."""
    parts = [rows.projected() for rows in found]
    information = np.sum([np.einsum("wmp,wmq->pq", columns, columns) for _, columns in parts], axis=0)
    scores = [np.einsum("wmp,wm->wp", columns, errors) for errors, columns in parts]
    return information, np.concatenate(scores)


def _finished(cut: Cut, at: Point, ends: tuple[End, ...], moved: Floats) -> Estimate:
    """Estimate of the shared unknowns with its validation; ``moved`` is the change by another length of windows."""
    problem = cut.problem
    information, scores = _sums(cut.linearised(at))
    covariance = by_windows(information, scores, cut.follows)
    residuals = tuple(np.full(experiment.samples.shape, np.nan) for experiment in problem.experiments)
    for (number, begin, end), errors, root in cut.residuals(at):
        residuals[number][begin:end] = np.where(root > 0.0, errors * root, np.nan)
    return Estimate(
        problem.solved(at.shared),
        at.shared,
        information=information,
        samples=information,
        prior=None,
        sandwich=covariance + np.outer(moved, moved),
        validation=_validated(cut, at),
        ends=ends,
        residuals=residuals,
        method="windows",
        windows=len(cut.windows),
    )


def _validated(cut: Cut, at: Point) -> ModelValidation:
    """Tests of the model on windows spread over the experiments."""
    count = len(cut.windows)
    few_enough = max(JUDGED // len(cut.windows[0].experiments[0].currents), 2)
    index = sorted({round(k) for k in np.linspace(0, count - 1, min(count, few_enough)).tolist()})
    few = replace(cut.windows[0], experiments=tuple(cut.windows[i].experiments[0] for i in index))
    z, roots = np.concatenate([at.shared, at.starts[index].T.ravel()]), [cut.weights[i] for i in index]
    return validate(few, z, roots, few.jacobian(z, roots))


Span = tuple[int, int, int]
"""Number of an experiment, first period of a window in it, and the one after its last."""


def _spans(problem: Problem, number: int, length: int) -> Iterator[Span]:
    """The windows of an experiment that have enough samples."""
    experiment = problem.experiments[number]
    for begin in range(0, experiment.periods, length):
        end = min(begin + length, experiment.periods)
        enough = experiment.measured[begin:end].sum() >= min(SHORTEST, length)
        if enough and (end - begin) * 2 >= length:
            yield number, begin, end


def _window(problem: Problem, span: Span) -> Experiment:
    """One window; after lost samples it starts from the last received one.

    An observer's velocity lags: a window starts with the slope of a parabola through the angles around its start
    instead. With too low a velocity it may stick where the machine moved, and the cost would have no gradient.
    """
    number, begin, end = span
    experiment = problem.experiments[number]
    received = np.flatnonzero(experiment.measured[:begin])
    angle, velocity = (
        experiment.samples[received[-1]].tolist() if len(received) else (experiment.angle, experiment.velocity)
    )
    if problem.plant.instruments.observer_bandwidth > 0.0:
        angles = np.concatenate([[experiment.angle], experiment.samples[:, 0]])
        velocity = _slope(angles, begin, problem.bench.timing.sample_time)
    return replace(experiment.part(begin, end).from_state(angle, velocity), assumed=None)


def _slope(angles: Floats, at: int, t_s: float) -> float:
    """Slope of a parabola through the angles around one of them [rad/s]."""
    near = np.arange(max(at - AROUND, 0), min(at + AROUND + 1, len(angles)))
    near = near[np.isfinite(angles[near])]
    if len(near) < 3:
        return 0.0
    return float(np.polyfit((near - at) * t_s, angles[near], 2)[1])


def by_windows(information: Floats, scores: Floats, follows: Sequence[bool]) -> Floats:
    """Cluster-robust covariance H⁻¹ (Σ g g^T) H⁻¹, with the correlation of neighbouring windows, shape (p, p).

    From the information H and the scores g of each window, shape (m, p); ``follows`` is True for a window that begins
    where the one before it ends. The diagonal is inf for unknowns that the windows do not identify.
    """
    m, p = scores.shape
    covariance: Floats = Spectrum(information).sandwich(scatter(scores, follows)) * (m / max(m - p, 1))
    return covariance


def scatter(scores: Floats, follows: Sequence[bool]) -> Floats:
    """Σ g g^T of scores with the correlation of neighbouring windows (Newey and West 1987), shape (p, p).

    The number of lags follows from the scores' correlation (Andrews, Econometrica 59, 1991).
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
