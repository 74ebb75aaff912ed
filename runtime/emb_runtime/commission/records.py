"""Records of a commissioning: a step, what was found by it, and who finds it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol

from emb_runtime.config.bench import Bench, Noise


class Kind(StrEnum):
    """Kind of a step: what is looked for in its log."""

    REST = "rest"  # Noise and clock of the sensors while nothing is sent
    CHAIN = "chain"  # The whole chain with 0 A
    CURRENT = "current"  # Sign, scale and latency of the reported current, with too little to move the brake
    FIRST_MOVE = "first move"  # Signs and scales of the sensors, and the current that moves the brake
    EXPERIMENT = "experiment"  # Parameters


@dataclass(frozen=True)
class Window:
    """Window of a step: outside of it no current flows that drives the brake farther out."""

    lowest: float  # Angle [rad]
    highest: float  # Angle [rad]
    speed: float  # [rad/s]


@dataclass(frozen=True)
class Step:
    """One guarded run: what is done, within which limits, and what that rests on."""

    name: str  # Name of its files
    kind: Kind
    purpose: str  # Description of what is done, for the operator
    rests_on: str  # Numbers that its limits come from, and where those come from
    limit: float  # Largest current that may leave [A]; 0 for none but 0 A
    duration: float  # [s]
    window: Window
    currents: tuple[float, ...] = ()  # Wanted current by sample [A]; after the last one it stays
    learns: bool = False  # With the learning shield
    final: bool = False  # With the bench file that was found
    asks: bool = False  # At rest: the samples come only when they are asked for, by 0 A


@dataclass(frozen=True)
class Rest:
    """Findings at rest."""

    noise: Noise  # Standard deviations
    period: float  # Of the samples by the node's clock [s]
    jitter: float  # Standard deviation of the samples about their grid, by the node's clock [s]
    clock_ratio: float  # Node's time over the computer's
    angle: float  # Mean [rad]


@dataclass(frozen=True)
class CurrentCheck:
    """Findings about the current."""

    delay: int  # Samples by which commands act late, by the node's reports
    scale: float  # Reported current over commanded one
    error: float  # Standard deviation of the rest [A]
    moved: float  # Farthest from the angle at the start [rad]
    uncertain: int = 0
    """Samples by which commands may act later than it looks, of a drive that does not say which one it obeyed."""


@dataclass(frozen=True)
class FirstMove:
    """Findings of the first move."""

    up: float  # Current at which the brake began to move in the positive direction [A]; NaN if it did not
    down: float  # Size of the current at which it began to move in the negative direction [A]; NaN if it did not
    scale: float  # Angle travelled over the integral of the velocity


@dataclass(frozen=True)
class Identification:
    """Parameters from the experiments so far."""

    values: Mapping[str, float]  # [SI]
    units: Mapping[str, str]  # Of the values, by name
    intervals: Mapping[str, tuple[float, float]]
    """95 %, with the systematic errors that the bench file does not exclude."""
    model: str  # Of the best one: the plant and what was added to it
    fits: bool  # The residuals do not speak against it
    ratio: float  # Mean square of the residuals in standard deviations of the noise at rest
    command_delay: int  # [samples]
    measurement_delay: int  # [samples]
    current_lag: tuple[float, float]
    """Interval of the current loop's time constant [s]; zeros where the logs ask for none."""
    features: Mapping[str, float]  # Features beyond eq. 3.12-3.14 that the model needed, by name [SI].
    jitter: float  # Standard deviation of the instants of sampling, by residuals that grow with the speed [s]
    noise: Noise  # Standard deviations of the residuals where the brake is slow, beyond what jitter explains
    contact: tuple[float, float]  # Interval of the encoder's reading at the origin [rad]
    objections: tuple[str, ...] = ()  # Alarms of the tests on the residuals, and what would explain them


class Examiner(Protocol):
    """Reads logs; made by another package, since the bench computer need not have an estimator."""

    def rest(self, log: Path) -> Rest:
        """Findings of a listen-only log."""
        ...

    def current(self, log: Path) -> CurrentCheck:
        """Findings about the current."""
        ...

    def first_move(self, log: Path, noise: Noise) -> FirstMove:
        """Findings of the first move."""
        ...

    def identify(
        self, logs: Sequence[Path], sheet: Bench, noise: Noise, before: Identification | None
    ) -> Identification:
        """Parameters from experiments, for ranges and errors of a data sheet and the noise at rest.

        The model that was found before is begun with.
        """
        ...

    def ended(self, log: Path) -> str:
        """Reason why a run ended, ``DONE`` if it was completed; empty for a log that is not whole."""
        ...
