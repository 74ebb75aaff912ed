"""Several runs of one brake: test of homogeneity, slope over a condition, control chart."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from emb_bench.estimate.effects import DRIFTS

DIFFERENT = 0.01  # Significance level of the test: with a smaller p-value, the number is not the same in all runs


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
    """Compare measurements of one number with positive standard deviations.

    Relative deviations have to be multiplied by one common value: with each measurement's value, small ones would count
    too much.
    """
    from scipy import special

    v, weights = np.asarray(values, dtype=np.float64), np.asarray(deviations, dtype=np.float64) ** -2.0
    mean = float(weights @ v / weights.sum())
    chi2 = float(weights @ (v - mean) ** 2)
    several = len(v) > 1
    p_value = float(special.chdtrc(len(v) - 1, chi2)) if several else 1.0
    scatter = math.sqrt(chi2 / (len(v) - 1)) if several else 0.0
    return Constancy(len(v), mean, float(weights.sum() ** -0.5), chi2, p_value, scatter, p_value >= DIFFERENT)


TESTS = 12  # Slopes that a campaign tests: four parameters over time, temperature and supply voltage
BEYOND = 3.0  # Standard deviations from the median at which a control chart has its limits (Shewhart 1931)


@dataclass(frozen=True)
class Slope:
    """Change of a number with a condition of its runs, by weighted least squares."""

    slope: float  # Per unit of the condition
    deviation: float  # Standard deviation of it, by those of the measurements or by a larger scatter about the line
    p_value: float  # Of a slope as large or larger, of either sign, if there is none

    @property
    def significant(self) -> bool:
        """True if the test rejects that there is none, as one of ``TESTS`` (Bonferroni)."""
        return self.p_value < DIFFERENT / TESTS


def slope(values: Sequence[float], deviations: Sequence[float], conditions: Sequence[float]) -> Slope | None:
    """Slope of a number over a condition; None for fewer than three runs, or a condition that does not change.

    A run without a positive, finite deviation does not count.
    """
    v, s, x = (np.asarray(given, np.float64) for given in (values, deviations, conditions))
    usable = np.isfinite(s) & (s > 0.0)
    if np.count_nonzero(usable) < 3:
        return None
    from scipy import special

    v, x, weights = v[usable], x[usable], s[usable] ** -2.0
    away = x - weights @ x / weights.sum()
    spread = float(weights @ away**2)
    if not spread > 0.0:
        return None
    found, freedom = float((weights * away) @ v / spread), len(v) - 2
    residuals = v - weights @ v / weights.sum() - found * away
    scatter = math.sqrt(float(weights @ residuals**2) / freedom)  # about the line, over the stated deviations
    deviation = spread**-0.5 * max(1.0, scatter)
    size = abs(found / deviation)
    p_value = 2.0 * special.stdtr(freedom, -size) if scatter > 1.0 else special.erfc(size / math.sqrt(2.0))
    return Slope(found, deviation, float(p_value))


def beyond(values: Sequence[float], deviations: Sequence[float]) -> list[int]:
    """Runs outside of a control chart's limits: ``BEYOND`` standard deviations of the run from the median."""
    if len(values) < 3:
        return []
    distances = np.abs(np.asarray(values) - np.median(values))
    return [int(i) for i in np.flatnonzero(distances > BEYOND * np.asarray(deviations))]


Effects = Mapping[str, tuple[float, float]]
"""Biases by effects, and the sizes of the effects, by name."""


def apart_by(deviation: float, effects: Effects, other: Effects) -> float:
    """Part of a run's deviation that counts in its difference to another run of the brake with ``other`` biases.

    An effect of the brake has the same size in both runs: only the difference of its two biases counts. A drift within
    a run is independent in each. The biases by ``effects`` are part of the ``deviation``.
    """
    square = max(deviation**2 - sum(bias**2 for bias, _ in effects.values()), 0.0)
    for name, (bias, size) in effects.items():
        shared = name not in DRIFTS and name in other and other[name][1] > 0.0
        square += (bias - (size / other[name][1] * other[name][0] if shared else 0.0)) ** 2
    return math.sqrt(square)
