"""The one table of what can be estimated from a record: parameters of a brake, of its features and its instruments.

The thesis identifies k_m, k_1, T_c and f_v. The others are what the record depends on besides: nuisances that are
estimated too, or constants whose error has a price. All that the tool says or does with a parameter by its name
follows from its row here: index, unit, range of a search, score test, remedy.

A machine that is no brake has names and units of its own: a linear servo has a mass in kg, not an inertia in kg·m². The
equations are those of a motor that turns; a radian of it is ``travel`` metres. A force F of the linear machine is a
torque F travel, a mass M an inertia M travel².
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.machine import ANGLE, ANGULAR_SPEED, CURRENT, FORCE, LENGTH, TORQUE, Machine


class Parameter(NamedTuple):
    """One row."""

    unit: str  # Of its value, SI; ``1`` for a number
    relative: bool = True  # Its sensitivity is θ ∂/∂θ (eq. 4.17); False for an absolute one, per unit
    about: str = ""  # What it is
    low: float = 0.0  # Lowest value that is searched; where low = high, limits of the bench
    high: float = 0.0  # Highest value that is searched
    start: float = 0.0  # Value of a feature to begin with where the plant has none; 0 for what is no feature
    of_a_record: bool = False  # Each record has one of its own
    gross: float = 1.0  # Deviation from which on an estimate is of no use: relative, or in its unit
    effect: str = ""  # Noun phrase for a score test; empty where there is none
    remedy: str = ""  # What to do if the score test finds it
    step: float = 0.0  # Of the score test's secant; 0 where the brake has a sensitivity
    positive: bool = False  # It cannot be negative
    addition: str = ""  # What a model that grows calls it; rows of one name are added together


_HELD = "estimate it as well: --params"
_PLANT = "estimate with a plant that has it: --model"

PARAMETERS: Mapping[str, Parameter] = {
    "k_m": Parameter("N·m/A", effect="a change of k_m, which is held fixed,", remedy=_HELD),
    "k_1": Parameter("N/rad", effect="a change of k_1, which is held fixed,", remedy=_HELD),
    "T_c": Parameter("N·m", effect="a change of T_c, which is held fixed,", remedy=_HELD),
    "f_v": Parameter("N·m·s/rad", effect="a change of f_v, which is held fixed,", remedy=_HELD),
    "J": Parameter(
        "kg·m²",
        about="moment of inertia [kg·m²]; scales with all torques, so that one of them has to be known",
        effect="another moment of inertia",
        remedy="correct J in the bench file",
    ),
    "offset": Parameter(
        "rad",
        False,
        "what the encoder shows at the origin [rad], of each log",
        of_a_record=True,
        effect="an encoder offset",
        remedy="home the encoder, or --nuisance offset,x1_0",
        addition="encoder offset",
    ),
    "contact": Parameter(
        "rad",
        False,
        "angle at which the clamping begins [rad], nominally 0",
        effect="a contact away from the origin",
        remedy="home the encoder at the contact, or --nuisance contact",
        addition="place of contact",
    ),
    "x1_0": Parameter(
        "rad",
        False,
        "angle at the start [rad], of each log",
        of_a_record=True,
        effect="another angle at the start",
        remedy="let the brake rest before the run, or --nuisance x1_0",
    ),
    "x2_0": Parameter(
        "rad/s",
        False,
        "velocity at the start [rad/s], of each log",
        of_a_record=True,
        gross=10.0,
        effect="a motion at the start",
        remedy="let the brake rest before the run, or --nuisance x2_0",
    ),
    "delay": Parameter(
        "samples",
        False,
        "time by which commands act late [samples], -0.1 to 0.9; below 0, samples are late",
        -0.1,  # samples that are taken late look like commands that act early
        0.9,  # whole samples are in the record, because the node reports what acted
        effect="a delay of the commands",
        remedy="--nuisance delay",
        addition="delay of commands",
    ),
    "current_offset": Parameter(
        "A",
        False,
        "current that acts beyond what the node reports [A]",
        effect="an offset of the current",
        remedy="calibrate it, or --nuisance current_offset",
    ),
    "velocity_gain": Parameter(
        "1",
        False,
        "relative error of the velocity's scale",
        -0.5,
        0.5,
        effect="an error of the velocity's scale",
        remedy="calibrate it, or --nuisance velocity_gain",
    ),
    "quadratic": Parameter(
        "1/rad",
        about="curvature of the clamping force, k_1 x (1 + quadratic x + cubic x²) [1/rad]",
        low=1e-8,
        high=0.1,
        start=1e-4,
        effect="a quadratic stiffness",
        remedy=_PLANT,
        step=1e-5,
        addition="curved stiffness",
    ),
    "cubic": Parameter(
        "1/rad²",
        about="the next term of that curve [1/rad²]",
        low=1e-10,
        high=1e-2,
        start=1e-6,
        effect="a cubic stiffness",
        remedy=_PLANT,
        step=1e-7,
        addition="curved stiffness",
    ),
    "hysteresis": Parameter(
        "1",
        about="share by which the clamping force is larger while tightening, smaller while releasing",
        low=1e-6,
        high=0.5,
        start=1e-2,
        effect="a hysteresis of the clamping force",
        remedy=_PLANT,
        step=1e-3,
        positive=True,
        addition="hysteresis",
    ),
    "play": Parameter(
        "rad",
        about="travel of the motor after a turn until the clamp follows [rad]; not together with hysteresis",
        low=1e-4,
        high=10.0,
        start=0.1,
        effect="play of the gear",
        remedy=_PLANT,
        step=0.02,
        positive=True,
        addition="play",
    ),
    "break_away": Parameter(
        "1",
        about="static friction as a multiple of T_c",
        low=1.0,
        high=5.0,
        start=1.1,
        effect="a static friction beyond T_c",
        remedy=_PLANT,
        step=1e-2,
        positive=True,
        addition="static friction",
    ),
    "stribeck_velocity": Parameter(
        "rad/s",
        about="speed at which the static friction has decayed [rad/s]",
        low=1.0,
        high=500.0,
        start=30.0,
        addition="static friction",
    ),
    "f_l": Parameter(
        "m",
        about="static friction that grows with the load [m]",
        low=1e-10,
        high=1e-4,
        start=1e-6,
        effect="a static friction that grows with the load",
        remedy=_PLANT,
        step=1e-9,
        positive=True,
        addition="static friction by load",
    ),
    "current_lag": Parameter(
        "s",
        about="time constant of the current loop [s]",
        low=1e-7,
        high=0.1,
        start=1e-3,
        effect="a lag of the current",
        remedy=_PLANT,
        step=2e-5,
        positive=True,
        addition="lag of the current",
    ),
}

_index = list(PARAMETERS).index
K_M = _index("k_m")
K_1 = _index("k_1")
T_C = _index("T_c")
F_V = _index("f_v")
J = _index("J")
CONTACT = _index("contact")
DELAY = _index("delay")
X1_0 = _index("x1_0")
X2_0 = _index("x2_0")
OFFSET = _index("offset")
BREAK_AWAY = _index("break_away")
STRIBECK_VELOCITY = _index("stribeck_velocity")
F_L = _index("f_l")
QUADRATIC = _index("quadratic")
CUBIC = _index("cubic")
HYSTERESIS = _index("hysteresis")
CURRENT_LAG = _index("current_lag")
CURRENT_OFFSET = _index("current_offset")
VELOCITY_GAIN = _index("velocity_gain")
PLAY = _index("play")
COMMAND = len(PARAMETERS)
"""Current that is commanded in the period at hand, and in no other [A]: what is unknown where a report was lost."""
PAST_COMMAND = COMMAND + 1  # That current in the periods after it, in which it shows in the state alone

SI = {name: row.unit for name, row in PARAMETERS.items()}
"""Units of the values of all of them."""
UNITS = {name: row.unit for name, row in PARAMETERS.items() if not row.relative}
"""Units of the unknowns whose sensitivity is absolute; the others are relative to their value."""
FEATURES = tuple(name for name, row in PARAMETERS.items() if row.start)
"""Features of a brake beyond the thesis's equations."""
OF_A_RECORD = tuple(name for name, row in PARAMETERS.items() if row.of_a_record)
"""Unknowns that each record has for itself: its start, and the homing of its encoder."""


def scale(names: Iterable[str], values: Iterable[float]) -> NDArray[np.float64]:
    """Factors from relative changes to those of the values: the value where a parameter is relative, else 1."""
    return np.array([value if PARAMETERS[name].relative else 1.0 for name, value in zip(names, values, strict=True)])


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
    """An unknown of a brake, or of another machine, as it is shown."""
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
