"""A machine that is no brake of ours: the ``[machine]`` table of a bench file; units of machines and recordings.

A file with this table describes what made a recording that others took. It is for analysis only: the ceilings of the
runtime do not hold in it, ``k_1 = 0`` says that there is no spring, and every command that drives, designs or trains
refuses it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from msgspec import Meta

from emb_runtime.config.typed import FieldError, NotNegative

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

Parameter = Literal["k_m", "k_1", "T_c", "f_v", "J"]
PARAMETERS = get_args(Parameter)  # Parameters of a machine that can be of interest
Window = Annotated[float, Meta(ge=1e-3, le=3600)]


@dataclass(frozen=True)
class Units:
    """Units in which results are shown; empty: as for every brake."""

    angle: str = ""
    command: str = ""

    def check(self, linear: bool) -> None:
        """Refuse an unknown unit, and a length or a force where the machine turns."""
        known = {"angle": (*ANGLE, *(LENGTH if linear else ())), "command": (*CURRENT, *TORQUE)}
        known["command"] += tuple(FORCE) if linear else ()
        for key, units in known.items():
            if (unit := getattr(self, key)) and unit not in units:
                raise FieldError(f"units.{key}", f"expected one of {', '.join(units)}, got {unit!r}")


@dataclass(frozen=True)
class Machine:
    """Facts about a machine beyond its parameters."""

    unknown: tuple[Parameter, ...]  # Parameters that are estimated where a command names none
    nuisances: tuple[str, ...] = ()  # Other unknowns, likewise
    window: Window = 0.0  # Length of the windows in which a recording is simulated [s]; 0: the recording chooses
    between: Literal["held", "open"] = "held"
    """Command between samples: ``held`` (zero-order hold) or ``open`` (hold or linear, which the recording chooses)."""
    travel: NotNegative = 0.0  # Travel of a linear machine per radian of its motor [m/rad]; 0 for one that turns
    units: Units = Units()

    def __post_init__(self) -> None:
        """Refuse what is named twice, and units that do not go with the machine."""
        for key in ("unknown", "nuisances"):
            names = getattr(self, key)
            if len(set(names)) < len(names):
                raise FieldError(key, f"expected each once, got {list(names)}")
        self.units.check(linear=self.travel > 0.0)

    @property
    def angle(self) -> str:
        """Unit in which angles, or positions, are shown."""
        return self.units.angle or ("m" if self.travel else "rad")

    @property
    def command(self) -> str:
        """Unit in which commands are shown."""
        return self.units.command or "A"
