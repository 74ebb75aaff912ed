"""Several runs of one brake: whether they measured one number, and its trend as a random walk between them.

*Trend.* Each run measured the number with its own deviation, and between runs it did a random walk of q per √h (the
local level model of Durbin and Koopman, Time Series Analysis by State Space Methods, 2nd ed., chapter 2), of which
nothing is known at the start. A Kalman filter forwards and a Rauch-Tung-Striebel smoother backwards give the number in
each run from all of them. The walk is the one of the greatest likelihood; as few runs say little about it, intervals
are averaged over all walks with their likelihoods.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import quantity
from emb_bench.estimate.records import NORMAL_95, Estimate

DIFFERENT = 0.01  # Significance level of the test: with a smaller p-value, the number is not the same in all runs
APART = 0.001  # Chance that a parameter of one and the same brake is said to differ, for all parameters together
FEWEST = 4  # Fewest runs that can tell a walk from the scatter of their deviations
SHORTEST = 1.0 / 3600.0  # Shortest time from the first to the last run that has a trend [h]
_WALKS = np.concatenate([[0.0], np.geomspace(1e-3, 10.0, 120)])
"""Walks that are averaged over, in the largest step that the measurements show."""


@dataclass(frozen=True)
class Constancy:
    """The mean of independent Gaussian measurements, weighted by their information, and the test of homogeneity."""

    runs: int
    mean: float
    deviation: float  # Standard deviation of the mean, if all runs measured one number
    chi2: float  # Sum of the squared distances from the mean in standard deviations
    p_value: float  # Of a chi2 as large or larger with ``runs`` - 1 degrees of freedom
    scatter: float  # Birge ratio: observed scatter over that of the stated deviations; 0 for a single run (Birge 1932)
    constant: bool  # True if the test does not reject one number for all runs


def constancy(values: Sequence[float], deviations: Sequence[float]) -> Constancy:
    """Compare measurements of one number.

    Args:
        values: at least one.
        deviations: their standard deviations, positive and finite. If they are shares of the number, take the same
            number for all: with each one's own value, those that came out small would count too much.
    """
    from scipy import special

    v, weights = np.asarray(values, dtype=np.float64), np.asarray(deviations, dtype=np.float64) ** -2.0
    mean = float(weights @ v / weights.sum())
    chi2 = float(weights @ (v - mean) ** 2)
    several = len(v) > 1
    p_value = float(special.chdtrc(len(v) - 1, chi2)) if several else 1.0
    scatter = math.sqrt(chi2 / (len(v) - 1)) if several else 0.0
    return Constancy(len(v), mean, float(weights.sum() ** -0.5), chi2, p_value, scatter, p_value >= DIFFERENT)


@dataclass(frozen=True)
class Differing:
    """A parameter that differs between records."""

    name: str
    values: tuple[float, ...]  # By each record alone, in their order, in the unit that they are shown in
    p_value: float  # Chance of such differences if it is the same (χ² of the values around their weighted mean)


def apart(e: Estimate) -> tuple[Differing, ...]:
    """Parameters in which records differ that each fit alone; the most different first.

    Empty if they fit together, if one does not fit alone, or if no parameter differs.

    Args:
        e: estimate from all of the records together.
    """
    if len(e.records) < 2 or e.validation.fits:
        return ()
    from emb_bench.estimate.methods import method_of

    alone = [method_of(e.method)(e.bench, e.plant, e.asked, starts=1).fit([record]) for record in e.records]
    if not all(one.validation.fits for one in alone):
        return ()
    found = []
    for name in e.asked.params:
        at = [next(i for i, u in enumerate(one.unknowns) if u.name == name) for one in alone]
        values = [float(one.values[i]) for one, i in zip(alone, at, strict=True)]
        deviations = [float((one.between_runs() * one.scale)[i]) for one, i in zip(alone, at, strict=True)]
        if not np.isfinite(deviations).all():
            continue
        p_value = constancy(values, deviations).p_value
        if p_value < APART / len(e.asked.params):
            shown = quantity(e.bench.machine, name)
            found.append(Differing(shown.name, tuple(value * shown.factor for value in values), p_value))
    return tuple(sorted(found, key=lambda one: one.p_value))


@dataclass(frozen=True, eq=False)
class RandomWalk:
    """A number that walks at random from run to run."""

    hours: Floats  # Of the runs since the first one, shape (n,)
    values: Floats  # The number in each run, from all of them, shape (n,)
    deviations: Floats  # Standard deviations of these, shape (n,)
    walk: float  # q, of the greatest likelihood, per √h; 0 if the number may be constant

    @property
    def ends(self) -> Floats:
        """Gaussian 95 % intervals, shape (n, 2)."""
        half = NORMAL_95 * self.deviations
        return np.stack([self.values - half, self.values + half], axis=1)


def random_walk(hours: Sequence[float], values: Sequence[float], deviations: Sequence[float]) -> RandomWalk | None:
    """Trend through measurements of one number; None for fewer than ``FEWEST``, or within ``SHORTEST``.

    Args:
        hours: of each, in any order.
        values: of each.
        deviations: their standard deviations, positive and finite.
    """
    t, y, variances = np.asarray(hours, float), np.asarray(values, float), np.asarray(deviations, float) ** 2
    span = float(np.ptp(t)) if len(t) else 0.0
    if len(t) < FEWEST or span < SHORTEST:
        return None
    order = np.argsort(t, kind="stable")
    t, y, variances = t[order] - t[order][0], y[order], variances[order]
    spread = float(np.ptp(y)) + float(np.sqrt(np.max(variances)))
    walks = _WALKS * spread * np.sqrt((len(t) - 1) / span)
    means, spreads, likelihoods = smoothed(t, y, variances, walks)
    density = np.exp(likelihoods - likelihoods.max())
    weights = density * np.gradient(walks)
    weights /= weights.sum()
    mean = weights @ means
    variance = weights @ (spreads + (means - mean) ** 2)
    back = np.argsort(order, kind="stable")
    likely = float(walks[int(np.argmax(likelihoods))])
    return RandomWalk(t[back], mean[back], np.sqrt(variance)[back], likely)


def smoothed(t: Floats, y: Floats, variances: Floats, walks: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean and variance of the number at each measurement, given all of them, for each of some walks.

    Args:
        t: times in order, shape (n,) [h].
        y: measurements, shape (n,).
        variances: theirs, shape (n,).
        walks: q, per √h, shape (m,).

    Returns:
        Means and variances, shape (m, n), and the logarithm of the likelihood, with nothing known before the first
        measurement, shape (m,).
    """
    n, steps = len(y), walks[:, None] ** 2 * np.diff(t)
    mean, variance, likelihood = np.empty((len(walks), n)), np.empty((len(walks), n)), np.zeros(len(walks))
    mean[:, 0], variance[:, 0] = y[0], variances[0]
    for k in range(1, n):
        before = variance[:, k - 1] + steps[:, k - 1]
        whole, surprise = before + variances[k], y[k] - mean[:, k - 1]
        mean[:, k] = mean[:, k - 1] + before / whole * surprise
        variance[:, k] = before * variances[k] / whole
        likelihood -= 0.5 * (np.log(whole) + surprise**2 / whole)
    for k in range(n - 2, -1, -1):
        before = variance[:, k] + steps[:, k]
        gain = variance[:, k] / before
        variance[:, k] += gain**2 * (variance[:, k + 1] - before)
        mean[:, k] += gain * (mean[:, k + 1] - mean[:, k])
    return mean, variance, likelihood
