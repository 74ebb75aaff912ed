"""The thesis's brake solved exactly between events, and its sensitivities with their jumps.

With a constant current the brake of eq. 3.12-3.14 is linear as long as it stays on one side of contact (x1 = 0) and
keeps its direction of motion, or sticks. The solution in such a segment is a Taylor series: from the second one on,
each derivative of the angle follows from the two before it, D_{n+2} = −(f_v/J) D_{n+1} − (γ k_1/J) D_n. Segments are
short against the brake's time constants, so that eight terms are exact to rounding. Sensitivities obey the same
recursion, forced by the motion (eq. 4.23).

Segments end at events, found as roots of the series:

- *contact* begins or ends: the clamping force is zero there, so nothing jumps;
- the velocity comes to zero, and the brake *sticks*, for the torque on it is no larger than T_c: it stays where it is
  until the current changes, and its velocity depends on no parameter;
- or it *reverses*: the acceleration jumps from a⁻ to a⁺, and the sensitivity of the velocity by the factor a⁺/a⁻, the
  saltation matrix of this event (Leine and Nijmeijer, Dynamics and Bifurcations of Non-Smooth Mechanical Systems, 2004,
  chapter 7). That of the angle is continuous, for the velocity is zero.

A brake at rest has a velocity of exactly 0.0.
"""

from __future__ import annotations

import math
from typing import Any

from emb_bench.brake.parameters import (
    COMMAND,
    CONTACT,
    CURRENT_OFFSET,
    DELAY,
    F_V,
    K_1,
    K_M,
    T_C,
    VISCOUS_ASYMMETRY,
    J,
)
from emb_runtime.config.bench import BrakeParameters

TERMS = 8  # Of the series
LONGEST = 0.05
"""Longest segment, times the rate at which the derivatives grow: the first omitted term is below 1e-16 of the sum."""
_ITERATIONS = 60  # of a root search; Newton needs 3 to 5, bisection alone 55
_ROUNDING = 1e-15  # relative resolution of a time within a segment


def advance_exact(
    p: BrakeParameters, x: Any, u: float, t_s: float, unknowns: Any, s: Any, viscous_asymmetry: float = 0.0
) -> None:
    """One sample period, in place; arguments are those of :func:`emb_bench.brake.motion.advance`.

    Friction depends on the direction d = ±1 of motion: T_c + f_v (1 + d viscous_asymmetry) |x2|.
    """
    drive, spring = p.k_m * u / p.J, p.gamma * p.k_1 / p.J
    coulomb, viscous = p.T_c / p.J, p.f_v / p.J
    _delayed_switch(p, x, u, t_s, unknowns, s)
    x1, x2 = float(x[0]), float(x[1])
    remaining = t_s
    while remaining > 0.0:
        pull = drive - spring * max(x1, 0.0)
        ahead = x2 if x2 != 0.0 else pull
        direction = 1.0 if ahead > 0.0 else -1.0
        damping = viscous * (1.0 + direction * viscous_asymmetry)
        if x2 == 0.0 and abs(pull) <= coulomb:
            for j in range(unknowns.shape[0]):
                s[j, 1] = 0.0
            break
        touching = x1 > 0.0 or (x1 == 0.0 and direction > 0.0)
        w = spring if touching else 0.0
        a = pull - direction * coulomb - damping * x2
        t = min(remaining, LONGEST / (damping + math.sqrt(spring)))
        y1, y2, b = glide(damping, w, x1, x2, a, t)
        stops = y2 * direction <= 0.0
        if stops and x2 != 0.0:
            t = _crossing(damping, w, x1, x2, a, t, True)
            y1, y2, b = glide(damping, w, x1, x2, a, t)
        if x1 < 0.0 < y1 or y1 < 0.0 < x1:
            t = _crossing(damping, w, x1, x2, a, t, False)
            y1, y2, b = glide(damping, w, x1, x2, a, t)
            y1, stops = 0.0, y2 == 0.0
        for j in range(unknowns.shape[0]):
            s[j, 0], s[j, 1] = _glide_sensitivity(
                damping, w, p, u, x1, x2, a, direction, coulomb, s[j, 0], s[j, 1], int(unknowns[j]), t
            )
        if stops:
            after = _acceleration_from_rest(drive - spring * max(y1, 0.0), coulomb)
            factor = after / b if b * direction < 0.0 else 0.0
            for j in range(unknowns.shape[0]):
                s[j, 1] *= factor
            y2 = 0.0
        x1, x2 = y1, y2
        remaining -= t
    x[0], x[1], x[3] = x1, x2, u


def glide(damping: float, w: float, x1: float, x2: float, a: float, t: float) -> tuple[float, float, float]:
    """Angle, velocity and acceleration after the time ``t`` of a segment, from those at its start.

    The damping is f_v / J [1/s], w is γ k_1 / J in contact, else 0 [1/s²]; ``t`` is at most LONGEST over the rate of
    the derivatives.
    """
    angle, velocity, acceleration = x1, x2, a
    first, second = x2, a  # D_n, D_{n+1}
    term = t  # t^n / n!
    for n in range(1, TERMS):
        third = -damping * second - w * first
        angle += first * term
        velocity += second * term
        acceleration += third * term
        first, second = second, third
        term *= t / (n + 1)
    return angle, velocity, acceleration


def _glide_sensitivity(
    damping: float,
    w: float,
    p: BrakeParameters,
    u: float,
    x1: float,
    x2: float,
    a: float,
    direction: float,
    coulomb: float,
    s1: float,
    s2: float,
    i: int,
    t: float,
) -> tuple[float, float]:
    """Sensitivities to parameter ``i`` after the time ``t``: driven by θ_i ∂a/∂θ_i along the motion."""
    angle_share, velocity_share, acceleration_share = 0.0, 0.0, 0.0  # of the forcing that follows the motion
    constant = 0.0
    if i == K_M:
        constant = p.k_m * u / p.J
    elif i == K_1:
        angle_share = -w
    elif i == T_C:
        constant = -direction * coulomb
    elif i == F_V:
        velocity_share = -damping
    elif i == J:
        acceleration_share = -1.0
    elif i == CONTACT:
        constant = w
    elif i in (CURRENT_OFFSET, COMMAND):
        constant = p.k_m / p.J
    elif i == VISCOUS_ASYMMETRY:
        velocity_share = -direction * p.f_v / p.J
    first, second = x2, a
    s_first = s2
    s_second = constant + angle_share * x1 + velocity_share * x2 + acceleration_share * a - damping * s2 - w * s1
    angle, velocity = s1, s2
    term = t
    for n in range(1, TERMS):
        third = -damping * second - w * first
        forcing = angle_share * first + velocity_share * second + acceleration_share * third
        angle += s_first * term
        velocity += s_second * term
        s_first, s_second = s_second, forcing - damping * s_second - w * s_first
        first, second = second, third
        term *= t / (n + 1)
    return angle, velocity


def _acceleration_from_rest(pull: float, coulomb: float) -> float:
    """Acceleration of a brake at rest under a torque ``pull`` per inertia: 0 while it sticks [rad/s²]."""
    return 0.0 if abs(pull) <= coulomb else pull - math.copysign(coulomb, pull)


def _delayed_switch(p: BrakeParameters, x: Any, u: float, t_s: float, unknowns: Any, s: Any) -> None:
    """Adds the effect of a later switch to the sensitivity to a delay: the previous command acts meanwhile."""
    for j in range(unknowns.shape[0]):
        if unknowns[j] == DELAY:
            spring, coulomb = p.gamma * p.k_1 / p.J * max(x[0], 0.0), p.T_c / p.J
            before, now = p.k_m * x[3] / p.J - spring, p.k_m * u / p.J - spring
            if x[1] != 0.0:
                s[j, 1] += t_s * (before - now)
            else:
                s[j, 1] += t_s * late_start(
                    _acceleration_from_rest(before, coulomb),
                    now - math.copysign(coulomb, before),
                    _acceleration_from_rest(now, coulomb),
                )


def late_start(before: float, caught: float, now: float) -> float:
    """Change of velocity of a brake at rest per delay of a command [rad/s²].

    Accelerations: ``before`` from rest under the previous command, 0 if it sticks; ``caught`` under the new command at
    slow sliding in the direction in which the previous command moves it; ``now`` from rest under the new command.
    """
    if before == 0.0 or caught == 0.0:
        return -now
    return before * now / caught - now


def _crossing(damping: float, w: float, x1: float, x2: float, a: float, t: float, of_velocity: bool) -> float:
    """Time at which the velocity, or else the angle, comes to zero in a segment at whose ends its signs differ [s].

    It is monotone in between: the angle because the velocity keeps its sign; the velocity because at a zero slope it
    bends towards zero, v'' = −(γ k_1/J) v.
    """
    start, slope = (x2, a) if of_velocity else (x1, x2)
    low, high = 0.0, t
    guess = min(-start / slope, t) if start * slope < 0.0 else t
    for _ in range(_ITERATIONS):
        angle, velocity, acceleration = glide(damping, w, x1, x2, a, guess)
        value, slope = (velocity, acceleration) if of_velocity else (angle, velocity)
        if value * start > 0.0:
            low = guess
        else:
            high = guess
        newton = guess - value / slope if slope != 0.0 else -1.0
        # Newton's last steps are rounding, to either side: an end of the bracket that one passes must not send it back.
        if value == 0.0 or min(abs(newton - guess), high - low) <= _ROUNDING * t:
            break
        guess = newton if low < newton < high else 0.5 * (low + high)
    return guess
