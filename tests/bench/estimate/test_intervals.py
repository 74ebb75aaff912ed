"""Rules of intervals by a table from docs/explanation/estimation.md; a measured parameter takes the place of J."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from emb_bench.brake.parameters import least
from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.intervals import bounded, deviations, interval, largest, unnoticed
from emb_bench.estimate.records import NORMAL_95, Contribution, EstimationProblem, freed
from emb_runtime.config.bench import PARAMETER_NAMES
from tests.bench.measurements import currents_of, fit, record


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


WRONG = 1.03  # True J over that of the bench file


def measured(bench: Bench, **known: float) -> Estimate:
    """Estimate with a wrong J from a brake whose k_m is known to shares of it, 95 %; nothing else is uncertain."""
    true = replace(bench, brake=bench.brake._replace(J=WRONG * bench.brake.J))
    plant = bench.plant("exact")
    data = record(true, plant, currents_of(bench, "chirp"), seed=1, brake=true.brake)
    here = replace(bench, systematic=replace(bench.systematic, angle_scale=0.0, play=0.0))
    said = {
        name: (getattr(bench.brake, name), half * getattr(bench.brake, name) / NORMAL_95)
        for name, half in known.items()
    }
    asked = with_systematic(freed(EstimationProblem(known=said), here), here, plant)
    return fit(here, plant, [data], asked)


def test_a_known_k_m_frees_j_and_all_totals_are_of_its_order(bench: Bench) -> None:
    e = measured(bench, k_m=1e-3)
    halves = dict(zip(e.labels, NORMAL_95 * e.deviations(), strict=True))
    values = dict(zip(e.labels, e.values.tolist(), strict=True))
    for name in (*PARAMETER_NAMES, "J"):
        true = getattr(bench.brake, name) * (WRONG if name == "J" else 1.0)
        assert abs(values[name] / true - 1.0) < halves[name] < 3e-3, name
    assert halves["k_m"] == pytest.approx(1e-3, rel=0.01)
    wrong = measured(bench)
    assert wrong.theta.k_m == pytest.approx(bench.brake.k_m / WRONG, rel=1e-3)
    assert "J" not in wrong.labels


def test_it_may_be_said_in_the_bench_file(bench: Bench) -> None:
    stated = replace(bench, systematic=replace(bench.systematic, k_m=1e-3 / NORMAL_95))
    asked = with_systematic(EstimationProblem(), stated, stated.plant("exact"))
    assert asked == with_systematic(asked, stated, stated.plant("exact"))
    assert asked.known["k_m"] == pytest.approx((bench.brake.k_m, 1e-3 / NORMAL_95 * bench.brake.k_m))
    assert (asked.nuisances, asked.known["J"]) == (("J",), (bench.brake.J, 0.05 * bench.brake.J))
    assert "J" not in asked.unmodelled
    without = with_systematic(EstimationProblem(("f_v",)), stated, stated.plant("exact"))
    assert without.known == {}


@pytest.mark.parametrize("known", [{}, {"k_m": 1e-3}])
def test_ratios_to_j_are_right_where_j_is_not(bench: Bench, known: dict[str, float]) -> None:
    ratios = measured(bench, **known).ratios()
    assert [one.name for one in ratios] == ["k_m/J", "k_1/J", "T_c/J", "f_v/J"]
    for name, one in zip(PARAMETER_NAMES, ratios, strict=True):
        low, high = one.interval
        assert low < getattr(bench.brake, name) / (WRONG * bench.brake.J) < high
        assert high - low < 0.01 * one.value
