"""Measures of an experiment's information, and the interval of their mean over many experiments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from emb_bench.information.criteria import Criterion, Name
from emb_bench.information.fisher import Kind
from emb_bench.numbers import LEVEL, Score
from emb_train.rewards import PRIOR

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Measure:
    """A number for a Fisher information matrix; more is better."""

    name: str  # Name on the command line
    label: str  # Formula or description of the number, for people
    criterion: Name  # Criterion whose optimum is searched for
    kind: Kind  # Of Fisher information
    prior: float  # Added to the diagonal
    against: Literal["difference", "log-ratio", "ratio"]
    """Comparison of a value with the optimum: by a difference in nat, by the ratio of which both are logarithms, or
    by their ratio."""

    def goal(self, size: int) -> Criterion:
        """Criterion that a design for ``size`` parameters optimises; its φ is the logarithm of what counts here."""
        return Criterion(self.criterion, tuple(range(size)))

    def values(self, matrices: Floats) -> Floats:
        """Of matrices without a prior, shape [N, n, n] to [N]."""
        size = matrices.shape[-1]
        phi = self.goal(size).phi(matrices + self.prior * np.eye(size))
        return phi if self.against != "ratio" else np.exp(phi)

    def shares(self, values: Floats, optima: Floats) -> Floats:
        """Of the optimum, for each draw: the difference in nat (0 at the optimum) for D, else the share (1 there)."""
        if self.against == "difference":
            return values - optima
        if self.against == "log-ratio":
            return np.asarray(np.exp(values - optima))
        return values / optima


MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        m.name: m
        for m in (
            Measure("D", "ln det(M + 12 I)", "D", "physical", PRIOR, "difference"),
            Measure("A", "-ln tr (M + 12 I)^-1", "A", "physical", PRIOR, "log-ratio"),
            Measure("E", "ln lambda_min(M + 12 I)", "E", "physical", PRIOR, "log-ratio"),
            Measure("weighted", "lambda_min of the thesis's weighted M", "E", "weighted", 0.0, "ratio"),
        )
    }
)
"""By name. ``weighted`` is, for one parameter, the thesis's weighted information itself."""


def mean_score(values: Floats) -> Score:
    """Mean of independent values with Student's 95 % interval for it; one value has no interval (NaN)."""
    from scipy.stats import t as student  # takes a second to import

    centre, count = float(np.mean(values)), len(values)
    if count < 2:
        return Score(centre, math.nan, math.nan)
    half = float(student.ppf(0.5 + 0.5 * LEVEL, count - 1) * np.std(values, ddof=1) / math.sqrt(count))
    return Score(centre, centre - half, centre + half)
