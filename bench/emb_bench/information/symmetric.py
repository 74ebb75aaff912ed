"""Symmetric packed matrices: small Fisher information matrices in compiled loops, with their D, A and E criteria.

A symmetric n×n matrix is a vector of n (n + 1) / 2 numbers, the rows of its upper triangle one after the other, which
is the order of ``numpy.triu_indices(n)``. The functions take arrays that the caller owns, call no numpy, and run as
plain Python or compiled (:mod:`emb_bench.compiled`) alike. They are meant for n ≤ 4.

All values follow from a Cholesky factor. A determinant by expansion or elimination can be negative for a nearly
singular matrix (thesis Fig. 4.2). A matrix that is singular to rounding, or contains a NaN, gets the worst value (log
det −inf, λ_min 0, tr M⁻¹ inf), never a NaN.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.compiled import compiled

Floats = NDArray[np.float64]

SINGULAR = 1e-14
"""A pivot below this share of its diagonal element is zero to the rounding of some hundred increments."""

LOG_DET, LAMBDA_MIN, LOG_LAMBDA_MIN, MINUS_LOG_TRACE = range(4)
"""Criteria: ln |M| (D), λ_min and ln λ_min (E), −ln tr M⁻¹ (A); :func:`phi` has all but λ_min itself."""

_ORTHOGONAL = 1e-15  # cosine of two rows that counts as zero
_SWEEPS = 30  # Jacobi needs 3 to 6; the bound only guarantees an end


def packed_size(n: int) -> int:
    """Length of the packed form of an n×n matrix."""
    return n * (n + 1) // 2


def packed_index(n: int, i: int, j: int) -> int:
    """Index of element (i, j), i ≤ j, of an n×n matrix in its packed form."""
    return i * (2 * n - i - 1) // 2 + j


def information(a1: float, a2: float, b1: float, b2: float, w1: float, w2: float) -> float:
    """One element of an increment of the FIM, a^T R⁻¹ b for the sensitivities a and b of two parameters (eq. 4.21).

    1 is the angle, 2 the velocity; their weights in the thesis are 1/(100² · 1e-6) = 100 and 1/500² = 1/250000.
    """
    return w1 * a1 * b1 + w2 * a2 * b2


def add_increment(m: Floats, s: Floats, w1: float, w2: float) -> None:
    """Add one sample's information to a packed FIM in place: rank two at most, for there are two outputs (eq. 4.37).

    Sensitivities of angle and velocity have the shape (n, 2).
    """
    position = 0
    for i in range(s.shape[0]):
        for j in range(i, s.shape[0]):
            m[position] += information(s[i, 0], s[i, 1], s[j, 0], s[j, 1], w1, w2)
            position += 1


def cholesky(m: Floats, work: Floats) -> bool:
    """Upper Cholesky factor U of a packed matrix, M = U^T U, in the upper triangle of ``work``.

    Returns:
        False if the matrix is singular to rounding, indefinite or holds a NaN; ``work`` is then of no use.
    """
    n = work.shape[0]
    for i in range(n):
        for j in range(i, n):
            rest = m[packed_index(n, i, j)]
            for k in range(i):
                rest -= work[k, i] * work[k, j]
            if j > i:
                work[i, j] = rest / work[i, i]
            elif rest > SINGULAR * m[packed_index(n, i, i)]:
                work[i, i] = math.sqrt(rest)
            else:
                return False
    return True


def log_det(m: Floats, work: Floats) -> float:
    """Logarithm of the determinant of a packed matrix, −inf if it is singular (D-optimality, eq. 4.12)."""
    if not cholesky(m, work):
        return -math.inf
    total = 0.0
    for i in range(work.shape[0]):
        total += math.log(work[i, i])
    return 2.0 * total


def trace_inverse(m: Floats, work: Floats) -> float:
    """Trace of M⁻¹ of a packed matrix, inf if it is singular (A-optimality, eq. 4.16): ‖U⁻¹‖² of its factor."""
    if not cholesky(m, work):
        return math.inf
    n = work.shape[0]
    total = 0.0
    for j in range(n):  # column j of U⁻¹ by back substitution, stored below the diagonal of work as row j
        inverse = 1.0 / work[j, j]
        total += inverse * inverse
        for i in range(j - 1, -1, -1):
            rest = work[i, j] * inverse
            for k in range(i + 1, j):
                rest += work[i, k] * work[j, k]
            work[j, i] = -rest / work[i, i]
            total += work[j, i] * work[j, i]
    return total


def lambda_min(m: Floats, work: Floats) -> float:
    """Smallest eigenvalue of a packed matrix, 0.0 if it is singular (E-optimality, eq. 4.14).

    Small eigenvalues keep their relative accuracy: 2×2 as |M| / λ_max, larger ones by one-sided Jacobi rotations of the
    Cholesky factor, so that nothing is subtracted from λ_max.
    """
    n = work.shape[0]
    if not cholesky(m, work):
        return 0.0
    if n == 1:
        return float(m[0])
    if n == 2:
        pivots = work[0, 0] * work[1, 1]
        difference = m[0] - m[2]
        largest = 0.5 * (m[0] + m[2] + math.sqrt(difference * difference + 4.0 * m[1] * m[1]))
        return float(pivots * pivots / largest)
    orthogonalise(work)
    smallest = math.inf
    for a in range(n):
        smallest = min(smallest, dot(work, a, a))
    return smallest


def phi(criterion: int, m: Floats, softness: float, work: Floats) -> float:
    """φ of a packed matrix by ``LOG_DET``, ``LOG_LAMBDA_MIN`` or ``MINUS_LOG_TRACE``; −inf if it is singular.

    A softness rounds E's kinks, see :meth:`emb_bench.information.criteria.Criterion.phi`.
    """
    n = work.shape[0]
    if not cholesky(m, work):
        return -math.inf
    if criterion == MINUS_LOG_TRACE:
        return -math.log(trace_inverse(m, work))
    total, smallest = 0.0, math.inf
    if criterion == LOG_DET:
        for i in range(n):
            total += 2.0 * math.log(work[i, i])
        return total
    orthogonalise(work)
    for i in range(n):
        smallest = min(smallest, dot(work, i, i))
    if softness > 0.0:
        for i in range(n):
            total += (smallest / dot(work, i, i)) ** (1.0 / softness)
        return math.log(smallest) - softness * math.log(total)
    return math.log(smallest)


def orthogonalise(factor: Floats) -> None:
    """Make the rows of an upper Cholesky factor orthogonal, in place; their squared lengths are the eigenvalues."""
    n = factor.shape[0]
    for i in range(n):
        for j in range(i):
            factor[i, j] = 0.0
    for _ in range(_SWEEPS):
        rotated = False
        for a in range(n - 1):
            for b in range(a + 1, n):
                if rotate(factor, a, b):
                    rotated = True
        if not rotated:
            break


def dot(rows: Floats, a: int, b: int) -> float:
    """Scalar product of two rows."""
    total = 0.0
    for k in range(rows.shape[1]):
        total += rows[a, k] * rows[b, k]
    return total


def rotate(rows: Floats, a: int, b: int) -> bool:
    """Rotate two rows in place until they are orthogonal (one-sided Jacobi); False if they were."""
    p, q, r = dot(rows, a, a), dot(rows, b, b), dot(rows, a, b)
    if abs(r) <= _ORTHOGONAL * math.sqrt(p) * math.sqrt(q):
        return False
    half = (q - p) / (2.0 * r)
    tangent = 1.0 / (abs(half) + math.sqrt(1.0 + half * half))
    if half < 0.0:
        tangent = -tangent
    cosine = 1.0 / math.sqrt(1.0 + tangent * tangent)
    sine = cosine * tangent
    for k in range(rows.shape[1]):
        first, second = rows[a, k], rows[b, k]
        rows[a, k] = cosine * first - sine * second
        rows[b, k] = sine * first + cosine * second
    return True


def each(criterion: int, m: Floats, added: float) -> Floats:
    """A criterion of N packed matrices M + added · I, shape (N,); compiled. The thesis adds ε (eq. 4.28)."""
    out = np.empty(len(m))
    compiled(_each)(criterion, m, added, out)
    return out


def _each(criterion: int, m: Floats, added: float, out: Floats) -> None:
    n = 1
    while packed_size(n) < m.shape[1]:
        n += 1
    row, work = np.empty(m.shape[1]), np.empty((n, n))
    for i in range(m.shape[0]):
        row[:] = m[i]
        for j in range(n):
            row[packed_index(n, j, j)] += added
        if criterion == LOG_DET:
            out[i] = log_det(row, work)
        elif criterion == LAMBDA_MIN:
            out[i] = lambda_min(row, work)
        elif criterion == LOG_LAMBDA_MIN:
            out[i] = math.log(lambda_min(row, work))
        else:
            out[i] = -math.log(trace_inverse(row, work))


@cache
def upper(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of each element of the packed form of an n×n matrix."""
    rows, columns = np.triu_indices(n)
    rows.flags.writeable = columns.flags.writeable = False
    return rows, columns


def pack(matrix: Any) -> Floats:
    """Upper triangle of a symmetric matrix as a vector."""
    square = np.asarray(matrix, dtype=np.float64)
    return square[upper(square.shape[0])]


def unpack(m: Any, n: int) -> Floats:
    """The symmetric n×n matrix of a packed one; leading axes stay: (..., n (n + 1) / 2) to (..., n, n)."""
    packed = np.asarray(m, dtype=np.float64)
    rows, columns = upper(n)
    square = np.empty((*packed.shape[:-1], n, n))
    square[..., rows, columns] = packed
    square[..., columns, rows] = packed
    return square
