"""The speed loop: what current a target speed asks for."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.brake import euler
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.estimator.kalman import State, initial_state, make_model
from emb_runtime.estimator.speed_loop import current_for
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
MODEL = make_model(BENCH, BENCH.range_set("pm50"))
UNIT = (1.0, 1.0, 1.0, 1.0)


def state_at(x: float, v: float, parameters: tuple[float, float, float, float] = UNIT) -> State:
    return initial_state(MODEL)._replace(mean=(x, v, *parameters))


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
        return current_for(MODEL, state_at(x, v), UNIT, speed, 1.0)

    for speed in (3.0, -3.0):
        assert MODEL.motor * current(speed) == pytest.approx(speed / 1e-3 + math.copysign(MODEL.coulomb, speed))
    assert current(0.0) == 0.0
    assert MODEL.motor * current(-1.0, v=1.0) == pytest.approx(-2.0 / 1e-3 - MODEL.coulomb + MODEL.viscous)
    assert MODEL.motor * current(0.0, x=20.0) == pytest.approx(20.0 * MODEL.spring)
    assert current(0.0, x=-5.0) == 0.0
