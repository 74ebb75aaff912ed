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
