"""Trend of one number over several runs, as a random walk between them.

Each run measured the number with its own deviation, and between runs it did a random walk of q per √h (the local level
model of Durbin and Koopman, Time Series Analysis by State Space Methods, 2nd ed., chapter 2), of which nothing is known
at the start. A Kalman filter forwards and a Rauch-Tung-Striebel smoother backwards give the number in each run from all
of them. The walk is the one of the greatest likelihood; as few runs say little about it, intervals are averaged over
what the likelihood leaves open of it, all walks being alike beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emb_bench.estimate.records import NORMAL_95

Floats = NDArray[np.float64]

FEWEST = 4  # Fewest runs that can tell a walk from the scatter of their deviations
SHORTEST = 1.0 / 3600.0  # Shortest time from the first to the last run that has a trend [h]
_WALKS = np.concatenate([[0.0], np.geomspace(1e-3, 10.0, 120)])
"""Walks that are averaged over, in the largest step that the measurements show."""


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
