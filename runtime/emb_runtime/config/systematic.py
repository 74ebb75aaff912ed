"""Systematic errors that a bench cannot exclude by itself: the ``[systematic]`` table of a bench file.

They are standard deviations of Gaussian priors with mean zero, or with what the plant itself says. What a record tells
better than its prior, as most records do, follows from the record. 0 excludes an error: the bench knows better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from emb_runtime.config.validation import Table


@dataclass(frozen=True)
class Systematic:
    """Standard deviations before any record, of what is estimated along and of what may be wrong with the plant."""

    offset: float = 0.05  # Reading of the encoder at the true origin [rad]
    current_offset: float = 0.05
    """Current that acts beyond what the node reports; a friction that depends on the direction looks the same [A]."""
    delay: float = 0.3  # By which commands act late, or samples early [samples]
    velocity_gain: float = 0.02  # Relative error of the velocity's scale
    held: float = 0.02  # Relative error of each parameter that is held at its nominal value
    quadratic: float = 1e-4  # Quadratic share of the stiffness that the plant lacks [1/rad]
    cubic: float = 1e-6  # Cubic share of the stiffness that the plant lacks [1/rad²]
    hysteresis: float = 1e-2  # Hysteresis of the clamping force that the plant lacks
    play: float = 0.2  # Clearance in the gear [rad]
    break_away: float = 0.1  # Static friction beyond the plant's, as a share of T_c
    f_l: float = 1e-7  # Load-dependent static friction beyond the plant's [m]
    current_lag: float = 5e-4  # Time constant of the current loop beyond the plant's [s]
    drift: float = 0.003  # Change of each parameter from the begin of a run to its end, as a share of it


def read_systematic(table: Table | None) -> Systematic:
    """The table of a bench file; what it leaves out has its default.

    Raises:
        BenchFileError: a key is unknown, or no number from 0 on.
    """
    if table is None:
        return Systematic()
    known = [entry.name for entry in fields(Systematic)]
    given = {
        name: table.number(name, lambda v: 0.0 <= v < math.inf, "a number from 0 on")
        for name in known
        if name in table.names()
    }
    table.nothing_else(known)
    return Systematic(**given)
