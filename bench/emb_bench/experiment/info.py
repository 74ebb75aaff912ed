"""Records of an experiment: the current that acted in each period, the sample at its end, and what is missing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

PIECE = 8192  # Most periods that are looked at together

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


class Rest(NamedTuple):
    """State of the brake before the experiment, from the samples."""

    angle: float  # Measured [rad]
    velocity: float  # Measured [rad/s]; 0 if the brake rested
    slack: float  # The angle is not known any better [rad]


class Piece(NamedTuple):
    """Some periods that follow each other, m of them, and the samples at their ends."""

    currents: Floats  # Current that acted [A], shape (m,)
    measured: Booleans
    """True where the sample at the period's end was received, so that the node reported what acted, shape (m,)."""
    angle: Floats  # Measured [rad], NaN where the sample was lost, shape (m,)
    velocity: Floats  # Measured [rad/s], NaN where the sample was lost, shape (m,)
    device_time_ns: Integers
    """The node's own time since sample 0, on the grid where the sample was lost [ns], shape (m,)."""
    reported: Booleans
    """True where it is known what acted, by the sample's report or by the charge of those around it, shape (m,)."""


@dataclass(frozen=True, eq=False)
class ExperimentInfo(ABC):
    """An experiment of n sampling periods, but for the periods themselves."""

    planned: int  # Periods that the run was to have
    periods: int  # n
    samples: int  # Samples at the periods' ends that were received
    braked: int  # Periods that the node braked by itself because no command came in time
    before: Rest  # State of the brake before the experiment, from the samples before sample 0
    command_delay: int  # Samples by which commands acted late, by the node's reports
    missing: tuple[str, ...]  # Descriptions of parts that are missing, or not to be trusted
    notes: tuple[str, ...]
    """Descriptions of what was taken for the currents that acted, where that is not what was told of them."""

    def x0(self, encoder_offset: float = 0.0) -> tuple[float, float]:
        """True angle [rad] and velocity [rad/s] at sample 0; an angle that may be the origin is taken as the origin.

        Args:
            encoder_offset: the encoder's reading at the origin [rad].
        """
        angle = self.before.angle - encoder_offset
        return (0.0 if abs(angle) <= self.before.slack else angle), self.before.velocity

    @abstractmethod
    def pieces(self) -> Iterator[Piece]:
        """All periods in their order, at most ``PIECE`` at a time."""


@dataclass(frozen=True, eq=False)
class Experiment(ExperimentInfo):
    """n sampling periods and the n + 1 samples around them; period k begins at sample k."""

    currents: Floats  # Current that acted in each period [A], shape (n,)
    measured: Booleans
    """True where the sample at the period's end was received, so that the node reported what acted, shape (n,)."""
    angle: Floats  # Measured [rad], NaN where the sample was lost, shape (n + 1,)
    velocity: Floats  # Measured [rad/s], NaN where the sample was lost, shape (n + 1,)
    device_time_ns: Integers
    """The node's own time since sample 0, on the grid where the sample was lost [ns], shape (n + 1,)."""
    reported: Booleans
    """True where it is known what acted, by the sample's report or by the charge of those around it, shape (n,)."""

    def pieces(self) -> Iterator[Piece]:
        """All periods in their order, at most ``PIECE`` at a time."""
        samples = (self.angle[1:], self.velocity[1:], self.device_time_ns[1:])
        for k in range(0, self.periods, PIECE):
            columns: Any = (self.currents, self.measured, *samples, self.reported)
            yield Piece(*(column[k : k + PIECE] for column in columns))
