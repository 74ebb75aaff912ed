"""The sensor monitor against the formulas of ``docs/explanation/sensor-monitor.md``, for laws and samples at random.

The reference is written from the page: it enumerates the brakes at the corners of the set where the monitor has closed
forms. A law's numbers are drawn independently of each other, so that none can stand in for another.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from random import Random
from typing import NamedTuple, cast

import pytest

from emb_runtime.config.bench import OLDEST_FRAME
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.sensor_monitor import (
    CONTRADICTING,
    HONEST,
    NO_CURRENTS,
    OUTSIDE_SET,
    REVERSED,
    Currents,
    SensorMonitor,
    State,
    begin_monitor,
    coasting_time,
    judge,
    largest_current,
    unseen_speed,
)
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield_design import VELOCITY_PAD, ShieldLaw, make_law
from emb_runtime.safety.state_machine import Fault, StopError
from tests.benches import SENSOR_BENCH
from tests.laws import with_numbers

BENCH = SENSOR_BENCH
SHIPPED = make_law(BENCH)
NEVER = 1e9
Range = tuple[float, float]
Run = tuple[State, "Sample"]  # The state before a sample, and that sample


class Sample(NamedTuple):
    """What :func:`judge` is told of one sample."""

    elapsed: float
    angle: float
    velocity: float
    obeyed: bool
    command: float
    reported: float


def sums_of(state: State) -> list[float]:
    """All that a state sums up, and what it has found out."""
    opposed = state.opposed
    sums = [*state.travel, *state.motion, *opposed.motion, opposed.travel, opposed.integral]
    return [*sums, float(state.confirmed), float(state.obeys)]


class Reference:
    """The sums and verdicts of the page."""

    def __init__(self, law: ShieldLaw, limits: SensorThresholds, angle: float, velocity: float) -> None:
        self.law, self.limits = law, limits
        self.x, self.v = angle, velocity
        self.travel, self.travel_from = [0.0, 0.0], [velocity, velocity]
        self.motion, self.opposed_motion = [0.0, 0.0], [0.0, 0.0]
        self.opposed_travel, self.opposed_from, self.integral = 0.0, velocity, 0.0
        self.confirmed = self.obeys = False
        self.acted: list[Range] = [(0.0, 0.0)] * (shown_late(law) + 1)
        self.flowing: Range = (0.0, 0.0)

    @property
    def sums(self) -> list[float]:
        """As :func:`sums_of`."""
        sums = [*self.travel, *self.motion, *self.opposed_motion, self.opposed_travel, self.integral]
        return [*sums, float(self.confirmed), float(self.obeys)]

    def judge(self, s: Sample) -> int:
        if any(not abs(n) <= 1e6 for n in s) or s.elapsed <= 0.0:
            return CONTRADICTING
        law, limits, x0, v0 = self.law, self.limits, self.x, self.v
        self.x, self.v = s.angle, s.velocity
        share = s.elapsed / law.sample_time
        missing = max(math.floor(share + 0.5), 1) - 1
        moved, integral, change = s.angle - x0, s.elapsed * (s.velocity + v0) / 2.0, s.velocity - v0

        slack = limits.offset * s.elapsed
        if missing:
            slack += law.change / law.sample_time * s.elapsed**2 / 4.0
        contradicts = False
        for way, sign in enumerate((1.0, -1.0)):
            self.travel[way] = max(self.travel[way] + sign * (moved - integral) - slack, 0.0)
            if self.travel[way] == 0.0:
                self.travel_from[way] = s.velocity
            gained = sign * (s.velocity - self.travel_from[way])
            contradicts |= self.travel[way] > limits.travel + (limits.lag if gained > 0 else limits.lead) * abs(gained)

        aside = law.angle_noise + missing * law.reach
        beyond = law.velocity_noise + missing * law.change
        angles = min(x0, s.angle) - aside, max(x0, s.angle) + aside
        speeds = min(v0, s.velocity) - beyond, max(v0, s.velocity) + beyond
        currents = self.currents(s, missing, speeds)

        def extremes(accelerations: Iterable[float]) -> Range:
            all_of_them = list(accelerations)
            return min(all_of_them), max(all_of_them)

        def sum_up(sums: list[float], accelerations: Range) -> None:
            least, most = accelerations
            sums[0] = max(sums[0] + change - share * gain(law, speeds[0], most), 0.0)
            sums[1] = max(sums[1] - change - share * gain(law, -speeds[1], -least), 0.0)

        sum_up(self.motion, extremes(drives_of(law, angles, currents)))
        if not self.confirmed:
            opposite = -currents[1], -currents[0]
            # A motor with the wrong sign; or sensors, so that the angle that is meant is the opposite one.
            wrong = [*drives_of(law, angles, opposite)]
            mirrored = -angles[1], -angles[0]
            wrong += [-a for a in drives_of(law, mirrored, currents)]
            sum_up(self.opposed_motion, extremes(wrong))
            self.opposed_travel += moved + integral
            self.integral += integral
            if missing:
                self.opposed_travel = self.integral = 0.0
                self.opposed_from = s.velocity
            return self.polarity(contradicts)
        if contradicts:
            return CONTRADICTING
        return OUTSIDE_SET if max(self.motion) > limits.motion else HONEST

    def polarity(self, contradicts: bool) -> int:
        limits = self.limits
        allowed = limits.travel + limits.lag * abs(self.v - self.opposed_from)
        angle_agrees = abs(self.opposed_travel) > allowed
        if contradicts:
            opposite_fits = not angle_agrees and abs(self.integral) >= limits.travel / 2.0
            return REVERSED if opposite_fits else CONTRADICTING
        if max(self.motion) > limits.motion:
            return REVERSED if max(self.opposed_motion) <= limits.motion / 2.0 else OUTSIDE_SET
        excluded = max(self.opposed_motion) > limits.motion
        self.obeys |= excluded
        self.confirmed = angle_agrees and excluded
        return HONEST

    def currents(self, s: Sample, missing: int, speeds: Range) -> Range:
        """Those that may have caused the change of the velocity."""
        law = self.law
        late = law.age_high * law.change
        damped = [
            min(max(-law.current * v / law.damping_velocity, -law.current), law.current)
            for v in (speeds[0] - late, speeds[1] + late)
        ]
        off = min(max(s.reported - s.command, -self.limits.current_error), self.limits.current_error)
        if missing:
            candidates = [0.0, s.command, *damped]
        elif s.obeyed:
            candidates = [s.command, s.command + off]
        else:
            candidates = [0.0, *damped]
        now = min(candidates), max(candidates)
        may = [now, *self.acted]
        self.acted = ([now] * (missing + 1) + self.acted)[: shown_late(law) + 1]
        acting = min(low for low, _ in may), max(high for _, high in may)
        if law.delay.lag == 0.0:
            return acting
        low, high = self.flowing
        self.flowing = (
            min(acting[0], acting[0] + law.delay.kept * (low - acting[0])),
            max(acting[1], acting[1] + law.delay.kept * (high - acting[1])),
        )
        return min(acting[0], low), max(acting[1], high)


def shown_late(law: ShieldLaw) -> int:
    """Periods before the last two that count: those of late frames, and whole time constants of an observer."""
    return min(law.age_high + (math.floor(1.0 / law.delay.observer) if law.delay.observer else 0), 5)


def drives_of(law: ShieldLaw, angles: Range, currents: Range) -> Iterator[float]:
    """What motor and spring of the brakes at the corners of the set do [rad/s²]."""
    xs = angles[0] - law.reach, angles[1] + law.reach
    motors, springs = (law.box.motor_low, law.box.motor_high), (law.box.spring_low, law.box.spring_high)
    for m, k, x, u in itertools.product(motors, springs, xs, currents):
        yield m * u - k * max(x, 0.0)


def gain(law: ShieldLaw, v: float, drive: float) -> float:
    """Most that a brake gains in one sample, which may stick where it would come to rest [rad/s]."""
    against = 1.0 if v > 0.0 else -1.0
    after = max(
        v + law.sample_time * (drive - against * c - d * v)
        for c in (law.box.friction_low, law.box.friction_high)
        for d in (law.box.viscous_low, law.box.viscous_high)
    )
    return (max(after, 0.0) if v > 0.0 else after) - v + VELOCITY_PAD


def drawn_law(rng: Random) -> ShieldLaw:
    motor, spring, friction, viscous = (
        sorted((rng.uniform(low, high), rng.uniform(low, high)))
        for low, high in ((1500.0, 6000.0), (30.0, 140.0), (800.0, 3400.0), (2.0, 9.0))
    )
    lag, observer = rng.choice([(0.0, 0.0), (rng.uniform(5e-4, 3e-3), 0.0), (0.0, rng.uniform(0.3, 3.0))])
    return with_numbers(
        SHIPPED,
        sample_time=rng.uniform(0.8e-3, 1.2e-3),
        age_high=rng.choice([0, 0, 1, 2, OLDEST_FRAME]),
        current=rng.uniform(3.0, 6.0),
        angle_noise=rng.uniform(1e-3, 0.1),
        velocity_noise=rng.uniform(0.1, 8.0),
        bottom=-rng.uniform(3.0, 9.7),
        reach=rng.uniform(0.1, 0.6),
        motor_low=motor[0],
        motor_high=motor[1],
        spring_low=spring[0],
        spring_high=spring[1],
        friction_low=friction[0],
        friction_high=friction[1],
        viscous_low=viscous[0],
        viscous_high=viscous[1],
        damping_velocity=rng.uniform(40.0, 90.0),
        change=rng.uniform(5.0, 60.0),
        lag=lag,
        kept=math.exp(-1e-3 / lag) if lag else 0.0,
        observer=observer,
    )


def drawn_limits(rng: Random) -> SensorThresholds:
    return SensorThresholds(
        travel=rng.uniform(0.02, 0.3),
        offset=rng.uniform(0.2, 2.0),
        lag=rng.uniform(2e-4, 2e-3),
        lead=rng.uniform(2e-4, 2e-3),
        motion=rng.uniform(2.0, 20.0),
        current_error=rng.uniform(0.1, 1.0),
        first_current=rng.uniform(1.0, 3.0),
    )


def drawn_samples(rng: Random, law: ShieldLaw, count: int) -> Iterator[Sample]:
    """A brake somewhere near the set, with signs, lies, gaps and disobedience that change now and then."""
    x, v, drift, offset = 0.0, 0.0, 0.0, 0.0
    signs = [rng.choice([1.0, 1.0, -1.0]) for _ in range(3)]
    motor, friction = rng.uniform(0.5, 1.5) * law.box.motor_high, rng.uniform(0.5, 1.5) * law.box.friction_low
    spring = rng.uniform(law.box.spring_low, law.box.spring_high)
    gaps, disobeyed, lies = rng.choice([0.0, 0.2]), rng.choice([0.0, 0.2]), rng.choice([0.0, 0.1])
    command = angle_lie = 0.0
    for _ in range(count):
        if rng.random() < 0.15:
            command = rng.choice([0.0, rng.uniform(-law.current, law.current)])
        if rng.random() < lies:
            drift, offset = rng.choice([0.0, rng.uniform(-60.0, 60.0)]), rng.choice([0.0, rng.uniform(-30.0, 30.0)])
        periods = rng.randint(2, 6) if rng.random() < gaps else 1
        elapsed = law.sample_time * rng.choice([periods, periods * rng.uniform(0.6, 1.4), 0.3])
        obeyed = rng.random() >= disobeyed
        before = v
        v += elapsed * (signs[0] * motor * (command if obeyed else 0.0) - spring * max(x, 0.0))
        v = math.copysign(max(abs(v) - elapsed * friction, 0.0), v)
        x += 0.5 * elapsed * (before + v)
        angle_lie += drift * elapsed
        noise = rng.gauss(0.0, 1e-3), rng.gauss(0.0, 1.0)
        angle, velocity = signs[1] * x + angle_lie + noise[0], signs[2] * v + offset + noise[1]
        if rng.random() < 0.003:
            angle = rng.choice([2e6, math.nan, -math.inf])
        reported = command + rng.choice([0.0, rng.uniform(-2.0, 2.0)])
        yield Sample(elapsed, angle, velocity, obeyed, command, reported)


def test_verdicts_and_sums_are_those_of_the_page() -> None:
    seen = dict.fromkeys([HONEST, CONTRADICTING, OUTSIDE_SET, REVERSED], 0)
    confirmed = 0
    for seed in range(60):
        rng = Random(seed)
        for _ in range(6):
            law, limits = drawn_law(rng), drawn_limits(rng)
            start = rng.uniform(-1.0, 1.0), rng.uniform(-3.0, 3.0)
            reference, state = Reference(law, limits, *start), begin_monitor(*start)
            for s in drawn_samples(rng, law, 60):
                expected = reference.judge(s)
                seen[expected] += 1
                state, found = judge(law, limits, state, *s)
                assert found == expected
                assert sums_of(state) == pytest.approx(reference.sums, rel=1e-9, abs=1e-9)
            confirmed += reference.confirmed
    assert min(confirmed, *seen.values()) >= 10


# --- exactly at a threshold -------------------------------------------------------------------------------------------


def state_after(law: ShieldLaw, samples: Iterable[Sample], limits: SensorThresholds, confirmed: bool = False) -> Run:
    """The state before the last sample, and that sample."""
    *before, last = samples
    state = begin_monitor(0.0, 0.0)._replace(confirmed=confirmed)
    for s in before:
        state, _ = judge(law, limits, state, *s)
    return state, last


SILENT = SensorThresholds(
    travel=NEVER, offset=0.5, lag=0.0, lead=0.0, motion=NEVER, current_error=0.5, first_current=2.0
)


def found(fits: Callable[[State], bool], confirmed: bool = False) -> tuple[ShieldLaw, Run, State]:
    """A law, the state before a sample, and that after it, such that it fits."""
    for seed in range(2000):
        rng = Random(seed)
        law = drawn_law(rng)
        samples = [s for s in drawn_samples(rng, law, 30) if abs(s.angle) < 1e6]
        state, last = state_after(law, samples, SILENT, confirmed)
        after, _ = judge(law, SILENT, state, *last)
        if fits(after):
            return law, (state, last), after
    raise AssertionError("expected a run whose sums fit, found none")


def verdict(law: ShieldLaw, run: Run, limits: SensorThresholds) -> tuple[int, bool]:
    """Of the last sample, and whether it has confirmed the polarity."""
    state, found = judge(law, limits, run[0], *run[1])
    return found, state.confirmed


def just_below(x: float) -> float:
    return math.nextafter(x, -math.inf)


@pytest.mark.parametrize("direction", ["up", "down"])
def test_a_travel_at_its_threshold_is_honest_and_beyond_it_not(direction: str) -> None:
    law, run, after = found(lambda state: getattr(state.travel, direction) > 0.0, confirmed=True)
    travel = getattr(after.travel, direction)
    assert verdict(law, run, SILENT._replace(travel=travel))[0] == HONEST
    assert verdict(law, run, SILENT._replace(travel=just_below(travel)))[0] == CONTRADICTING


@pytest.mark.parametrize("direction", ["up", "down"])
def test_a_motion_at_its_threshold_is_honest_and_beyond_it_not(direction: str) -> None:
    law, run, after = found(lambda s: getattr(s.motion, direction) == max(s.motion) > 0.0, confirmed=True)
    motion = max(after.motion)
    assert verdict(law, run, SILENT._replace(motion=motion))[0] == HONEST
    assert verdict(law, run, SILENT._replace(motion=just_below(motion)))[0] == OUTSIDE_SET


def sizes(state: State) -> tuple[float, float]:
    """Motion, and motion of the opposite polarity."""
    return max(state.motion), max(state.opposed.motion)


def test_until_the_polarity_is_confirmed_the_threshold_of_the_motion_is_the_same() -> None:
    law, run, sums = found(lambda m: sizes(m)[0] > 0.0)
    assert verdict(law, run, SILENT._replace(motion=sizes(sums)[0]))[0] == HONEST
    assert verdict(law, run, SILENT._replace(motion=just_below(sizes(sums)[0])))[0] in (OUTSIDE_SET, REVERSED)


def test_the_opposite_polarity_fits_up_to_half_the_threshold_of_the_motion() -> None:
    law, run, sums = found(lambda m: sizes(m)[0] > 2.2 * sizes(m)[1] > 0.0)
    half = sizes(sums)[1]
    assert verdict(law, run, SILENT._replace(motion=2.0 * half))[0] == REVERSED
    assert verdict(law, run, SILENT._replace(motion=just_below(2.0 * half)))[0] == OUTSIDE_SET


def test_the_polarity_is_confirmed_beyond_both_thresholds() -> None:
    law, run, sums = found(lambda s: sizes(s)[1] > sizes(s)[0] and abs(s.opposed.travel) > 2.0 * max(s.travel) > 0.0)
    motion, travel = sizes(sums)[1], abs(sums.opposed.travel)
    for limits, confirmed in (
        ((just_below(motion), just_below(travel)), True),
        ((motion, just_below(travel)), False),
        ((just_below(motion), travel), False),
    ):
        assert verdict(law, run, SILENT._replace(motion=limits[0], travel=limits[1])) == (HONEST, confirmed)


@pytest.mark.parametrize(
    ("travel", "expected"), [(1.95, REVERSED), (2.0, REVERSED), (2.05, CONTRADICTING), (2.2, CONTRADICTING)]
)
def test_the_opposite_sign_of_the_angle_fits_if_the_velocity_says_half_the_threshold(
    travel: float, expected: int
) -> None:
    law = SHIPPED._replace(sample_time=2.0**-10)
    integral = 2.0**-10
    sample = Sample(2.0**-10, -1.5 * integral, 2.0, True, 0.0, 0.0)
    limits = SILENT._replace(offset=0.0, travel=travel * integral)
    assert judge(law, limits, begin_monitor(0.0, 0.0), *sample)[1] == expected


def test_a_travel_of_exactly_zero_begins_anew() -> None:
    ts = 2.0**-10
    law = SHIPPED._replace(sample_time=ts)
    limits = SILENT._replace(offset=0.0, lag=0.5, lead=0.5)
    for sign in (-1.0, 1.0):
        state = begin_monitor(0.0, 0.0)._replace(confirmed=True)
        state, first = judge(law, limits, state, *Sample(ts, 4.0 * ts, 8.0, True, 0.0, 0.0))  # excess 0 at 8 rad/s
        assert first == HONEST
        thrown = Sample(ts, 12.0 * ts + sign, 8.0, True, 0.0, 0.0)  # 1 rad off, with no velocity gained since
        assert judge(law, limits._replace(travel=0.75), state, *thrown)[1] == CONTRADICTING


# --- what counts as a measurement -------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", range(4))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_numbers_count_up_to_a_million(place: int, sign: float) -> None:
    def state_of(size: float) -> State:
        numbers = [0.0, 0.0, 0.0, 0.0]
        numbers[place] = sign * size
        angle, velocity, command, reported = numbers
        state, verdict = judge(SHIPPED, SILENT, begin_monitor(0.0, 0.0), 1e-3, angle, velocity, True, command, reported)
        assert (verdict == CONTRADICTING) == (not size <= 1e6)
        return state

    for none in (math.nextafter(1e6, math.inf), math.inf, math.nan):
        assert state_of(none) == begin_monitor(0.0, 0.0)
    assert state_of(1e6) != begin_monitor(0.0, 0.0)


def test_a_sample_time_counts_up_to_a_million_seconds() -> None:
    for elapsed, expected in ((1e6, HONEST), (math.nextafter(1e6, math.inf), CONTRADICTING)):
        assert judge(SHIPPED, SILENT, begin_monitor(0.0, 0.0), elapsed, 0.0, 0.0, True, 0.0, 0.0)[1] == expected


# --- thresholds, coasting, faults -------------------------------------------------------------------------------------


def test_the_thresholds_are_those_of_the_page() -> None:
    for seed in range(20):
        rng = Random(seed)
        sigma, horizon, tolerated = rng.uniform(0.1, 3.0), rng.randint(100, 2000), rng.uniform(0.1, 1.0)
        bench = replace(
            BENCH,
            noise=replace(BENCH.noise, velocity=sigma),
            timing=replace(BENCH.timing, horizon=horizon),
            guard=replace(BENCH.guard, current_error=tolerated),
        )
        law = with_numbers(drawn_law(rng), observer=0.0)
        t = law.sample_time
        for observer, samples in ((0.5, 4.0), (2.0, 1.0), (3.0, 0.75)):
            observed = sensor_thresholds(bench, with_numbers(law, observer=observer))
            assert observed.lag == pytest.approx(samples * t)
            assert observed.lead == pytest.approx(0.75 * t)
        found = sensor_thresholds(bench, law)
        assert found.offset == pytest.approx(sigma / 2)
        assert found.travel == pytest.approx(2 * law.angle_noise + 4 * t * sigma * math.log(2 * horizon / 1e-9))
        assert found.lag == found.lead == pytest.approx(0.75 * t)
        mistaken = law.box.friction_low + law.box.friction_high
        assert found.motion == pytest.approx(2 * law.velocity_noise + t * mistaken)
        assert found.current_error == tolerated
        gentle = 1.5 * law.box.friction_high / law.box.motor_low
        assert found.first_current == pytest.approx(gentle if gentle < law.current else law.current)


def test_the_thresholds_of_the_shipped_bench_are_those_that_the_page_states() -> None:
    limits = sensor_thresholds(BENCH, SHIPPED)
    stated = round(limits.travel, 2), limits.offset, round(limits.motion, 1), round(limits.first_current, 2)
    assert stated == (0.12, 0.5, 16.5, 2.15)
    held = SHIPPED.box.friction_low / SHIPPED.box.spring_high
    missing = SHIPPED.change * SHIPPED.sample_time  # A T²/4 of one lost sample, T two periods
    assert (round(held, 1), round(held / 2.0, 1), round(missing, 3)) == (7.9, 4.0, 0.065)
    assert sensor_thresholds(BENCH, SHIPPED._replace(current=1.0)).first_current == 1.0


def test_friction_alone_stops_a_brake_within_the_free_stroke_and_what_the_spring_allows() -> None:
    law = with_numbers(SHIPPED, friction_low=4.0, velocity_noise=0.0, angle_noise=0.0, bottom=-2.0, spring_high=0.5)
    assert coasting_time(law, 1.5, 2.0) == 1.0  # twice v / d_1; 1.5 rad and v² / 2 d_1 are the free stroke
    assert coasting_time(law, -1.5, -2.0) == 1.0
    assert coasting_time(law, -1.5, -2.0, 4.5) == 2.0  # with what is not seen yet, and the spring's 0.75 against it
    assert coasting_time(law, 1.501, 2.0) == 0.0
    stiff = with_numbers(law, bottom=-9.0, spring_high=2.0)
    assert coasting_time(stiff, 1.0, 2.0 * math.sqrt(2.0)) == math.sqrt(2.0)  # and d_1 / w_2
    assert coasting_time(stiff, 1.0, 2.001 * math.sqrt(2.0)) == 0.0
    assert coasting_time(stiff, 1.0, 0.0) == 0.0  # at rest there is nothing to wait for
    assert coasting_time(stiff, -1.0, 1.0) == 0.5  # nor beyond d_1 / 2 w_2, where it would take too long
    assert coasting_time(stiff, -1.001, 1.0) == 0.0
    noisy = with_numbers(law, bottom=-90.0, spring_high=0.01, angle_noise=0.5, velocity_noise=1.0)
    assert coasting_time(noisy, 1.0, 3.0) == 2.0
    assert coasting_time(noisy._replace(bottom=-3.5), 1.0, 3.0) == 2.0
    assert coasting_time(noisy._replace(bottom=-3.49), 1.0, 3.0) == 0.0


def stopped(limits: SensorThresholds, run: Iterable[Sample], law: ShieldLaw = SHIPPED) -> StopError:
    monitor = SensorMonitor(law, limits)
    monitor.begin_run(SensorSample(0, 0.0, 0.0, 0, 0, 0.0, 15, NodeState.ACTIVE))

    def go() -> None:
        for s in run:
            told = SensorSample(0, s.angle, s.velocity, 0, 0, s.reported, 15, NodeState.ACTIVE)
            monitor.check(s.elapsed, told, s.obeyed, s.command)

    with pytest.raises(StopError) as caught:
        go()
    return caught.value


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_each_fault_tells_the_sum_and_the_threshold_that_it_passed(sign: float) -> None:
    limits = SILENT._replace(travel=0.25, motion=16.0)
    drifting = [Sample(1e-3, sign * 0.3, 0.0, True, 0.0, 0.0)]
    told = "the angle is 0.30 rad beyond the integral of the velocity (threshold 0.25 rad)"
    assert (stopped(limits, drifting).fault, stopped(limits, drifting).detail) == (Fault.SENSORS_CONTRADICT, told)

    backwards = [Sample(1e-3, -sign * 1e-3 * (100.0 * k - 50.0), sign * 100.0, True, 0.0, 0.0) for k in range(1, 9)]
    caught = stopped(limits._replace(motion=NEVER), backwards)
    told = "the angle is 0.30 rad beyond the integral of the velocity (threshold 0.25 rad); the opposite sign would fit"
    assert (caught.fault, caught.detail) == (Fault.WRONG_POLARITY, told)

    jumped = [Sample(1e-3, sign * 0.025, sign * 50.0, True, 0.0, 0.0)]
    caught = stopped(limits._replace(travel=NEVER), jumped)
    assert caught.fault is Fault.MOTION_OUTSIDE_SET
    reference = Reference(SHIPPED, SILENT, 0.0, 0.0)
    reference.judge(jumped[0])
    told = f"the velocity changed by {max(reference.motion):.1f} rad/s more than any brake's (threshold 16.0 rad/s)"
    assert caught.detail == told

    at_it = [Sample(1e-3, sign * 0.525, sign * 50.0, True, 0.0, 0.0)]
    state, _ = judge(SHIPPED, SILENT, begin_monitor(0.0, 0.0), *at_it[0])
    exactly = limits._replace(motion=max(state.motion))
    assert stopped(exactly, at_it).detail.startswith("the angle is 0.50 rad beyond")


@pytest.mark.parametrize("reported", [2.5, 3.0])
def test_the_reported_current_of_the_sample_is_the_one_that_counts(reported: float) -> None:
    limits = sensor_thresholds(BENCH, SHIPPED)
    reference = Reference(SHIPPED, limits, 0.0, 0.0)
    frozen = Sample(1e-3, 0.0, 0.0, True, 3.0, reported)
    first = next(k for k in range(100) if reference.judge(frozen) != HONEST)
    monitor = SensorMonitor(SHIPPED, limits)
    monitor.begin_run(SensorSample(0, 0.0, 0.0, 0, 0, 0.0, 15, NodeState.ACTIVE))
    told = SensorSample(0, 0.0, 0.0, 0, 0, reported, 15, NodeState.ACTIVE)
    for _ in range(first):
        monitor.check(1e-3, told, True, 3.0)
    with pytest.raises(StopError):
        monitor.check(1e-3, told, True, 3.0)


# --- the first move ---------------------------------------------------------------------------------------------------


def unseen_of_the_page(law: ShieldLaw, limits: SensorThresholds, state: State) -> float:
    """Speed that currents add which have acted and are not in the sample yet."""
    acted = [max(map(abs, both)) for both in zip(state.lows, state.highs, strict=True)][: shown_late(law) + 1]
    unseen = law.sample_time * sum(acted[: law.age_high]) + limits.lag * max(acted[law.age_high :])
    return law.box.motor_high * (unseen + law.delay.lag * max(map(abs, state.flowing)))


def most_of_the_page(law: ShieldLaw, limits: SensorThresholds, state: State) -> float:
    """Largest current of the first move, by bisection over what the worst brake does in two periods."""
    t, d = law.sample_time, law.box.friction_low
    now = abs(state.velocity) + law.velocity_noise + unseen_of_the_page(law, limits, state)
    stroke = min(-law.bottom, d / law.box.spring_high)
    angle = abs(state.angle) + 2.0 * law.angle_noise
    if angle < stroke:  # within this and the next period, and the frames' age, by the greatest speed that ends there
        angle += (2 + law.age_high) * t * math.sqrt(2.0 * d * (stroke - angle))

    def is_stopped(u: float) -> bool:
        after = now + t * law.box.motor_high * u
        driven = after + t * (law.box.motor_high * law.current * after / law.damping_velocity - d)
        squared = (driven + 2.0 * law.velocity_noise) ** 2
        return angle <= d / law.box.spring_high / 2.0 and angle + squared / (2.0 * d) <= stroke

    low, high = 0.0, 1000.0
    if angle > min(d / law.box.spring_high / 2.0, stroke):  # nothing that moves there is stopped by friction for sure
        return limits.first_current
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if is_stopped(middle) else (low, middle)
    low = low if low > 1e-9 else 0.0
    rests = abs(state.velocity) <= law.velocity_noise
    return max(low, limits.first_current) if rests else low


def test_the_first_move_is_what_friction_stops_by_the_page() -> None:
    rng, beyond, below = Random(0), 0, 0
    for _ in range(4000):
        law, limits = drawn_law(rng), drawn_limits(rng)
        state = begin_monitor(rng.uniform(-1.0, 1.0) * rng.choice([0.5, 6.0]), rng.gauss(0.0, 10.0))
        pairs = [sorted(rng.choice([0.0, 1.0]) * rng.gauss(0.0, 1.0) for _ in "ab") for _ in NO_CURRENTS]
        lows, highs = zip(*pairs, strict=True)
        state = state._replace(lows=cast(Currents, lows), highs=cast(Currents, highs))
        if law.delay.lag:
            state = state._replace(flowing=(-rng.random(), rng.random()))
        assert unseen_speed(law, limits, state) == pytest.approx(unseen_of_the_page(law, limits, state))
        most = most_of_the_page(law, limits, state)
        assert largest_current(law, limits, state, 1e3) == pytest.approx(most, rel=1e-6)
        assert largest_current(law, limits, state, 0.5 * most) == 0.5 * most
        beyond += most > limits.first_current
        below += most < limits.first_current
    assert 1000 < beyond < 3500
    assert below > 100


def test_the_first_move_is_more_than_gentle_up_to_where_half_of_the_friction_holds_the_spring() -> None:
    law = with_numbers(
        SHIPPED, friction_low=1024.0, spring_high=128.0, angle_noise=0.0, sample_time=2.0**-10, bottom=-5.875
    )  # half of the friction holds 4 rad, and friction stops 64 rad/s within the 2 rad from 3.875 to 5.875
    limits = sensor_thresholds(BENCH, law)._replace(first_current=0.25)
    assert (
        largest_current(law, limits, begin_monitor(3.875, 0.0), 100.0) > 0.25
    )  # and 64 rad/s for two periods are 0.125 rad
    for angle in (3.876, -3.876, 5.875, 50.0):
        assert largest_current(law, limits, begin_monitor(angle, 0.0), 100.0) == 0.25
    short = law._replace(bottom=-1.0)
    for angle in (1.0, 1.5, 50.0):
        assert largest_current(short, limits, begin_monitor(angle, 0.0), 100.0) == 0.25


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_what_may_be_at_rest_by_the_noise_may_be_moved_and_what_is_faster_is_left_to_friction(sign: float) -> None:
    limits = sensor_thresholds(BENCH, SHIPPED)._replace(first_current=1e3)
    fastest = SHIPPED.velocity_noise
    assert largest_current(SHIPPED, limits, begin_monitor(0.0, sign * fastest), 1e6) == 1e3
    assert largest_current(SHIPPED, limits, begin_monitor(0.0, sign * math.nextafter(fastest, math.inf)), 1e6) < 1e3
