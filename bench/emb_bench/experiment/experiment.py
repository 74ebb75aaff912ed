"""One experiment as arrays: the applied current in each sampling period, and the sample at its end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum, auto
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.plants import Plant
from emb_runtime.errors import UsageError

REST_SIGMAS = 4.0
"""Standard deviations within which a mean counts as zero: rest at the origin."""

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Booleans = NDArray[np.bool_]


class Lack(Enum):
    """Missing or uncertain part of an experiment; the comments name the numbers in ``Quality.lacks``."""

    ENDS_EARLY = auto()  # Periods, and planned periods
    LOST = auto()  # Samples; the currents before them were not reported
    LOST_WITH_CHARGE = auto()  # Samples, and periods whose current follows from the charge
    CONTRADICTED = auto()  # Periods whose reported current differs from the command
    NO_COUNTERS = auto()
    NO_VELOCITY = auto()  # Bandwidth of the observer in its place [rad/s]
    NO_CURRENT = auto()
    NO_COMMANDS = auto()
    NO_TIMES = auto()
    LOST_OF_RECORDING = auto()  # Samples
    HEAD = auto()  # Line of the head in a file
    OTHER_FRAMES = auto()  # CAN frames that were skipped, and their identifiers
    BAD_FRAMES = auto()  # CAN frames that do not fit the DBC


@dataclass(frozen=True)
class Quality:
    """Facts about an experiment besides its samples, from its log."""

    planned: int = 0  # Planned periods of the run
    braked: int = 0  # Periods in which the node braked, because no command came in time
    command_delay: int = 0  # Samples by which commands acted late, by the node's reports
    lacks: Mapping[Lack, tuple[float, ...]] = field(default_factory=dict)  # With the numbers that belong to each
    faults: tuple[str, ...] = ()  # Contradictions of a recording to its map, in words
    within: float | None = None
    """For a mapped drive: largest difference of command and report at which the command is used [A]; NaN if its
    mapping is not readable, so that the report is used; None for other nodes."""


@dataclass(frozen=True, eq=False)
class Experiment:
    """An experiment of n sampling periods; period k lies between the samples k and k + 1, k = 0, ..., n - 1."""

    name: str
    currents: Floats  # Applied current in each period, reported or assumed [A], shape (n,)
    samples: Floats  # Samples 1 to n: angle [rad], velocity [rad/s], NaN where lost, shape (n, 2)
    angle: float  # Angle measured before the experiment [rad]
    velocity: float  # Velocity measured before the experiment [rad/s]; 0 if the brake rested
    slack: float  # Standard deviation of ``angle`` [rad]; 0 if unavailable
    from_origin: bool  # True if the start cannot be distinguished from rest at the origin
    late: Floats | None = None
    """Lateness of each sample after the grid, by the node's stamps [s], shape (n,); None without stamps."""
    assumed: Floats | None = None
    """Assumed current of periods without report, NaN for the others [A], shape (n,); None without such gaps.
    ``currents`` has the same value, or an estimated one."""
    places: Floats | None = None
    """Estimated angle [rad] and velocity [rad/s] after each gap of several periods, shape (gaps, 2); None before an
    estimate."""
    before: float = 0.0  # Current that acted before the first period [A]
    outliers: int = 0  # Samples removed as outliers
    first: tuple[float, float] = (np.nan, np.nan)  # Sample 0: angle [rad], velocity [rad/s]; NaN where it was lost
    quality: Quality = Quality()

    @property
    def periods(self) -> int:
        """The number n of sampling periods."""
        return len(self.currents)

    @property
    def all_samples(self) -> Floats:
        """Samples 0 to n: angle [rad] and velocity [rad/s], NaN where lost, shape (n + 1, 2)."""
        return np.vstack([[self.first], self.samples])

    @property
    def measured(self) -> Booleans:
        """True for each of the samples 1 to n that was received, shape (n,)."""
        return np.isfinite(self.samples[:, 0]) & np.isfinite(self.samples[:, 1])

    @property
    def reported(self) -> Booleans:
        """True for each period with a reported current, shape (n,)."""
        return np.ones(self.periods, np.bool_) if self.assumed is None else np.isnan(self.assumed)

    @cached_property
    def gaps(self) -> tuple[Integers, Integers]:
        """Periods without a reported current: single ones, and the last ones of several in a row."""
        lost = np.zeros(self.periods + 2, np.bool_)
        lost[1:-1] = ~self.reported
        ends = lost[1:-1] & ~lost[2:]
        return np.flatnonzero(ends & ~lost[:-2]), np.flatnonzero(ends & lost[:-2])

    @cached_property
    def inside(self) -> Booleans:
        """True for each period at whose end the brake is inside a gap of several, shape (n,)."""
        lost = ~self.reported
        result: Booleans = lost & np.append(lost[1:], False)
        return result

    @property
    def gap_unknowns(self) -> int:
        """Number of unknowns of the gaps: a current for a single period, an angle and a velocity after a longer gap."""
        return len(self.gaps[0]) + 2 * len(self.gaps[1])

    def x0(self, encoder_offset: float = 0.0) -> tuple[float, float]:
        """True angle [rad] and velocity [rad/s] at sample 0; an angle that may be the origin is set to it."""
        angle = self.angle - encoder_offset
        return (0.0 if abs(angle) <= REST_SIGMAS * self.slack else angle), self.velocity

    def seen_by(self, plant: Plant) -> Experiment:
        """The experiment for a plant; its encoder offset determines whether the start may be rest at the origin."""
        return replace(self, from_origin=self.x0(plant.instruments.encoder_offset) == (0.0, 0.0))

    def start(self, offset: float) -> tuple[float, float]:
        """True angle [rad] and velocity [rad/s] at sample 0, for an encoder that reads ``offset`` at the origin."""
        return (0.0 if self.from_origin else self.angle - offset), self.velocity

    def lose(self, mask: Booleans) -> Experiment:
        """The experiment without the samples of a mask, shape (n,), as outliers; the currents stay."""
        samples = np.where(mask[:, None], np.nan, self.samples)
        return replace(self, samples=samples, outliers=self.outliers + int(mask.sum()))

    def until(self, n: int) -> Experiment:
        """The first ``n`` periods."""
        late, assumed = (None if row is None else row[:n] for row in (self.late, self.assumed))
        cut = replace(self, currents=self.currents[:n], samples=self.samples[:n], late=late, assumed=assumed)
        return cut if self.places is None else replace(cut, places=self.places[: len(cut.gaps[1])])

    def from_state(self, angle: float, velocity: float) -> Experiment:
        """The experiment with another state at sample 0 [rad, rad/s]; data on the old state are removed."""
        return replace(self, angle=angle, velocity=velocity, slack=0.0, from_origin=False, places=None)

    def part(self, begin: int, end: int) -> Experiment:
        """The periods from ``begin`` to ``end``, which start at the sample measured before them."""
        cut = self.until(end)
        if begin == 0:
            return cut
        angle, velocity = self.samples[begin - 1].tolist()
        late, assumed = (None if row is None else row[begin:] for row in (cut.late, cut.assumed))
        return replace(
            cut.from_state(angle, velocity),
            currents=cut.currents[begin:],
            samples=cut.samples[begin:],
            late=late,
            assumed=assumed,
            before=float(self.currents[begin - 1]),
            first=(angle, velocity),
        )

    def split(self, length: int) -> Iterator[Experiment]:
        """The experiment in parts of at most ``length`` periods."""
        for begin in range(0, self.periods, length):
            yield self.part(begin, begin + length)


def planned(currents: Sequence[float] | Floats, offset: float = 0.0) -> Experiment:
    """A planned experiment: currents [A] of its periods, from rest at the origin, without samples.

    The encoder reads ``offset`` at the origin [rad].
    """
    try:
        row = np.asarray(currents, dtype=np.float64)
    except (TypeError, ValueError) as err:
        raise UsageError(f"expected currents [A] as numbers: {err}") from err
    if row.ndim != 1:
        raise UsageError(f"expected one row of currents, got an array of shape {row.shape}")
    if not np.isfinite(row).all():
        k = int(np.argmin(np.isfinite(row)))
        raise UsageError(f"expected finite currents, got {row[k]} at step {k}")
    return Experiment("planned", row, np.full((len(row), 2), np.nan), offset, 0.0, 0.0, True)
