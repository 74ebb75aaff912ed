"""Rules of intervals, against a table written by hand from docs/explanation/estimation.md."""

from __future__ import annotations

from math import inf

import numpy as np

from emb_bench.brake.parameters import least
from emb_bench.estimate.intervals import bounded, deviations, interval, largest, unnoticed
from emb_bench.estimate.records import Contribution


def test_biases_by_several_effects_add_in_quadrature_and_none_is_zero() -> None:
    budget = [Contribution("drag", (3.0, 0.0)), Contribution("J", (4.0, -2.0))]
    assert unnoticed(budget, 2).tolist() == [5.0, 2.0]
    assert unnoticed(budget, 2, ("J",)).tolist() == [3.0, 0.0]
    assert unnoticed([], 2).tolist() == [0.0, 0.0]
    assert [largest(budget, 0), largest(budget, 0, ("J",))] == budget[::-1]
    assert largest(budget, 1, ("J",)) is None


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


def test_an_interval_ends_at_the_least_value_that_a_brake_can_have() -> None:
    for name, value, given, expected in (
        ("k_1", 82.0, (-318.5, inf), (-inf, inf)),
        ("k_1", 23.0, (-1.0, 47.0), (0.0, 47.0)),
        ("k_1", 23.0, (22.0, 24.0), (22.0, 24.0)),
        ("J", 8e-6, (-inf, 3e-5), (-inf, 3e-5)),
        ("T_c", -0.01, (-0.02, 0.0), (-0.02, 0.0)),  # of a biased method
        ("break_away", 1.2, (0.7, 1.7), (1.0, 1.7)),
        ("quadratic", 1e-4, (-1e-4, 3e-4), (-1e-4, 3e-4)),
        ("offset", 0.1, (-0.2, 0.4), (-0.2, 0.4)),
    ):
        assert bounded(given, value, least(name)) == expected, name
