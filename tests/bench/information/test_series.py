"""Criteria of many matrices at once are those of each."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from emb_bench.information.criteria import criteria
from emb_bench.information.packed import Floats
from emb_bench.information.series import criteria_series
from emb_runtime.errors import UsageError

NAMES = ("k_m", "k_1", "T_c", "f_v")


def growing(seed: int, samples: int, dead: int, twins: bool) -> Floats:
    """Information after each sample: singular at first, and for ever with a dead parameter or two that are alike."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((samples, len(NAMES))) * 10.0 ** rng.uniform(-3.0, 3.0, len(NAMES))
    if dead < len(NAMES):
        rows[:, dead] = 0.0
    if twins:
        rows[:, 1] = -2.0 * rows[:, 0]
    result: Floats = np.cumsum(rows[:, :, None] * rows[:, None, :], axis=0)
    return result


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32),
    samples=st.integers(0, 12),
    dead=st.integers(0, 9),
    twins=st.booleans(),
    interest=st.lists(st.sampled_from(NAMES), min_size=1, unique=True),
)
@example(seed=916, samples=5, dead=2, twins=False, interest=["k_m"])  # only just lost
def test_each_matrix_has_the_numbers_that_it_has_alone(
    seed: int, samples: int, dead: int, twins: bool, interest: list[str]
) -> None:
    matrices = growing(seed, samples, dead, twins)
    series = criteria_series(matrices, NAMES, interest)
    alone = [criteria(matrix, NAMES, interest) for matrix in matrices]
    np.testing.assert_allclose(series.log_det, [c.log_det for c in alone], rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(series.lambda_min, [c.lambda_min for c in alone], rtol=1e-6)
    np.testing.assert_allclose(series.trace_inverse, [c.trace_inverse for c in alone], rtol=1e-6)


def test_of_a_diagonal_matrix_the_numbers_are_known() -> None:
    series = criteria_series(np.diag([2.0, 4.0, 5.0, 8.0])[None], NAMES, NAMES)
    np.testing.assert_allclose([series.log_det[0], series.lambda_min[0]], [np.log(320.0), 2.0])
    np.testing.assert_allclose(series.trace_inverse, 0.5 + 0.25 + 0.2 + 0.125)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -1.0])
def test_a_matrix_that_is_no_information_is_refused(wrong: float) -> None:
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[1, 2, 2] = wrong
    with pytest.raises(UsageError, match="expected a square, finite Fisher information matrix"):
        criteria_series(matrices, NAMES, NAMES)
