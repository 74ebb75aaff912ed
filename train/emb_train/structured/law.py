"""Reference as a table: levels and switches that are polynomials of the estimated parameters.

Each of l_0, l_1, … and t_1, t_2, … is l_i0 + Σ l_ij φ_j + Σ l_ijk φ_j φ_k, clipped to ±1, with φ the
logarithms of the estimates, scaled to −1..1 over their ranges and cut off there. With zeros for all slopes the
reference is blind: it depends on no measurement. A first level of small speed is a probe: its few milliseconds tell
the estimator enough to decide on the rest. How it is followed: :mod:`emb_runtime.estimator.speed_loop`.

Scalar functions; compiled by :func:`emb_bench.compiled.compiled` they are the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from emb_bench.config.bench import Bench
from emb_runtime.config.bench import Ranges
from emb_runtime.estimator.kalman import Four, Model, State, believed, relative
from emb_runtime.estimator.speed_loop import Scale, follow_reference

FEATURES = 4  # Scaled estimates that a reference may depend on
PRODUCTS = tuple((i, j) for i in range(FEATURES) for j in range(i, FEATURES))
TERMS = 1 + FEATURES + len(PRODUCTS)  # Of a level or switch: constant, slopes, products in the order of ``PRODUCTS``


class Box(NamedTuple):
    """Relative parameters over whose ranges the features are scaled."""

    low: Four
    high: Four


def box_of(bench: Bench, ranges: Ranges) -> Box:
    """The box of a set of ranges."""
    return Box(relative(bench, ranges.low), relative(bench, ranges.high))


def scaled(value: float, low: float, high: float) -> float:
    """Logarithm of a value, −1..1 over its range and cut off there; 0 for one that is known."""
    if high <= low:
        return 0.0
    return min(max(math.log(value * value / (low * high)) / math.log(high / low), -1.0), 1.0)


def features(box: Box, parameters: Four) -> Four:
    """Features φ that levels and switches depend on."""
    (km, k1, tc, fv), low, high = parameters, box.low, box.high
    return (
        scaled(km, low[0], high[0]),
        scaled(k1, low[1], high[1]),
        scaled(tc, low[2], high[2]),
        scaled(fv, low[3], high[3]),
    )


def of_features(terms: Any, f: Four) -> float:
    """A level or a switch; ``terms`` has the shape [TERMS]."""
    f1, f2, f3, f4 = f
    total = terms[0] + terms[1] * f1 + terms[2] * f2 + terms[3] * f3 + terms[4] * f4
    total += f1 * (terms[5] * f1 + terms[6] * f2 + terms[7] * f3 + terms[8] * f4)
    total += f2 * (terms[9] * f2 + terms[10] * f3 + terms[11] * f4)
    total += f3 * (terms[12] * f3 + terms[13] * f4) + f4 * (terms[14] * f4)
    return float(total)


def set_reference(table: Any, f: Four, reference: Any) -> None:
    """Evaluate a table in place.

    Args:
        table: n levels, then n − 1 switches, shape [2 n − 1, TERMS].
        f: from :func:`features`.
        reference: becomes levels and switches, shape [2 n − 1].
    """
    for i in range(len(reference)):
        reference[i] = min(max(of_features(table[i], f), -1.0), 1.0)


def wanted_current(model: Model, state: State, scale: Scale, box: Box, table: Any, reference: Any) -> float:
    """Current for the newest sample [A].

    Args:
        model: of the estimator.
        state: estimate of the newest sample.
        scale: of the reference.
        box: of the features.
        table: of the reference, see :func:`set_reference`.
        reference: work space, shape [2 n − 1].
    """
    set_reference(table, features(box, believed(model, state)), reference)
    levels = (len(reference) + 1) // 2
    return follow_reference(model, state, scale, reference[:levels], reference[levels:], state.step)
