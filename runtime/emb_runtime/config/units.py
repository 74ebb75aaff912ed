"""Units of the machines and recordings of others: an explicit table, and nothing is guessed."""

from __future__ import annotations

import math
from collections.abc import Mapping

TIME: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # Seconds in each
ANGLE: Mapping[str, float] = {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi}  # Radians in each
LENGTH: Mapping[str, float] = {"m": 1.0, "mm": 1e-3, "um": 1e-6}
"""Metres in each; a linear machine's position, which its ``travel`` turns into an angle."""
ANGULAR_SPEED: Mapping[str, float] = {
    "rad/s": 1.0,
    "deg/s": math.pi / 180.0,
    "rev/s": 2.0 * math.pi,
    "rpm": math.pi / 30.0,
}
"""Radians per second in each."""
SPEED: Mapping[str, float] = {"m/s": 1.0, "mm/s": 1e-3}  # Metres per second in each
CURRENT: Mapping[str, float] = {"A": 1.0, "mA": 1e-3, "V": 1.0, "1": 1.0}
"""Amperes in each; volts at an amplifier, or a bare number, stand for amperes, and ``k_m`` is per one of them."""
TORQUE: Mapping[str, float] = {"Nm": 1.0, "mNm": 1e-3}  # Newton metres in each
FORCE: Mapping[str, float] = {"N": 1.0, "kN": 1e3}
"""Newtons in each; a linear machine's, which its ``travel`` turns into a torque."""
