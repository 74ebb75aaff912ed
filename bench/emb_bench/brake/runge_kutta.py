"""One step of a brake that slides: its motion, and the variational equations along it.

The equation of motion is J x2' = k_m i − γ F_cl − σ T_f with the direction σ of motion, F_cl and T_f of
:mod:`emb_bench.brake.forces`, and the motor's current i, which approaches the
commanded one u with the time constant ``current_lag``. A step has one σ, one side of contact and one law of the
stop, so that everything in it is smooth.

It is integrated by the explicit Runge-Kutta pair of Dormand and Prince (J. Comput. Appl. Math. 6, 1980), whose
difference of orders 5 and 4 judges the velocity. The sensitivities go through the same formula at the same stages; so
they are derivatives of the numerical motion itself. The recursion of the exact brake does not serve here: a Stribeck
curve with any exponent has no series at rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emb_bench.brake.forces import (
    clamping_force,
    clamping_share,
    clamping_slopes,
    decay,
    sliding_share,
    sliding_slope,
    sliding_torque,
)
from emb_bench.brake.parameters import COMMAND, CONTACT, CURRENT_LAG, CURRENT_OFFSET, DELAY, K_M, PAST_COMMAND, J
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import BrakeParameters

Angles = tuple[float, float, float, float, float, float]


class Slide(NamedTuple):
    """Start of a step, and the laws that apply throughout it."""

    direction: float  # Of motion, 1.0 or −1.0
    x1: float  # Angle at the start [rad]
    x2: float  # Velocity at the start [rad/s]
    w: float  # Position of the stop at the start, see :mod:`emb_bench.brake.forces`
    rate: float  # Its slope along the angle [1/rad]
    loaded: float  # 1.0 in contact, else 0.0
    i: float  # Current at the start [A]
    u: float  # Current that it approaches [A]


class Stage(NamedTuple):
    """The brake at one instant of a step, linearised."""

    x1: float  # Angle [rad]
    speed: float  # Velocity in the direction of motion [rad/s]
    w: float  # Position of the stop
    i: float  # Current [A]
    force: float  # Clamping force [N]
    stribeck: float  # Stribeck factor
    per_force: float  # Derivative of the acceleration along the clamping force [rad/s²/N]
    per_angle: float  # Along the angle at constant w [1/s²]
    per_velocity: float  # Along the velocity [1/s]
    per_w: float  # Along w [rad/s²]
    acceleration: float  # [rad/s²]


class Step(NamedTuple):
    """End of a step, and the stages that it went through."""

    x1: float  # Angle [rad]
    x2: float  # Velocity [rad/s]
    acceleration: float  # [rad/s²]
    error: float  # Of the velocity by the lower of the two orders [rad/s]
    angles: Angles  # At the stages [rad]
    velocities: Angles  # At the stages [rad/s]


def current(m: Mechanics, i: float, u: float, t: float) -> float:
    """Motor current a time ``t`` after it was ``i`` under the command ``u``: a first-order lag [A]."""
    if m.current_lag == 0.0:
        return u
    return u + (i - u) * math.exp(-t / m.current_lag)


def current_share(m: Mechanics, i: float, u: float, t: float, before: float, t_s: float, unknown: int) -> float:
    """Sensitivity of that current to an unknown whose sensitivity was ``before`` a time ``t`` ago [A].

    A command that is late by a part of the period ``t_s`` delays the current by the same time.
    """
    if m.current_lag == 0.0:
        return 0.0
    if unknown == COMMAND:
        return 1.0 + (before - 1.0) * math.exp(-t / m.current_lag)
    if unknown == PAST_COMMAND:
        return before * math.exp(-t / m.current_lag)
    if unknown == CURRENT_LAG:
        return (before + (i - u) * t / m.current_lag) * math.exp(-t / m.current_lag)
    if unknown == DELAY:
        return t_s * (i - u) / m.current_lag * math.exp(-t / m.current_lag)
    return 0.0


def acceleration(m: Mechanics, p: BrakeParameters, a: Slide, t: float, x1: float, x2: float) -> float:
    """Acceleration of the sliding brake, a time ``t`` into the step [rad/s²]."""
    force = clamping_force(m, p, x1, a.w + a.rate * (x1 - a.x1)) * a.loaded
    friction = a.direction * sliding_torque(m, p, x2 * a.direction, force, decay(m, x2))
    return (p.k_m * current(m, a.i, a.u, t) - p.gamma * force - friction) / p.J


def stage(m: Mechanics, p: BrakeParameters, a: Slide, t: float, x1: float, x2: float, stribeck: float) -> Stage:
    """Acceleration and its derivatives for the variational equations; ``stribeck`` is the factor at this velocity."""
    w = a.w + a.rate * (x1 - a.x1)
    i = current(m, a.i, a.u, t)
    speed = x2 * a.direction
    force = clamping_force(m, p, x1, w) * a.loaded
    along, across = clamping_slopes(m, p, x1, w)
    per_force = -(p.gamma + a.direction * m.f_l * stribeck) / p.J * a.loaded
    friction = a.direction * sliding_torque(m, p, speed, force, stribeck)
    return Stage(
        x1,
        speed,
        w,
        i,
        force,
        stribeck,
        per_force,
        per_force * along,
        -sliding_slope(m, p, speed, force, stribeck) / p.J,
        per_force * across,
        (p.k_m * i - p.gamma * force - friction) / p.J,
    )


def forcing(m: Mechanics, p: BrakeParameters, direction: float, at: Stage, i: int, current_change: float) -> float:
    """θ_i ∂/∂θ_i of the acceleration at constant state, with the effect of a change of the current [A] [rad/s²]."""
    if i == K_M:
        return p.k_m * at.i / p.J
    if i == J:
        return -at.acceleration
    if i == CURRENT_OFFSET:  # of the command and of the current before it alike, so that no lag shows in it
        return p.k_m / p.J
    if i == COMMAND and m.current_lag == 0.0:
        return p.k_m / p.J
    if i in (DELAY, CURRENT_LAG, COMMAND, PAST_COMMAND):
        return p.k_m * current_change / p.J
    if i == CONTACT:
        return -at.per_angle
    friction = direction * sliding_share(m, p, at.speed, at.force, at.stribeck, i)
    return at.per_force * clamping_share(m, p, at.x1, at.w, i) - friction / p.J


def step(m: Mechanics, p: BrakeParameters, a: Slide, before: float, h: float) -> Step:
    """One step of length ``h`` [s], ``before`` being the acceleration at its start [rad/s²]."""
    v1, b1 = a.x2, before
    x2, v2 = a.x1 + _second(h, v1), a.x2 + _second(h, b1)
    b2 = acceleration(m, p, a, _C2 * h, x2, v2)
    x3, v3 = a.x1 + _third(h, v1, v2), a.x2 + _third(h, b1, b2)
    b3 = acceleration(m, p, a, _C3 * h, x3, v3)
    x4, v4 = a.x1 + _fourth(h, v1, v2, v3), a.x2 + _fourth(h, b1, b2, b3)
    b4 = acceleration(m, p, a, _C4 * h, x4, v4)
    x5, v5 = a.x1 + _fifth(h, v1, v2, v3, v4), a.x2 + _fifth(h, b1, b2, b3, b4)
    b5 = acceleration(m, p, a, _C5 * h, x5, v5)
    x6, v6 = a.x1 + _sixth(h, v1, v2, v3, v4, v5), a.x2 + _sixth(h, b1, b2, b3, b4, b5)
    b6 = acceleration(m, p, a, h, x6, v6)
    x, v = a.x1 + _sum(h, v1, v3, v4, v5, v6), a.x2 + _sum(h, b1, b3, b4, b5, b6)
    after = acceleration(m, p, a, h, x, v)
    error = abs(_difference(h, b1, b3, b4, b5, b6, after))
    return Step(x, v, after, error, (a.x1, x2, x3, x4, x5, x6), (v1, v2, v3, v4, v5, v6))


Stages = tuple[Stage, Stage, Stage, Stage, Stage, Stage]


def stages(m: Mechanics, p: BrakeParameters, a: Slide, x: Angles, v: Angles, h: float) -> Stages:
    """The stages of a step of length ``h`` [s] with the angles ``x`` and the velocities ``v``, linearised."""
    return (
        stage(m, p, a, 0.0, x[0], v[0], decay(m, v[0])),
        stage(m, p, a, _C2 * h, x[1], v[1], decay(m, v[1])),
        stage(m, p, a, _C3 * h, x[2], v[2], decay(m, v[2])),
        stage(m, p, a, _C4 * h, x[3], v[3], decay(m, v[3])),
        stage(m, p, a, _C5 * h, x[4], v[4], decay(m, v[4])),
        stage(m, p, a, h, x[5], v[5], decay(m, v[5])),
    )


def vary(
    m: Mechanics,
    p: BrakeParameters,
    a: Slide,
    at: Stages,
    h: float,
    i: int,
    before: tuple[float, float, float, float],
    t_s: float,
) -> tuple[float, float]:
    """Sensitivities of angle [rad] and velocity [rad/s] to unknown ``i`` at the end of a step of length ``h`` [s].

    ``before`` are those of angle, velocity, w and current at its start.
    """
    x1, v1, w, c = before
    w -= a.rate * x1  # what that of w has beyond the angle's share
    b1 = _slope(m, p, a, at[0], x1, v1, w, i, c)
    x2, v2 = x1 + _second(h, v1), v1 + _second(h, b1)
    b2 = _slope(m, p, a, at[1], x2, v2, w, i, current_share(m, a.i, a.u, _C2 * h, c, t_s, i))
    x3, v3 = x1 + _third(h, v1, v2), v1 + _third(h, b1, b2)
    b3 = _slope(m, p, a, at[2], x3, v3, w, i, current_share(m, a.i, a.u, _C3 * h, c, t_s, i))
    x4, v4 = x1 + _fourth(h, v1, v2, v3), v1 + _fourth(h, b1, b2, b3)
    b4 = _slope(m, p, a, at[3], x4, v4, w, i, current_share(m, a.i, a.u, _C4 * h, c, t_s, i))
    x5, v5 = x1 + _fifth(h, v1, v2, v3, v4), v1 + _fifth(h, b1, b2, b3, b4)
    b5 = _slope(m, p, a, at[4], x5, v5, w, i, current_share(m, a.i, a.u, _C5 * h, c, t_s, i))
    x6, v6 = x1 + _sixth(h, v1, v2, v3, v4, v5), v1 + _sixth(h, b1, b2, b3, b4, b5)
    b6 = _slope(m, p, a, at[5], x6, v6, w, i, current_share(m, a.i, a.u, h, c, t_s, i))
    return x1 + _sum(h, v1, v3, v4, v5, v6), v1 + _sum(h, b1, b3, b4, b5, b6)


def _slope(
    m: Mechanics, p: BrakeParameters, a: Slide, at: Stage, s1: float, s2: float, w: float, i: int, c: float
) -> float:
    """Right-hand side of the variational equation of the velocity."""
    along = at.per_angle * s1 + at.per_w * (w + a.rate * s1) + at.per_velocity * s2
    return along + forcing(m, p, a.direction, at, i, c)


# The pair's coefficients, one row each.
_C2, _C3, _C4, _C5 = 1.0 / 5.0, 3.0 / 10.0, 4.0 / 5.0, 8.0 / 9.0


def _second(h: float, k1: float) -> float:
    return h * (1.0 / 5.0 * k1)


def _third(h: float, k1: float, k2: float) -> float:
    return h * (3.0 / 40.0 * k1 + 9.0 / 40.0 * k2)


def _fourth(h: float, k1: float, k2: float, k3: float) -> float:
    return h * (44.0 / 45.0 * k1 - 56.0 / 15.0 * k2 + 32.0 / 9.0 * k3)


def _fifth(h: float, k1: float, k2: float, k3: float, k4: float) -> float:
    return h * (19372.0 / 6561.0 * k1 - 25360.0 / 2187.0 * k2 + 64448.0 / 6561.0 * k3 - 212.0 / 729.0 * k4)


def _sixth(h: float, k1: float, k2: float, k3: float, k4: float, k5: float) -> float:
    return h * (
        9017.0 / 3168.0 * k1 - 355.0 / 33.0 * k2 + 46732.0 / 5247.0 * k3 + 49.0 / 176.0 * k4 - 5103.0 / 18656.0 * k5
    )


def _sum(h: float, k1: float, k3: float, k4: float, k5: float, k6: float) -> float:
    """Step of order 5."""
    return h * (35.0 / 384.0 * k1 + 500.0 / 1113.0 * k3 + 125.0 / 192.0 * k4 - 2187.0 / 6784.0 * k5 + 11.0 / 84.0 * k6)


def _difference(h: float, k1: float, k3: float, k4: float, k5: float, k6: float, k7: float) -> float:
    """Difference between the steps of order 4 and 5, which estimates the error."""
    first = 71.0 / 57600.0 * k1 - 71.0 / 16695.0 * k3 + 71.0 / 1920.0 * k4
    return h * (first - 17253.0 / 339200.0 * k5 + 22.0 / 525.0 * k6 - 1.0 / 40.0 * k7)
