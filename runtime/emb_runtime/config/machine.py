"""A machine that is no brake of ours: the ``[machine]`` table of a bench file.

A file with this table describes what made a recording that others took. It is for analysis only: the ceilings of the
runtime do not hold in it, ``k_1 = 0`` says that there is no spring, and every command that drives, designs or trains
refuses it.
"""

from __future__ import annotations

from dataclasses import dataclass

from emb_runtime.config.units import ANGLE, CURRENT, FORCE, LENGTH, TORQUE
from emb_runtime.config.validation import Table

PARAMETERS = ("k_m", "k_1", "T_c", "f_v", "J", "coulomb_asymmetry", "viscous_asymmetry")
"""Parameters of a machine that can be of interest."""
BETWEEN = ("held", "open")  # Knowledge of the course of a command between its stamps
WINDOWS = (lambda v: 1e-3 <= v <= 3600.0, "a time from 0.001 to 3600 s")  # Lengths of windows that are taken


@dataclass(frozen=True)
class Machine:
    """Facts about a machine beyond its parameters."""

    unknown: tuple[str, ...]  # Parameters that are estimated where a command names none
    nuisances: tuple[str, ...]  # Other unknowns, likewise
    window: float
    """Length of the windows in which a recording is simulated, each from a start of its own [s]; 0: it chooses."""
    between: str
    """``held`` where it is known what acted in each period; ``open`` where a command may have gone straight to the next
    instead of being held, which the recording chooses."""
    travel: float  # Travel of a linear machine per radian of its motor [m/rad]; 0 for one that turns
    angle: str  # Unit in which angles, or positions, are shown
    command: str  # Unit in which commands are shown


def read_machine(table: Table) -> Machine:
    """The table of a bench file.

    Raises:
        BenchFileError: a key is missing, unknown, of the wrong type or out of range.
    """
    given = table.names()
    travel = table.number("travel", lambda v: v >= 0.0, "a length from 0") if "travel" in given else 0.0
    shown = read_units(table.table("units"), travel) if "units" in given else {}
    record = Machine(
        unknown=table.texts("unknown", PARAMETERS),
        nuisances=table.texts("nuisances") if "nuisances" in given else (),
        window=table.number("window", *WINDOWS) if "window" in given else 0.0,
        between=table.text("between", BETWEEN) if "between" in given else BETWEEN[0],
        travel=travel,
        angle=shown.get("angle", "m" if travel else "rad"),
        command=shown.get("command", "A"),
    )
    table.nothing_else(("nuisances", "window", "between", "travel", "units"))
    return record


def read_units(table: Table, travel: float) -> dict[str, str]:
    """Units in which results are shown, by ``angle`` and ``command``; lengths and forces are a linear machine's.

    Raises:
        BenchFileError: a key or a unit is unknown, or a length or a force is asked of a machine that turns.
    """
    linear = (LENGTH, FORCE) if travel else ({}, {})
    known = {"angle": (*ANGLE, *linear[0]), "command": (*CURRENT, *TORQUE, *linear[1])}
    found = {name: table.text(name, known[name]) for name in known if name in table.names()}
    table.nothing_else(known)
    return found
