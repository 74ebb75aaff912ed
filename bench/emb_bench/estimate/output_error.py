"""Output-error method: the parameters whose simulated angle and velocity lie nearest to the measured ones.

Errors are weighted by the samples' standard deviations: with white Gaussian noise this is maximum likelihood, and
efficient. The simulation is a plant of the bench at the node's time stamps; its derivatives are the exact
sensitivities, with the jumps at reversals. Lost samples do not count; the currents of periods without report are
unknowns (:meth:`emb_bench.estimate.prediction.Problem.jacobian`). There are local minima: the search begins at several
points, and if no minimum fits, once more by continuation with a filter (:mod:`emb_bench.estimate.search`).

**The start.** An experiment that cannot be distinguished from rest at the origin starts there; any other starts at the
measured angle and velocity. If ``x1_0`` or ``offset`` is unknown, the mean of the samples at rest before the experiment
is one more measurement, of x1_0 + offset. With ``offset`` alone the brake rested at the true origin.

**Outliers.** The error of a sample is compared with the median of its neighbours' errors. A lack of the model changes
the errors of many samples alike, and so the median; a single wrong sample does not. A sample beyond ``OUTLIER`` is
removed, angle and velocity together: a loss that is quadratic up to there and constant beyond. If more samples than the
share ``MOST`` are beyond it, none is removed: then the noise or the model differs from the bench file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from emb_bench.brake.motion import Floats
from emb_bench.estimate.average import average
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.method import Method
from emb_bench.estimate.model_validation import LEVEL, validate
from emb_bench.estimate.prediction import Problem, by_experiment
from emb_bench.estimate.records import OUTLIER, SAME, End, ModelValidation
from emb_bench.estimate.search import EVALUATIONS, continuation, minimise
from emb_bench.information.identifiability import Spectrum
from emb_runtime.errors import UsageError

AROUND = 5  # Neighbours on each side
MOST = 0.01  # Largest share of samples that are removed as outliers
REWEIGHTED = 3  # Updates of the weights along the motion, with a jittering clock
REMOVALS = 3  # Most searches for outliers


@dataclass(frozen=True, eq=False)
class Fit:
    """State of output error: the problem, the weights of its samples, and the ends of local searches, best first."""

    problem: Problem  # Its experiments are without outliers, with the gap unknowns found so far
    weights: list[Floats]
    ends: tuple[End, ...]

    @property
    def best(self) -> End:
        """The end with the least sum of squares."""
        return self.ends[0]

    @property
    def limit(self) -> float:
        """Quantile of χ² that a right model stays below."""
        freedom = self.samples - len(self.best.z)
        return float(special.chdtri(max(freedom, 1), LEVEL / 2.0))

    @property
    def samples(self) -> int:
        """Number of the samples that count, angles and velocities."""
        return sum(int(np.sum(root > 0.0)) for root in self.weights)

    @property
    def explains(self) -> bool:
        """True if the residuals are no larger than the right model's."""
        return self.best.cost <= self.limit

    @property
    def ratio(self) -> float:
        """χ²/n."""
        return self.best.cost / max(self.samples, 1)

    def moved(self, best: End) -> Fit:
        """The fit with another best end, also for the other searches that ended in the same minimum."""
        others = [
            replace(end, z=best.z, cost=best.cost) if end.cost - self.best.cost <= SAME else end
            for end in self.ends[1:]
        ]
        return replace(self, ends=(best, *others))

    def finished(self, validation: ModelValidation | None = None) -> Estimate:
        """Estimate, with its tests if there are none yet."""
        return finished(self.problem, self.best.z, self.weights, self.ends, validation=validation)


class OutputError(Method):
    """Output error from the nominal brake, from random starts, and by continuation."""

    systematic = True

    def solve(self, problem: Problem) -> Estimate:
        """As :class:`Method`, in seven steps."""
        ideal = replace(problem, question=replace(problem.question, systematic={}))
        points = start_points(ideal, self.starts, self.seed)  # 1. Start at the nominal brake, and at random ones.
        fit = searched(ideal, points)  # 2. Search from each, without systematic errors.
        fit = without_outliers(fit, points)  # 3. Remove outliers, and search again.
        full = with_systematic_errors(fit, problem)  # 4. Free the systematic errors, at the best minimum.
        if not full.explains:  # 5. If that does not fit, search another minimum by continuation.
            fit = with_continuation(fit, points[0])
            full = with_systematic_errors(fit, problem)
        full = with_gaps(full)  # 6. Search the gap unknowns as well.
        full = reweighted(full)  # 7. Update the weights along the motion found.
        return full.finished()


def start_points(problem: Problem, starts: int, seed: int) -> list[Floats]:
    """Starts of the searches: the nominal brake, then uniform draws from the prior's or else the shield's ranges."""
    if starts < 1:
        raise UsageError(f"expected at least 1 start, got {starts}")
    bench, first = problem.bench, problem.nominal()
    ranges = problem.question.prior or bench.range_set(bench.shield.ranges)
    rng, points = np.random.default_rng(seed), [first]
    for _ in range(starts - 1):
        drawn, point = rng.random(len(first)), problem.values(first)
        for i, unknown in enumerate(problem.unknowns):
            low, high = getattr(ranges.low, unknown.name, 0.0), getattr(ranges.high, unknown.name, 0.0)
            if low < high:
                point[i] = low + drawn[i] * (high - low)
        points.append(np.clip(problem.coordinates(point), *problem.bounds))
    return points


def search(problem: Problem, start: Floats, weights: Sequence[Floats], evaluations: int = EVALUATIONS) -> End:
    """One local search of the simulation nearest to the samples."""
    return minimise(problem, start, lambda z: problem.jacobian(z, weights), evaluations)


def searched(problem: Problem, points: Sequence[Floats]) -> Fit:
    """A local search from each point, with the weights of the first; then the gap unknowns from the best end."""
    weights = problem.weights(points[0])
    return with_gaps(Fit(problem, weights, tuple(search(problem, point, weights) for point in points)))


def without_outliers(fit: Fit, points: Sequence[Floats]) -> Fit:
    """The searches repeated without outliers, until there are none or too many."""
    for _ in range(REMOVALS):
        residuals = by_experiment(fit.problem.jacobian(fit.best.z, fit.weights)[0], fit.weights)
        found = [outliers(r, root > 0.0) for r, root in zip(residuals, fit.weights, strict=True)]
        if not few(found):
            break
        experiments = tuple(
            experiment.lose(mask) for experiment, mask in zip(fit.problem.experiments, found, strict=True)
        )
        fit = searched(replace(fit.problem, experiments=experiments), points)
    return fit


def outliers(residuals: Floats, counts: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask of the outliers of an experiment, shape (n,).

    From residuals in standard deviations, and a mask of the outputs that count, shape (n, 2).
    """
    found = np.zeros(len(residuals), np.bool_)
    for errors, counted in zip(residuals.T, counts.T, strict=True):
        at = np.flatnonzero(counted)
        if len(at) <= 2 * AROUND:
            continue
        padded = np.pad(errors[at], AROUND, mode="reflect")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * AROUND + 1)
        apart = np.abs(errors[at] - np.median(windows, axis=1))
        usual = 1.4826 * float(np.median(apart))  # of Gaussian noise, its standard deviation
        found[at[apart > OUTLIER * max(usual, 1.0)]] = True
    return found


def few(found: Sequence[NDArray[np.bool_]]) -> bool:
    """Returns True if there are outliers, and few enough to be removed."""
    count = sum(int(mask.sum()) for mask in found)
    return 0 < count <= max(1.0, MOST * sum(len(mask) for mask in found))


def with_systematic_errors(fit: Fit, problem: Problem) -> Fit:
    """The best minimum searched again with the systematic errors of the ``problem``, which ``fit`` lacks."""
    problem = replace(problem, experiments=fit.problem.experiments)
    if not problem.question.default_nuisances:
        return Fit(problem, fit.weights, fit.ends)
    index = [problem.unknowns.index(unknown) for unknown in fit.problem.unknowns]

    def wider(ideal: Floats) -> Floats:
        z = problem.nominal()
        z[index] = ideal
        return z

    ends = tuple(replace(end, z=wider(end.z), start=wider(end.start)) for end in fit.ends)
    full = Fit(problem, fit.weights, ends)
    return full.moved(full.best.then(search(problem, np.clip(full.best.z, *problem.bounds), fit.weights)))


def with_continuation(fit: Fit, point: Floats) -> Fit:
    """The fit with one more search, from the end of a continuation that begins at a point."""
    near = continuation(fit.problem, point)
    return with_gaps(replace(fit, ends=(*fit.ends, near.then(search(fit.problem, near.z, fit.weights)))))


def with_gaps(fit: Fit) -> Fit:
    """The ends best first, the best one refined together with the gap unknowns.

    The other searches linearise the gap unknowns at their values in the experiments. This one simulates each step in z
    and the gap unknowns, and takes only steps that lower the sum of squares. The experiments then have the values
    found.
    """
    problem, fit = fit.problem, replace(fit, ends=tuple(sorted(fit.ends, key=lambda end: end.cost)))
    if not any(experiment.gap_unknowns for experiment in problem.experiments):
        return fit.moved(fit.best)
    count = len(fit.best.z)
    after = minimise(
        problem,
        np.concatenate([fit.best.z, problem.in_gaps()]),
        lambda both: problem.filled(both[count:]).joint(both[:count], fit.weights),
    )
    found = fit.moved(fit.best.then(replace(after, z=after.z[:count])))
    return replace(found, problem=problem.filled(after.z[count:]))


def reweighted(fit: Fit, evaluations: int = EVALUATIONS) -> Fit:
    """The best minimum with weights updated along the motion, with a jittering clock; else the same fit."""
    if fit.problem.plant.instruments.clock_jitter > 0.0:
        for _ in range(REWEIGHTED):
            weights = fit.problem.weights(fit.best.z)
            end = search(fit.problem, fit.best.z, weights, evaluations)
            fit = Fit(fit.problem, weights, (replace(end, start=fit.best.start), *fit.ends[1:]))
    return fit


def finished(
    problem: Problem,
    z: Floats,
    weights: Sequence[Floats],
    ends: tuple[End, ...],
    linearised: Callable[[Floats], tuple[Floats, Floats]] | None = None,
    validation: ModelValidation | None = None,
    **more: Any,
) -> Estimate:
    """Estimate from a fit ``z``: averaged values, information, covariance, validation.

    ``linearised`` computes residuals and Jacobian at a z, by default of the simulation; ``more`` are further fields.
    """
    linearised = linearised or partial(problem.jacobian, weights=weights)
    found = linearised(z)
    every, jacobian = found
    residuals, information = by_experiment(every, weights), jacobian.T @ jacobian
    prior = np.diag((problem.prior[1] * problem.scale(z)) ** 2)
    averaged, near = average(problem, z, found), z
    if averaged.errors:
        near = np.clip(z + averaged.step, *problem.bounds)
        averaged = average(problem, near, linearised(near))
        near = np.clip(near + averaged.step, *problem.bounds)
    added = averaged.added()
    fields = {
        "information": information + added,
        "samples": information - prior,
        "prior": prior if prior.any() else None,
        "sandwich": sandwich(information + added, jacobian, every, [len(r) for r in residuals], added),
        "validation": validation or validate(problem, z, weights, found),
        "ends": ends,
        "residuals": tuple(np.where(root > 0.0, r, np.nan) for r, root in zip(residuals, weights, strict=True)),
    }
    return Estimate(problem.solved(near), near, **fields | more)


def sandwich(
    information: Floats, jacobian: Floats, errors: Floats, lengths: Sequence[int], added: Floats | float = 0.0
) -> Floats:
    """Sandwich covariance of an estimate: H⁻¹ (Σ g g^T) H⁻¹ with the scores g of the samples, shape (p, p).

    Autocorrelated residuals widen it: scores are summed by Newey and West (1987), with Bartlett weights up to 4
    (n/100)^(2/9) lags. Starts, priors and the information ``added`` to that of the Jacobian enter by their information.
    ``errors``, shape (m,), has two residuals for each sample of experiments of these ``lengths``, then those of starts
    and priors. The diagonal is inf for unknowns that the data do not identify.
    """
    scores, meat, used = jacobian * errors[:, None], np.zeros_like(information), 0
    for n in lengths:
        g = scores[used : used + 2 * n].reshape(n, 2, -1).sum(axis=1)
        used += 2 * n
        meat += g.T @ g
        reach = math.floor(4.0 * (n / 100.0) ** (2.0 / 9.0))
        for lag in range(1, min(reach, n - 1) + 1):
            cross = g[lag:].T @ g[:-lag]
            meat += (1.0 - lag / (reach + 1.0)) * (cross + cross.T)
    meat += jacobian[used:].T @ jacobian[used:] + added
    return Spectrum(information).sandwich(meat)
