"""Quantities as a machine's own people call and measure them: a linear servo has a mass in kg, not an inertia in kg·m².

The equations are those of a motor that turns; a radian of it is ``travel`` metres. A force F of the linear machine is a
torque F travel, a mass M an inertia M travel². Results are shown in the units of the machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from emb_bench.brake.parameters import SI
from emb_bench.config.machine import ANGLE, ANGULAR_SPEED, CURRENT, FORCE, LENGTH, TORQUE, Machine

LINEAR: Mapping[str, str] = {"mass": "J", "F_c": "T_c", "F_v": "f_v"}
"""Parameters of a linear machine [kg, N, N·s/m], and what they are in coordinates of its motor."""
_OF_LINEAR = {ours: name for name, ours in LINEAR.items()}
_LINEAR_UNITS = {"mass": "kg", "F_c": "N", "F_v": "N·s/m"}
_SPELLED = {"Nm": "N·m", "mNm": "mN·m", "deg": "°", "um": "µm"}


class Quantity(NamedTuple):
    """One number of a result as it is shown."""

    name: str
    unit: str  # ``1`` for a share
    factor: float  # From SI units, in coordinates of the motor, to ``unit``


def quantity(machine: Machine | None, name: str) -> Quantity:
    """An unknown of a brake, or of another machine, as it is shown.

    Args:
        machine: of the bench; None for a brake, whose unknowns are shown as they are.
        name: one of :data:`emb_bench.brake.parameters.PARAMETERS`.
    """
    if machine is None:
        return Quantity(name, SI[name], 1.0)
    if machine.travel and name in _OF_LINEAR:
        own = _OF_LINEAR[name]
        return Quantity(own, _LINEAR_UNITS[own], 1.0 / in_motor_coordinates(name, machine.travel))
    if name == "current_offset":
        return command(machine)._replace(name=_offset(machine.command))
    if name == "k_m":
        per = "" if machine.command in ("1", *TORQUE, *FORCE) else f"/{_ampere(machine.command)}"
        return Quantity(name, f"{'N' if machine.travel else 'N·m'}{per}", 1.0 / (machine.travel or 1.0))
    match SI[name]:
        case "rad":
            return angle(machine)._replace(name=name)
        case "rad/s":
            return velocity(machine)._replace(name=name)
        case unit:
            return Quantity(name, unit, 1.0)


def renamed(shares: Mapping[str, float], machine: Machine | None) -> dict[str, float]:
    """Shares of unknowns by the names that are shown."""
    return {quantity(machine, name).name: share for name, share in shares.items()}


def angle(machine: Machine | None) -> Quantity:
    """The angle, or the position of a linear machine."""
    if machine is None:
        return Quantity("angle", "rad", 1.0)
    unit = machine.angle
    if unit in LENGTH:
        return Quantity("position", _spelled(unit), machine.travel / LENGTH[unit])
    return Quantity("angle", _spelled(unit), 1.0 / ANGLE[unit])


def velocity(machine: Machine | None) -> Quantity:
    """The velocity, in the unit of the angle per second."""
    if machine is None:
        return Quantity("velocity", "rad/s", 1.0)
    shown = angle(machine)
    if machine.angle == "rev":
        return Quantity("velocity", "rpm", 1.0 / ANGULAR_SPEED["rpm"])
    return shown._replace(name="velocity", unit=f"{shown.unit}/s")


def command(machine: Machine | None) -> Quantity:
    """Quantity that drives: a current, or the torque, the force or the number that was commanded."""
    unit = "A" if machine is None else machine.command
    if machine is not None and unit in FORCE:
        return Quantity("force", unit, 1.0 / machine.travel / FORCE[unit])
    if unit in TORQUE:
        return Quantity("torque", _spelled(unit), 1.0 / TORQUE[unit])
    return Quantity({"V": "voltage", "1": "command"}.get(unit, "current"), unit, 1.0 / CURRENT[unit])


def in_motor_coordinates(parameter: str, travel: float) -> float:
    """Factor from a parameter of a linear machine to the one in coordinates of its motor."""
    return travel if parameter == "T_c" else travel**2


def _offset(unit: str) -> str:
    """The name of the offset of a command in a unit."""
    kinds = ((FORCE, "force_offset"), (TORQUE, "torque_offset"), (("V",), "voltage_offset"), (("1",), "command_offset"))
    return next((name for units, name in kinds if unit in units), "current_offset")


def _ampere(unit: str) -> str:
    return "V" if unit == "V" else "A"


def _spelled(unit: str) -> str:
    return _SPELLED.get(unit, unit)
