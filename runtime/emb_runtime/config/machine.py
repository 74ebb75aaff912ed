"""A machine that is no brake of ours: the ``[machine]`` table of a bench file.

A file with this table describes what made a recording that others took. It is for analysis only: the ceilings of the
runtime do not hold in it, ``k_1 = 0`` says that there is no spring, and every command that drives, designs or trains
refuses it.
"""

from __future__ import annotations

from dataclasses import dataclass

from emb_runtime.config.validation import Table

PARAMETERS = ("k_m", "k_1", "T_c", "f_v", "J", "coulomb_asymmetry", "viscous_asymmetry")
"""Parameters of a machine that can be of interest."""


@dataclass(frozen=True)
class Machine:
    """Facts about a machine beyond its parameters."""

    unknown: tuple[str, ...]
    """Parameters that are estimated where a command names none."""
    nuisances: tuple[str, ...]
    """Other unknowns, likewise."""
    window: float
    """Length of the windows in which a recording is simulated, each from a start of its own [s]."""
    travel: float
    """Travel of a linear machine per radian of its motor [m/rad]; 0 for one that turns."""


def read_machine(table: Table) -> Machine:
    """The table of a bench file.

    Raises:
        BenchFileError: a key is missing, unknown, of the wrong type or out of range.
    """
    given = table.names()
    record = Machine(
        unknown=table.texts("unknown", PARAMETERS),
        nuisances=table.texts("nuisances") if "nuisances" in given else (),
        window=table.number("window", lambda v: 1e-3 <= v <= 3600.0, "a time from 0.001 to 3600 s"),
        travel=table.number("travel", lambda v: v >= 0.0, "a length from 0") if "travel" in given else 0.0,
    )
    table.nothing_else(("nuisances", "travel"))
    return record
