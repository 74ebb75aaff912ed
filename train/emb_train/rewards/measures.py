"""D, E and A of many packed Fisher information matrices at once, with a multiple of the identity added first.

What is added is the thesis's ε I (eq. 4.28) or a prior. The running normalisation (eq. 4.35-4.39) leaves step rewards
as they are and guards a determinant that is multiplied out; these come from a Cholesky factor and need no guard.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from emb_bench.compiled import compiled
from emb_bench.information.packed import Floats, lambda_min, log_det, packed_index, packed_size, trace_inverse


def add_diagonal(m: Floats, added: float, n: int, out: Floats) -> None:
    """M + added · I, packed."""
    for j in range(m.shape[0]):
        out[j] = m[j]
    for j in range(n):
        out[packed_index(n, j, j)] += added


def log_dets(m: Floats, added: float, row: Floats, work: Floats, out: Floats) -> None:
    """Of each row, ln |M + added · I|; arguments as in :func:`each`, and scratch."""
    for i in range(m.shape[0]):
        add_diagonal(m[i], added, work.shape[0], row)
        out[i] = log_det(row, work)


def lambda_mins(m: Floats, added: float, row: Floats, work: Floats, out: Floats) -> None:
    """Of each row, λ_min(M + added · I)."""
    for i in range(m.shape[0]):
        add_diagonal(m[i], added, work.shape[0], row)
        out[i] = lambda_min(row, work)


def log_lambda_mins(m: Floats, added: float, row: Floats, work: Floats, out: Floats) -> None:
    """Of each row, ln λ_min(M + added · I)."""
    for i in range(m.shape[0]):
        add_diagonal(m[i], added, work.shape[0], row)
        out[i] = math.log(lambda_min(row, work))


def log_traces(m: Floats, added: float, row: Floats, work: Floats, out: Floats) -> None:
    """Of each row, −ln tr (M + added · I)⁻¹."""
    for i in range(m.shape[0]):
        add_diagonal(m[i], added, work.shape[0], row)
        out[i] = -math.log(trace_inverse(row, work))


def each(measure: Callable[[Floats, float, Floats, Floats, Floats], None], m: Floats, added: float) -> Floats:
    """One of the measures above for N packed matrices; compiled in the scalar and in the vector environment alike.

    Args:
        measure: one of the functions above.
        m: packed, shape [N, n (n + 1) / 2].
        added: multiple of the identity.

    Returns:
        Shape [N].
    """
    n = 1
    while packed_size(n) < m.shape[1]:
        n += 1
    out = np.empty(len(m))
    compiled(measure)(m, added, np.empty(m.shape[1]), np.empty((n, n)), out)
    return out
