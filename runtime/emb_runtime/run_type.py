"""What a run is for, as its log says."""

from __future__ import annotations

from enum import StrEnum


class RunType(StrEnum):
    """What a run is for."""

    EXPERIMENT = "experiment"
    HOMING = "homing"
    """To bring the brake to the origin."""
    LISTEN_ONLY = "reading"
    """To see what is on the bus."""


HOMING_LOG = "-home"
LISTEN_ONLY_LOG = "-read"
"""How the names of logs end that hold no experiment, before their suffix."""
