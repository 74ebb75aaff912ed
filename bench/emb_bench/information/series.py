"""Criteria of many Fisher information matrices at once: those of an experiment as it goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from emb_bench.information.criteria import criteria
from emb_bench.information.packed import SINGULAR, Floats


class Series(NamedTuple):
    """D, E and A of each matrix, as :class:`emb_bench.information.criteria.Criteria` has them; each of shape (m,)."""

    log_det: Floats
    lambda_min: Floats
    trace_inverse: Floats


def criteria_series(matrices: Floats, params: Sequence[str], interest: Sequence[str]) -> Series:
    """What :func:`emb_bench.information.criteria.criteria` says of each matrix, to rounding.

    Args:
        matrices: FIMs, shape (m, len(params), len(params)).
        params: what to call their rows.
        interest: those that count; the others are unknown nuisances.

    Raises:
        UsageError: a matrix is not finite, or has a negative diagonal element; or the subset is not one.
    """
    index = [list(params).index(name) for name in interest]
    diagonals = np.diagonal(matrices, axis1=1, axis2=2)
    found = Series(*(np.full(len(matrices), worst) for worst in (-math.inf, 0.0, math.inf)))
    # Of a parameter without any information no matrix has to be looked at; the first samples have many such.
    sound = np.isfinite(matrices).all(axis=(1, 2)) & (diagonals >= 0.0).all(axis=1)
    left = ~(sound & (diagonals[:, index] == 0.0).any(axis=1))
    whole = np.flatnonzero(sound & (diagonals > 0.0).all(axis=1))
    unit = np.sqrt(diagonals[whole])
    values, vectors = np.linalg.eigh(matrices[whole] / (unit[:, :, None] * unit[:, None, :]))
    regular = (values > SINGULAR * len(params)).all(axis=1)
    whole, unit, values, vectors = whole[regular], unit[regular], values[regular], vectors[regular]
    # Rows of the scaled inverse: those that count.
    rows = vectors[:, index]
    scaled = (rows / values[:, None, :]) @ rows.transpose(0, 2, 1)
    inverse = scaled / (unit[:, index, None] * unit[:, None, index])
    logarithms = 2.0 * np.log(unit[:, index]).sum(axis=1)
    if len(index) < len(params):
        found.log_det[whole] = logarithms - np.linalg.slogdet(scaled)[1]
    else:
        found.log_det[whole] = logarithms + np.log(values).sum(axis=1)
    found.lambda_min[whole] = 1.0 / np.linalg.eigvalsh(inverse)[:, -1]
    found.trace_inverse[whole] = np.trace(inverse, axis1=1, axis2=2)
    left[whole] = False
    for k in np.flatnonzero(left).tolist():  # nearly singular, or wrong
        one = criteria(matrices[k], params, interest)
        found.log_det[k], found.lambda_min[k], found.trace_inverse[k] = one.log_det, one.lambda_min, one.trace_inverse
    return found
