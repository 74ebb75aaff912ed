"""Several runs of one brake: whether they measured one number."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from emb_bench.brake.parameters import quantity
from emb_bench.estimate.estimate import Estimate

DIFFERENT = 0.01  # Significance level of the test: with a smaller p-value, the number is not the same in all runs
APART = 0.001  # Chance that a parameter of one and the same brake is said to differ, for all parameters together


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

    If these are shares of the number, take the same number for all: with each one's own value, those that came out
    small would count too much.
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
    """Parameters in which the records of an estimate differ that each fit alone; the most different first.

    Empty if they fit together, if one does not fit alone, or if no parameter differs.
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
            found.append(Differing(quantity(e.bench.machine, name).name, tuple(values), p_value))
    return tuple(sorted(found, key=lambda one: one.p_value))
