"""A machine that is no brake of ours: the ``[machine]`` table of a bench file.

A file with this table describes what made a recording that others took. It is for analysis only: the ceilings of the
runtime do not hold in it, ``k_1 = 0`` says that there is no spring, and every command that drives, designs or trains
refuses it.

The equations are the brake's, in SI units. Of a linear machine the angle is a position [m], and so the inertia is a
mass [kg] and a torque is a force [N].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from msgspec import Meta

from emb_runtime.config.typed import FieldError

Parameter = Literal["k_m", "k_1", "T_c", "f_v", "J"]
PARAMETERS = get_args(Parameter)  # Parameters of a machine that can be of interest
Angle = Literal["rad", "m"]
Command = Literal["A", "V", "1", "Nm", "N"]
COMMANDS: Mapping[str, str] = {"A": "current", "V": "voltage", "1": "command", "Nm": "torque", "N": "force"}
"""Names of a command by its unit. Volts and bare numbers stand for amperes: ``k_m`` is per one of them. A commanded
torque or force has no ``k_m``: it is 1."""
LOADS = ("Nm", "N")  # Units of a command that has no ``k_m``
Window = Annotated[float, Meta(ge=1e-3, le=3600)]
WINDOW = 0.5  # Default length of the windows [s]


@dataclass(frozen=True)
class Machine:
    """Facts about a machine beyond its parameters."""

    unknown: tuple[Parameter, ...]  # Parameters that are estimated where a command names none
    nuisances: tuple[str, ...] = ()  # Other unknowns, likewise
    window: Window = WINDOW  # Length of the windows in which a recording is simulated [s]
    angle: Angle = "rad"  # Unit of the angle; m of a position, where the machine is linear
    command: Command = "A"  # Unit of the command

    def __post_init__(self) -> None:
        """Refuse what is named twice."""
        for key in ("unknown", "nuisances"):
            names = getattr(self, key)
            if len(set(names)) < len(names):
                raise FieldError(key, f"expected each once, got {list(names)}")

    @property
    def linear(self) -> bool:
        """True if it moves along a line."""
        return self.angle == "m"
