"""Records that each fit alone and do not fit together: two brakes in one call, or one that has changed between runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emb_bench.analysis.constancy import constancy
from emb_bench.brake.parameters import quantity
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.records import Estimate

LEVEL = 0.001  # Chance that a parameter of one and the same brake is said to differ, for all parameters together


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
        if p_value < LEVEL / len(e.asked.params):
            shown = quantity(e.bench.machine, name)
            found.append(Differing(shown.name, tuple(value * shown.factor for value in values), p_value))
    return tuple(sorted(found, key=lambda one: one.p_value))
