"""Rules for the interval of an estimate, in their order (docs/explanation/estimation.md).

1. *The information*: a Gaussian interval with the covariance averaged over the presence of systematic errors.
2. *Unmodelled effects*: their root mean square biases are added in quadrature.
3. *A model that does not fit*: the deviation is at least that of the sandwich, which the residuals give.
4. *The likelihood profile*, where one was made, takes the interval's place if it is not closed, or if its assumptions
   hold: the model fits, and the method is output error. Beside a bias by rule 2 the union of both counts.
5. *Several models* that explain the experiments: the union with the interval of their mixture.
6. *Physical bounds*: an interval ends at the least value that is possible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.estimate.records import Contribution

Interval = tuple[float, float]


def unnoticed(budget: Sequence[Contribution], unknowns: int, without: Sequence[str] = ()) -> Floats:
    """Root mean square bias of each of so many unknowns by the effects of a budget, but for some of them."""
    biases = np.array([one.bias for one in budget if one.name not in without]).reshape(-1, unknowns)
    total: Floats = np.sqrt(np.sum(biases**2, axis=0))
    return total


def largest(budget: Sequence[Contribution], i: int, without: Sequence[str] = ()) -> Contribution | None:
    """The largest entry of a budget for unknown ``i``, but for some of them; None without any."""
    found = [one for one in budget if one.bias[i] != 0.0 and one.name not in without]
    return max(found, key=lambda one: abs(one.bias[i]), default=None)


def deviations(bound: Floats, unnoticed: Floats, sandwich: Floats, *, fits: bool) -> Floats:
    """Standard deviations by rules 1 to 3, from Cramér-Rao bounds, biases and the sandwich, shape (unknowns,)."""
    total: Floats = np.hypot(bound, unnoticed)
    return total if fits else np.maximum(total, sandwich)


def interval(gaussian: Interval, profile: Interval, *, closed: bool, holds: bool, biased: bool) -> Interval:
    """Interval of one unknown by rule 4.

    The profile is ``closed`` if it rises beyond the level on both sides; ``holds`` if the assumptions of rule 4 do;
    ``biased`` if rule 2 widened the Gaussian interval.
    """
    if closed and not holds:
        return gaussian
    return union(gaussian, profile) if biased else profile


def bounded(interval: Interval, value: float, least: float) -> Interval:
    """Interval of a value by rule 6; infinite if it excludes no possible value."""
    low, high = interval
    if not -math.inf < low < least <= value:
        return interval
    return (-math.inf if math.isinf(high) else least), high


def union(one: Interval, other: Interval) -> Interval:
    """The smallest interval that holds both."""
    return min(one[0], other[0]), max(one[1], other[1])
