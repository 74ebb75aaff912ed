"""What a bench may declare beyond the thesis's brake, and the envelope of a drive that can only let go: by search."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench, load_bench
from emb_runtime.safety.shield import shield, window
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from tests.properties.shield_climb import climb
from tests.properties.shield_search import (
    COASTING,
    DROPS,
    FINE,
    LAST_SPEED,
    PLANT,
    ROUGH,
    Floats,
    bench_with,
    coasting_induction,
    draw_brakes,
    lagging_induction,
    search,
)

SHIPPED = load_bench()
Induction = Callable[[ShieldLaw, Floats, Floats, NDArray[np.bool_]], int]


DECLARED = [
    pytest.param("stribeck", {"break_away": 1.2}, id="stribeck"),
    pytest.param("load", {"break_away": 1.2, "f_l": 2e-6}, id="load"),
    pytest.param("lag", {"current_lag": 0.002}, id="lag"),
    pytest.param("rough", ROUGH, id="rough"),
    pytest.param("cubic", {}, id="cubic"),
    pytest.param("hysteresis", {}, id="hysteresis"),
]


@pytest.mark.parametrize(("plant", "declared"), DECLARED)
def test_a_brake_whose_features_are_declared_is_held_and_comes_home(plant: str, declared: dict[str, Any]) -> None:
    found = search(bench_with(**declared), 800, seed=21, plant=plant)
    assert set(found.labels[:, 3]) == {FINE, PLANT}
    assert not found.violated.any(), found.describe(int(np.flatnonzero(found.violated)[0]))
    assert found.home[found.obeyed].all()


@pytest.mark.parametrize("declared", [ROUGH, {"current_lag": 0.0005}, {"frame_age": (0, 5)}, {"frame_age": (2, 4)}])
def test_all_that_can_be_declared_holds_the_limits_whatever_is_lost(declared: dict[str, Any]) -> None:
    found = search(bench_with(**declared), 1000, seed=22)
    assert set(found.labels[:, 2]) == set(range(len(DROPS)))
    assert not found.violated.any(), found.describe(int(np.flatnonzero(found.violated)[0]))


@pytest.mark.parametrize("plant", ["lag", "rough"])
def test_a_lag_that_is_not_declared_breaks_the_limits(plant: str) -> None:
    assert search(SHIPPED, 300, seed=23, plant=plant).violated.mean() > 0.1


def test_half_of_the_lag_is_not_enough() -> None:
    assert search(bench_with(current_lag=0.0007), 600, seed=24, plant="lag").violated.any()


@pytest.mark.parametrize("freewheel", [False, True])
def test_the_coasting_envelope_needs_no_brake_when_commands_are_lost(freewheel: bool) -> None:
    found = search(bench_with(**COASTING), 1500, seed=25, freewheel=freewheel)
    assert not found.violated.any(), found.describe(int(np.flatnonzero(found.violated)[0]))
    assert found.home[found.obeyed].all()
    killed = found.of("killed")
    assert found.rows[killed, LAST_SPEED].max() < 60.0  # it rests, or creeps under Euler's sign()


def test_hill_climbing_finds_no_way_out() -> None:
    for declared in ({}, ROUGH, COASTING, {"frame_age": (0, 5)}):
        assert climb(bench_with(**declared), 30, 40, seed=26).min() > 0.0


def test_hill_climbing_finds_the_way_out_of_a_law_without_its_margin() -> None:
    law = make_law(SHIPPED)
    careless = law._replace(bottom=law.bottom - 0.3, top=law.top + 0.3)
    assert climb(SHIPPED, 30, 40, seed=26, law=careless).min() < 0.0


def failures(induction: Induction, draws: int, bench: Bench, law: ShieldLaw) -> tuple[int, int]:
    rng = np.random.default_rng(27)
    failed = np.zeros(60_000, dtype=np.bool_)
    brakes = draw_brakes(rng, bench.range_set(bench.shield.ranges), len(failed))
    tried = compiled(induction)(law, brakes, rng.random((len(failed), draws)), failed)
    return tried, int(failed.sum())


def test_one_period_keeps_what_is_safe_with_a_lagging_current() -> None:
    bench = bench_with(current_lag=0.002)
    law = make_law(bench)
    tried, failed = failures(lagging_induction, 16, bench, law)
    assert tried > 50_000
    assert failed == 0
    forgetful = law._replace(kept=0.0)  # as if the current were there at once
    assert failures(lagging_induction, 16, bench, forgetful)[1] > 0


def test_one_period_keeps_what_can_coast() -> None:
    bench = bench_with(**COASTING)
    law = make_law(bench)
    tried, failed = failures(coasting_induction, 10, bench, law)
    assert tried > 50_000
    assert failed == 0
    optimistic = law._replace(friction_low=1.5 * law.friction_low)
    assert failures(coasting_induction, 10, bench, optimistic)[1] > 0


@settings(max_examples=600, deadline=None)
@given(
    st.sampled_from([{}, ROUGH, COASTING, {"frame_age": (0, 3)}]),
    st.floats(-12.0, 105.0),
    st.floats(-550.0, 550.0),
    st.tuples(*[st.floats(-6.0, 6.0)] * 5),
    st.floats(-6.0, 6.0),
    st.integers(0, 499),
)
def test_the_shield_answers_inside_the_window_in_which_no_current_is_always_if_it_coasts(
    declared: dict[str, Any],
    angle: float,
    velocity: float,
    past: tuple[float, float, float, float, float],
    wanted: float,
    step: int,
) -> None:
    law = make_law(bench_with(**declared))
    lowest, highest = window(law, angle, velocity, past)
    sent, _ = shield(law, angle, velocity, wanted, past, step)
    assert -law.current <= lowest <= sent <= highest <= law.current
    assert not law.coasting or lowest <= 0.0 <= highest


def test_what_was_commanded_matters_to_a_lagging_current_and_not_to_a_fresh_one() -> None:
    pushed = (6.0,) * 5
    braked = (-6.0,) * 5
    lagging, fresh = make_law(bench_with(current_lag=0.002)), make_law(SHIPPED)
    assert window(fresh, 20.0, 470.0, pushed) == window(fresh, 20.0, 470.0, braked)
    assert window(lagging, 20.0, 440.0, pushed)[1] < window(lagging, 20.0, 440.0, braked)[1]
    assert window(fresh, 20.0, 100.0, (math.nan,) * 5) == (-6.0, 6.0)
    assert window(lagging, 20.0, 100.0, (math.nan,) * 5) == (-6.0, -6.0)
