"""The envelope shield: from what the policy wants to a current from which every brake of a box can still be held.

:func:`make_law` turns a bench into a :class:`ShieldLaw`; :func:`shield` is one pure scalar function of that law, the
newest measurement, the last own commands and the step. It runs as it is in the runtime and, compiled by
``emb_bench.compiled``, bit for bit the same in the training environment.

The argument, in short (in full, with what it does not cover, in ``docs/shield.md``):

* A measurement, ± a few sigma, is a box of states. :func:`successor` maps that box and a current to a box that contains
  what any brake of the parameter box can do in one sample, under forward Euler and under the exact flow.
* The envelope asks that a state can be stopped by full braking of the weakest brake before the angle limits, and that
  its speed is below the limit. The window of currents for which the whole successor box lies in the envelope has a
  closed form (:func:`_highest_current`); what the policy wants is clipped to it.
* Where the window is empty on one side, the clip is full braking. Envelope plus ``angle_margin`` contains a set that
  full braking, the node's damped stop and the window all map into itself. So a period in which the node does not get
  its answer, and a kill at any moment, are harmless as well.
* By the worst brake's arrival time the shield takes over to be home at the end of the experiment.

All accelerations are torques over the inertia [rad/s²]; a name that ends in ``_low``/``_high`` is a bound of the box.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emb_runtime.bench import Bench
from emb_runtime.errors import BenchFileError

# Values of records.Reason; plain integers, because the compiled function cannot see an IntFlag.
LIMITED = 2
RETURNING = 4

VELOCITY_PAD = 0.3
"""Forward Euler against the exact flow within one sample: viscous friction changes while the speed does [rad/s]."""
ANGLE_PAD = 0.005
"""Left of ``angle_margin`` for rounding, and for an exact flow that is not quite monotone within a sample [rad]."""
BELIEVABLE = 1e6
"""A measurement beyond this (or NaN) is no measurement; far beyond all limits, far below where squares overflow."""


class Landing(NamedTuple):
    """How the way home ends. Safety does not depend on it; that it brings every brake home was searched only."""

    share: float
    """Of the guaranteed deceleration, planned for the landing."""
    gain: float
    """Share of a velocity error that is removed per sample, with the middle k_m."""
    reserve: int
    """Samples kept beyond the worst arrival and the time in which friction alone brings a slow brake to rest."""


FRESH_LANDING = Landing(share=0.8, gain=0.6, reserve=7)
"""For commands that act in the very period of the sample that they answer."""
LATE_LANDING = Landing(share=0.5, gain=0.283, reserve=25)
"""For unknown or greater frame ages, where the loop has dead time."""
COMMITTED = 16
"""Samples before the reserve in which the policy does not get control back."""


class ShieldLaw(NamedTuple):
    """Everything that :func:`shield` knows; floats and integers only. ``_low``/``_high``: bounds of the box."""

    sample_time: float
    """[s]."""
    steps: int
    """Commands in one experiment."""
    age_low: int
    """Least samples between a measurement and the period in which its answer acts."""
    age_high: int
    """Most samples of the same, 0..3."""
    current: float
    """Limit, both signs [A]."""
    angle_noise: float
    """A measured angle lies within this of the truth [rad]."""
    velocity_noise: float
    """[rad/s]."""
    bottom: float
    """Full braking of the weakest brake stops above this angle [rad]."""
    top: float
    """Full braking of the weakest brake stops below this angle [rad]."""
    outward_speed: float
    """Largest velocity that a successor may have [rad/s]."""
    homeward_speed: float
    """Largest speed of a successor towards the origin from contact [rad/s]."""
    reach: float
    """What the angle changes at most in one sample [rad]."""
    motor_low: float
    """k_m / J [rad/(s²·A)]."""
    motor_high: float
    spring_low: float
    """γ k_1 / J [1/s²]."""
    spring_high: float
    friction_low: float
    """T_c / J [rad/s²]."""
    friction_high: float
    viscous_low: float
    """f_v / J [1/s]."""
    viscous_high: float
    braking: float
    """Deceleration that every brake of the box reaches outside contact [rad/s²]."""
    damping_velocity: float
    """The node's, used when there is no believable angle [rad/s]."""
    cruise: float
    """Homeward speed that every brake reaches inside this envelope [rad/s]."""
    ramp: float
    """Homeward acceleration that every brake reaches outside contact [rad/s²]."""
    landing: float
    """Deceleration planned for the landing [rad/s²]."""
    gain: float
    """As in :class:`Landing`."""
    reserve: float
    """Time kept for the end of the landing [s]."""
    committed: float
    """Before the end the policy does not get control back [s]."""
    settling: float
    """Before the end no more hop is begun: what is inside a wider zone only stops [s]."""
    rest_zone: float
    """|angle| within which the landing stops [rad]."""
    settled_zone: float
    """The same just before the end [rad]."""
    rest_velocity: float
    """|velocity| below which friction is left to stop the brake [rad/s]."""


def shield(
    law: ShieldLaw, angle: float, velocity: float, wanted: float, u1: float, u2: float, u3: float, step: int
) -> tuple[float, int]:
    """The current to send in place of the wanted one, and why it differs.

    A ``wanted`` that is not finite counts as 0 A. Where the measurement or an own command is NaN, infinite or absurd,
    there is no box to reason about: the answer is the damped stop if the velocity is believable, else 0 A. The loop
    refuses such samples before they come here, and the node then brakes by itself.

    Args:
        law: from :func:`make_law`.
        angle: newest measurement [rad].
        velocity: newest measurement [rad/s].
        wanted: what the policy asks for [A].
        u1: the last own command, for ages above 0 [A].
        u2: the one before it [A].
        u3: the one before that [A].
        step: index of this command in the experiment, 0 first.

    Returns:
        The current [A], finite and within the limit, and bits of ``records.Reason``: LIMITED (what was wanted did not
        fit), RETURNING (the way home has taken over).
    """
    if not (abs(velocity) <= BELIEVABLE and abs(angle) <= BELIEVABLE and abs(u1) + abs(u2) + abs(u3) <= BELIEVABLE):
        return _blind_current(law, velocity), LIMITED
    lowest = -law.current
    highest = law.current
    x_low = BELIEVABLE * 2.0
    x_high = -x_low
    v_low = x_low
    v_high = -x_low
    for age in range(law.age_low, law.age_high + 1):
        xl = angle - law.angle_noise
        xh = angle + law.angle_noise
        vl = velocity - law.velocity_noise
        vh = velocity + law.velocity_noise
        for past in range(age, 0, -1):
            u = u1
            if past == 2:
                u = u2
            elif past == 3:
                u = u3
            xl, xh, vl, vh = successor(law, xl, xh, vl, vh, u)
        top = _highest_current(
            law,
            vl,
            vh,
            law.top - xh,
            law.braking + law.spring_low * max(xl, 0.0),
            law.outward_speed,
            law.spring_low * max(xl - law.reach, 0.0),
        )
        bottom = -_highest_current(
            law,
            -vh,
            -vl,
            xl - law.bottom,
            law.braking,
            law.homeward_speed,
            -law.spring_high * max(xh + law.reach, 0.0),
        )
        highest = min(highest, max(top, -law.current))
        lowest = max(lowest, min(bottom, law.current))
        x_low = min(x_low, xl)
        x_high = max(x_high, xh)
        v_low = min(v_low, vl)
        v_high = max(v_high, vh)

    if lowest > highest:  # cannot happen to a brake of the box; whatever this is, full braking is right for it
        return (-law.current if velocity > 0.0 else law.current), LIMITED
    sent = min(max(wanted, lowest), highest) if math.isfinite(wanted) else min(max(0.0, lowest), highest)
    bits = 0 if sent == wanted else LIMITED
    left = (law.steps - 1 - step) * law.sample_time
    if _must_return(law, x_low, x_high, v_low, v_high, sent, left):
        sent = _return_current(law, 0.5 * (x_low + x_high), 0.5 * (v_low + v_high), left)
        sent = min(max(sent, lowest), highest)
        bits |= RETURNING
    return sent, bits


def successor(
    law: ShieldLaw, xl: float, xh: float, vl: float, vh: float, u: float
) -> tuple[float, float, float, float]:
    """The box of states that any brake of the parameter box can reach in one sample.

    Args:
        law: from :func:`make_law`.
        xl: least angle [rad].
        xh: greatest angle [rad].
        vl: least velocity [rad/s].
        vh: greatest velocity [rad/s].
        u: current during the sample [A].

    Returns:
        The same four bounds one sample later, for forward Euler and for the exact flow.
    """
    strong = law.motor_high * u
    weak = law.motor_low * u
    drive_high = max(strong, weak) - law.spring_low * max(xl - law.reach, 0.0)
    drive_low = min(strong, weak) - law.spring_high * max(xh + law.reach, 0.0)
    high = _fastest(law, vl, vh, drive_high) + VELOCITY_PAD
    low = -_fastest(law, -vh, -vl, -drive_low) - VELOCITY_PAD
    return xl + law.sample_time * min(vl, low), xh + law.sample_time * max(vh, high), low, high


def _fastest(law: ShieldLaw, vl: float, vh: float, drive: float) -> float:
    """Greatest velocity one sample after [vl, vh], where ``drive`` bounds motor and spring [rad/s²].

    Euler's map is monotone on either side of zero and jumps at it, so the two corners and the jump bound it. A brake
    that would come to rest may stick: hence not below zero from above.
    """
    ts = law.sample_time
    if vh <= 0.0:
        return vh + ts * (drive + law.friction_high - law.viscous_high * vh)
    fastest = max(vh + ts * (drive - law.friction_low - law.viscous_low * vh), 0.0)
    if vl <= 0.0:
        fastest = max(fastest, ts * (drive + law.friction_high))
    return fastest


def _highest_current(
    law: ShieldLaw, vl: float, vh: float, room: float, braking: float, speed: float, spring: float
) -> float:
    """Greatest current after which no brake is faster than ``speed`` or too fast to stop within ``room`` [A].

    The inverse of :func:`_fastest`. For the lower limits it is called in mirrored velocities.

    Args:
        law: from :func:`make_law`.
        vl: least velocity now [rad/s].
        vh: greatest velocity now [rad/s].
        room: distance to the limit, at least [rad].
        braking: deceleration that the weakest brake reaches [rad/s²].
        speed: greatest velocity that the successor may have [rad/s].
        spring: what the clamping force takes from the motion, at least [rad/s²]; negative where it drives it.
    """
    ts = law.sample_time
    v = min(speed, _stoppable(room, vh, braking, ts)) - VELOCITY_PAD
    if v < 0.0:
        return -law.current
    if vh > 0.0:
        drive = (v - vh) / ts + law.friction_low + law.viscous_low * vh
        if vl <= 0.0:
            drive = min(drive, v / ts - law.friction_high)
    else:
        drive = (v - vh) / ts - law.friction_high + law.viscous_high * vh
    drive += spring
    return drive / (law.motor_high if drive > 0.0 else law.motor_low)


def _stoppable(room: float, v: float, braking: float, ts: float) -> float:
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


def _blind_current(law: ShieldLaw, velocity: float) -> float:
    """Damped stop against a believable velocity, 0 A without one."""
    if not abs(velocity) <= BELIEVABLE:
        return 0.0
    return min(max(-law.current * velocity / law.damping_velocity, -law.current), law.current)


def _must_return(law: ShieldLaw, xl: float, xh: float, vl: float, vh: float, current: float, left: float) -> bool:
    """Whether after ``current`` the worst brake could come home too late, with ``left`` seconds after this sample."""
    if left < law.committed:
        return True
    xl, xh, vl, vh = successor(law, xl, xh, vl, vh, current)
    return max(_arrival(law, xl, vl), _arrival(law, xh, vh)) + law.reserve > left


def _arrival(law: ShieldLaw, x: float, v: float) -> float:
    """Time in which the worst brake of the box is at rest at the origin by the way home [s]."""
    out = v
    spring = law.spring_low * x
    if x < 0.0:
        x = -x
        out = -v
        spring = 0.0
    t = 0.0
    home = -out
    if out > 0.0:  # stop the outward motion first
        braking = law.braking + spring
        t = out / braking
        x += 0.5 * out * (t + law.sample_time)
        home = 0.0
    beyond = 0.5 * home * home / law.landing - x
    if beyond > 0.0:  # too fast to stop at the origin: come back from the other side
        t += home / law.landing
        x = beyond
        home = 0.0
        spring = 0.0
    ramp = law.ramp + 0.5 * spring
    peak = math.sqrt((x + 0.5 * home * home / ramp) / (0.5 / ramp + 0.5 / law.landing))
    peak = max(min(peak, law.cruise), home)
    cruising = x - 0.5 * (peak * peak - home * home) / ramp - 0.5 * peak * peak / law.landing
    if cruising > 0.0:
        t += cruising / law.cruise
    return t + (peak - home) / ramp + peak / law.landing


def _return_current(law: ShieldLaw, x: float, v: float, left: float) -> float:
    """The way home: follow the speed from which a planned deceleration lands at the origin [A]."""
    motor = 0.5 * (law.motor_low + law.motor_high)
    zone = law.settled_zone if left < law.settling else law.rest_zone
    if abs(x) < zone:
        if abs(v) < law.rest_velocity:
            return 0.0
        # The noise is left out: what chatters between the signs of a standing brake is not braked into moving.
        excess = v - law.velocity_noise if v > 0.0 else v + law.velocity_noise
        return -law.gain * excess / (law.sample_time * motor)
    direction = -1.0 if x > 0.0 else 1.0
    planned = math.sqrt(2.0 * law.landing * abs(x))
    drive = 0.5 * (law.friction_low + law.friction_high) * direction + 0.5 * (law.viscous_low + law.viscous_high) * v
    drive += 0.5 * (law.spring_low + law.spring_high) * max(x, 0.0)
    if planned < law.homeward_speed:  # the planned speed falls as the origin comes nearer
        drive -= law.landing * direction * min(max(direction * v / planned, 0.0), 1.0)
    else:
        planned = law.homeward_speed
    drive += law.gain * (direction * planned - v) / law.sample_time
    return drive / motor


def damped_excess(motor: float, friction: float, current: float, damping_velocity: float, sample_time: float) -> float:
    """What the node's damped stop needs beyond full braking, at most, for the weakest brake [rad].

    Below ``damping_velocity`` V the damped stop decelerates with c v + d, c = k_m I/(J V), d = T_c/J, and stops from V
    within V/c − d/c² ln(1 + c V/d), sampled within V t_s more. Full braking takes V²/2(c V + d) + V t_s/2.
    The difference grows with the speed up to V and stays from there on; it falls with d.

    Args:
        motor: smallest k_m / J [rad/(s²·A)].
        friction: smallest T_c / J [rad/s²].
        current: limit [A].
        damping_velocity: V [rad/s].
        sample_time: t_s [s].
    """
    v = damping_velocity
    slope = motor * current / v
    damped = v / slope - friction / (slope * slope) * math.log1p(slope * v / friction)
    return damped - 0.5 * v * v / (slope * v + friction) + 0.5 * v * sample_time


def chatter_excess(friction_low: float, friction_high: float, sample_time: float) -> float:
    """What forward Euler's sign() adds to a damped stop, at most [rad].

    A brake that comes to rest under Euler is thrown to the other side, with up to w = t_s T_c/J, again and again with
    alternating signs. Stopping from w takes w²/2d + w t_s, and the alternating steps sum to less than 2 w t_s.

    Args:
        friction_low: smallest T_c / J [rad/s²].
        friction_high: greatest T_c / J [rad/s²].
        sample_time: t_s [s].
    """
    thrown = sample_time * friction_high
    return 0.5 * thrown * thrown / friction_low + 3.0 * thrown * sample_time


def make_law(bench: Bench) -> ShieldLaw:
    """The shield of a bench: its limits for every brake in the set that ``bench.shield.ranges`` names.

    Raises:
        BenchFileError: for that set the limits cannot be guaranteed; the message says which step of the argument fails.
    """
    low, high = bench.range_set(bench.shield.ranges).low, bench.range_set(bench.shield.ranges).high
    ts = bench.timing.sample_time
    age_low, age_high = bench.shield.frame_age
    motor = (low.k_m / high.J, high.k_m / low.J)
    spring = (low.gamma * low.k_1 / high.J, high.gamma * high.k_1 / low.J)
    friction = (low.T_c / high.J, high.T_c / low.J)
    viscous = (low.f_v / high.J, high.f_v / low.J)
    braking = bench.limits.current * motor[0] + friction[0]
    bottom = bench.limits.angle[0] + bench.shield.angle_margin
    noise = bench.shield.noise_sigmas * bench.noise.velocity
    outward = bench.limits.velocity - VELOCITY_PAD
    # A brake that enters the free stroke at this speed still stops above the bottom.
    homeward = min(outward, _stoppable(-bottom, 0.0, braking, ts))
    # At the homeward limit the clip lets a brake settle where the least and the greatest friction agree.
    periods = age_high + 1
    ratio = motor[1] / motor[0]
    uneven = VELOCITY_PAD + ts * (ratio * friction[1] - friction[0])
    cruise = (homeward - noise - periods * uneven) / (1.0 + periods * ts * (ratio * viscous[1] - viscous[0]))
    plan = FRESH_LANDING if age_high == 0 else LATE_LANDING
    rest = noise + bench.shield.home_velocity
    coast = (rest + noise) / friction[0]
    law = ShieldLaw(
        sample_time=ts,
        steps=bench.timing.horizon,
        age_low=age_low,
        age_high=age_high,
        current=bench.limits.current,
        angle_noise=bench.shield.noise_sigmas * bench.noise.angle,
        velocity_noise=noise,
        bottom=bottom,
        top=bench.limits.angle[1] - bench.shield.angle_margin,
        outward_speed=outward,
        homeward_speed=homeward,
        reach=ts * bench.limits.velocity,
        motor_low=motor[0],
        motor_high=motor[1],
        spring_low=spring[0],
        spring_high=spring[1],
        friction_low=friction[0],
        friction_high=friction[1],
        viscous_low=viscous[0],
        viscous_high=viscous[1],
        braking=braking,
        damping_velocity=bench.node.damping_velocity,
        cruise=cruise,
        ramp=bench.limits.current * motor[0] - friction[1] - 0.6 * viscous[1] * cruise,
        landing=plan.share * (braking - spring[1] * min(0.5 * cruise * cruise / braking, 12.0)),
        gain=plan.gain,
        reserve=coast + plan.reserve * ts,
        committed=coast + (plan.reserve + COMMITTED) * ts,
        settling=coast,
        rest_zone=0.3 * bench.shield.home_angle,
        settled_zone=0.8 * bench.shield.home_angle,
        rest_velocity=rest,
    )
    if reason := _gap(law, bench):
        raise BenchFileError(f"the shield cannot guarantee the limits for the set '{bench.shield.ranges}': {reason}")
    return law


def _gap(law: ShieldLaw, bench: Bench) -> str:
    """The first step of the argument that does not hold for this law; empty if all do."""
    ts = law.sample_time
    speed, top_angle = bench.limits.velocity, bench.limits.angle[1]
    if law.homeward_speed <= law.velocity_noise or law.cruise <= law.velocity_noise:
        return (
            f"with {law.velocity_noise:g} rad/s of noise no homeward speed is left above the lower limit "
            f"(homeward {law.homeward_speed:.1f} rad/s, cruise {law.cruise:.1f} rad/s); widen limits.angle or "
            "limits.velocity, or narrow the set"
        )
    # The extreme brakes of a successor box are those with the least acceleration.
    change = law.braking + law.spring_low * top_angle + law.viscous_high * speed
    flow = 0.5 * ts * ts * law.viscous_high * change
    if flow > VELOCITY_PAD:
        return (
            f"within a sample of {ts:g} s viscous friction changes by {flow:.2f} rad/s and {VELOCITY_PAD:g} are "
            "allowed for; shorten timing.sample_time"
        )
    damped = law.motor_high * law.current / law.damping_velocity + law.viscous_high
    if damped * ts >= 1.0:
        return (
            f"the damped stop takes {damped * ts:.2f} of the strongest brake's speed in one sample and would reverse "
            "it; raise node.damping_velocity"
        )
    needed = damped_excess(law.motor_low, law.friction_low, law.current, law.damping_velocity, ts)
    needed += chatter_excess(law.friction_low, law.friction_high, ts) + ANGLE_PAD
    if bench.shield.angle_margin < needed:
        return (
            f"the damped stop needs {needed:.3f} rad beyond full braking and shield.angle_margin is "
            f"{bench.shield.angle_margin:g} rad; raise it, or lower node.damping_velocity"
        )
    slowed = law.motor_low * law.current * min(1.0, law.homeward_speed / law.damping_velocity)
    held = slowed + law.friction_low + law.viscous_low * law.homeward_speed - law.spring_high * top_angle
    if held <= 0.0:
        return (
            f"coming home at {law.homeward_speed:.0f} rad/s from {top_angle:g} rad, the stiffest spring accelerates "
            f"the weakest motor by {-held:.0f} rad/s² against full braking; narrow k_m or k_1, or lower limits.angle"
        )
    if law.ramp <= 0.0 or law.landing <= 0.0:
        return (
            "the weakest motor cannot bring the brake home against the greatest friction and the stiffest spring "
            f"(it would accelerate with {law.ramp:.0f} rad/s² and land with {law.landing:.0f} rad/s²); narrow the set"
        )
    # Width of a successor box; the windows against the two angle limits must not both close on it.
    spread = law.current * (law.motor_high - law.motor_low) + law.friction_low + law.friction_high
    spread += (law.viscous_high - law.viscous_low) * speed + (law.spring_high - law.spring_low) * top_angle
    width = 2.0 * law.velocity_noise + (law.age_high + 1) * (2.0 * VELOCITY_PAD + ts * spread)
    room = 2.0 * (0.5 * width * width / law.braking + ts * width * (law.age_high + 2) + law.angle_noise)
    if law.top - law.bottom <= room:
        return (
            f"what one measurement leaves open needs {room:.2f} rad between the angle limits and there are "
            f"{law.top - law.bottom:.2f} rad; widen limits.angle"
        )
    return ""
