"""The thesis's brake under forward Euler, sign() and all, and its sensitivities: plain scalar functions.

The state is the motor angle x1 [rad] (contact at 0) and the motor velocity x2 [rad/s], the input the motor current u
[A]. Each identified parameter enters the equation of motion (eq. 3.12-3.14) through exactly one torque and linearly:
motor ∝ k_m, clamping ∝ k_1, Coulomb friction ∝ T_c, viscous friction ∝ f_v. So :func:`torque` is at once a term of the
dynamics and that term's derivative with respect to its relative parameter, θ_i ∂/∂θ_i.

``sign(0) = 0``, and the brake is in contact at x1 ≥ 0, as in eq. 3.13. The derivative of sign() is zero everywhere, as
in automatic differentiation: at a sign change of x2 these sensitivities are those of the thesis, not those of the
brake.

The functions run as plain Python in the simulated node and compiled by :func:`emb_bench.compiled.compiled` in the
batch, with the same bits.
"""

from __future__ import annotations

from typing import Any

from emb_bench.brake.parameters import COMMAND, CONTACT, CURRENT_OFFSET, DELAY, F_V, K_1, K_M, T_C, J
from emb_runtime.config.bench import BrakeParameters


def sign(value: float) -> float:
    """−1.0, 0.0 or 1.0; 0.0 for zero (and for NaN)."""
    if value > 0.0:
        return 1.0
    if value < 0.0:
        return -1.0
    return 0.0


def stiffness(p: BrakeParameters, x1: float) -> float:
    """Stiffness that the motor feels, γ k_1 in contact and 0 outside (eq. 3.13) [N·m/rad]."""
    if x1 >= 0.0:
        return p.gamma * p.k_1
    return 0.0


def torque(p: BrakeParameters, x1: float, x2: float, u: float, i: int) -> float:
    """The torque that parameter ``i`` of ``PARAMETERS`` scales, signed as it acts on the motor (eq. 3.12-3.14) [N·m].

    It is also θ_i times its derivative with respect to θ_i. The inertia scales the acceleration: its share is −J ẍ. The
    derivatives to the angle of contact [N·m/rad] and to an offset of the current [N·m/A] are absolute; those to other
    parameters are 0.
    """
    if i == K_M:
        return p.k_m * u
    if i == K_1:
        return -stiffness(p, x1) * x1
    if i == T_C:
        return -p.T_c * sign(x2)
    if i == F_V:
        return -p.f_v * x2
    if i == J:
        return -p.J * acceleration(p, x1, x2, u)
    if i == CONTACT:
        return stiffness(p, x1)
    if i in (CURRENT_OFFSET, COMMAND):
        return p.k_m
    return 0.0


def acceleration(p: BrakeParameters, x1: float, x2: float, u: float) -> float:
    """Second row of eq. 3.12: the sum of the four torques over the inertia [rad/s²]."""
    driving = p.k_m * u - stiffness(p, x1) * x1
    friction = -p.T_c * sign(x2) - p.f_v * x2
    return (driving + friction) / p.J


def step(p: BrakeParameters, x1: float, x2: float, u: float, t_s: float) -> tuple[float, float]:
    """Angle and velocity after one Euler step (eq. 4.1) with a constant current; limits are the caller's."""
    return x1 + t_s * x2, x2 + t_s * acceleration(p, x1, x2, u)


def sensitivity_step(
    p: BrakeParameters, x1: float, x2: float, u: float, t_s: float, s1: float, s2: float, i: int
) -> tuple[float, float]:
    """One step of the sensitivity to the *relative* parameter ``i`` (eq. 4.25; eq. 5.6 for f_v, 6.1 for k_1).

    Relative means θ_i ∂x/∂θ_i with the value that ``p`` has: to normalise by another value θ_nom,i instead (eq. 4.17),
    multiply the sensitivity by θ_nom,i / θ_i. Angle, velocity and their sensitivities s1 and s2, 0 at the start (eq.
    4.26), are those before the step; it returns the sensitivities after it.
    """
    restoring = stiffness(p, x1) * s1 + p.f_v * s2
    return s1 + t_s * s2, s2 + t_s * ((torque(p, x1, x2, u, i) - restoring) / p.J)


def advance_euler(p: BrakeParameters, x: Any, u: float, t_s: float, unknowns: Any, s: Any) -> None:
    """One sample period, in place; arguments are those of :func:`emb_bench.brake.motion.advance`."""
    x1, x2 = float(x[0]), float(x[1])
    for j in range(unknowns.shape[0]):
        s[j, 0], s[j, 1] = sensitivity_step(p, x1, x2, u, t_s, float(s[j, 0]), float(s[j, 1]), int(unknowns[j]))
        if unknowns[j] == DELAY:  # by a fraction of a sample: a share of the step with the current before
            s[j, 1] += t_s * p.k_m * (x[3] - u) / p.J
    x[0], x[1] = step(p, x1, x2, u, t_s)
    x[3] = u
