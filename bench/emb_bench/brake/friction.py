"""The friction of a brake beyond Coulomb's: static friction, its decay with speed, and its growth with the load.

Sliding at the velocity v, eq. 3.5 with the static friction of eq. 3.6:

    T_f = sign(v) [T_c + (T_s − T_c) e] + f_v v,   e = exp(−|v/v_s|^δ),   T_s = break_away T_c + f_l F_cl

Eq. 3.5 prints (T_s − T_c sign(v)) without a sign before it, which would make friction drive a brake that moves
backwards; eq. 3.8, figure 3.3 and the reference (Armstrong-Hélouvry, Dupont and Canudas de Wit, Automatica 30, 1994,
section 4) have it as above. A brake at rest holds any torque up to T_s. Without a Stribeck velocity the static friction
acts at rest only, and a brake that breaks away is at once left with T_c.

Plain scalar functions; compiled by :func:`emb_bench.compiled.compiled` they are bit for bit the same.
"""

from __future__ import annotations

import math

from emb_bench.brake.parameters import BREAK_AWAY, F_L, F_V, STRIBECK_VELOCITY, T_C
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import BrakeParameters


def static_torque(m: Mechanics, p: BrakeParameters, force: float) -> float:
    """Largest torque that holds a brake at rest under a clamping force [N] (eq. 3.6) [N·m]."""
    return m.break_away * p.T_c + m.f_l * force


def decay(m: Mechanics, speed: float) -> float:
    """Share of the static friction beyond T_c that is left at a speed, of either sign [rad/s]."""
    if m.stribeck_velocity == 0.0:
        return 0.0
    ratio = abs(speed / m.stribeck_velocity)
    power: float = ratio * ratio if m.stribeck_exponent == 2.0 else ratio**m.stribeck_exponent  # the usual one is fast
    return math.exp(-power)


def decay_slope(m: Mechanics, speed: float, left: float) -> float:
    """Derivative of :func:`decay`, whose value is ``left``, along the speed if that is positive [s/rad]."""
    if m.stribeck_velocity == 0.0:
        return 0.0
    ratio = abs(speed / m.stribeck_velocity)
    power: float = ratio if m.stribeck_exponent == 2.0 else ratio ** (m.stribeck_exponent - 1.0)
    return -m.stribeck_exponent / m.stribeck_velocity * power * left


def sliding_torque(m: Mechanics, p: BrakeParameters, speed: float, force: float, left: float) -> float:
    """Friction against the motion (eq. 3.5) [N·m].

    Args:
        m: the brake's features.
        p: its parameters.
        speed: velocity in the direction of motion [rad/s].
        force: clamping force [N].
        left: :func:`decay` at this speed; 1 gives the static friction.
    """
    return p.T_c + (static_torque(m, p, force) - p.T_c) * left + p.f_v * speed


def sliding_slope(m: Mechanics, p: BrakeParameters, speed: float, force: float, left: float) -> float:
    """Derivative of :func:`sliding_torque` along the speed: below f_v where friction falls with speed [N·m·s/rad]."""
    return (static_torque(m, p, force) - p.T_c) * decay_slope(m, speed, left) + p.f_v


def sliding_share(m: Mechanics, p: BrakeParameters, speed: float, force: float, left: float, i: int) -> float:
    """θ_i ∂/∂θ_i of :func:`sliding_torque` at constant speed and force [N·m]."""
    if i == T_C:
        return p.T_c * (1.0 + (m.break_away - 1.0) * left)
    if i == F_V:
        return p.f_v * speed
    if i == BREAK_AWAY:
        return m.break_away * p.T_c * left
    if i == STRIBECK_VELOCITY:
        return -(static_torque(m, p, force) - p.T_c) * decay_slope(m, speed, left) * speed
    if i == F_L:
        return m.f_l * force * left
    return 0.0


def acceleration_from_rest(m: Mechanics, p: BrakeParameters, pull: float, force: float) -> float:
    """Acceleration of a brake at rest under a torque: 0 while it sticks [rad/s²].

    Args:
        m: the brake's features.
        p: its parameters.
        pull: motor torque less the torque of the clamping force [N·m].
        force: clamping force [N].
    """
    if abs(pull) <= static_torque(m, p, force):
        return 0.0
    return (pull - math.copysign(sliding_torque(m, p, 0.0, force, decay(m, 0.0)), pull)) / p.J


def parting_acceleration(m: Mechanics, p: BrakeParameters, force: float) -> float:
    """Acceleration of a brake whose torque has just come to T_s: 0 with a Stribeck velocity [rad/s²]."""
    return (static_torque(m, p, force) - sliding_torque(m, p, 0.0, force, decay(m, 0.0))) / p.J
