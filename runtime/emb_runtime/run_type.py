"""What a run is for, as its log says."""

from __future__ import annotations

from enum import StrEnum


class Purpose(StrEnum):
    """What a run is for."""

    EXPERIMENT = "experiment"
    HOMING = "homing"
    """To bring the brake to the origin."""
    READING = "reading"
    """To see what is on the bus."""


HOMING_LOG = "-home"
READING_LOG = "-read"
"""How the names of logs end that hold no experiment, before their suffix."""
