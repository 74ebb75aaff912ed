"""The clamping force of a brake: cubic in the angle, higher on applying than on releasing.

Eq. 3.9 with the slope at contact as k_1, F_cl = k_1 x (1 + quadratic x + cubic x²) for x ≥ 0, the angle from contact,
and none outside. The hysteresis of section 3.2.1 multiplies it by 1 + hysteresis·w. w in [−1, 1] is the position of a
Prandtl stop (Visintin, Differential Models of Hysteresis, 1994): it follows the angle, dw/dx = 1/hysteresis_travel,
until it saturates, and leaves saturation when the motion turns. The friction behind it grows with the force, so a brake
that is open remembers nothing: w starts from 0 each time contact is made, and each application begins on the middle
curve.

Plain scalar functions; compiled by :func:`emb_bench.compiled.compiled` they are bit for bit the same.
"""

from __future__ import annotations

import math

from emb_bench.brake.parameters import CONTACT, CUBIC, HYSTERESIS, K_1, QUADRATIC
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import Mechanics

SATURATED = 1.0 - 1e-9
"""|w| that counts as saturated: what is missing would not be seen in the angle's last digits."""


def clamping_force(m: Mechanics, p: BrakeParameters, x1: float, w: float) -> float:
    """Clamping force at an angle in contact, x1 ≥ 0; the caller knows the side [N]."""
    return p.k_1 * x1 * (1.0 + x1 * (m.quadratic + x1 * m.cubic)) * (1.0 + m.hysteresis * w)


def clamping_slopes(m: Mechanics, p: BrakeParameters, x1: float, w: float) -> tuple[float, float]:
    """Derivatives of the clamping force along the angle at constant w [N/rad], and along w [N]."""
    along = p.k_1 * (1.0 + x1 * (2.0 * m.quadratic + x1 * 3.0 * m.cubic)) * (1.0 + m.hysteresis * w)
    return along, p.k_1 * x1 * (1.0 + x1 * (m.quadratic + x1 * m.cubic)) * m.hysteresis


def clamping_share(m: Mechanics, p: BrakeParameters, x1: float, w: float, i: int) -> float:
    """θ_i ∂F_cl/∂θ_i for unknown ``i`` at constant angle and w [N]; for the angle of contact ∂F_cl/∂contact [N/rad]."""
    both = 1.0 + m.hysteresis * w
    if i == K_1:
        return clamping_force(m, p, x1, w)
    if i == QUADRATIC:
        return p.k_1 * m.quadratic * x1 * x1 * both
    if i == CUBIC:
        return p.k_1 * m.cubic * x1 * x1 * x1 * both
    if i == HYSTERESIS:
        return w * clamping_slopes(m, p, x1, w)[1]
    if i == CONTACT:
        return -clamping_slopes(m, p, x1, w)[0]
    return 0.0


def stop_rate(m: Mechanics, w: float, direction: float) -> float:
    """dw/dx of a brake in contact that moves in ``direction``: 0 in saturation and without hysteresis [1/rad]."""
    if m.hysteresis == 0.0 or w * direction >= SATURATED:
        return 0.0
    return 1.0 / m.hysteresis_travel


def edge_ahead(m: Mechanics, x1: float, w: float, direction: float) -> float:
    """The next angle in ``direction`` where the force changes its law: contact, or saturation of w; or infinity [rad].

    Args:
        m: the brake's features.
        x1: angle [rad].
        w: position in the hysteresis.
        direction: of motion, 1.0 or −1.0.
    """
    if x1 < 0.0:
        return 0.0 if direction > 0.0 else -math.inf
    rate = stop_rate(m, w, direction)
    if direction > 0.0:
        return x1 + (1.0 - w) / rate if rate > 0.0 else math.inf
    if x1 == 0.0:
        return -math.inf
    return max(0.0, x1 - (1.0 + w) / rate) if rate > 0.0 else 0.0
