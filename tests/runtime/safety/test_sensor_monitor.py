"""The sensor monitor of a run: numbers that are none, the first move, and the wait for friction.

Verdicts and sums of any run are those of the page (test_sensor_monitor_reference.py); whole runs with honest and faulty
sensors are played by the loop (test_lies.py, test_homing.py) and by the search (tests/searches/sensor_monitor.py).
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.sensor_monitor import (
    CONTRADICTING,
    HONEST,
    OUTSIDE_SET,
    REVERSED,
    SensorMonitor,
    begin_monitor,
    judge,
    largest_current,
)
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield_design import make_law
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
LAW = make_law(BENCH)
LIMITS = sensor_thresholds(BENCH, LAW)
TS = 1e-3


# --- hostile numbers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("elapsed", [math.nan, math.inf, -math.inf, 0.0, -TS, 1e9])
def test_a_time_that_is_none_contradicts(elapsed: float) -> None:
    assert judge(LAW, LIMITS, begin_monitor(0.0, 0.0), elapsed, 0.0, 0.0, True, 0.0, 0.0)[1] == CONTRADICTING


def numbers(state: Any) -> list[float]:
    """All numbers of a state."""
    return [number for part in state for number in numbers(part)] if isinstance(state, tuple) else [state]


wild = st.floats(-1e6, 1e6) | st.floats(-10.0, 10.0)


@given(st.lists(st.tuples(st.floats(1e-9, 1e6), wild, wild, st.booleans(), wild, wild), max_size=8))
def test_whatever_comes_the_state_stays_finite(samples: list[tuple[float, float, float, bool, float, float]]) -> None:
    state = begin_monitor(0.0, 0.0)
    for elapsed, angle, velocity, obeyed, command, reported in samples:
        state, verdict = judge(LAW, LIMITS, state, elapsed, angle, velocity, obeyed, command, reported)
        assert verdict in (HONEST, CONTRADICTING, OUTSIDE_SET, REVERSED)
        assert all(map(math.isfinite, numbers(state)))


# --- the monitor of a run ---------------------------------------------------------------------------------------------


def sample(angle: float, velocity: float) -> SensorSample:
    return SensorSample(0, angle, velocity, 0, 0, 0.0, 15, NodeState.ACTIVE)


def test_at_rest_at_the_origin_the_first_move_is_the_full_current_and_far_from_it_the_gentle_one() -> None:
    monitor = SensorMonitor(LAW, LIMITS)
    for angle, velocity, most in (
        (0.0, 0.0, 6.0),
        (3.5, 0.0, 6.0),
        (4.0, 0.0, LIMITS.first_current),
        (-4.0, 0.0, LIMITS.first_current),
        (50.0, 0.0, LIMITS.first_current),
        (0.0, 100.0, 0.0),  # what moves fast is left to friction, with either sign
        (0.0, -100.0, 0.0),
    ):
        monitor.begin_run(sample(angle, velocity))
        assert monitor.largest_current(6.0) == most
    monitor.begin_run(sample(0.0, 60.0))
    assert 0.0 < monitor.largest_current(6.0) < LIMITS.first_current


def test_once_the_motion_has_shown_its_sign_nothing_is_limited() -> None:
    state = begin_monitor(50.0, 300.0)
    assert largest_current(LAW, LIMITS, state, 6.0) == LIMITS.first_current
    state = state._replace(obeys=True)
    assert largest_current(LAW, LIMITS, state, 6.0) == 6.0
    assert largest_current(LAW, LIMITS, state, 1.0) == 1.0


def test_friction_is_waited_for_where_the_motion_has_not_shown_its_sign() -> None:
    for shown in (False, True):
        monitor = SensorMonitor(LAW, LIMITS)
        monitor.begin_run(sample(0.0, 0.0))
        if shown:
            v = TS * (6.0 * BENCH.brake.k_m - BENCH.brake.T_c) / BENCH.brake.J
            x = 0.5 * TS * v
            monitor.check(TS, SensorSample(0, x, v, 0, 0, 6.0, 15, NodeState.ACTIVE), True, 6.0)
        for velocity in (20.0, 80.0):
            assert (monitor.coasting_time(sample(0.1, velocity)) > 0.0) != shown
            assert (monitor.coasting_time(sample(0.1, velocity)) == 0.0) == shown


def test_a_run_begins_where_its_first_sample_lies() -> None:
    monitor = SensorMonitor(LAW, LIMITS)
    monitor.begin_run(sample(3.0, 0.0))
    monitor.check(TS, sample(3.0, 0.0), False, 0.0)
    monitor.begin_run(sample(-3.0, 0.0))
    monitor.check(TS, sample(-3.0, 0.0), False, 0.0)


def test_friction_is_waited_for_up_to_the_speed_that_the_page_gives() -> None:
    monitor = SensorMonitor(LAW, LIMITS)
    monitor.begin_run(sample(0.0, 0.0))
    assert monitor.coasting_time(sample(0.1, 126.41)) > 0.0
    assert monitor.coasting_time(sample(0.1, 126.71)) == 0.0


def test_a_monitor_that_has_heard_nothing_limits_the_first_move_already() -> None:
    fresh, begun = SensorMonitor(LAW, LIMITS), SensorMonitor(LAW, LIMITS)
    begun.begin_run(sample(0.0, 0.0))
    assert fresh.largest_current(100.0) == begun.largest_current(100.0) < 20.0
