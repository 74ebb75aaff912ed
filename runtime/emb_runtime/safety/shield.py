"""The envelope shield: limits a requested current so that every brake of the set can still be stopped.

:func:`shield` is one pure scalar function of a bench's law (:func:`emb_runtime.safety.shield_design.make_law`), the
newest measurement, the last commands sent and the step. The runtime runs it as plain Python or compiled; the training
environment runs it compiled by ``emb_bench.compiled``, with bit-identical results.

The argument, in short (in full, with what it does not cover, in ``docs/explanation/shield.md``):

* A measurement, ± a few sigma, is a box of states. :func:`successor` maps that box and a current to a box that contains
  what any brake of the parameter box can do in one sample, under forward Euler and under the exact flow.
* A state is in the envelope if full braking of the weakest brake stops it before the angle limits, and if its speed is
  below the limit. The window of currents for which the whole successor box lies in the envelope has a closed form
  (:func:`_highest_current`); the requested current is clipped to it.
* Where the window is empty on one side, the clip is full braking. The envelope with ``angle_margin`` contains a set
  that is invariant under full braking, the node's damped stop and the window. So the limits also hold if the node gets
  no answer in a period, or if the process is killed at any moment.
* A current that lags and a drive that can only switch its current off have windows of their own. With late frames the
  window is the intersection over all ages.
* The shield takes over in time for the worst brake to be home at the end of the experiment.

All accelerations are torques over the inertia [rad/s²]; a name that ends in ``_low``/``_high`` is a bound of the box.
Functions that run in most cycles have ``b if b < a else a`` in place of ``min(a, b)``, and likewise for ``max``: it
gives the same, zeros and NaN included, in a third of the time.
"""

from __future__ import annotations

import math
from typing import Final

from emb_runtime.safety.shield_design import CREEPS, VELOCITY_PAD, ShieldLaw, stoppable

# Values of records.Reason; plain integers, because the compiled function cannot see an IntFlag.
LIMITED: Final = 2
RETURNING: Final = 4

BELIEVABLE: Final = 1e6
"""A measurement above this (or NaN) is invalid; far beyond all limits, far below where squares overflow."""

PIECES: Final = 8  # Trapezoids for the way home of a coasting brake
PAST: Final = 5  # Number of commands in ``past``
Past = tuple[float, float, float, float, float]
"""The last commands sent, newest first [A]; 0 where nothing was sent. A law for fresh frames does not use them."""
NO_PAST: Past = (0.0, 0.0, 0.0, 0.0, 0.0)
States = tuple[float, float, float, float]
"""A box of states: least and greatest angle [rad], least and greatest velocity [rad/s]."""


def shield(law: ShieldLaw, angle: float, velocity: float, wanted: float, past: Past, step: int) -> tuple[float, int]:
    """The current to send in place of the requested one, and why it differs.

    A request that is not finite counts as 0 A. If the measurement or a past command is NaN, infinite or above
    ``BELIEVABLE``, the result is the damped stop if the velocity is valid, else 0 A. The loop rejects such samples
    earlier, and the node then brakes by itself.

    Args:
        law: of the bench.
        angle: newest measurement [rad].
        velocity: newest measurement [rad/s].
        wanted: current requested by the policy [A].
        past: the last commands sent, newest first [A].
        step: index of this command in the experiment, 0 first.

    Returns:
        The current [A], finite and within the limit, and bits of ``records.Reason``: LIMITED (the request was
        outside the window), RETURNING (the way home has taken over).
    """
    if not _believable(law, angle, velocity, past):
        return _blind_current(law, velocity), LIMITED
    lowest, highest, xl, xh, vl, vh = _window_and_box(law, angle, velocity, past)
    sent = wanted if math.isfinite(wanted) else 0.0
    sent = lowest if lowest > sent else sent
    sent = highest if highest < sent else sent
    bits = 0 if sent == wanted else LIMITED
    left = (law.steps - 1 - step) * law.sample_time
    if _must_return(law, xl, xh, vl, vh, sent, left):
        sent = _return_current(law, 0.5 * (xl + xh), 0.5 * (vl + vh), left)
        sent = min(max(sent, lowest), highest)
        bits |= RETURNING
    return sent, bits


def window(law: ShieldLaw, angle: float, velocity: float, past: Past) -> tuple[float, float]:
    """Least and greatest current after which every brake of the set can still be stopped within the limits [A].

    Both are within the current limit. They are equal if only full braking is possible. If the measurement or a past
    command is invalid, both are the damped stop, or 0 A.
    """
    if not _believable(law, angle, velocity, past):
        blind = _blind_current(law, velocity)
        return blind, blind
    found = _window_and_box(law, angle, velocity, past)
    return found[0], found[1]


def _window_and_box(
    law: ShieldLaw, angle: float, velocity: float, past: Past
) -> tuple[float, float, float, float, float, float]:
    """The :func:`window`, and the box of states at the start of this period if every command was obeyed.

    The box is the hull over all ages of a frame. With a lag its velocities are those after the flowing current has
    decayed.
    """
    lowest, highest = -law.current, law.current
    x0, x1, v0, v1 = math.inf, -math.inf, math.inf, -math.inf
    for age in range(law.age_low, law.age_high + 1):
        (xl, xh, vl, vh), obeyed = _rolled(law, angle, velocity, past, age)
        if law.coasting:
            bottom, top = _coasting_window(law, xl, xh, vl, vh)
        elif law.delay.lag > 0.0:
            bottom, top = _lagging_window(law, xl, xh, vl, vh, past)
        else:
            bottom, top = braking_window(law, xl, xh, vl, vh)
        highest = top if top < highest else highest
        lowest = bottom if bottom > lowest else lowest
        xl, xh, vl, vh = obeyed
        x0, x1 = xl if xl < x0 else x0, xh if xh > x1 else x1
        v0, v1 = vl if vl < v0 else v0, vh if vh > v1 else v1
    if lowest > highest:  # cannot happen to a brake of the set: full braking
        lowest = highest = -law.current if velocity > 0.0 else law.current
    if law.delay.lag > 0.0:
        v0, v1 = _decayed(law, v0, v1, past)
    return lowest, highest, x0, x1, v0, v1


def _decayed(law: ShieldLaw, vl: float, vh: float, past: Past) -> tuple[float, float]:
    """Least and greatest velocity after the current that flows in a motor with a lag has decayed."""
    box, delay, flowing = law.box, law.delay, 0.0
    for i in range(PAST - 1, -1, -1):
        flowing = past[i] + delay.kept * (flowing - past[i])
    vl += delay.lag * (box.motor_low if flowing > 0.0 else box.motor_high) * flowing
    vh += delay.lag * (box.motor_high if flowing > 0.0 else box.motor_low) * flowing
    return vl, vh


def braking_window(law: ShieldLaw, xl: float, xh: float, vl: float, vh: float) -> tuple[float, float]:
    """The window for a box of states, each end cut at full braking (L2-L4 in ``docs/explanation/shield.md``)."""
    ts, box, limit, spring = law.sample_time, law.box, law.current, law.box.spring_low
    nearest, farthest = xl - law.reach, xh + law.reach
    braking = box.braking + spring * (0.0 if xl < 0.0 else xl)
    fastest, v = law.outward_speed, stoppable(law.top - xh, vh, braking, ts)
    v = (v if v < fastest else fastest) - VELOCITY_PAD
    top = _highest_current(law, vl, vh, v, spring * (0.0 if nearest < 0.0 else nearest))
    fastest, v = law.homeward_speed, stoppable(xl - law.bottom, -vl, box.braking, ts)
    v = (v if v < fastest else fastest) - VELOCITY_PAD
    bottom = -_highest_current(law, -vh, -vl, v, -box.spring_high * (0.0 if farthest < 0.0 else farthest))
    return limit if limit < bottom else bottom, -limit if -limit > top else top


def _coasting_window(law: ShieldLaw, xl: float, xh: float, vl: float, vh: float) -> tuple[float, float]:
    """The window of a brake that has to stop by coasting: each end cut at 0 A (L10).

    On the way up friction must dissipate the kinetic energy and that of the softest spring before the apex; on the way
    down, the kinetic energy and that of the stiffest spring before the bottom.
    """
    ts, box, home = law.sample_time, law.box, law.home
    above = xh + ts * max(vh + law.change, 0.0)
    below = xl + ts * min(vl - law.change, 0.0)
    squeezed = max(above, 0.0)
    left = box.friction_low * (home.apex - above) + 0.5 * box.spring_low * (home.apex * home.apex - squeezed * squeezed)
    v = min(law.outward_speed, math.sqrt(max(2.0 * left, 0.0))) - VELOCITY_PAD
    top = _highest_current(law, vl, vh, v, box.spring_low * max(xl - law.reach, 0.0))
    left = box.friction_low * (below - law.bottom) - 0.5 * box.spring_high * squeezed * squeezed
    v = min(law.homeward_speed, math.sqrt(max(2.0 * left, 0.0))) - VELOCITY_PAD
    bottom = -_highest_current(law, -vh, -vl, v, -box.spring_high * max(xh + law.reach, 0.0))
    return min(bottom, 0.0), max(top, 0.0)


def _lagging_window(law: ShieldLaw, xl: float, xh: float, vl: float, vh: float, past: Past) -> tuple[float, float]:
    """The window where the current follows the command with a lag, for either motor (L7-L9)."""
    box = law.box
    strongest = _flowing(law, past, vl, 1.0)
    weakest = _flowing(law, past, -vh, -1.0)
    room = law.top - xh
    soft = box.spring_low * max(xl - law.reach, 0.0)
    held = box.spring_low * max(xl, 0.0)
    weak = _lagging_current(law, vl, vh, room, law.outward_speed, soft, strongest, box.motor_low, box.braking + held)
    strong = _lagging_current(
        law, vl, vh, room, law.outward_speed, soft, strongest, box.motor_high, box.braking_high + held
    )
    top = min(weak, strong)
    room = xl - law.bottom
    stiff = -box.spring_high * max(xh + law.reach, 0.0)
    weak = _lagging_current(law, -vh, -vl, room, law.homeward_speed, stiff, weakest, box.motor_low, box.braking)
    strong = _lagging_current(law, -vh, -vl, room, law.homeward_speed, stiff, weakest, box.motor_high, box.braking_high)
    bottom = -min(weak, strong)
    return min(bottom, law.current), max(top, -law.current)


def _flowing(law: ShieldLaw, past: Past, slowest: float, sign: float) -> float:
    """Greatest current, times ``sign``, that may flow at the start of this period [A].

    Each of the last periods had its command or, if that was lost, the node's damped stop; before them any current is
    possible. The least velocity now is ``slowest``, times ``sign``, which is −1 for the least current.
    """
    flowing = law.current
    for i in range(PAST - 1, -1, -1):
        slow = slowest - (i + 1) * law.change
        braked = damped_current(slow, law.current, law.damping_velocity)
        u = max(min(max(sign * past[i], -law.current), law.current), braked)
        flowing = u + law.delay.kept * max(flowing - u, 0.0)
    return flowing


def _lagging_current(
    law: ShieldLaw,
    vl: float,
    vh: float,
    room: float,
    speed: float,
    spring: float,
    flowing: float,
    motor: float,
    braking: float,
) -> float:
    """Greatest command after which a brake with this motor stays within speed and room in spite of its lag [A].

    The current ``flowing`` raises the velocity by motor · lag · flowing until it has decayed to the one that holds the
    spring. For the stop within ``room`` the brake counts as faster by motor · lag · (flowing + limit).

    Args:
        law: of the bench.
        vl: least velocity now [rad/s].
        vh: greatest velocity now [rad/s].
        room: distance to the limit, at least [rad].
        speed: greatest velocity that any brake may reach [rad/s].
        spring: as of :func:`_highest_current` [rad/s²].
        flowing: greatest current now, positive where it drives [A].
        motor: k_m / J [rad/(s²·A)].
        braking: deceleration of the weakest brake with this motor [rad/s²].
    """
    ts, box = law.sample_time, law.box
    rising = motor * flowing + max(-spring - box.friction_low, 0.0)
    reached = vh + law.delay.lag * max(rising, 0.0)
    stopping = vh + law.delay.lag * motor * (flowing + law.current)
    v = stoppable(room, stopping, braking, ts)
    if v < VELOCITY_PAD:
        return -law.current
    over = min(speed - reached, v - stopping) - VELOCITY_PAD
    # If the motion may reverse within the sample, friction may drive it, and so may viscous friction until then.
    helping = box.viscous_high * min(vh - law.change, 0.0) - box.friction_high
    friction = box.friction_low + box.viscous_low * vh if vl > law.change else helping
    return (over / ts + friction + spring) / motor


def _believable(law: ShieldLaw, angle: float, velocity: float, past: Past) -> bool:
    total = abs(angle)
    if law.age_high > 0 or law.delay.lag > 0.0 or law.delay.observer > 0.0:
        total += abs(past[0]) + abs(past[1]) + abs(past[2]) + abs(past[3]) + abs(past[4])
    return abs(velocity) <= BELIEVABLE and total <= BELIEVABLE


def _rolled(law: ShieldLaw, angle: float, velocity: float, past: Past, age: int) -> tuple[States, States]:
    """Boxes of states at the start of this period, after a measurement of that age.

    In the first box each command since then may have been lost, so that the node has braked; in the second none was.
    """
    xl = angle - law.angle_noise
    xh = angle + law.angle_noise
    vl = velocity - law.velocity_noise
    vh = velocity + law.velocity_noise
    lost = obeyed = xl, xh, vl, vh
    if law.delay.observer > 0.0:
        fallen, risen, fell, rose = _unseen(law, xl, xh, vl, vh, past, age)
        lost, obeyed = (xl, xh, vl + fallen, vh + risen), (xl, xh, vl + fell, vh + rose)
    for i in range(age, 0, -1):
        u = past[i - 1]
        xl, xh, vl, vh = lost
        u_low = min(u, damped_current(vh + law.change, law.current, law.damping_velocity))
        u_high = max(u, damped_current(vl - law.change, law.current, law.damping_velocity))
        lost = _moved(law, xl, xh, vl, vh, u_low, u_high)
        xl, xh, vl, vh = obeyed
        obeyed = _moved(law, xl, xh, vl, vh, u, u)
    return lost, obeyed


def _unseen(
    law: ShieldLaw, xl: float, xh: float, vl: float, vh: float, past: Past, age: int
) -> tuple[float, float, float, float]:
    """Least and greatest change of the velocity that an observer does not show yet, for a measurement of that age.

    Two pairs, as in :func:`_rolled`: if commands may have been lost, and if none was.
    """
    ts, change, reach, delay = law.sample_time, law.change, law.reach, law.delay
    shares, before = delay.hidden
    blind = before[age] * change
    aside = blind + (2.0 / delay.observer) * change
    slow, fast = vl - aside, vh + aside
    fallen = fell = -blind
    risen = rose = blind
    for i in range(PAST - age):
        slow, fast = slow - change, fast + change
        down, up, obeyed_down, obeyed_up = _accelerated(law, xl - i * reach, xh + i * reach, slow, fast, past[age + i])
        share = shares[i] * ts
        fallen -= share * (0.0 if down < 0.0 else down)
        risen += share * (0.0 if up < 0.0 else up)
        fell -= share * (0.0 if obeyed_down < 0.0 else obeyed_down)
        rose += share * (0.0 if obeyed_up < 0.0 else obeyed_up)
    return fallen, risen, fell, rose


def _accelerated(
    law: ShieldLaw, xl: float, xh: float, slow: float, fast: float, own: float
) -> tuple[float, float, float, float]:
    """Greatest accelerations of any brake of the set in a period, downwards and upwards [rad/s²].

    The first two are for a command that may have been lost, so that the node has braked; the others for one obeyed.

    Args:
        law: of the bench.
        xl: least angle at the start of the period [rad].
        xh: greatest angle there [rad].
        slow: least velocity within the period [rad/s].
        fast: greatest velocity within it [rad/s].
        own: command of the period [A].
    """
    motor_low, motor_high, spring_low, spring_high, friction_low, friction_high, viscous_low, viscous_high, _, _ = (
        law.box
    )
    limit, damping = law.current, law.damping_velocity
    nearest, farthest = xl - law.reach, xh + law.reach
    soft = spring_low * (0.0 if nearest < 0.0 else nearest)
    stiff = spring_high * (0.0 if farthest < 0.0 else farthest)
    strong, weak = motor_high * own, motor_low * own
    obeyed_up = (weak if weak > strong else strong) - soft
    obeyed_down = stiff - (weak if weak < strong else strong)
    u = damped_current(slow, limit, damping)
    u = u if u > own else own
    strong, weak = motor_high * u, motor_low * u
    up = (weak if weak > strong else strong) - soft
    u = damped_current(fast, limit, damping)
    u = u if u < own else own
    strong, weak = motor_high * u, motor_low * u
    down = stiff - (weak if weak < strong else strong)
    # Friction lowers the acceleration in the direction of the motion, and raises the one against it.
    if slow > 0.0:
        taken = viscous_low * slow
        up, obeyed_up = up - friction_low - taken, obeyed_up - friction_low - taken
    else:
        taken = viscous_high * slow
        up, obeyed_up = up + friction_high - taken, obeyed_up + friction_high - taken
    if fast < 0.0:
        taken = viscous_low * fast
        down, obeyed_down = down - friction_low + taken, obeyed_down - friction_low + taken
    else:
        taken = viscous_high * fast
        down, obeyed_down = down + friction_high + taken, obeyed_down + friction_high + taken
    return down, up, obeyed_down, obeyed_up


def damped_current(velocity: float, limit: float, damping_velocity: float) -> float:
    """Damped stop: current with which a node without a command brakes, against the speed, up to the limit [A].

    It reaches the limit at ``damping_velocity`` [rad/s], which is infinite for a node that only switches off.
    """
    u = -limit * velocity / damping_velocity
    u = -limit if -limit > u else u
    return limit if limit < u else u


def successor(
    law: ShieldLaw, xl: float, xh: float, vl: float, vh: float, u: float
) -> tuple[float, float, float, float]:
    """The box of states that any brake of the parameter box can reach in one sample with the current ``u`` [A].

    Four bounds [rad, rad/s] give the same four one sample later, for forward Euler and for the exact flow.
    """
    return _moved(law, xl, xh, vl, vh, u, u)


def _moved(
    law: ShieldLaw, xl: float, xh: float, vl: float, vh: float, u_low: float, u_high: float
) -> tuple[float, float, float, float]:
    """The successor of a box of states for a current that lies between two bounds."""
    drive_low, drive_high = drives(law, xl, xh, u_low, u_high)
    high = fastest_next(law, vl, vh, drive_high) + VELOCITY_PAD
    low = -fastest_next(law, -vh, -vl, -drive_low) - VELOCITY_PAD
    slowest, fastest = low if low < vl else vl, high if high > vh else vh
    return xl + law.sample_time * slowest, xh + law.sample_time * fastest, low, high


def drives(law: ShieldLaw, xl: float, xh: float, u_low: float, u_high: float) -> tuple[float, float]:
    """Least and greatest acceleration by motor and spring that any brake of the set has within a sample [rad/s²].

    Its angle begins within ``xl`` and ``xh`` [rad], and its current stays within ``u_low`` and ``u_high`` [A].
    """
    motor_low, motor_high, spring_low, spring_high, _, _, _, _, _, _ = law.box
    nearest, farthest = xl - law.reach, xh + law.reach
    strong, weak = motor_high * u_high, motor_low * u_high
    drive_high = (weak if weak > strong else strong) - spring_low * (0.0 if nearest < 0.0 else nearest)
    strong, weak = motor_high * u_low, motor_low * u_low
    drive_low = (weak if weak < strong else strong) - spring_high * (0.0 if farthest < 0.0 else farthest)
    return drive_low, drive_high


def fastest_next(law: ShieldLaw, vl: float, vh: float, drive: float) -> float:
    """Greatest velocity one sample after [vl, vh], where ``drive`` bounds motor and spring [rad/s²].

    Euler's map is monotone on either side of zero and jumps at it, so the two corners and the jump bound it. A brake
    that would come to rest may stick: so the bound for a positive velocity is at least 0.
    """
    ts, box = law.sample_time, law.box
    if vh <= 0.0:
        return vh + ts * (drive + box.friction_high - box.viscous_high * vh)
    fastest = vh + ts * (drive - box.friction_low - box.viscous_low * vh)
    fastest = 0.0 if fastest < 0.0 else fastest
    if vl <= 0.0:
        jumped = ts * (drive + box.friction_high)
        fastest = jumped if jumped > fastest else fastest
    return fastest


def _highest_current(law: ShieldLaw, vl: float, vh: float, v: float, spring: float) -> float:
    """Greatest current after which no brake is faster than ``v``; full braking where that is negative [A].

    The inverse of :func:`fastest_next` for velocities within ``vl`` and ``vh``; for the lower limits it is called in
    mirrored velocities. ``spring`` is the least deceleration by the clamping force [rad/s²]; negative if it drives.
    """
    ts, box = law.sample_time, law.box
    if v < 0.0:
        return -law.current
    if vh > 0.0:
        drive = (v - vh) / ts + box.friction_low + box.viscous_low * vh
        if vl <= 0.0:
            jumping = v / ts - box.friction_high
            drive = jumping if jumping < drive else drive
    else:
        drive = (v - vh) / ts - box.friction_high + box.viscous_high * vh
    drive += spring
    return drive / (box.motor_high if drive > 0.0 else box.motor_low)


def _blind_current(law: ShieldLaw, velocity: float) -> float:
    """The damped stop for a valid velocity, else 0 A."""
    return damped_current(velocity, law.current, law.damping_velocity) if abs(velocity) <= BELIEVABLE else 0.0


def _must_return(law: ShieldLaw, xl: float, xh: float, vl: float, vh: float, current: float, left: float) -> bool:
    """Returns True if after ``current`` the worst brake could be home too late, with ``left`` seconds left."""
    if left < law.home.committed:
        return True
    xl, xh, vl, vh = successor(law, xl, xh, vl, vh, current)
    first, last = _arrival(law, xl, vl), _arrival(law, xh, vh)
    return (last if last > first else first) + law.home.reserve > left


def _arrival(law: ShieldLaw, x: float, v: float) -> float:
    """Time in which the worst brake of the box is at rest at the origin by the way home [s]."""
    way, landing = law.home, law.home.landing
    out = v
    spring = law.box.spring_low * x
    if x < 0.0:
        x = -x
        out = -v
        spring = 0.0
    t = 0.0
    home = -out
    if out > 0.0:  # stop the outward motion first
        braking = law.box.braking + spring
        t = out / braking
        x += 0.5 * out * (t + law.sample_time)
        home = 0.0
    beyond = 0.5 * home * home / landing - x
    if beyond > 0.0:  # too fast to stop at the origin: come back from the other side
        t += home / landing
        x = beyond
        home = 0.0
        spring = 0.0
    ramp = way.ramp + 0.5 * spring
    peak = math.sqrt((x + 0.5 * home * home / ramp) / (0.5 / ramp + 0.5 / landing))
    peak = way.cruise if way.cruise < peak else peak
    peak = home if home > peak else peak
    cruising = x - 0.5 * (peak * peak - home * home) / ramp - 0.5 * peak * peak / landing
    if cruising > 0.0:
        t += cruising / way.cruise
    if law.coasting:
        t += _climbing_down(law, x)
    return t + (peak - home) / ramp + peak / landing


def _climbing_down(law: ShieldLaw, x: float) -> float:
    """Additional time of a coasting brake where its speed limit is below that at the origin [s].

    The speed limit is a concave function of the angle, so that the trapezoids lie above the integral.
    """
    box, home = law.box, law.home
    begin = 2.0 * box.friction_low / box.spring_high
    width = (min(x, home.apex) - begin) / PIECES
    lost = 0.0
    for i in range(PIECES + 1 if width > 0.0 else 0):
        at = begin + i * width
        left = box.friction_low * (at - law.bottom) - 0.5 * box.spring_high * at * at
        speed = max(math.sqrt(max(2.0 * left, 0.0)), CREEPS * home.creep) - home.creep
        weight = 0.5 if i in (0, PIECES) else 1.0
        lost += weight * width * max(1.0 / speed - 1.0 / home.cruise, 0.0)
    return lost


def _return_current(law: ShieldLaw, x: float, v: float, left: float) -> float:
    """The way home: follow the speed from which a planned deceleration lands at the origin [A]."""
    box, home = law.box, law.home
    motor = 0.5 * (box.motor_low + box.motor_high)
    zone = home.settled_zone if left < home.settling else home.rest_zone
    if abs(x) < zone:
        # Speeds that friction stops in the remaining time need no current; of faster ones the certain part is braked.
        in_time = home.rest_velocity - 2.0 * law.velocity_noise + box.friction_low * left
        if abs(v) < min(home.rest_velocity, max(law.velocity_noise, in_time)):
            return 0.0
        # Less the noise: else the noise of a brake at rest would become a current that moves it.
        excess = v - law.velocity_noise if v > 0.0 else v + law.velocity_noise
        return -home.gain * excess / (law.sample_time * motor)
    direction = -1.0 if x > 0.0 else 1.0
    planned = math.sqrt(2.0 * home.landing * abs(x))
    drive = 0.5 * (box.friction_low + box.friction_high) * direction + 0.5 * (box.viscous_low + box.viscous_high) * v
    drive += 0.5 * (box.spring_low + box.spring_high) * max(x, 0.0)
    if planned < law.homeward_speed:  # the planned speed falls as the origin comes nearer
        drive -= home.landing * direction * min(max(direction * v / planned, 0.0), 1.0)
    else:
        planned = law.homeward_speed
    drive += home.gain * (direction * planned - v) / law.sample_time
    return drive / motor
