"""Type of a run, as in the log's metadata under ``purpose``."""

from __future__ import annotations

from enum import StrEnum


class RunType(StrEnum):
    """Type of a run."""

    EXPERIMENT = "experiment"
    HOMING = "homing"  # To bring the brake to the origin
    LISTEN_ONLY = "reading"  # To see what is on the bus


HOMING_LOG = "-home"
LISTEN_ONLY_LOG = "-read"  # Endings, before the suffix, of the names of logs that hold no experiment


FIRST_CURRENT = "first_current"
"""Entry of a log: largest current of the first move [A]. A log of a version that did not judge its sensors has none."""

FIRST_MOVE = "first_move"
"""Entry of a log: what limits the first move. A log without it was recorded with a constant limit, FIRST_CURRENT."""
STOPPABLE = "stoppable"
"""Value of FIRST_MOVE: what friction alone can stop if a sign is wrong, see ``safety/sensor_monitor.py``."""
