"""Sensors judged over time: what is small in each sample and grows.

The reception judges each step of the angle against the velocity; a slow lie passes it. Here two errors are summed up,
each in both directions and from its last zero on (a CUSUM: Page, Continuous inspection schemes, Biometrika 41, 1954):

* **Travel**: the angle against the integral of the velocity over the device's time.
* **Motion**: the change of the velocity against what any brake of the shield's set can do with the current that acted.

While nothing has shown that a positive current moves the brake in the positive direction, the same sums are formed for
a motor, a sensor or both with the wrong sign. Once they have excluded these, the polarity is confirmed. Until the
motion has shown its sign, a current is limited to what friction alone can stop, should the sign be wrong.

:func:`judge` is a plain scalar function on one small row of memory per run, so that the runtime, a simulation and a
compiled batch run the same code. Formulas, thresholds and what they cannot see: ``docs/explanation/sensor-monitor.md``.
"""

from __future__ import annotations

import math
from typing import Any, Final

from emb_runtime.config.bench import OLDEST_FRAME
from emb_runtime.records import SensorSample
from emb_runtime.safety.sensor_thresholds import SensorThresholds
from emb_runtime.safety.shield import BELIEVABLE, damped_current, drives, fastest_next
from emb_runtime.safety.shield_design import VELOCITY_PAD, ShieldLaw
from emb_runtime.safety.state_machine import Fault, StopError

# Verdicts; plain integers, because a compiled function cannot see an enum.
HONEST: Final = 0
CONTRADICTING: Final = 1
OUTSIDE_SET: Final = 2
REVERSED: Final = 3

# Places in the row of memory.
ANGLE: Final = 0  # Last measurement [rad]
VELOCITY: Final = 1  # Last measurement [rad/s]
TRAVEL_UP: Final = 2  # Angle beyond the integral of the velocity [rad]
TRAVEL_DOWN: Final = 3  # Integral of the velocity beyond the angle [rad]
UP_FROM: Final = 4  # Velocity at the sample from which TRAVEL_UP is summed [rad/s]
DOWN_FROM: Final = 5
MOTION_UP: Final = 6  # Velocity gained beyond the set [rad/s]
MOTION_DOWN: Final = 7
CONFIRMED: Final = 8  # 1.0 once the polarity is confirmed
OPPOSED_TRAVEL: Final = 9
"""Angle travelled plus integral of the velocity: noise, if one of the two has the wrong sign [rad]."""
OPPOSED_FROM: Final = 10  # Velocity at the sample from which it is summed [rad/s]
OPPOSED_UP: Final = 11  # As MOTION_UP, for a brake that obeys the opposite current [rad/s]
OPPOSED_DOWN: Final = 12
INTEGRAL: Final = 13  # Integral of the velocity since the same sample [rad]
FLOWING_LOW: Final = 14  # Least current that may flow in a motor whose current lags [A]
FLOWING_HIGH: Final = 15
OBEYS: Final = 16
"""1.0 once the motion has excluded a motor, or a velocity, with the wrong sign: the node's own stop brakes."""
LOWS: Final = 17  # Least current of each of the last periods, newest first [A]
PERIODS: Final = OLDEST_FRAME + 1
HIGHS: Final = LOWS + PERIODS
MEMORY: Final = HIGHS + PERIODS  # Length of the row


def begin(memory: Any, angle: float, velocity: float) -> None:
    """Begin a run with its first measurement and without a current, in a row of length MEMORY [rad, rad/s]."""
    for i in range(MEMORY):
        memory[i] = 0.0
    memory[ANGLE] = angle
    memory[VELOCITY] = memory[UP_FROM] = memory[DOWN_FROM] = memory[OPPOSED_FROM] = velocity


def judge(
    law: ShieldLaw,
    limits: SensorThresholds,
    memory: Any,
    elapsed: float,
    angle: float,
    velocity: float,
    obeyed: bool,
    command: float,
    reported: float,
) -> int:
    """Judge one more sample.

    Args:
        law: of the shield.
        limits: the thresholds.
        memory: row of the run, changed.
        elapsed: time since the sample before, by the device's clock [s].
        angle: measured [rad].
        velocity: measured [rad/s].
        obeyed: the node says that the command which answered the sample before acted.
        command: that command; 0 if none was sent [A].
        reported: the current that the node reports of the period [A].

    Returns:
        HONEST, CONTRADICTING (angle and velocity do not fit each other), OUTSIDE_SET (the velocity does not fit the
        current, for any brake of the set), or REVERSED. A number that is no measurement contradicts.
    """
    size = abs(angle) + abs(velocity) + abs(command) + abs(reported)
    if not (size <= BELIEVABLE and 0.0 < elapsed <= BELIEVABLE):  # this way round, NaN is no measurement
        return CONTRADICTING
    share = elapsed / law.sample_time
    periods = max(round(share), 1)
    angle_before, velocity_before = memory[ANGLE], memory[VELOCITY]
    memory[ANGLE], memory[VELOCITY] = angle, velocity
    travelled, expected = angle - angle_before, 0.5 * elapsed * (velocity + velocity_before)
    contradicts = _sum_travel(law, limits, memory, elapsed, travelled - expected, velocity, periods)
    change = velocity - velocity_before
    xl, xh, vl, vh = angle_before, angle, velocity_before, velocity
    if travelled < 0.0:
        xl, xh = angle, angle_before
    if change < 0.0:
        vl, vh = velocity, velocity_before
    aside, beyond = law.angle_noise, law.velocity_noise
    if periods > 1:
        aside += (periods - 1) * law.reach
        beyond += (periods - 1) * law.change
    xl, xh, vl, vh = xl - aside, xh + aside, vl - beyond, vh + beyond
    low, high = _acting(law, limits, memory, periods, obeyed, command, reported, vl, vh)
    least, most = drives(law, xl, xh, low, high)
    up = memory[MOTION_UP] + change - share * _gain(law, vl, most)
    down = memory[MOTION_DOWN] - change - share * _gain(law, -vh, -least)
    memory[MOTION_UP] = up = up if up > 0.0 else 0.0
    memory[MOTION_DOWN] = down = down if down > 0.0 else 0.0
    if memory[CONFIRMED] == 0.0:
        _sum_opposed(law, memory, change, share, (xl, xh, vl, vh), low, high)
        memory[OPPOSED_TRAVEL] += travelled + expected
        memory[INTEGRAL] += expected
        if periods > 1:  # the integral is not known well enough: begin anew
            memory[OPPOSED_TRAVEL] = memory[INTEGRAL] = 0.0
            memory[OPPOSED_FROM] = velocity
        return _judge_polarity(limits, memory, velocity, contradicts)
    if contradicts:
        return CONTRADICTING
    return OUTSIDE_SET if up > limits.motion or down > limits.motion else HONEST


def largest_current(law: ShieldLaw, limits: SensorThresholds, memory: Any, limit: float) -> float:
    """Largest current that may be sent, at most ``limit`` [A].

    Until the motion has shown its sign, it is what friction can stop if that is wrong.
    """
    if memory[OBEYS] != 0.0:
        return limit
    stoppable = _stoppable_current(law, limits, memory)
    if abs(memory[VELOCITY]) <= law.velocity_noise:  # what rests may be moved; what moves is first left to friction
        stoppable = max(stoppable, limits.first_current)
    return min(limit, stoppable)


def coasting_time(law: ShieldLaw, angle: float, velocity: float, unseen: float = 0.0) -> float:
    """Time in which friction alone stops any brake of the set near the origin [s]; 0 where it may not.

    The signs of the sensors do not matter. Twice what the least friction takes of the measured speed, as the spring may
    help the motion by half of it; and what it takes of all of the speed, with the help of the spring from here. What is
    ``unseen``, by :func:`unseen_speed`, only makes the wait longer: the limit of the first move has kept the distance.
    """
    speed, friction = abs(velocity) + law.velocity_noise, law.friction_low
    now = abs(angle) + law.angle_noise
    farthest = now + 0.5 * speed * speed / friction
    near = now <= 0.5 * law.friction_low / law.spring_high
    if not near or farthest > _held_stroke(law, friction):
        return 0.0
    return max(speed / (0.5 * law.friction_low), (speed + unseen) / (law.friction_low - law.spring_high * now))


def unseen_speed(law: ShieldLaw, limits: SensorThresholds, memory: Any) -> float:
    """Upper bound on the speed change not yet visible in the measurement [rad/s].

    Causes are frames that act late, a current that lags, and a velocity that an observer derives from the angle.
    """
    speed = acted = 0.0
    for i in range(law.age_high):
        speed += law.motor_high * max(-memory[LOWS + i], memory[HIGHS + i]) * law.sample_time
    for i in range(law.age_high, _oldest(law) + 1):
        acted = max(-memory[LOWS + i], memory[HIGHS + i], acted)
    speed += law.motor_high * acted * limits.lag
    flowing: float = max(-memory[FLOWING_LOW], memory[FLOWING_HIGH])
    return speed + law.motor_high * law.lag * flowing


def _oldest(law: ShieldLaw) -> int:
    """Number of periods before the last two whose currents the velocity may show only now: late frames, an observer."""
    if law.observer == 0.0:
        return law.age_high
    return min(law.age_high + int(1.0 / law.observer), OLDEST_FRAME)


def _held_stroke(law: ShieldLaw, friction: float) -> float:
    """Distance from the origin within which such a friction holds any brake of the set [rad]."""
    return min(-law.bottom, friction / law.spring_high)


def _stoppable_current(law: ShieldLaw, limits: SensorThresholds, memory: Any) -> float:
    """Largest current after which :func:`coasting_time` still finds that friction stops a brake of either sign [A].

    Reckons with the strongest motor of the set, with what has acted and is not in the sample yet (late frames, a
    current that lags, an observer), with the errors of two samples, and with one period in which the node gets no
    command and its stop, with the wrong sign, drives the brake. 0 where there is no such current; the constant one so
    far from the origin that friction alone is no stop at all, as where a way home begins.
    """
    ts, friction = law.sample_time, law.friction_low
    speed: float = abs(memory[VELOCITY]) + law.velocity_noise + unseen_speed(law, limits, memory)
    now = abs(memory[ANGLE]) + 2.0 * law.angle_noise
    stroke = _held_stroke(law, friction)
    now += (law.age_high + 2) * ts * math.sqrt(2.0 * friction * max(stroke - now, 0.0))
    if now > 0.5 * friction / law.spring_high or now > stroke:
        return limits.first_current
    after_stop = math.sqrt(2.0 * friction * (stroke - now)) - 2.0 * law.velocity_noise
    before_stop = (after_stop + ts * friction) / (1.0 + ts * law.motor_high * law.current / law.damping_velocity)
    return max(before_stop - speed, 0.0) / (ts * law.motor_high)


def _sum_travel(
    law: ShieldLaw,
    limits: SensorThresholds,
    memory: Any,
    elapsed: float,
    excess: float,
    velocity: float,
    periods: int,
) -> bool:
    """Sum up the angle beyond the integral of the velocity; returns True if it contradicts.

    What an integration by samples and a lagging velocity add is proportional to the velocity gained since, and so
    cancels when it comes back: it is allowed once, not per sample.
    """
    slack = limits.offset * elapsed
    if periods > 1:  # the velocity between is known within a triangle of the greatest acceleration, up or down
        slack += 0.25 * elapsed * elapsed * law.change / law.sample_time
    up, down = memory[TRAVEL_UP] + excess - slack, memory[TRAVEL_DOWN] - excess - slack
    if up <= 0.0:
        up, memory[UP_FROM] = 0.0, velocity
    if down <= 0.0:
        down, memory[DOWN_FROM] = 0.0, velocity
    memory[TRAVEL_UP], memory[TRAVEL_DOWN] = up, down
    return bool(
        up > limits.travel + lag_angle(limits, velocity - memory[UP_FROM])
        or down > limits.travel + lag_angle(limits, memory[DOWN_FROM] - velocity)
    )


def lag_angle(limits: SensorThresholds, gained: float) -> float:
    """Angle beyond the integral of a velocity that has gained so much, by its lag; by its lead if it has lost [rad]."""
    return max(limits.lag * gained, -limits.lead * gained)


def _gain(law: ShieldLaw, slowest: float, drive: float) -> float:
    """Most that the velocity of a brake of the set gains in one sample, from ``slowest`` or above [rad/s].

    The faster the brake, the less: friction takes more, and helps where it moves against the drive.
    """
    return fastest_next(law, slowest, slowest, drive) - slowest + VELOCITY_PAD


def _acting(
    law: ShieldLaw,
    limits: SensorThresholds,
    memory: Any,
    periods: int,
    obeyed: bool,
    command: float,
    reported: float,
    vl: float,
    vh: float,
) -> tuple[float, float]:
    """Least and greatest current that may have caused the change between the last two samples [A].

    That of the period before counts as well: a measured velocity lags. So do those of older ones where frames may be
    late, or an observer derives the velocity. Where no command acted, the node braked by itself, or let go.
    """
    if obeyed and periods == 1:
        low = high = command
        if reported > command:
            high = min(reported, command + limits.current_error)
        elif reported < command:
            low = max(reported, command - limits.current_error)
    else:
        late = law.age_high * law.change
        low = min(damped_current(vh + late, law.current, law.damping_velocity), 0.0)
        high = max(damped_current(vl - late, law.current, law.damping_velocity), 0.0)
        if periods > 1:
            low, high = min(low, command), max(high, command)
    least, most, oldest = low, high, _oldest(law)
    for i in range(oldest + 1):
        if memory[LOWS + i] < least:
            least = memory[LOWS + i]
        if memory[HIGHS + i] > most:
            most = memory[HIGHS + i]
    for _ in range(min(periods, oldest + 1)):
        for i in range(oldest, 0, -1):
            memory[LOWS + i], memory[HIGHS + i] = memory[LOWS + i - 1], memory[HIGHS + i - 1]
        memory[LOWS], memory[HIGHS] = low, high
    if law.lag > 0.0:
        flowing_low, flowing_high = memory[FLOWING_LOW], memory[FLOWING_HIGH]
        memory[FLOWING_LOW] = least + law.kept * min(flowing_low - least, 0.0)
        memory[FLOWING_HIGH] = most + law.kept * max(flowing_high - most, 0.0)
        return min(least, flowing_low), max(most, flowing_high)
    return least, most


def _sum_opposed(
    law: ShieldLaw,
    memory: Any,
    change: float,
    share: float,
    box: tuple[float, float, float, float],
    low: float,
    high: float,
) -> None:
    """Sum up what does not fit a brake whose motor or sensors have the wrong sign."""
    xl, xh, vl, vh = box
    least, most = drives(law, min(xl, 0.0), xh, -high, -low)
    most += law.spring_high * max(law.reach - xl, 0.0)  # sensors of the wrong sign: a clamped brake seems to be below 0
    memory[OPPOSED_UP] = max(memory[OPPOSED_UP] + change - share * _gain(law, vl, most), 0.0)
    memory[OPPOSED_DOWN] = max(memory[OPPOSED_DOWN] - change - share * _gain(law, -vh, -least), 0.0)


def _judge_polarity(limits: SensorThresholds, memory: Any, velocity: float, contradicts: bool) -> int:
    """Verdict while the polarity is not confirmed; confirms it if a wrong one is excluded."""
    opposed = max(memory[OPPOSED_UP], memory[OPPOSED_DOWN])
    allowed = limits.travel + limits.lag * abs(velocity - memory[OPPOSED_FROM])
    agreeing = abs(memory[OPPOSED_TRAVEL]) > allowed
    if contradicts:
        return CONTRADICTING if agreeing or abs(memory[INTEGRAL]) < 0.5 * limits.travel else REVERSED
    if max(memory[MOTION_UP], memory[MOTION_DOWN]) > limits.motion:
        return OUTSIDE_SET if opposed > 0.5 * limits.motion else REVERSED
    if opposed > limits.motion:
        memory[OBEYS] = 1.0
        if agreeing:
            memory[CONFIRMED] = 1.0
    return HONEST


class SensorMonitor:
    """The monitor of one run."""

    __slots__ = ("_law", "_limits", "_memory")

    def __init__(self, law: ShieldLaw, limits: SensorThresholds) -> None:
        self._law = law
        self._limits = limits
        self._memory = [0.0] * MEMORY

    def begin(self, sample: SensorSample) -> None:
        """Begin a run with its first sample."""
        begin(self._memory, sample.angle, sample.velocity)

    def largest_current(self, limit: float) -> float:
        """Largest current that may be sent, at most ``limit`` [A]."""
        return largest_current(self._law, self._limits, self._memory, limit)

    @property
    def obeys(self) -> bool:
        """Returns True if the motion has shown its sign."""
        return bool(self._memory[OBEYS] != 0.0)

    def coasting_time(self, sample: SensorSample) -> float:
        """Time for which friction alone is to stop the brake, as its node might drive it [s]."""
        if self.obeys:
            return 0.0
        law, limits, memory = self._law, self._limits, self._memory
        return coasting_time(law, sample.angle, sample.velocity, unseen_speed(law, limits, memory))

    def check(self, elapsed: float, sample: SensorSample, obeyed: bool, command: float) -> None:
        """Take one more sample, as :func:`judge`; raises StopError if the sensors cannot be right."""
        verdict = judge(
            self._law, self._limits, self._memory, elapsed, sample.angle, sample.velocity, obeyed, command,
            sample.applied_current,
        )  # fmt: skip
        if verdict != HONEST:
            raise StopError(_FAULTS[verdict], self._detail(verdict))

    def _detail(self, verdict: int) -> str:
        memory, limits = self._memory, self._limits
        travel, motion = max(memory[TRAVEL_UP], memory[TRAVEL_DOWN]), max(memory[MOTION_UP], memory[MOTION_DOWN])
        told = f"the angle is {travel:.2f} rad beyond the integral of the velocity (threshold {limits.travel:.2f} rad)"
        moved = (
            f"the velocity changed by {motion:.1f} rad/s more than any brake's (threshold {limits.motion:.1f} rad/s)"
        )
        why = moved if motion > limits.motion else told
        return f"{why}; the opposite sign would fit" if verdict == REVERSED else why


_FAULTS: Final = {
    CONTRADICTING: Fault.SENSORS_CONTRADICT,
    OUTSIDE_SET: Fault.MOTION_OUTSIDE_SET,
    REVERSED: Fault.WRONG_POLARITY,
}
