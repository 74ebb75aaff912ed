"""Results of the checks of an estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import optimize, special

from emb_bench.brake.motion import Floats
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import NORMAL_95, Unknown
from emb_bench.information.identifiability import Doubt

LEVEL = NORMAL_95**2
"""Increase of χ² that one parameter stays below in 95 % of experiments: a quantile of χ² with one degree of freedom."""
AGREES = 0.1  # Largest relative difference of two half-widths that count as equal
NEGLIGIBLE = 0.01  # Weight below which a model does not count in an interval


@dataclass(frozen=True, eq=False)
class Profile:
    """Likelihood profile of one unknown: rise of χ² with it fixed and the others refitted."""

    label: str
    values: Floats  # Values of the unknown, ascending [SI units], shape (n,)
    rise: Floats  # χ² above its minimum, prior included, shape (n,)
    interval: tuple[float, float]
    """95 % by the likelihood ratio; infinite on a side where the rise does not reach ``LEVEL``."""
    doubt: Doubt | None
    """None if it is closed, else ``FLAT`` (open on both sides), ``OPEN_BELOW``, ``OPEN_ABOVE`` or ``CUT``."""
    fisher: tuple[float, float]
    """95 % by the Fisher information, around the profile's minimum; infinite if not identified."""
    minimum: float  # Value with the least χ², SI units
    fell: float  # Fall of χ² below that of the estimate, which is then a local minimum only; 0 if none

    @property
    def agrees(self) -> bool:
        """Returns True if the Fisher information gives the same interval."""
        half = self.fisher[1] - self.minimum
        sides = (self.interval[1] - self.minimum, self.minimum - self.interval[0])
        return max(abs(side / half - 1.0) for side in sides) <= AGREES


@dataclass(frozen=True)
class HeldOut:
    """Prediction of a held-out experiment."""

    name: str
    chi2: float  # Squares of the prediction's errors, weighted by noise and the uncertainty of the estimate
    freedom: int
    p_value: float  # Chance of a larger one if the model is right
    fits: bool
    error: float = math.nan  # Root mean square of the angle's error over windows [rad]; NaN for other methods

    @property
    def ratio(self) -> float:
        """χ²/n."""
        return self.chi2 / max(self.freedom, 1)


@dataclass(frozen=True)
class Differing:
    """A parameter that differs between experiments."""

    name: str
    values: tuple[float, ...]
    """By each experiment alone, in their order, in the unit of the output; NaN if it does not fit."""
    p_value: float  # Chance of such differences if it is the same (χ² of the values around their weighted mean)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A fitted model."""

    name: str  # Of the plant and the features added to it
    estimate: Estimate = field(repr=False)
    deviance: float  # −2 log L, but for a constant that all models share
    bic: float
    held_out: float  # Log predictive density of the held-out part, without a constant that all models share
    weight: float = 0.0  # Posterior probability by BIC

    @property
    def fits(self) -> bool:
        """Returns True if the tests on the residuals do not reject it."""
        return self.estimate.validation.fits


@dataclass(frozen=True)
class Change:
    """Difference that another model makes to a parameter."""

    name: str
    percent: float  # Of the value by the first model
    deviations: float  # In the standard deviations that the first model states


@dataclass(frozen=True, eq=False)
class ModelChoice:
    """Models that were fitted to the same experiments, the best one first."""

    candidates: tuple[Candidate, ...]
    same: tuple[str, ...] = ()
    """Plants without a rank: one that fits better differs only by an offset that is estimated."""

    @property
    def best(self) -> Candidate:
        """The model with the least BIC among those that fit, or among all if none does."""
        return self.candidates[0]

    @property
    def plausible(self) -> tuple[Candidate, ...]:
        """Models whose weight counts."""
        return tuple(c for c in self.candidates if c.weight >= NEGLIGIBLE)

    def changes(self, other: Candidate) -> tuple[Change, ...]:
        """Changes of the parameters of interest if ``other`` were right instead of the best model."""
        e, found = self.best.estimate, []
        theirs = dict(zip(other.estimate.unknowns, other.estimate.values.tolist(), strict=True))
        columns = (e.unknowns, e.values.tolist(), e.between_runs().tolist(), e.scale.tolist())
        for unknown, value, deviation, size in zip(*columns, strict=True):
            if unknown.name in e.question.params and unknown in theirs:
                change = (theirs[unknown] - value) / size if size > 0.0 else math.nan
                sigmas = change / deviation if deviation > 0.0 else math.nan
                found.append(Change(unknown.name, 100.0 * change, sigmas))
        return tuple(found)

    def interval(self, unknown: Unknown, level: float = 0.95) -> tuple[float, float]:
        """Interval of the mixture of the plausible models [SI units]."""
        parts = [(c.weight, *gaussian) for c in self.plausible if (gaussian := _normal(c.estimate, unknown))]
        return mixture_interval(parts, level)


def mixture_interval(parts: Sequence[tuple[float, float, float]], level: float) -> tuple[float, float]:
    """Central interval of a mixture of Gaussians, each with a weight, a mean and a standard deviation."""
    if not parts or not all(math.isfinite(deviation) for _, _, deviation in parts):
        return -math.inf, math.inf
    weights, means, deviations = (np.array(column) for column in zip(*parts, strict=True))
    weights = weights / weights.sum()
    low, high = float(np.min(means - 9.0 * deviations)), float(np.max(means + 9.0 * deviations))
    if low == high:
        return low, high

    def below(x: float, share: float) -> float:
        return float(weights @ special.ndtr((x - means) / deviations)) - share

    tails = 0.5 * (1.0 - level), 0.5 * (1.0 + level)
    first, last = (optimize.brentq(below, low, high, args=(tail,), xtol=1e-9 * (high - low)) for tail in tails)
    return float(first), float(last)


def _normal(e: Estimate, unknown: Unknown) -> tuple[float, float] | None:
    """Value and standard deviation of an unknown in SI units; None if the model does not have it."""
    if unknown not in e.unknowns:
        return None
    i = e.unknowns.index(unknown)
    low, high = e.intervals()[i].tolist()
    return float(e.values[i]), 0.5 * (high - low) / NORMAL_95
