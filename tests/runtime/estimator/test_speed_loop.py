"""The speed loop: what current a speed asks for, and which level holds when."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake import euler
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.estimator.kalman import State, make_model, start
from emb_runtime.estimator.speed_loop import current_for, follow_reference, scale_of, share_after
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
MODEL, EXACT = (make_model(BENCH, BENCH.range_set("pm50"), sticks=sticks) for sticks in (False, True))
SCALE = scale_of(BENCH)
UNIT = (1.0, 1.0, 1.0, 1.0)


def state_at(x: float, v: float, parameters: tuple[float, float, float, float] = UNIT) -> State:
    return start(MODEL)._replace(mean=(x, v, *parameters))


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.floats(0.6, 1.4)] * 4), st.floats(1.0, 90.0), st.floats(-15.0, 15.0), st.sampled_from([1.0, 0.4]))
def test_it_reaches_the_speed_or_its_share_of_it_within_one_period_where_the_current_suffices(
    relative: tuple[float, float, float, float], x: float, change: float, gain: float
) -> None:
    nominal = BENCH.brake
    k_m, k_1, t_c, f_v = (a * b for a, b in zip(relative, nominal[2:], strict=True))
    brake = BrakeParameters(nominal.J, nominal.gamma, k_m, k_1, t_c, f_v)
    current = current_for(MODEL, state_at(x, 200.0, relative), relative, 200.0 + change, gain)
    _, v = euler.step(brake, x, 200.0, current, MODEL.sample_time)
    if abs(current) < MODEL.current:
        assert v == pytest.approx(200.0 + gain * change, abs=1e-6)
    else:
        assert abs(current) == MODEL.current
        assert (v - 200.0 - gain * change) * current < 0.0


def test_a_brake_that_sticks_is_driven_against_the_friction_of_where_it_is_to_go() -> None:
    def current(speed: float, v: float = 0.0, x: float = 0.0) -> float:
        return current_for(EXACT, state_at(x, v), UNIT, speed, 1.0)

    for speed in (3.0, -3.0):
        assert EXACT.motor * current(speed) == pytest.approx(speed / 1e-3 + math.copysign(EXACT.coulomb, speed))
    assert current(0.0) == 0.0
    assert EXACT.motor * current(-1.0, v=1.0) == pytest.approx(-2.0 / 1e-3 - EXACT.coulomb + EXACT.viscous)
    assert EXACT.motor * current(0.0, x=20.0) == pytest.approx(20.0 * EXACT.spring)
    assert current(0.0, x=-5.0) == 0.0
    uncertain = state_at(0.0, 1.0)  # ± 5 rad/s: for Euler's brake the mean of the sign counts
    found = MODEL.motor * current_for(MODEL, uncertain, UNIT, 1.0, 1.0)
    assert found == pytest.approx(MODEL.coulomb * math.tanh(0.8 / 5.0) + MODEL.viscous)


def wanted(levels: list[float], switches: list[float], step: float) -> float:
    """Mean level of the coming period, by the current of a loop so slow that it is proportional."""
    slow = SCALE._replace(gain=1e-6)
    state, model = state_at(-1.0, 0.0), EXACT._replace(coulomb=0.0)
    proportional = 1e-6 * SCALE.speed / 1e-3 / model.motor
    return follow_reference(model, state, UNIT, slow, levels, switches, step) / proportional


def test_levels_hold_between_their_switches_and_in_the_period_of_a_switch_by_their_shares() -> None:
    levels = [1.0, -1.0, -0.01]
    for step, expected in ((0.0, 1.0), (149.0, 1.0), (150.0, -1.0), (299.0, -1.0), (300.0, -0.01), (499.0, -0.01)):
        assert wanted(levels, [0.3, 0.6], step) == pytest.approx(expected)
    assert wanted(levels, [100.25 / 500, 0.6], 100.0) == pytest.approx(0.25 - 0.75)
    assert wanted(levels, [0.2, 0.1], 99.0) == pytest.approx(1.0)  # a switch before the one that comes first
    assert wanted(levels, [0.2, 0.1], 101.0) == pytest.approx(-0.01)
    assert wanted([0.5], [], 7.0) == pytest.approx(0.5)
    found = [share_after(0.1, step, 500.0) for step in (0.0, 49.0, 49.5, 50.0, 60.0)]
    assert found == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])


def test_the_scale_is_the_benchs() -> None:
    assert (scale_of(BENCH, 0.3), scale_of(BENCH).gain) == ((500.0, 500.0, 0.3), 1.0)
