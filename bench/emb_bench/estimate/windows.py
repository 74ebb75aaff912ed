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

Short windows leave little time for what disturbs the machine, long ones tell it better from the noise of the sensor.
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
from emb_bench.estimate.model_validation import examine
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
AROUND = 8  # Samples on each side of a window's start from which its velocity is taken, where none is measured
RESTARTS = 4  # Most times that a search goes on from better starts of the windows
RESTARTED = 1e-3  # Share of the cost by which a restart has to lower it to be followed by another
HALVINGS = 12  # Most halvings of a step of a window's start
STILL = 1e-9  # Share of a window's squares below which a step of its start ends the steps
SETTLED = 4  # Steps in which the starts of windows settle for given parameters
FOLLOWS = 0.97  # Largest correlation of neighbouring windows' scores that is reckoned with
START = ("x1_0", "x2_0")
_LOST = 1e-9  # share of a start's largest singular value below which the samples do not tell it

JUDGED = 5000  # Samples, in whole windows, that the model is validated on: an hour has millions, and these see as much
OTHER = 4.0  # Ratio of the lengths of the windows in two estimates whose difference is counted
REFINED = 2  # Searches that are carried to their ends: those whose first steps led lowest
BATCH = 20_000  # Samples of windows that are simulated together
SHORT = 6  # Simulations of a search that is only begun


class Windows(Method):
    """Output error of all windows: the parameters that they share."""

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
    """Some windows at a point: what they add to the normal equations once their starts are eliminated.

    The m rows of a window are its samples; those that do not count, or that a shorter window lacks, are zero.
    """

    errors: Floats  # Of the samples in standard deviations, shape (w, m)
    shared: Floats  # Derivatives of what is shown to the shared unknowns, shape (w, m, p)
    own: Floats  # Derivatives to the starts, shape (w, m, 2)
    inverse: Floats  # Pseudo-inverses of those, shape (w, 2, m)

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
        """Errors and derivatives beside what the starts take up."""
        return self.errors - _times(self.own, self.steps), self.shared - self.own @ (self.inverse @ self.shared)

    def at(self, chosen: Integers | Booleans) -> Rows:
        """Some of them."""
        return Rows(*(rows[chosen] for rows in self))

    def put(self, chosen: Integers | Booleans, others: Rows) -> None:
        """Put others in the place of some."""
        for rows, new in zip(self, others, strict=True):
            rows[chosen] = new


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """Product of each matrix with its vector."""
    products: Floats = (matrices @ vectors[:, :, None])[:, :, 0]
    return products


class Cut:
    """The experiments of a problem in windows, weighted at shared unknowns and at the starts where they were seen."""

    def __init__(self, problem: Problem, shared: Floats) -> None:
        length = max(round(problem.window / problem.bench.timing.sample_time), SHORTEST)
        asked = replace(problem.asked, nuisances=(*problem.asked.nuisances, *START))
        self.problem = problem
        self.spans = [span for i in range(len(problem.experiments)) for span in _spans(problem, i, length)]
        if not self.spans:
            raise UsageError(f"method windows: no window of {length} periods has {SHORTEST} samples: expected longer")
        self.windows = [replace(problem, asked=asked, experiments=(_window(problem, span),)) for span in self.spans]
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
        """Searches from shared unknowns, best first; of several most are only begun."""
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
        """One local search over what the windows share, again from better starts as long as there are any.

        With fewer ``evaluations`` than ``EVALUATIONS`` the search is only begun.
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
            # A search asks for the squares alone: their triangular root says the same in a few rows.
            rows: Floats = np.concatenate([part.reshape(-1, part.shape[2]) for part in parts])
            root: Floats = np.asarray(np.linalg.qr(rows, "r"))
            return root[:, -1], -root[:, :-1]

        end = minimise(self.problem, begun.shared, residuals, evaluations)
        return self.settled(at._replace(shared=end.z))[0], end

    def restarted(self, at: Point) -> Point:
        """Each window at the better one of its start and of where it was seen to start, parameters unchanged.

        A window may have come to stick, or to move where the machine stuck, and nothing at its own start leads it back.
        """
        fresh, found = self.settled(Point(at.shared, self.begun.starts))
        pairs = zip(found, self.linearised(at), strict=True)
        better = np.concatenate([new.costs < old.costs for new, old in pairs])
        return Point(at.shared, np.where(better[:, None], fresh.starts, at.starts))

    def linearised(self, at: Point) -> list[Rows]:
        """Contributions of the windows at a point, in batches."""
        return [self._linearised(chosen, at.shared, at.starts[chosen]) for chosen in self.batches]

    def _linearised(self, chosen: Integers, shared: Floats, starts: Floats) -> Rows:
        said, inside, roots = self._predicted(chosen, shared, starts), self.inside[chosen], self.roots[chosen]
        errors = np.nan_to_num(self.samples[chosen] - self._below(inside, said.samples)) * roots
        rows = self._below(inside, said.sensitivities.transpose(0, 2, 1)) * roots[..., None]
        rows = rows.reshape(len(chosen), -1, rows.shape[-1])
        own = rows[:, :, -len(START) :]
        lengths = np.linalg.norm(own, axis=1, keepdims=True)
        unit = np.where(lengths > 0.0, lengths, 1.0)
        inverse = np.linalg.pinv(own / unit, rcond=_LOST) / unit.transpose(0, 2, 1)
        return Rows(errors.reshape(len(chosen), -1), rows[:, :, : -len(START)], own, inverse)

    def _predicted(self, chosen: Integers, shared: Floats, starts: Floats) -> Trajectory:
        """Predicts windows from their starts, the samples of one below those of the other."""
        one, z = self.windows[0], np.append(shared, starts[0])
        plant = replace(one.plant, mechanics=one.mechanics(z))
        parts = [self.windows[i].experiments[0] for i in chosen]
        t_s = one.bench.timing.sample_time
        return simulate_apart(plant, one.at(z, 0), parts, starts, t_s, one.names(0), compiled(march))

    def _below(self, inside: Booleans, rows: Floats) -> Floats:
        """Rows of outputs that count, one window below the other, apart: shape (w, m, outputs, ...)."""
        apart = np.zeros((*inside.shape, len(self.outputs), *rows.shape[2:]))
        apart[inside] = rows[:, self.outputs]
        return apart

    def settled(self, at: Point) -> tuple[Point, list[Rows]]:
        """The starts moved to where they fit best, the shared unknowns as they are; and the windows there."""
        found = [self._settled(chosen, at.shared, at.starts[chosen]) for chosen in self.batches]
        return Point(at.shared, np.concatenate([starts for starts, _ in found])), [rows for _, rows in found]

    def _settled(self, chosen: Integers, shared: Floats, starts: Floats) -> tuple[Floats, Rows]:
        """Starts of windows after damped Gauss-Newton steps, none of which raises the squares of a window.

        Near rest a step may be far too long: the samples of a brake that friction holds hardly depend on its start.
        """
        rows, going = self._linearised(chosen, shared, starts), np.arange(len(chosen))
        for _ in range(SETTLED):
            left, steps, costs, gained = going, rows.at(going).steps, rows.costs, np.zeros(len(chosen))
            for _ in range(HALVINGS):
                trial = self._linearised(chosen[left], shared, starts[left] + steps)
                lower = trial.costs <= costs[left]
                moved = left[lower]
                starts[moved] += steps[lower]
                rows.put(moved, trial.at(lower))
                gained[moved] = costs[moved] - trial.costs[lower]
                left, steps = left[~lower], 0.5 * steps[~lower]
                if not len(left):
                    break
            going = going[gained[going] > STILL * costs[going]]
            if not len(going):
                break
        return starts, rows

    def residuals(self, at: Point) -> Iterator[tuple[Span, Floats, Floats]]:
        """Span, errors of the samples [rad, rad/s] and their weights of each window, shapes (n, 2)."""
        shown = [self._predicted(chosen, at.shared, at.starts[chosen]).samples for chosen in self.batches]
        ends = np.cumsum([end - begin for _, begin, end in self.spans])
        apart = np.split(np.concatenate(shown), ends[:-1])
        for window, said, span, root in zip(self.windows, apart, self.spans, self.weights, strict=True):
            yield span, window.experiments[0].samples - said, root

    @property
    def follows(self) -> list[bool]:
        """True for each window that begins where the one before it ends."""
        return [False, *(a[0] == b[0] and a[2] == b[1] for a, b in pairwise(self.spans))]


def _other(problem: Problem, shared: Floats) -> Floats:
    """The shared unknowns from windows of another length: longer ones, or shorter where those would be too few."""
    seconds = sum(experiment.periods for experiment in problem.experiments) * problem.bench.timing.sample_time
    length = problem.window * OTHER
    if FEWEST_WINDOWS * len(shared) * length > seconds:
        length = problem.window / OTHER
    return Cut(replace(problem, asked=replace(problem.asked, window=length)), shared).search(shared)[0].shared


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
    """Estimate of what the windows share, which another length of them moves, with its validation."""
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
    chosen = sorted({round(k) for k in np.linspace(0, count - 1, min(count, few_enough)).tolist()})
    few = replace(cut.windows[0], experiments=tuple(cut.windows[i].experiments[0] for i in chosen))
    z, roots = np.concatenate([at.shared, at.starts[chosen].T.ravel()]), [cut.weights[i] for i in chosen]
    return examine(few, z, roots, few.jacobian(z, roots))


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
    """One window; one that begins with lost samples starts from the last that was received.

    An observer's velocity lags: instead of it a window starts with the slope of a parabola through the angles around
    its start. One that starts too slow may stick where the machine did not, and then nothing says which way to go.
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
    """Covariance from the scatter of the windows: H⁻¹ (Σ g g^T) H⁻¹, neighbours counted together, shape (p, p).

    From the information H and the scores g of each window, shape (m, p); ``follows`` is True for a window that begins
    where the one before it ends. The diagonal is inf for unknowns that the windows do not identify.
    """
    m, p = scores.shape
    covariance: Floats = Spectrum(information).sandwich(scatter(scores, follows)) * (m / max(m - p, 1))
    return covariance


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
