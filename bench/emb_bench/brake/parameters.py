"""The table of unknowns: parameters of a brake, of its features and its instruments.

The thesis identifies k_m, k_1, T_c and f_v. The record also depends on nuisance parameters, which are estimated, and on
constants, whose errors enter the uncertainty. The row of a parameter has its unit, search range, score test and remedy;
its place is the index in compiled code.

A machine that is no brake has other names and units: a linear servo has a mass in kg, not an inertia in kg·m².
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from emb_bench.config.machine import COMMANDS, LOADS, Machine


class Parameter(NamedTuple):
    """One row."""

    unit: str  # Of its value, SI; ``1`` for a number
    relative: bool = True  # Its sensitivity is θ ∂/∂θ (eq. 4.17); False for an absolute one, per unit
    about: str = ""  # What it is
    low: float = 0.0  # Lowest value of a search; with low = high the bench's limits
    high: float = 0.0  # Highest value of a search
    start: float = 0.0  # Initial value of a feature that the plant lacks; 0 for others
    of_an_experiment: bool = False  # Each experiment has its own value
    gross: float = 1.0  # Deviation above which it is not identified: relative, or in its unit
    effect: str = ""  # Noun phrase for a score test; empty where there is none
    remedy: str = ""  # What to do if the score test finds it
    step: float = 0.0  # Of the score test's secant; 0 where the brake has a sensitivity
    positive: bool = False  # It cannot be negative
    addition: str = ""  # Name in the growth of a model; rows of one name are added together


_FREE_IT = "estimate it as well: --params"

PARAMETERS: Mapping[str, Parameter] = {
    "k_m": Parameter("N·m/A", effect="a change of k_m, which is fixed,", remedy=_FREE_IT),
    "k_1": Parameter("N/rad", effect="a change of k_1, which is fixed,", remedy=_FREE_IT),
    "T_c": Parameter("N·m", effect="a change of T_c, which is fixed,", remedy=_FREE_IT),
    "f_v": Parameter("N·m·s/rad", effect="a change of f_v, which is fixed,", remedy=_FREE_IT),
    "J": Parameter(
        "kg·m²",
        about="moment of inertia [kg·m²]; scales with all torques, so that one of them has to be given",
        effect="another moment of inertia",
        remedy="correct J in the bench file",
    ),
    "offset": Parameter(
        "rad",
        False,
        "reading of the encoder at the origin [rad], of each log",
        of_an_experiment=True,
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
        of_an_experiment=True,
        effect="another angle at the start",
        remedy="let the brake rest before the run, or --nuisance x1_0",
    ),
    "x2_0": Parameter(
        "rad/s",
        False,
        "velocity at the start [rad/s], of each log",
        of_an_experiment=True,
        gross=10.0,
        effect="a motion at the start",
        remedy="let the brake rest before the run, or --nuisance x2_0",
    ),
    "delay": Parameter(
        "samples",
        False,
        "time by which commands act late [samples], -0.1 to 0.9; below 0, samples are late",
        -0.1,  # samples that are taken late look like commands that act early
        0.9,  # more is in the record: the node reports the currents
        effect="a delay of the commands",
        remedy="--nuisance delay",
        addition="delay of commands",
    ),
    "current_offset": Parameter(
        "A",
        False,
        "acting current less the reported one [A]",
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
    "viscous_asymmetry": Parameter(
        "1",
        False,
        "share by which f_v is larger in the positive direction and smaller in the negative",
        -0.9,
        0.9,
        effect="a viscous friction that depends on the direction, f_v (1 ± it),",
        remedy="--nuisance viscous_asymmetry",
    ),
    "quadratic": Parameter(
        "1/rad",
        False,
        "curvature of the clamping force, k_1 x (1 + quadratic x + cubic x²) [1/rad]",
        high=0.1,
        start=1e-4,
        gross=0.01,
        effect="a quadratic stiffness",
        remedy="estimate it as well: --nuisance quadratic,cubic",
        step=1e-5,
        addition="curved stiffness",
    ),
    "cubic": Parameter(
        "1/rad²",
        False,
        "the next term of that curve [1/rad²]",
        high=1e-2,
        start=1e-6,
        gross=1e-4,
        effect="a cubic stiffness",
        remedy="estimate it as well: --nuisance quadratic,cubic",
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
        remedy="estimate it as well: --nuisance hysteresis",
        step=1e-3,
        positive=True,
        addition="hysteresis",
    ),
    "play": Parameter(
        "rad",
        about="travel of the motor after a reversal until the clamp follows [rad]; not together with hysteresis",
        low=1e-4,
        high=10.0,
        start=0.1,
        effect="play of the gear",
        remedy="estimate it as well: --nuisance play",
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
        remedy="estimate it as well: --nuisance break_away,stribeck_velocity",
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
        remedy="estimate it as well: --nuisance break_away,f_l,stribeck_velocity",
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
        remedy="estimate it as well: --nuisance current_lag",
        step=2e-5,
        positive=True,
        addition="lag of the current",
    ),
}

CURVED = {"quadratic": 1, "cubic": 2}
"""Terms of the clamping force that may be negative, and their powers of the angle."""


def least(name: str) -> float:
    """Least value that a brake can have, SI units."""
    row = PARAMETERS[name]
    if not row.relative:
        return -math.inf
    return 1.0 if name == "break_away" else 0.0


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
VISCOUS_ASYMMETRY = _index("viscous_asymmetry")
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
OF_AN_EXPERIMENT = tuple(name for name, row in PARAMETERS.items() if row.of_an_experiment)
"""Unknowns that each record has for itself: its start, and the homing of its encoder."""


LINEAR: Mapping[str, str] = {"mass": "J", "F_c": "T_c", "F_v": "f_v"}
"""Names of parameters of a linear machine, and the places that they have in the equations."""
_OF_LINEAR = {
    "J": ("mass", "kg"), "T_c": ("F_c", "N"), "f_v": ("F_v", "N·s/m"), "k_1": ("k_1", "N/m"),
    "angle": ("position", "m"), "velocity": ("velocity", "m/s"),
}  # fmt: skip


class Quantity(NamedTuple):
    """Name and unit of a result in the output."""

    name: str
    unit: str  # ``1`` for a share


def quantity(machine: Machine | None, name: str) -> Quantity:
    """An unknown of a brake or of another machine, its angle, velocity or command (``current``), as it is shown."""
    plain = Quantity(name, {"angle": "rad", "velocity": "rad/s", "current": "A"}.get(name) or SI[name])
    if machine is None:
        return plain
    load = "N" if machine.linear else "N·m"
    if name in ("current", "current_offset"):
        name = name.replace("current", COMMANDS[machine.command])
        return Quantity(name, load if machine.command in LOADS else machine.command)
    if name == "k_m":
        return Quantity(name, load if machine.command in ("1", *LOADS) else f"{load}/{machine.command}")
    if machine.linear:
        return Quantity(*_OF_LINEAR.get(name, (name, plain.unit.replace("rad", "m"))))
    return plain


def renamed(shares: Mapping[str, float], machine: Machine | None) -> dict[str, float]:
    """Shares of unknowns by the names that are shown."""
    return {quantity(machine, name).name: share for name, share in shares.items()}
