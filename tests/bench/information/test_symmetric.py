from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.information.symmetric import (
    Floats,
    add_increment,
    lambda_min,
    log_det,
    pack,
    packed_index,
    packed_size,
    trace_inverse,
    unpack,
)

sensitivity = st.floats(-1e3, 1e3)


def badly_scaled(seed: int, n: int) -> tuple[Floats, Floats]:
    """A random positive definite matrix with scales over eight decades, and its inverse by way of the scaled one."""
    rng = np.random.default_rng(seed)
    half = rng.normal(size=(n, n + 2))
    scale = 10.0 ** rng.uniform(-4.0, 4.0, n)
    core = half @ half.T
    return core * np.outer(scale, scale), np.linalg.inv(core) / np.outer(scale, scale)


@given(sensitivity, sensitivity, sensitivity, sensitivity)
def test_two_parameters_give_the_matrix_of_equation_6_3(a: float, b: float, c: float, d: float) -> None:
    m = np.zeros(3)
    add_increment(m, np.array([[a, b], [c, d]]), 100.0, 1.0 / 250000.0)
    expected = [100 * a * a + b * b / 250000, 100 * a * c + b * d / 250000, 100 * c * c + d * d / 250000]
    assert m.tolist() == pytest.approx(expected, rel=1e-12, abs=1e-9)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_packing_is_numpys_order_of_the_upper_triangle_and_undone_by_unpacking(n: int) -> None:
    rows, columns = np.triu_indices(n)
    assert [packed_index(n, i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True)] == list(
        range(packed_size(n))
    )
    matrix, _ = badly_scaled(n, n)
    np.testing.assert_array_equal(unpack(pack(matrix), n), matrix)
    np.testing.assert_array_equal(unpack(np.stack([pack(matrix)] * 3), n), np.stack([matrix] * 3))


@given(st.integers(0, 2**32 - 1), st.integers(1, 4))
def test_the_criteria_are_those_of_dense_linear_algebra_whatever_the_scales(seed: int, n: int) -> None:
    matrix, inverse = badly_scaled(seed, n)
    m, work = pack(matrix), np.full((n, n), np.nan)
    assert log_det(m, work) == pytest.approx(-np.linalg.slogdet(inverse)[1], abs=1e-6)
    assert trace_inverse(m, work) == pytest.approx(np.trace(inverse), rel=1e-6)
    assert lambda_min(m, work) == pytest.approx(1.0 / np.linalg.eigvalsh(inverse)[-1], rel=1e-6)
    np.testing.assert_array_equal(m, pack(matrix))


def test_a_small_eigenvalue_beside_a_large_one_loses_no_digit_to_cancellation() -> None:
    # Half the trace less the root of the discriminant would give 2.0 or 0.0 here, whatever the small entry.
    assert lambda_min(np.array([1e16, 0.0, 1.2345]), np.empty((2, 2))) == pytest.approx(1.2345, rel=1e-14)
    large, off, small = Fraction(10**12), Fraction(10**5), Fraction(3, 100)
    exact = (large * small - off * off) / large  # |M| / λ_max, λ_max being `large` to 1e-14
    found = lambda_min(np.array([1e12, 1e5, 0.03]), np.empty((2, 2)))
    assert found == pytest.approx(float(exact), rel=1e-13)
    assert lambda_min(pack(np.diag([1e14, 1e7, 1.2345])), np.empty((3, 3))) == pytest.approx(1.2345, rel=1e-14)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.ones((3, 3)),
        np.diag([1.0, 0.0, 1.0]),
        np.diag([1.0, -1.0, 1.0]),
        np.full((3, 3), np.nan),
        np.diag([1.0, np.nan, 1.0]),
        np.diag([1.0, np.inf, 1.0]),
    ],
    ids=["zero", "rank one", "zero pivot", "indefinite", "nan", "nan on the diagonal", "infinite"],
)
def test_a_matrix_that_tells_nothing_certain_has_the_worst_values_and_never_nan(matrix: Floats) -> None:
    m, work = pack(matrix), np.empty((3, 3))
    assert (log_det(m, work), trace_inverse(m, work), lambda_min(m, work)) == (-math.inf, math.inf, 0.0)


def test_what_rounding_leaves_of_a_singular_sum_counts_as_singular() -> None:
    rng = np.random.default_rng(3)
    m = np.zeros(3)
    for s in rng.normal(size=(500, 2)):
        add_increment(m, np.array([s, 0.3 * s]), 1e6, 1.0)  # the second parameter always does 0.3 of the first
    assert log_det(m, np.empty((2, 2))) == -math.inf
    assert m[0] * m[2] - m[1] * m[1] != 0.0  # a determinant in floating point would have had a logarithm, or NaN
