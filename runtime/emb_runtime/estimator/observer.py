"""Observer of a velocity: the tracking loop of second order by which a drive derives it from the measured angle.

Sampled once a period T it is an α-β filter (Kalata, The tracking index, IEEE Trans. Aerospace and Electronic Systems
20(2), 1984) with the poles z = exp((−ζ ± j √(1 − ζ²)) ω_o T).
"""

from __future__ import annotations

import math
from typing import Final

DAMPING: Final = 0.7  # Least that is assumed: with a greater one the same lag is that of a faster observer


def observer_gains(bandwidth: float, t_s: float, damping: float = DAMPING) -> tuple[float, float]:
    """α and β of the observer of a bandwidth ω_o [rad/s].

    The filter's poles solve z² − (2 − α − β) z + (1 − α) = 0, so that α = 1 − |z|² and β = 1 + |z|² − 2 Re z.
    """
    radius = math.exp(-damping * bandwidth * t_s)
    real = radius * math.cos(math.sqrt(1.0 - damping * damping) * bandwidth * t_s)
    return 1.0 - radius * radius, 1.0 + radius * radius - 2.0 * real
