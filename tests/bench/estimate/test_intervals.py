"""Rules of intervals, against a table written by hand from docs/explanation/estimation.md."""

from __future__ import annotations

import numpy as np

from emb_bench.estimate.intervals import deviations, interval, unnoticed


def test_biases_by_several_effects_add_in_quadrature_and_none_is_zero() -> None:
    assert unnoticed(np.array([[3.0, 0.0], [4.0, 2.0]])).tolist() == [5.0, 2.0]
    assert unnoticed(np.zeros((0, 2))).tolist() == [0.0, 0.0]


def test_deviations_add_an_unnoticed_bias_and_are_no_less_than_the_sandwich_of_a_model_that_does_not_fit() -> None:
    bound, bias = np.array([3.0, 1.0, np.inf]), np.array([4.0, 0.0, 1.0])
    sandwich = np.array([4.5, 2.0, np.inf])
    assert deviations(bound, bias, sandwich, fits=True).tolist() == [5.0, 1.0, np.inf]
    assert deviations(bound, bias, sandwich, fits=False).tolist() == [5.0, 2.0, np.inf]


def test_a_profile_counts_where_it_is_open_or_its_assumptions_hold() -> None:
    gaussian, profile, both = (1.0, 4.0), (2.0, 5.0), (1.0, 5.0)
    for closed, holds, biased, expected in (
        (True, False, False, gaussian),
        (True, False, True, gaussian),
        (True, True, False, profile),
        (True, True, True, both),
        (False, False, False, profile),
        (False, False, True, both),
        (False, True, False, profile),
        (False, True, True, both),
    ):
        found = interval(gaussian, profile, closed=closed, holds=holds, biased=biased)
        assert found == expected, (closed, holds, biased)
