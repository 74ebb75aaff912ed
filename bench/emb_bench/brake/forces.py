"""Friction and clamping force of a brake with features.

**Friction** beyond Coulomb's: static friction, its decay with speed, and its growth with the load. Sliding at the
velocity v, eq. 3.5 with the static friction of eq. 3.6:

    T_f = sign(v) [T_c + (T_s − T_c) e] + f_v v,   e = exp(−|v/v_s|^δ),   T_s = break_away T_c + f_l F_cl

Eq. 3.5 prints (T_s − T_c sign(v)) without a sign before it, which would make friction drive a brake that moves
backwards; eq. 3.8, figure 3.3 and the reference (Armstrong-Hélouvry, Dupont and Canudas de Wit, Automatica 30, 1994,
section 4) have it as above. A brake at rest holds any torque up to T_s. Without a Stribeck velocity the static friction
acts at rest only, and the friction falls to T_c at break-away.

**Clamping force**: cubic in the angle, and another on applying than on releasing. Eq. 3.9 with the slope at contact as
k_1, F_cl = k_1 x (1 + quadratic x + cubic x²) for x ≥ 0, the angle from contact, and none outside. Two features make it
depend on the direction; a brake has one of them at most. Both remember where the motion turned by a Prandtl stop w
(Visintin, Differential Models of Hysteresis, 1994): it follows the angle until it saturates, and leaves saturation when
the motion turns.

- The *hysteresis* of section 3.2.1 multiplies the force by 1 + hysteresis·w, w in [−1, 1], dw/dx = 1/hysteresis_travel.
  The friction behind it grows with the force, so a brake that is open remembers nothing: w starts from 0 each time
  contact is made, and each application begins on the middle curve.
- With *play* the clamp lags the motor by w in ±play/2, dw/dx = 1: x is the angle less w. After a turn the motor moves
  through the clearance while the clamp, and with it the force, stays. The clamp lags an open brake as well. A brake
  begins in the middle of its clearance. This is the play of a gear as a relation of angles alone: the force is lower on
  applying, and the motor gets back γ k_1 play more of work per radian than it gave, which T_c has to outweigh.

Plain scalar functions; compiled by :func:`emb_bench.compiled.compiled` they are bit for bit the same.
"""

from __future__ import annotations

import math

from emb_bench.brake.parameters import (
    BREAK_AWAY,
    CONTACT,
    CUBIC,
    F_L,
    F_V,
    HYSTERESIS,
    K_1,
    QUADRATIC,
    STRIBECK_VELOCITY,
    T_C,
)
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import BrakeParameters


def static_torque(m: Mechanics, p: BrakeParameters, force: float) -> float:
    """Largest torque that holds a brake at rest under a clamping force [N] (eq. 3.6) [N·m]."""
    return m.break_away * p.T_c + m.f_l * force


def decay(m: Mechanics, speed: float) -> float:
    """Stribeck factor e: remaining share of the static friction beyond T_c at a speed, of either sign [rad/s]."""
    if m.stribeck_velocity == 0.0:
        return 0.0
    ratio = abs(speed / m.stribeck_velocity)
    power: float = ratio * ratio if m.stribeck_exponent == 2.0 else ratio**m.stribeck_exponent  # the usual one is fast
    return math.exp(-power)


def decay_slope(m: Mechanics, speed: float, stribeck: float) -> float:
    """Derivative of :func:`decay`, whose value is ``stribeck``, along the speed if that is positive [s/rad]."""
    if m.stribeck_velocity == 0.0:
        return 0.0
    ratio = abs(speed / m.stribeck_velocity)
    power: float = ratio if m.stribeck_exponent == 2.0 else ratio ** (m.stribeck_exponent - 1.0)
    return -m.stribeck_exponent / m.stribeck_velocity * power * stribeck


def sliding_torque(m: Mechanics, p: BrakeParameters, speed: float, force: float, stribeck: float) -> float:
    """Friction against the motion (eq. 3.5) [N·m]; ``stribeck`` is :func:`decay` at this speed, 1 if static."""
    return p.T_c + (static_torque(m, p, force) - p.T_c) * stribeck + p.f_v * speed


def sliding_slope(m: Mechanics, p: BrakeParameters, speed: float, force: float, stribeck: float) -> float:
    """Derivative of :func:`sliding_torque` along the speed: below f_v where friction falls with speed [N·m·s/rad]."""
    return (static_torque(m, p, force) - p.T_c) * decay_slope(m, speed, stribeck) + p.f_v


def sliding_share(m: Mechanics, p: BrakeParameters, speed: float, force: float, stribeck: float, i: int) -> float:
    """θ_i ∂/∂θ_i of :func:`sliding_torque` at constant speed and force [N·m]."""
    if i == T_C:
        return p.T_c * (1.0 + (m.break_away - 1.0) * stribeck)
    if i == F_V:
        return p.f_v * speed
    if i == BREAK_AWAY:
        return m.break_away * p.T_c * stribeck
    if i == STRIBECK_VELOCITY:
        return -(static_torque(m, p, force) - p.T_c) * decay_slope(m, speed, stribeck) * speed
    if i == F_L:
        return m.f_l * force * stribeck
    return 0.0


def acceleration_from_rest(m: Mechanics, p: BrakeParameters, pull: float, force: float) -> float:
    """Acceleration of a brake at rest under the motor's torque less the clamping force's: 0 if it sticks [rad/s²]."""
    if abs(pull) <= static_torque(m, p, force):
        return 0.0
    return (pull - math.copysign(sliding_torque(m, p, 0.0, force, decay(m, 0.0)), pull)) / p.J


def parting_acceleration(m: Mechanics, p: BrakeParameters, force: float) -> float:
    """Acceleration of a brake whose torque has just come to T_s: 0 with a Stribeck velocity [rad/s²]."""
    return (static_torque(m, p, force) - sliding_torque(m, p, 0.0, force, decay(m, 0.0))) / p.J


SATURATED = 1.0 - 1e-9
"""Share of its limit above which w counts as saturated: the rest is below the angle's last digits."""


def travel(m: Mechanics, x1: float, w: float) -> float:
    """Angle of the clamp from contact [rad]: that of the motor, less the lag with play."""
    return x1 - w if m.play > 0.0 else x1


def clamping_force(m: Mechanics, p: BrakeParameters, x1: float, w: float) -> float:
    """Clamping force of a brake in contact, whose travel is 0 or more [N]."""
    x = travel(m, x1, w)
    return p.k_1 * x * (1.0 + x * (m.quadratic + x * m.cubic)) * (1.0 + m.hysteresis * w)


def clamping_slopes(m: Mechanics, p: BrakeParameters, x1: float, w: float) -> tuple[float, float]:
    """Derivatives of the clamping force along the angle at constant w [N/rad], and along w [N, with play N/rad]."""
    x = travel(m, x1, w)
    along = p.k_1 * (1.0 + x * (2.0 * m.quadratic + x * 3.0 * m.cubic)) * (1.0 + m.hysteresis * w)
    if m.play > 0.0:
        return along, -along
    return along, p.k_1 * x * (1.0 + x * (m.quadratic + x * m.cubic)) * m.hysteresis


def clamping_share(m: Mechanics, p: BrakeParameters, x1: float, w: float, i: int) -> float:
    """θ_i ∂F_cl/∂θ_i for unknown ``i`` at constant angle and w [N]; ∂F_cl/∂θ_i for a curvature and the contact."""
    x, both = travel(m, x1, w), 1.0 + m.hysteresis * w
    if i == K_1:
        return clamping_force(m, p, x1, w)
    if i == QUADRATIC:
        return p.k_1 * x * x * both
    if i == CUBIC:
        return p.k_1 * x * x * x * both
    if i == HYSTERESIS:
        return p.k_1 * x * (1.0 + x * (m.quadratic + x * m.cubic)) * m.hysteresis * w
    if i == CONTACT:
        return -clamping_slopes(m, p, x1, w)[0]
    return 0.0


def stop_limit(m: Mechanics) -> float:
    """Value of w where it saturates, and with the other sign."""
    return 0.5 * m.play if m.play > 0.0 else 1.0


def stop_rate(m: Mechanics, w: float, direction: float) -> float:
    """dw/dx in ``direction``, in contact or with play: 0 in saturation and without either feature [1/rad]."""
    if w * direction >= SATURATED * stop_limit(m):
        return 0.0
    if m.play > 0.0:
        return 1.0
    return 1.0 / m.hysteresis_travel if m.hysteresis > 0.0 else 0.0


def edge_ahead(m: Mechanics, x1: float, w: float, direction: float) -> float:
    """The next angle ahead where the force changes its law: contact, or saturation of w; or infinity [rad]."""
    rate = stop_rate(m, w, direction)
    if m.play > 0.0:
        if rate > 0.0:
            return x1 + (direction * stop_limit(m) - w)
        return w if (w - x1) * direction > 0.0 else direction * math.inf
    if x1 < 0.0:
        return 0.0 if direction > 0.0 else -math.inf
    if direction > 0.0:
        return x1 + (1.0 - w) / rate if rate > 0.0 else math.inf
    if x1 == 0.0:
        return -math.inf
    return max(0.0, x1 - (1.0 + w) / rate) if rate > 0.0 else 0.0
