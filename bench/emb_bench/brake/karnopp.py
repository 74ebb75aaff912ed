"""The thesis's brake under forward Euler with Karnopp's interval of rest (eq. 3.7), and its sensitivities.

Within |x2| < ε a brake whose external torque T_e = k_m u − γ F_cl is no larger than T_s = break_away T_c is held: its
velocity is zero from there on, and friction is whatever holds it. If T_e is larger, friction is T_s against it and not
yet viscous, as eq. 3.7 prints it; beyond ε it is that of the thesis. So a brake at rest does not chatter by T_c t_s/J
as under sign(), which is what this plant is for (Karnopp, J. Dyn. Syst. Meas. Control 107, 1985).

Where it is wrong: it stops from up to ε at once, angle and instant of the stop are those of the grid, and a brake that
is decelerated by more than 2ε in a period jumps over the interval (the friction alone takes T_c t_s/J = 2.2 rad/s,
6 A take 28 rad/s). The sensitivities are those of these equations, with no derivative of the case distinction, as the
Euler brake has none of sign(); they lack the jumps of the exact brake.

Plain Python; compiled by :func:`emb_bench.compiled.compiled` it is bit for bit the same.
"""

from __future__ import annotations

import math
from typing import Any

from emb_bench.brake.euler import sensitivity_step, step, stiffness
from emb_bench.brake.parameters import BREAK_AWAY, CONTACT, DELAY, K_1, K_M, T_C, J
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import Mechanics


def advance_karnopp(m: Mechanics, p: BrakeParameters, x: Any, u: float, t_s: float, chosen: Any, s: Any) -> None:
    """One sample period, in place; arguments are those of :func:`emb_bench.brake.motion.advance`."""
    x1, x2 = float(x[0]), float(x[1])
    external = p.k_m * u - stiffness(p, x1) * x1
    static = m.break_away * p.T_c
    if abs(x2) >= m.karnopp_velocity:
        for j in range(chosen.shape[0]):
            s1, s2 = float(s[j, 0]), float(s[j, 1])
            s[j, 0], s[j, 1] = sensitivity_step(p, x1, x2, u, t_s, s1, s2, int(chosen[j]))
        x[0], x[1] = step(p, x1, x2, u, t_s)
    elif abs(external) <= static:
        s[:, 1] = 0.0
        x[1] = 0.0
    else:
        friction = math.copysign(static, external)
        a = (external - friction) / p.J
        for j in range(chosen.shape[0]):
            share = _share(p, x1, u, a, friction, int(chosen[j])) - stiffness(p, x1) * s[j, 0]
            s[j, 0] += t_s * s[j, 1]
            s[j, 1] += t_s * share / p.J
        x[0], x[1] = x1 + t_s * x2, x2 + t_s * a
    for j in range(chosen.shape[0]):
        if chosen[j] == DELAY and x[1] != 0.0:  # by a fraction of a sample: a share of the step with the current before
            s[j, 1] += t_s * p.k_m * (x[3] - u) / p.J
    x[3] = u


def _share(p: BrakeParameters, x1: float, u: float, a: float, friction: float, i: int) -> float:
    """θ_i ∂/∂θ_i of the torque on a brake that breaks away with the acceleration ``a`` [N·m]."""
    if i == K_M:
        return p.k_m * u
    if i == K_1:
        return -stiffness(p, x1) * x1
    if i in (T_C, BREAK_AWAY):
        return -friction
    if i == J:
        return -p.J * a
    if i == CONTACT:
        return stiffness(p, x1)
    return 0.0
