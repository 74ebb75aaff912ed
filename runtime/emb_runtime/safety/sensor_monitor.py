"""Monitor of the sensors over time: an error that is small in each sample and grows.

The reception checks each step of the angle against the velocity; a slow drift passes this check. Here two errors are
summed in both directions, each from its last zero on (a CUSUM: Page, Continuous inspection schemes, Biometrika 41,
1954):

* **Travel**: the angle against the integral of the velocity over the device's time.
* **Motion**: the change of the velocity against what any brake of the shield's set can do with the current that acted.

Until the motion has shown that a positive current moves the brake in the positive direction, the same sums are also
formed for a motor, a sensor or both with the wrong sign. When the sums exclude these, the polarity is confirmed. Until
the motion has shown its sign, the current is limited so that friction alone can stop the brake if the sign is wrong.

:func:`judge` is a plain scalar function from one state to the next, so that the runtime, a simulation and a compiled
batch run the same code. Formulas, thresholds and what they cannot see: ``docs/explanation/sensor-monitor.md``.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

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

Currents = tuple[float, float, float, float, float, float]
"""One current for each of the last OLDEST_FRAME + 1 periods, newest first [A]."""


class Cusum(NamedTuple):
    """Sum of an error in both directions, each from its last zero on."""

    up: float
    down: float


class Opposed(NamedTuple):
    """Sums for a motor, a sensor or both with the wrong sign, until the polarity is confirmed."""

    travel: float
    """Angle travelled plus integral of the velocity: noise, if one of the two has the wrong sign [rad]."""
    integral: float  # Integral of the velocity since the same sample [rad]
    begin: float  # Velocity at that sample [rad/s]
    motion: Cusum  # As that of the state, for a brake that obeys the opposite current [rad/s]


class State(NamedTuple):
    """State of the monitor after a sample."""

    angle: float  # Last measurement [rad]
    velocity: float  # Last measurement [rad/s]
    travel: Cusum  # Angle beyond the integral of the velocity, and below it [rad]
    up_from: float  # Velocity at the sample from which ``travel.up`` is summed [rad/s]
    down_from: float
    motion: Cusum  # Velocity gained beyond the set, and lost [rad/s]
    opposed: Opposed
    lows: Currents  # Least current that may have acted in each period
    highs: Currents  # Greatest current that may have acted
    flowing: tuple[float, float]  # Least and greatest current that may flow in a motor whose current lags [A]
    obeys: bool
    """True once the motion has excluded a motor, or a velocity, with the wrong sign: the node's stop brakes."""
    confirmed: bool  # True once the polarity is confirmed


NO_CURRENTS: Final[Currents] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def begin_monitor(angle: float, velocity: float) -> State:
    """State at the first measurement of a run, without a current [rad, rad/s]."""
    zero = Cusum(0.0, 0.0)
    opposed = Opposed(0.0, 0.0, velocity, zero)
    lows = highs = NO_CURRENTS
    return State(angle, velocity, zero, velocity, velocity, zero, opposed, lows, highs, (0.0, 0.0), False, False)


def add(sums: Cusum, error: float, slack_up: float, slack_down: float) -> Cusum:
    """Add an error, less the slack of each direction."""
    up, down = sums
    up, down = up + error - slack_up, down - error - slack_down
    return Cusum(up if up > 0.0 else 0.0, down if down > 0.0 else 0.0)


def judge(
    law: ShieldLaw,
    limits: SensorThresholds,
    state: State,
    elapsed: float,
    angle: float,
    velocity: float,
    obeyed: bool,
    command: float,
    reported: float,
) -> tuple[State, int]:
    """Check one more sample.

    Args:
        law: parameters of the shield.
        limits: the thresholds.
        state: state after the previous sample.
        elapsed: time since the previous sample, by the device's clock [s].
        angle: measured [rad].
        velocity: measured [rad/s].
        obeyed: True if, by the node's report, the command for the previous sample was applied.
        command: that command; 0 if none was sent [A].
        reported: current that the node reports for the period [A].

    Returns:
        The next state, and HONEST (no fault), CONTRADICTING (angle and velocity do not fit each other), OUTSIDE_SET
        (the velocity does not fit the current, for any brake of the set), or REVERSED. A value that is not finite, or
        too large for a measurement, is CONTRADICTING.
    """
    size = abs(angle) + abs(velocity) + abs(command) + abs(reported)
    if not (size <= BELIEVABLE and 0.0 < elapsed <= BELIEVABLE):  # this way round, NaN is no measurement
        return state, CONTRADICTING
    x, v, travel, up_from, down_from, motion, opposed, lows, highs, flowing, obeys, confirmed = state
    share = elapsed / law.sample_time
    periods = max(round(share), 1)
    travelled, expected = angle - x, 0.5 * elapsed * (velocity + v)
    slack = limits.offset * elapsed
    if periods > 1:  # between them the velocity lies within a triangle of the greatest acceleration, up or down
        slack += 0.25 * elapsed * elapsed * law.change / law.sample_time
    travel = add(travel, travelled - expected, slack, slack)
    up, down = travel
    up_from = velocity if up == 0.0 else up_from
    down_from = velocity if down == 0.0 else down_from
    above = up > limits.travel + lag_angle(limits, velocity - up_from)
    contradicts = above or down > limits.travel + lag_angle(limits, down_from - velocity)
    change = velocity - v
    xl, xh, vl, vh = x, angle, v, velocity
    if travelled < 0.0:
        xl, xh = angle, x
    if change < 0.0:
        vl, vh = velocity, v
    aside, beyond = law.angle_noise, law.velocity_noise
    if periods > 1:
        aside += (periods - 1) * law.reach
        beyond += (periods - 1) * law.change
    xl, xh, vl, vh = xl - aside, xh + aside, vl - beyond, vh + beyond
    low, high = _caused(law, limits, periods, obeyed, command, reported, vl, vh)
    least, most, flowing = _acting(law, lows, highs, flowing, low, high)
    for _ in range(min(periods, OLDEST_FRAME + 1)):
        a, b, c, d, e, _ = lows
        lows = low, a, b, c, d, e
        a, b, c, d, e, _ = highs
        highs = high, a, b, c, d, e
    weakest, strongest = drives(law, xl, xh, least, most)
    motion = add(motion, change, share * _gain(law, vl, strongest), share * _gain(law, -vh, -weakest))
    if confirmed:
        beyond_set = motion.up > limits.motion or motion.down > limits.motion
        verdict = CONTRADICTING if contradicts else OUTSIDE_SET if beyond_set else HONEST
    else:
        weakest, strongest = drives(law, min(xl, 0.0), xh, -most, -least)
        # Sensors of the wrong sign: a clamped brake seems to be below 0.
        strongest += law.box.spring_high * max(law.reach - xl, 0.0)
        against = add(opposed.motion, change, share * _gain(law, vl, strongest), share * _gain(law, -vh, -weakest))
        opposed = Opposed(opposed.travel + (travelled + expected), opposed.integral + expected, opposed.begin, against)
        if periods > 1:  # the integral is not accurate enough: begin anew
            opposed = Opposed(0.0, 0.0, velocity, against)
        verdict, shown, confirmed = _judge_polarity(limits, opposed, motion, velocity, contradicts)
        obeys = obeys or shown
    return State(
        angle, velocity, travel, up_from, down_from, motion, opposed, lows, highs, flowing, obeys, confirmed
    ), verdict


def largest_current(law: ShieldLaw, limits: SensorThresholds, state: State, limit: float) -> float:
    """Largest current that may be sent, at most ``limit`` [A].

    Until the motion has shown its sign, friction has to be able to stop the brake if the sign is wrong.
    """
    if state.obeys:
        return limit
    stoppable = _stoppable_current(law, limits, state)
    if abs(state.velocity) <= law.velocity_noise:  # at rest, enough to move the brake; friction stops a moving one
        stoppable = max(stoppable, limits.first_current)
    return min(limit, stoppable)


def coasting_time(law: ShieldLaw, angle: float, velocity: float, unseen: float = 0.0) -> float:
    """Time in which friction alone stops any brake of the set near the origin [s]; 0 where it cannot be relied on.

    The signs of the sensors do not matter. With the least friction f, the strongest spring w and the distance x, the
    time is max(2 v / f, (v + unseen) / (f − w x)). In the first term the spring drives the motion with half of f. The
    speed ``unseen``, by :func:`unseen_speed`, only lengthens the time: the first move's limit includes the distance.
    """
    box, friction = law.box, law.box.friction_low
    speed = abs(velocity) + law.velocity_noise
    now = abs(angle) + law.angle_noise
    farthest = now + 0.5 * speed * speed / friction
    near = now <= 0.5 * box.friction_low / box.spring_high
    if not near or farthest > _held_stroke(law, friction):
        return 0.0
    return max(speed / (0.5 * box.friction_low), (speed + unseen) / (box.friction_low - box.spring_high * now))


def unseen_speed(law: ShieldLaw, limits: SensorThresholds, state: State) -> float:
    """Upper bound on the speed change not yet visible in the measurement [rad/s].

    Causes are frames that act late, a current that lags, and a velocity that an observer derives from the angle.
    """
    motor = law.box.motor_high
    speed = acted = 0.0
    for i in range(law.age_high):
        speed += motor * max(-state.lows[i], state.highs[i]) * law.sample_time
    for i in range(law.age_high, _oldest(law) + 1):
        acted = max(-state.lows[i], state.highs[i], acted)
    speed += motor * acted * limits.lag
    flowing: float = max(-state.flowing[0], state.flowing[1])
    return speed + motor * law.delay.lag * flowing


def _oldest(law: ShieldLaw) -> int:
    """Number of periods before the last two whose currents may still change the velocity: late frames, an observer."""
    if law.delay.observer == 0.0:
        return law.age_high
    return min(law.age_high + int(1.0 / law.delay.observer), OLDEST_FRAME)


def _held_stroke(law: ShieldLaw, friction: float) -> float:
    """Distance from the origin within which a friction holds any brake of the set [rad]."""
    return min(-law.bottom, friction / law.box.spring_high)


def _stoppable_current(law: ShieldLaw, limits: SensorThresholds, state: State) -> float:
    """Largest current after which friction still stops a brake of either sign, by :func:`coasting_time` [A].

    Assumes the strongest motor of the set, the currents that the sample does not show yet (late frames, a current that
    lags, an observer), the errors of two samples, and one period without a command, in which the node's stop drives the
    brake with the wrong sign. 0 if there is no such current. Farther from the origin, where friction alone cannot stop
    the brake (as at the start of a way home), it is the constant ``first_current``.
    """
    ts, box, friction = law.sample_time, law.box, law.box.friction_low
    speed: float = abs(state.velocity) + law.velocity_noise + unseen_speed(law, limits, state)
    now = abs(state.angle) + 2.0 * law.angle_noise
    stroke = _held_stroke(law, friction)
    now += (law.age_high + 2) * ts * math.sqrt(2.0 * friction * max(stroke - now, 0.0))
    if now > 0.5 * friction / box.spring_high or now > stroke:
        return limits.first_current
    after_stop = math.sqrt(2.0 * friction * (stroke - now)) - 2.0 * law.velocity_noise
    before_stop = (after_stop + ts * friction) / (1.0 + ts * box.motor_high * law.current / law.damping_velocity)
    return max(before_stop - speed, 0.0) / (ts * box.motor_high)


def lag_angle(limits: SensorThresholds, gained: float) -> float:
    """Allowed angle beyond the integral of the velocity [rad]: by lag for a gained velocity, by lead for a lost one."""
    lag, lead = limits.lag * gained, -limits.lead * gained
    return lead if lead > lag else lag


def _gain(law: ShieldLaw, slowest: float, drive: float) -> float:
    """Largest velocity gain of a brake of the set in one sample, from ``slowest`` or above [rad/s].

    The gain falls with the velocity: friction opposes a motion with the drive, and supports the drive against it.
    """
    return fastest_next(law, slowest, slowest, drive) - slowest + VELOCITY_PAD


def _caused(
    law: ShieldLaw,
    limits: SensorThresholds,
    periods: int,
    obeyed: bool,
    command: float,
    reported: float,
    vl: float,
    vh: float,
) -> tuple[float, float]:
    """Least and greatest current of the periods since the previous sample [A].

    In a period without a command the node braked by itself, or its current was 0.
    """
    if obeyed and periods == 1:
        low = high = command
        if reported > command:
            high = command + limits.current_error
            high = high if high < reported else reported
        elif reported < command:
            low = command - limits.current_error
            low = low if low > reported else reported
        return low, high
    late = law.age_high * law.change
    low = min(damped_current(vh + late, law.current, law.damping_velocity), 0.0)
    high = max(damped_current(vl - late, law.current, law.damping_velocity), 0.0)
    if periods > 1:
        return min(low, command), max(high, command)
    return low, high


def _acting(
    law: ShieldLaw, lows: Currents, highs: Currents, flowing: tuple[float, float], low: float, high: float
) -> tuple[float, float, tuple[float, float]]:
    """Least and greatest current that may have caused the change between two samples, and that may flow afterwards [A].

    The current of the previous period counts, too, as a measured velocity lags. With late frames or an observer the
    currents of older periods count as well.
    """
    delay = law.delay
    least, most = low, high
    for i in range(_oldest(law) + 1):
        low, high = lows[i], highs[i]
        least = low if low < least else least
        most = high if high > most else most
    low, high = flowing
    if delay.lag > 0.0:
        flowing = least + delay.kept * min(low - least, 0.0), most + delay.kept * max(high - most, 0.0)
        return min(least, low), max(most, high), flowing
    return least, most, flowing


def _judge_polarity(
    limits: SensorThresholds, opposed: Opposed, motion: Cusum, velocity: float, contradicts: bool
) -> tuple[int, bool, bool]:
    """Verdict while the polarity is not confirmed; True if the motion shows its sign, and if the angle agrees."""
    against = max(opposed.motion.up, opposed.motion.down)
    agrees = abs(opposed.travel) > limits.travel + limits.lag * abs(velocity - opposed.begin)
    if contradicts:
        unknown = agrees or abs(opposed.integral) < 0.5 * limits.travel
        return CONTRADICTING if unknown else REVERSED, False, False
    if max(motion.up, motion.down) > limits.motion:
        return OUTSIDE_SET if against > 0.5 * limits.motion else REVERSED, False, False
    shown = against > limits.motion
    return HONEST, shown, shown and agrees


class SensorMonitor:
    """The monitor of one run."""

    __slots__ = ("_law", "_limits", "_state")

    def __init__(self, law: ShieldLaw, limits: SensorThresholds) -> None:
        self._law = law
        self._limits = limits
        self._state = begin_monitor(0.0, 0.0)

    def begin_run(self, sample: SensorSample) -> None:
        """Begin a run with its first sample."""
        self._state = begin_monitor(sample.angle, sample.velocity)

    def largest_current(self, limit: float) -> float:
        """Largest current that may be sent, at most ``limit`` [A]."""
        return largest_current(self._law, self._limits, self._state, limit)

    @property
    def obeys(self) -> bool:
        """Returns True if the motion has shown its sign."""
        return self._state.obeys

    def coasting_time(self, sample: SensorSample) -> float:
        """Time in which friction alone stops the brake [s]; 0 once the node's stop is known to brake."""
        if self.obeys:
            return 0.0
        law, limits, state = self._law, self._limits, self._state
        return coasting_time(law, sample.angle, sample.velocity, unseen_speed(law, limits, state))

    def check(self, elapsed: float, sample: SensorSample, obeyed: bool, command: float) -> None:
        """Check one more sample, as :func:`judge`; raises StopError if the sensors cannot be right."""
        self._state, verdict = judge(
            self._law, self._limits, self._state, elapsed, sample.angle, sample.velocity, obeyed, command,
            sample.applied_current,
        )  # fmt: skip
        if verdict != HONEST:
            raise StopError(_FAULTS[verdict], self._detail(verdict))

    def _detail(self, verdict: int) -> str:
        limits, travel, motion = self._limits, max(self._state.travel), max(self._state.motion)
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
