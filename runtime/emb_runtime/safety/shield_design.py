"""The law of the envelope shield: what a bench's set of brakes can do, as numbers, checked for every gap.

:func:`make_law` turns a bench into the :class:`ShieldLaw` that :mod:`emb_runtime.safety.shield` works with, or refuses
the bench with the step of the argument (``docs/explanation/shield.md``) that does not hold for it.

All accelerations are torques over the inertia [rad/s²]; a name that ends in ``_low``/``_high`` is a bound of the set.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise
from operator import ge, gt, le, lt
from typing import Final, NamedTuple

from emb_runtime.config.bench import FASTEST_OBSERVER, OLDEST_FRAME, PER_LAG, Bench
from emb_runtime.errors import BenchFileError

VELOCITY_PAD: Final = 0.3
"""Forward Euler against the exact flow within one sample: viscous friction changes while the speed does [rad/s]."""
ANGLE_PAD: Final = 0.005
"""Left of ``angle_margin`` for rounding, and for an exact flow that is not quite monotone within a sample [rad]."""


class Landing(NamedTuple):
    """End of the way home. Safety does not depend on it; that it brings every brake home was searched only."""

    share: float  # Share of the guaranteed deceleration that is planned for the landing
    gain: float  # Share of a velocity error that is removed per sample, with the middle k_m
    reserve: int
    """Samples kept beyond the worst arrival and the time in which friction alone brings a slow brake to rest."""


FRESH_LANDING = Landing(share=0.8, gain=0.6, reserve=7)
"""For commands that act in the very period of the sample that they answer."""
LATE_LANDING = Landing(share=0.5, gain=0.283, reserve=25)
"""For unknown or greater frame ages, where the loop has dead time."""
OBSERVED_LANDING = Landing(share=0.65, gain=0.5, reserve=2)
"""For a velocity that an observer derives from the angle."""
CREEPS: Final = 3.0  # Coasting: speed allowed at the largest angle, as a multiple of ``creep``
LONGEST_LAG: Final = 2.0  # Samples. With a slower current loop the limits would hold, but the landing would not.
OVERSHOOT: Final = 0.125  # Observer: what its response exceeds that of a critically damped one by, over its bandwidth
SHARPEST: Final = 1.5  # Bandwidth times sample time beyond which the overshoot of a sampled observer falls no further
SLOWEST_OBSERVER: Final = 0.75  # The same below which the way home was not searched
LATEST_OBSERVED: Final = 1  # Frame age; with older frames and an observer the limits would hold, but not the landing.
COMMITTED: Final = 16  # Samples before the reserve in which the policy does not get control back


class Box(NamedTuple):
    """Bounds of the set's brakes."""

    motor_low: float  # k_m / J [rad/(s²·A)]
    motor_high: float
    spring_low: float  # γ k_1 / J [1/s²]
    spring_high: float
    friction_low: float  # T_c / J [rad/s²]
    friction_high: float  # With what a brake that breaks away or is clamped may have beyond T_c
    viscous_low: float  # f_v / J [1/s]
    viscous_high: float
    braking: float  # Deceleration that every brake of the box reaches outside contact [rad/s²]
    braking_high: float  # Deceleration that the brakes with the strongest motor reach there [rad/s²]


class Hidden(NamedTuple):
    """Samples that an acceleration counts for in the velocity that an observer does not show yet; 0 for a sensor."""

    periods: tuple[float, float, float, float, float]  # In each period before the measurement, newest first
    before: tuple[float, float, float, float, float, float]
    """Before those of them whose commands are known, by the age of the measurement: :func:`unseen`."""


class Delay(NamedTuple):
    """Delay of current and velocity behind the commands, frames that are late apart."""

    lag: float  # Largest time constant of the current loop [s]
    kept: float  # Share of a difference between current and command that the longest lag keeps over a sample
    observer: float
    """Least bandwidth of the observer that derives the velocity from the angle, times the sample time; 0 for a sensor.

    It is at most that of an observer that lags no less.
    """
    hidden: Hidden


class WayHome(NamedTuple):
    """Numbers of the way home."""

    apex: float  # Coasting: no brake of the box gets beyond this angle [rad]
    creep: float  # Coasting: speed home that may be below its limit [rad/s]
    cruise: float  # Homeward speed that every brake reaches inside this envelope [rad/s]
    ramp: float  # Homeward acceleration that every brake reaches outside contact [rad/s²]
    landing: float  # Deceleration planned for the landing [rad/s²]
    gain: float  # Gain as in :class:`Landing`
    reserve: float  # Time kept for the end of the landing [s]
    committed: float  # Before the end the policy does not get control back [s]
    settling: float  # Before the end no more hop is begun: what is inside a wider zone only stops [s]
    rest_zone: float  # |angle| within which the landing stops [rad]
    settled_zone: float  # |angle| within which the landing stops just before the end [rad]
    rest_velocity: float  # |velocity| below which friction is left to stop the brake [rad/s]


class ShieldLaw(NamedTuple):
    """Parameters of :func:`emb_runtime.safety.shield.shield`: floats and integers; ``_low``/``_high``: of the box."""

    sample_time: float  # [s]
    steps: int  # Commands in one experiment
    age_low: int  # Least samples between a measurement and the period in which its answer acts
    age_high: int  # Most samples of the same, 0..5
    current: float  # Limit, both signs [A]
    angle_noise: float  # A measured angle lies within this of the truth [rad]
    velocity_noise: float  # [rad/s]
    bottom: float  # Full braking of the weakest brake stops above this angle [rad]
    top: float  # Full braking of the weakest brake stops below this angle [rad]
    outward_speed: float  # Largest velocity that a successor may have [rad/s]
    homeward_speed: float  # Largest speed of a successor towards the origin from contact [rad/s]
    reach: float  # Largest change of the angle in one sample [rad]
    box: Box
    damping_velocity: float  # The node's, also used when there is no believable angle [rad/s]
    change: float  # Largest change of the velocity in one sample [rad/s]
    delay: Delay
    coasting: bool  # 0 A for ever must keep the limits, in place of the damped stop
    home: WayHome


def stoppable(room: float, v: float, braking: float, ts: float) -> float:
    """Greatest next velocity from which ``room`` suffices, −1 if there is none.

    Stopping from v takes v²/2a + v t_s/2: under forward Euler that is consumed by exactly t_s v in a braking sample.
    The next angle is bounded by t_s times the larger of the velocities before and after.
    """
    if room <= 0.0:
        return -1.0
    half = 0.5 * braking * ts
    faster = math.sqrt(9.0 * half * half + 2.0 * braking * room) - 3.0 * half
    if faster >= v:
        return faster
    rest = room - ts * v
    if rest <= 0.0:
        return -1.0
    return math.sqrt(half * half + 2.0 * braking * rest) - half


def unseen(scaled: float, periods: int) -> float:
    """Samples by which an observer may lag for what acted before the last ``periods`` samples.

    That of a critically damped observer, the integral of (1 + ωτ) exp(−ωτ), and the overshoot of one that is less
    damped. ``scaled`` is the bandwidth times the sample time.
    """
    began = scaled * periods
    return (2.0 + began) * math.exp(-began) / scaled + OVERSHOOT / min(scaled, SHARPEST)


def hidden_by(scaled: float) -> Hidden:
    """Change of the velocity that an observer of this bandwidth times the sample time does not show yet; 0: a sensor.

    A critically damped one does not show the share (1 + ωτ) exp(−ωτ) of what the acceleration has changed until the
    time τ before.
    """
    if scaled == 0.0:
        return Hidden((0.0,) * 5, (0.0,) * 6)
    left = [2.0 / scaled, *((2.0 / scaled + i + 1) * math.exp(-scaled * (i + 1)) for i in range(OLDEST_FRAME))]
    a, b, c, d, e = (before - after for before, after in pairwise(left))
    u, v, w, x, y, z = (unseen(scaled, OLDEST_FRAME - age) for age in range(OLDEST_FRAME + 1))
    return Hidden((a, b, c, d, e), (u, v, w, x, y, z))


def damped_excess(motor: float, friction: float, current: float, damping_velocity: float, sample_time: float) -> float:
    """Largest way of the node's damped stop beyond full braking, for the weakest brake [rad].

    Below ``damping_velocity`` V the damped stop decelerates with c v + d, c = k_m I/(J V), d = T_c/J, and stops from V
    within V/c − d/c² ln(1 + c V/d), sampled within V t_s more. Full braking takes V²/2(c V + d) + V t_s/2.
    The difference grows with the speed up to V and stays from there on; it falls with d.

    ``motor`` is the smallest k_m / J [rad/(s²·A)], ``friction`` the smallest T_c / J [rad/s²], ``current`` I the limit.
    """
    v = damping_velocity
    slope = motor * current / v
    damped = v / slope - friction / (slope * slope) * math.log1p(slope * v / friction)
    return damped - 0.5 * v * v / (slope * v + friction) + 0.5 * v * sample_time


def chatter_excess(friction_low: float, friction_high: float, sample_time: float) -> float:
    """Largest way that forward Euler's sign() adds to a damped stop, with T_c/J within these bounds [rad].

    A brake that comes to rest under Euler is thrown to the other side, with up to w = t_s T_c/J, again and again with
    alternating signs. Stopping from w takes w²/2d + w t_s, and the alternating steps sum to less than 2 w t_s.
    """
    thrown = sample_time * friction_high
    return 0.5 * thrown * thrown / friction_low + 3.0 * thrown * sample_time


def coasting_excess(spring: float, friction: float, viscous: float, stroke: float, sample_time: float) -> float:
    """Largest way that forward Euler adds to that of a coasting brake, in a free ``stroke`` [rad].

    An Euler step of t_s at the acceleration a adds t_s²/2 (a² + w v²) to the energy; viscous friction takes t_s d v².
    So energy is gained below a speed v* only, there t_s/2 ∫ a² dt = t_s/2 ∫ |a| d|v| ≤ t_s/2 · a · v* on each of the
    way up, the way home and the end in the free stroke; friction turns energy into way. Infinite where viscous friction
    takes less than Euler adds.

    ``spring`` is the stiffest w = γ k_1 / J [1/s²], ``friction`` the smallest T_c / J [rad/s²], ``viscous`` the
    smallest d = f_v / J [1/s].
    """
    taken = viscous - 0.5 * sample_time * spring
    if taken <= 0.0:
        return math.inf
    fastest = 2.0 * friction + math.sqrt(friction * (friction + 2.0 * spring * stroke))  # w x + T_c/J at the apex
    slow = fastest * math.sqrt(0.5 * sample_time / taken)
    return sample_time * slow * (fastest + 0.5 * friction) / friction


def make_law(bench: Bench) -> ShieldLaw:
    """The shield of a bench: its limits for every brake in the set that ``bench.shield`` describes.

    Raises:
        BenchFileError: for that set the limits cannot be guaranteed; the message says which step of the argument fails.
    """
    law = law_of(bench)
    if reason := unmet_condition(law, bench):
        what = f"the shield cannot guarantee the limits for the set '{bench.shield.ranges}'"
        raise BenchFileError(f"{what}: {reason}{_or_lower(bench)}")
    return law


def late_step(law: ShieldLaw) -> int:
    """Step that a way home is always at for the shield: the end is as near as it may be while the brake still moves."""
    return law.steps - 2 - math.ceil(law.home.settling / law.sample_time)


def _or_lower(bench: Bench) -> str:
    """Another remedy: the largest whole upper angle with which every condition holds, if there is one."""
    bottom, top = bench.limits.angle
    for angle in reversed(range(math.ceil(top))):
        lower = replace(bench, limits=replace(bench.limits, angle=(bottom, float(angle))))
        if not unmet_condition(law_of(lower), lower):
            return f", or lower limits.angle to {angle} rad"
    return ""


def _box(bench: Bench) -> Box:
    shield, limits, brakes = bench.shield, bench.limits, bench.range_set(bench.shield.ranges)
    low, high = brakes.low, brakes.high
    motor_low, motor_high, friction_low = low.k_m / high.J, high.k_m / low.J, low.T_c / high.J
    loaded = shield.f_l * high.k_1 * limits.angle[1]
    return Box(
        motor_low=motor_low,
        motor_high=motor_high,
        spring_low=low.gamma * low.k_1 / high.J,
        spring_high=high.gamma * high.k_1 / low.J,
        friction_low=friction_low,
        friction_high=(shield.break_away * high.T_c + loaded) / low.J,
        viscous_low=low.f_v / high.J,
        viscous_high=high.f_v / low.J,
        braking=limits.current * motor_low + friction_low,
        braking_high=limits.current * motor_high + friction_low,
    )


def law_of(bench: Bench) -> ShieldLaw:
    """The law of a bench, as far as there is one: nothing is checked here."""
    shield, limits, ts = bench.shield, bench.limits, bench.timing.sample_time
    current, coasting = limits.current, shield.envelope == "coasting"
    lag, age_high, box = shield.current_lag, shield.frame_age[1], _box(bench)
    bottom = limits.angle[0] + shield.angle_margin
    noise = shield.noise_sigmas * bench.noise.velocity
    outward = limits.velocity - VELOCITY_PAD
    # A brake that enters the free stroke at this speed still stops above the bottom.
    weak = stoppable(-bottom, 0.0, box.braking, ts) - lag * box.motor_low * current
    strong = stoppable(-bottom, 0.0, box.braking_high, ts) - lag * box.motor_high * current
    homeward = min(outward, weak, strong)
    # At the homeward limit the clip lets a brake settle where the least and the greatest friction agree.
    periods = age_high + 1
    ratio = box.motor_high / box.motor_low
    uneven = VELOCITY_PAD + ts * (ratio * box.friction_high - box.friction_low)
    creep = noise + periods * uneven
    top = limits.angle[1] - shield.angle_margin
    apex = top
    if coasting:
        homeward = min(homeward, math.sqrt(max(-2.0 * box.friction_low * bottom, 0.0)))
        apex = min(apex, _apex(box.friction_low, box.spring_high, -bottom, CREEPS * creep))
    driven = current * box.motor_high + box.friction_high + box.viscous_high * limits.velocity + box.spring_high * apex
    change = VELOCITY_PAD + ts * driven
    plan = FRESH_LANDING if age_high == 0 and lag == 0.0 else LATE_LANDING
    observer, reckoned, behind = 0.0, float(periods), lag
    if (bandwidth := bench.sensors.bandwidth) is not None:
        plan = OBSERVED_LANDING if age_high == 0 else LATE_LANDING
        observer = min(bandwidth * ts, FASTEST_OBSERVER)
        behind = 6.0 * ts / observer  # three times the longest lag, by search
        creep += 2.0 / observer * uneven + unseen(observer, OLDEST_FRAME - age_high) * change
        reckoned += 2.0 / observer
    cruise = (homeward - creep) / (1.0 + reckoned * ts * (ratio * box.viscous_high - box.viscous_low))
    reserve = plan.reserve * ts + 2.0 * behind
    rest = noise + shield.home_velocity
    coast = (rest + noise) / box.friction_low
    return ShieldLaw(
        sample_time=ts,
        steps=bench.timing.horizon,
        age_low=shield.frame_age[0],
        age_high=age_high,
        current=current,
        angle_noise=shield.noise_sigmas * bench.noise.angle,
        velocity_noise=noise,
        bottom=bottom,
        top=top,
        outward_speed=outward,
        homeward_speed=homeward,
        reach=ts * limits.velocity,
        box=box,
        damping_velocity=bench.node.damping_velocity,
        change=change,
        delay=Delay(lag, math.exp(-ts / lag) if lag > 0.0 else 0.0, observer, hidden_by(observer)),
        coasting=coasting,
        home=WayHome(
            apex=apex,
            creep=creep,
            cruise=cruise,
            ramp=current * box.motor_low - box.friction_high - 0.6 * box.viscous_high * cruise,
            landing=plan.share * (box.braking - box.spring_high * min(0.5 * cruise * cruise / box.braking, 12.0)),
            gain=plan.gain,
            reserve=coast + reserve,
            committed=coast + reserve + COMMITTED * ts,
            settling=coast,
            rest_zone=0.3 * shield.home_angle,
            settled_zone=0.8 * shield.home_angle,
            rest_velocity=rest,
        ),
    )


def _apex(friction: float, spring: float, stroke: float, speed: float) -> float:
    """The angle at which a brake that coasts home at ``speed`` still stops within the free stroke; −1: none [rad]."""
    left = friction * stroke - 0.5 * speed * speed
    return (friction + math.sqrt(friction * friction + 2.0 * spring * left)) / spring if left > 0.0 else -1.0


def unmet_condition(law: ShieldLaw, bench: Bench) -> str:
    """The first step of the argument that does not hold for this law, with what to change; "" if all do."""
    conditions = _conditions(law, bench)
    return next((refusal for value, holds, limit, refusal in conditions if not holds(value, limit)), "")


def _conditions(law: ShieldLaw, bench: Bench) -> Iterator[tuple[float, Callable[[float, float], bool], float, str]]:
    """The steps of the argument: a value, its relation to a limit, the limit; what is wrong otherwise, and its remedy.

    In an order in which each has a value where those before it hold.
    """
    ts, box, home, (lag, _, observer, _) = law.sample_time, law.box, law.home, law.delay
    speed, farthest = bench.limits.velocity, home.apex if law.coasting else bench.limits.angle[1]
    yield (lag > 0.0) + law.coasting + (law.age_high > 0), le, 1, (
        "a lag of the current, frames that may be late and the coasting envelope are covered one at a time; choose one "
        "of shield.current_lag, shield.frame_age and shield.envelope"
    )  # fmt: skip
    if observer > 0.0:
        yield (lag > 0.0) + law.coasting + (law.age_high > LATEST_OBSERVED), le, 0, (
            f"an observer's velocity is covered with frames of age {LATEST_OBSERVED} at most, and neither with a lag "
            "of the current nor with the coasting envelope; change shield.frame_age, shield.current_lag or "
            "shield.envelope, or delete [sensors] where a sensor measures the velocity"
        )  # fmt: skip
        least, got = SLOWEST_OBSERVER / ts, observer / ts
        yield observer, ge, SLOWEST_OBSERVER, (
            f"the way home works for a sensors.observer_bandwidth of {least:g} rad/s at least, or a "
            f"sensors.velocity_lag of {PER_LAG / least:g} s at most, got {got:g} rad/s, or {PER_LAG / got:g} s; make "
            "the observer faster"
        )  # fmt: skip
    yield lag, le, LONGEST_LAG * ts, (
        f"the way home works for a shield.current_lag of {LONGEST_LAG * ts:g} s at most, got {lag:g} s; shorten the "
        "lag of the current loop"
    )  # fmt: skip
    if law.coasting:
        yield home.apex, gt, 0.0, (
            f"from no angle would a brake come to rest in {-law.bottom:.2f} rad of free stroke by friction alone; "
            "widen limits.angle, lower shield.angle_margin or narrow the set"
        )  # fmt: skip
    # The cruise is less than the homeward speed by more than the noise.
    yield home.cruise, gt, law.velocity_noise, (
        f"with {law.velocity_noise:g} rad/s of noise no homeward speed is left above the lower limit (homeward "
        f"{law.homeward_speed:.1f} rad/s, cruise {home.cruise:.1f} rad/s); widen limits.angle or limits.velocity, or "
        "narrow the set"
    )  # fmt: skip
    # The extreme brakes of a successor box are those with the least acceleration.
    change = box.braking + box.spring_low * farthest + box.viscous_high * speed
    flow = 0.5 * ts * ts * box.viscous_high * change
    yield flow, le, VELOCITY_PAD, (
        f"within a sample of {ts:g} s viscous friction changes by {flow:.2f} rad/s and {VELOCITY_PAD:g} are allowed "
        "for; shorten timing.sample_time"
    )  # fmt: skip
    if bench.node.stop == "damped" or not law.coasting:
        damped = (box.motor_high * law.current / law.damping_velocity + box.viscous_high) * ts
        yield damped, lt, 1.0, (
            f"the damped stop takes {damped:.2f} of the strongest brake's speed in one sample and would reverse it; "
            "raise node.damping_velocity"
        )  # fmt: skip
    margin, (needed, why) = bench.shield.angle_margin, _margin(law)
    yield margin, ge, needed, (
        f"{why} needs {needed:.3f} rad beyond the envelope and shield.angle_margin is {margin:g} rad; raise it"
    )  # fmt: skip
    if not law.coasting:
        slowed = box.motor_low * law.current * min(1.0, law.homeward_speed / law.damping_velocity)
        held = slowed + box.friction_low + box.viscous_low * law.homeward_speed - box.spring_high * farthest
        yield held, gt, 0.0, (
            f"coming home at {law.homeward_speed:.0f} rad/s from {farthest:g} rad, the stiffest spring accelerates the "
            f"weakest motor by {-held:.0f} rad/s² against full braking; narrow k_m or k_1"
        )  # fmt: skip
    yield min(home.ramp, home.landing), gt, 0.0, (
        "the weakest motor cannot bring the brake home against the greatest friction and the stiffest spring (it would "
        f"accelerate with {home.ramp:.0f} rad/s² and land with {home.landing:.0f} rad/s²); narrow the set"
    )  # fmt: skip
    if not law.coasting:
        room, between = _room(law, speed, farthest), law.top - law.bottom
        yield between, gt, room, (
            f"what one measurement leaves open needs {room:.2f} rad between the angle limits and there are "
            f"{between:.2f} rad; widen limits.angle"
        )  # fmt: skip


def _room(law: ShieldLaw, speed: float, farthest: float) -> float:
    """Room in which the windows against the two angle limits do not both close on a successor box [rad]."""
    ts, box, (lag, _, observer, _) = law.sample_time, law.box, law.delay
    spread = law.current * (box.motor_high - box.motor_low) + box.friction_low + box.friction_high
    spread += (box.viscous_high - box.viscous_low) * speed + (box.spring_high - box.spring_low) * farthest
    width = 2.0 * law.velocity_noise + (law.age_high + 1) * (2.0 * VELOCITY_PAD + ts * spread)
    width += (4.0 * lag + 2.0 * ts * law.age_high) * box.motor_high * law.current
    if observer > 0.0:
        width += 2.0 * (2.0 / observer + unseen(observer, OLDEST_FRAME - law.age_high)) * law.change
    return 2.0 * (0.5 * width * width / box.braking + ts * width * (law.age_high + 2) + law.angle_noise)


def _margin(law: ShieldLaw) -> tuple[float, str]:
    """Way that the true brake may need beyond the envelope [rad], and the brake that needs it."""
    ts, box = law.sample_time, law.box
    needed = chatter_excess(box.friction_low, box.friction_high, ts) + ANGLE_PAD
    if law.coasting:
        needed += coasting_excess(box.spring_high, box.friction_low, box.viscous_low, -law.bottom, ts)
        needed += 0.5 * ts * box.friction_high / box.viscous_low  # Euler's sign() lets it creep until this wears off
        return needed, "a brake that coasts in samples"
    motors = (box.motor_low, box.motor_high)[: 2 if law.delay.lag > 0.0 else 1]
    stops = [damped_excess(m, box.friction_low, law.current, law.damping_velocity, ts) for m in motors]
    # The node brakes against the velocity at the start of a period, and a current that still flows raises it.
    held = [ts * law.delay.lag * m * law.current for m in motors]
    return needed + max(a + b for a, b in zip(stops, held, strict=True)), "the damped stop"
