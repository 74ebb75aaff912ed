"""Sensors judged over time: honest ones of any brake of the set never alarm, faulty ones do, in the stated time."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.config.bench import Bench, BrakeParameters, load_bench
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.sensor_monitor import (
    CONFIRMED,
    CONTRADICTING,
    HONEST,
    MEMORY,
    OBEYS,
    OUTSIDE_SET,
    REVERSED,
    SensorMonitor,
    begin,
    coasting_time,
    judge,
    largest_current,
)
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield_design import make_law
from emb_runtime.safety.state_machine import Fault, StopError

BENCH = load_bench()
LAW = make_law(BENCH)
LIMITS = sensor_thresholds(BENCH, LAW)
BOX = BENCH.range_set(BENCH.shield.ranges)
TS = 1e-3

Sensors = Callable[[float, float, int], tuple[float, float]]
Policy = Callable[[float, float, int], float]


def honest(angle: float, velocity: float, _k: int) -> tuple[float, float]:
    return angle, velocity


def gentle_then_full(_x: float, _v: float, k: int) -> float:
    """6 A to and fro after a gentle begin: half a period of 30 ms."""
    return 2.0 if k < 20 else 6.0 if (k - 20) // 30 % 2 else -6.0


def moved(p: BrakeParameters, x: float, v: float, u: float) -> tuple[float, float]:
    """The brake one sample on, by 50 pieces: written here, with an exact standstill."""
    h = TS / 50
    for _ in range(50):
        drive = (p.k_m * u - p.gamma * p.k_1 * max(x, 0.0)) / p.J
        friction = p.T_c / p.J
        if v == 0.0 and abs(drive) <= friction:
            continue
        way = math.copysign(1.0, v) if v else math.copysign(1.0, drive)
        after = v + h * (drive - way * friction - p.f_v / p.J * v)
        if v and after * v < 0.0:
            after = 0.0
        x, v = x + 0.5 * h * (v + after), after
    return x, v


class Run:
    """A brake, its sensors and the monitor, without a shield."""

    def __init__(
        self,
        p: BrakeParameters = BENCH.brake,
        sensors: Sensors = honest,
        policy: Policy = gentle_then_full,
        *,
        bench: Bench = BENCH,
        motor: float = 1.0,
        noise: random.Random | None = None,
        lost: Callable[[int], bool] = lambda k: False,
        samples: int = 300,
    ) -> None:
        law = make_law(bench)
        limits = sensor_thresholds(bench, law)
        memory = [0.0] * MEMORY
        x = v = 0.0
        begin(memory, *sensors(x, v, 0))
        self.verdict, self.seen, self.confirmed = HONEST, samples, -1
        self.farthest = self.fastest = 0.0
        periods, command = 0, 0.0
        for k in range(samples):
            u = policy(x, v, k) if periods == 0 else 0.0
            if periods == 0:
                command = u
            x, v = moved(p, x, v, motor * u)
            self.farthest, self.fastest = max(self.farthest, abs(x)), max(self.fastest, abs(v))
            periods += 1
            if lost(k):
                continue
            errors = (noise.gauss(0.0, 1e-3), noise.gauss(0.0, 1.0)) if noise else (0.0, 0.0)
            angle, velocity = sensors(x, v, k + 1)
            self.verdict = judge(
                law, limits, memory, periods * TS, angle + errors[0], velocity + errors[1], periods == 1, command, u
            )
            periods = 0
            if self.confirmed < 0 and memory[CONFIRMED]:
                self.confirmed = k + 1
            if self.verdict != HONEST:
                self.seen = k + 1
                break


def brakes(seed: int) -> BrakeParameters:
    rng = random.Random(seed)
    corner = rng.random() < 0.5
    return BrakeParameters(
        *(
            low + (float(rng.random() < 0.5) if corner else rng.random()) * (high - low)
            for low, high in zip(BOX.low, BOX.high, strict=True)
        )
    )


# --- honest sensors ---------------------------------------------------------------------------------------------------


@given(st.integers(0, 10**9), st.integers(2, 80), st.floats(0.0, 6.0), st.floats(0.0, 0.2))
def test_honest_sensors_of_any_brake_of_the_set_never_alarm(
    seed: int, half_period: int, current: float, share_lost: float
) -> None:
    rng = random.Random(seed)
    run = Run(
        brakes(seed),
        policy=lambda _x, _v, k: current if k // half_period % 2 == 0 else -current,
        noise=rng,
        lost=lambda _k: rng.random() < share_lost,
        samples=150,
    )
    assert run.verdict == HONEST


@pytest.mark.parametrize("declared", [{"frame_age": (0, 2)}, {"current_lag": 0.002}], ids=["late", "lag"])
@pytest.mark.parametrize("seed", range(5))
def test_honest_sensors_never_alarm_where_frames_or_currents_may_be_late(declared: dict[str, Any], seed: int) -> None:
    bench = replace(BENCH, shield=BENCH.shield._replace(**declared))
    rng = random.Random(seed)
    run = Run(brakes(seed), bench=bench, noise=rng, lost=lambda _k: rng.random() < 0.1, samples=150)
    assert run.verdict == HONEST
    frozen = Run(brakes(seed), lambda *_: (0.0, 0.0), lambda *_: 6.0, bench=bench)
    assert frozen.verdict == OUTSIDE_SET


def test_a_gentle_first_move_confirms_the_polarity_within_15_ms_on_any_brake() -> None:
    for seed in range(20):
        run = Run(brakes(seed), policy=lambda *_: LIMITS.first_current, noise=random.Random(seed), samples=40)
        assert run.verdict == HONEST
        assert 2 <= run.confirmed <= 15


# --- faulty sensors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.3, 0.5, 0.8, 1.3, 3.0])
def test_a_scale_of_the_velocity_alone_is_seen(scale: float) -> None:
    assert Run(sensors=lambda x, v, _k: (x, scale * v)).verdict != HONEST


def test_a_scale_of_both_by_a_half_is_a_brake_on_the_border_of_the_set() -> None:
    assert Run(sensors=lambda x, v, _k: (0.5 * x, 0.5 * v)).verdict == HONEST


def test_a_wrong_sign_is_seen_in_the_first_gentle_move() -> None:
    for (sensors, motor), seed in itertools.product(
        [
            (honest, -1.0),
            (lambda x, v, _k: (-x, -v), 1.0),
            (lambda x, v, _k: (-x, v), 1.0),
            (lambda x, v, _k: (x, -v), 1.0),
        ],
        range(10),
    ):
        run = Run(
            brakes(seed), sensors, lambda *_: LIMITS.first_current, motor=motor, noise=random.Random(seed), samples=40
        )
        assert (run.verdict, run.confirmed) == (REVERSED, -1)
        assert run.seen <= 15
        assert run.farthest < 0.7


def test_both_drifting_alike_is_seen_where_friction_would_have_stopped_the_brake() -> None:
    def drifting(x: float, v: float, k: int) -> tuple[float, float]:
        n = max(k - 60, 0)
        return x + TS * (0.5 * min(n, 30) ** 2 + 30.0 * max(n - 30, 0)), v + min(n, 30)

    run = Run(sensors=drifting, policy=lambda _x, _v, k: 2.0 if k < 30 else 0.0)
    assert run.verdict == OUTSIDE_SET
    assert run.seen <= 110


def drifting_with_every_nth_missing(nth: int, drift: float, policy: Policy) -> Run:
    """The angle drifts, and every nth pair is missing; 500 samples."""
    return Run(
        sensors=lambda x, v, k: (x + drift * TS * k, v),
        policy=policy,
        lost=lambda k: k % nth == nth // 2,
        samples=500,
    )


def test_missing_pairs_hide_a_drift_of_65_rad_s_times_their_share_and_little_more() -> None:
    for policy, sign, nth in itertools.product([lambda *_: 0.0, gentle_then_full], [-1.0, 1.0], [5, 10, 20]):
        hidden = drifting_with_every_nth_missing(nth, sign * 65.0 / nth, policy)
        assert hidden.verdict == HONEST
        seen = drifting_with_every_nth_missing(nth, sign * (65.0 / nth + 5.0), policy)
        assert seen.verdict == CONTRADICTING
        assert seen.seen <= 100


# --- hostile numbers --------------------------------------------------------------------------------------------------


def test_what_is_no_number_contradicts() -> None:
    for bad, place in itertools.product([math.nan, math.inf, -math.inf, 1e300, -1e300], range(4)):
        numbers = [0.0, 0.0, 0.0, 0.0]
        numbers[place] = bad
        memory = [0.0] * MEMORY
        begin(memory, 0.0, 0.0)
        angle, velocity, command, reported = numbers
        assert judge(LAW, LIMITS, memory, TS, angle, velocity, True, command, reported) == CONTRADICTING
        assert all(map(math.isfinite, memory))


@pytest.mark.parametrize("elapsed", [math.nan, math.inf, -math.inf, 0.0, -TS, 1e9])
def test_a_time_that_is_none_contradicts(elapsed: float) -> None:
    memory = [0.0] * MEMORY
    begin(memory, 0.0, 0.0)
    assert judge(LAW, LIMITS, memory, elapsed, 0.0, 0.0, True, 0.0, 0.0) == CONTRADICTING


wild = st.floats(-1e6, 1e6) | st.floats(-10.0, 10.0)


@given(st.lists(st.tuples(st.floats(1e-9, 1e6), wild, wild, st.booleans(), wild, wild), max_size=8))
def test_whatever_comes_the_memory_stays_finite(
    samples: list[tuple[float, float, float, bool, float, float]],
) -> None:
    memory = [0.0] * MEMORY
    begin(memory, 0.0, 0.0)
    for elapsed, angle, velocity, obeyed, command, reported in samples:
        verdict = judge(LAW, LIMITS, memory, elapsed, angle, velocity, obeyed, command, reported)
        assert verdict in (HONEST, CONTRADICTING, OUTSIDE_SET, REVERSED)
        assert all(map(math.isfinite, memory))


# --- the monitor of a run ---------------------------------------------------------------------------------------------


def sample(angle: float, velocity: float) -> SensorSample:
    return SensorSample(0, angle, velocity, 0, 0, 0.0, 15, NodeState.ACTIVE)


def test_the_monitor_of_a_run_raises_the_fault_with_sum_and_threshold() -> None:
    monitor = SensorMonitor(LAW, LIMITS)
    monitor.begin(sample(0.0, 0.0))
    for k in range(1, 7):
        monitor.check(TS, sample(0.02 * k, 0.0), False, 0.0)
    with pytest.raises(StopError) as caught:
        monitor.check(TS, sample(0.14, 0.0), False, 0.0)
    assert caught.value.fault is Fault.SENSORS_CONTRADICT
    assert f"threshold {LIMITS.travel:.2f} rad" in caught.value.detail


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
        monitor.begin(sample(angle, velocity))
        assert monitor.largest_current(6.0) == most
    monitor.begin(sample(0.0, 60.0))
    assert 0.0 < monitor.largest_current(6.0) < LIMITS.first_current


def test_once_the_motion_has_shown_its_sign_nothing_is_limited() -> None:
    memory = [0.0] * MEMORY
    begin(memory, 50.0, 300.0)
    assert largest_current(LAW, LIMITS, memory, 6.0) == LIMITS.first_current
    memory[OBEYS] = 1.0
    assert largest_current(LAW, LIMITS, memory, 6.0) == 6.0
    assert largest_current(LAW, LIMITS, memory, 1.0) == 1.0


def test_a_first_move_at_its_limit_and_a_period_of_the_nodes_own_stop_are_stopped_by_friction() -> None:
    """Also where the sign is wrong, so that the stop drives the brake; whatever the policy wanted."""
    for motor, seed in itertools.product([1.0, -1.0], range(40)):
        rng = random.Random(seed)
        memory, p = [0.0] * MEMORY, brakes(seed)
        x, v = rng.uniform(-0.5, 0.5), 0.0
        begin(memory, x, v)
        for _ in range(60):
            most = largest_current(LAW, LIMITS, memory, 6.0)
            ahead = moved(p, x, v, motor * rng.choice([-most, most]))
            left = moved(p, *ahead, -motor * min(max(-6.0 * ahead[1] / 60.0, -6.0), 6.0))
            if memory[OBEYS] == 0.0 and most != LIMITS.first_current:
                rest, speed = left
                for _ in range(300):
                    rest, speed = moved(p, rest, speed, 0.0)
                assert speed == 0.0
                assert abs(rest) < 9.7
                assert coasting_time(LAW, *left) > 0.0
            u = rng.choice([-most, 0.0, most])
            x, v = moved(p, x, v, motor * u)
            if judge(LAW, LIMITS, memory, TS, x + rng.gauss(0.0, 1e-3), v + rng.gauss(0.0, 1.0), True, u, u) != HONEST:
                break


def test_the_first_move_at_its_limit_shows_the_sign_within_4_ms_on_any_brake() -> None:
    for seed in range(20):
        for motor in (1.0, -1.0):
            rng = random.Random(seed)
            memory, p, x, v = [0.0] * MEMORY, brakes(seed), 0.0, 0.0
            begin(memory, x, v)
            for _ in range(4):
                u = largest_current(LAW, LIMITS, memory, 6.0)
                x, v = moved(p, x, v, motor * u)
                seen = judge(LAW, LIMITS, memory, TS, x + rng.gauss(0.0, 1e-3), v + rng.gauss(0.0, 1.0), True, u, u)
                if seen != HONEST or memory[OBEYS]:
                    break
            assert (seen, memory[OBEYS]) == ((HONEST, 1.0) if motor > 0.0 else (REVERSED, 0.0))


def test_friction_is_waited_for_where_the_motion_has_not_shown_its_sign() -> None:
    for shown in (False, True):
        monitor = SensorMonitor(LAW, LIMITS)
        monitor.begin(sample(0.0, 0.0))
        if shown:
            x, v = moved(BENCH.brake, 0.0, 0.0, 6.0)
            monitor.check(TS, SensorSample(0, x, v, 0, 0, 6.0, 15, NodeState.ACTIVE), True, 6.0)
        for velocity in (20.0, 80.0):
            assert (monitor.coasting_time(sample(0.1, velocity)) > 0.0) != shown
            assert (monitor.coasting_time(sample(0.1, velocity)) == 0.0) == shown


def test_a_run_begins_where_its_first_sample_lies() -> None:
    monitor = SensorMonitor(LAW, LIMITS)
    monitor.begin(sample(3.0, 0.0))
    monitor.check(TS, sample(3.0, 0.0), False, 0.0)
    monitor.begin(sample(-3.0, 0.0))
    monitor.check(TS, sample(-3.0, 0.0), False, 0.0)


def test_friction_is_waited_for_up_to_the_speed_that_the_page_gives() -> None:
    monitor = SensorMonitor(LAW, LIMITS)
    monitor.begin(sample(0.0, 0.0))
    assert monitor.coasting_time(sample(0.1, 126.41)) > 0.0
    assert monitor.coasting_time(sample(0.1, 126.71)) == 0.0


def test_a_monitor_that_has_heard_nothing_limits_the_first_move_already() -> None:
    fresh, begun = SensorMonitor(LAW, LIMITS), SensorMonitor(LAW, LIMITS)
    begun.begin(sample(0.0, 0.0))
    assert fresh.largest_current(100.0) == begun.largest_current(100.0) < 20.0


# --- a brake that is left to friction ---------------------------------------------------------------------------------


def test_the_wait_is_longer_by_what_the_last_current_may_have_added_unseen() -> None:
    waits = []
    for current in (0.0, 5.0, -5.0):
        monitor = SensorMonitor(LAW, LIMITS)
        monitor.begin(sample(0.0, 0.0))
        monitor.check(TS, SensorSample(0, 0.0, 0.0, 0, 0, current, 15, NodeState.ACTIVE), True, current)
        waits.append(monitor.coasting_time(sample(0.0, 10.0)))
    speed = 10.0 + LAW.velocity_noise
    assert waits[0] == pytest.approx(2.0 * speed / LAW.friction_low)
    fastest = speed + LAW.motor_high * 5.0 * LIMITS.lag
    spring = LAW.spring_high * LAW.angle_noise
    assert waits[1] == waits[2] == pytest.approx(fastest / (LAW.friction_low - spring))


def test_at_the_border_friction_stops_any_brake_within_the_free_stroke() -> None:
    for seed, (angle, velocity), sign in itertools.product(
        range(20), [(0.0, 127.0), (2.0, 109.0), (3.9, 89.0), (-2.0, 109.0), (-3.9, 89.0)], [-1.0, 1.0]
    ):
        wait = coasting_time(LAW, angle, sign * velocity)
        assert 0.1 < wait < 0.25
        x, v = angle, sign * velocity
        for _ in range(math.ceil(wait / TS)):
            x, v = moved(brakes(seed), x, v, 0.0)
        assert v == 0.0
        assert abs(x) < 8.0
