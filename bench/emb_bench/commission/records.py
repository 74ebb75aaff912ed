"""Findings of a commissioning: what the logs of its steps show, and what contradicts the data sheet there.

The first contradiction ends the commissioning. Comparisons are this way round for NaN.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from emb_bench.brake.parameters import SI
from emb_bench.config.bench import Bench
from emb_runtime.config.bench import Noise, Sensors
from emb_runtime.errors import BenchFileError, EmbError, SafetyStopError
from emb_runtime.numbers import between, in_percent, plain

SCALE_ERROR = 0.2  # By which reported and commanded current, or angle and velocity, may differ in scale
LAG_ERROR = 0.05  # By which the time constant of the current loop may exceed the data sheet's
NOISE_EXCESS = 1.1  # Noise at rest over the data sheet's, at most: 1000 samples tell a deviation to 3 %
AT_REST = 8.0  # Standard deviations of the angle's noise within which the brake has not moved
AT_BORDER = 0.1  # Distance from a border of the data sheet, as a share of it, within which a parameter is suspected
NEARLY = 1.5  # Mean square of the residuals, in variances of the noise at rest, up to which a model almost fits
AGAIN = "and begin again in another folder"


def noise_problems(noise: Noise, sheet: Bench) -> Iterator[EmbError]:
    """More noise at rest than the data sheet's."""
    for name, unit in (("angle", "rad"), ("velocity", "rad/s")):
        got, most = getattr(noise, name), getattr(sheet.noise, name)
        if not got <= NOISE_EXCESS * most:
            yield SafetyStopError(
                f"the {name} scatters by {plain(got)} {unit} at rest, the data sheet's bench file has {plain(most)}, "
                f"and the shield would allow for too little: wait until the brake rests, or correct noise.{name} "
                f"{AGAIN}"
            )


def late_problems(late: int, words: str, sheet: Bench) -> Iterator[EmbError]:
    """Answers that act later than the data sheet's shield allows for [samples]."""
    if late > (allowed := sheet.shield.frame_age[1]):
        allows = f"the data sheet's bench file allows for {allowed}: correct shield.frame_age"
        yield SafetyStopError(f"{words}, and {allows} {AGAIN}")


@dataclass(frozen=True)
class CurrentCheck:
    """Reported against commanded current."""

    delay: int  # Samples by which commands act late, by the node's reports
    latest: int  # The same, at most: of a drive that does not report which command it obeyed, a sample more
    scale: float  # Reported current over commanded one
    moved: float  # Farthest from the angle at the start [rad]

    def __str__(self) -> str:
        return f"commands {self.delay} samples late, current times {self.scale:.4f}"

    def problems(self, sheet: Bench) -> Iterator[EmbError]:
        """A current of a wrong sign or scale, a motion, late commands."""
        if not abs(self.scale - 1.0) <= SCALE_ERROR:
            yield SafetyStopError(
                f"the drive reports {plain(self.scale)} A for 1 A commanded: sign or scale of its current is wrong"
            )
        if not self.moved <= AT_REST * sheet.noise.angle:
            yield SafetyStopError(
                f"the brake moved by {plain(self.moved)} rad under a current that moves no brake of the data sheet: "
                f"friction is lower or the motor stronger (T_c and k_m in [ranges.{sheet.shield.ranges}]), or "
                "something else turns it"
            )
        yield from late_problems(self.delay, f"commands act {self.delay} samples late", sheet)


@dataclass(frozen=True)
class FirstMove:
    """Currents of the first move."""

    up: float  # Current at which the brake began to move in the positive direction [A]; NaN if it did not
    down: float  # Size of the current at which it began to move in the negative direction [A]; NaN if it did not
    scale: float  # Angle travelled over the integral of the velocity

    def __str__(self) -> str:
        return f"moves at {self.up:.3f} A and {-self.down:.3f} A, angle over velocity {self.scale:.3f}"

    def problems(self, sheet: Bench) -> Iterator[EmbError]:
        """A brake that did not move, an angle that is not the velocity's integral."""
        if not (math.isfinite(self.up) and math.isfinite(self.down)):
            yield SafetyStopError(
                "the brake did not move under a current that moves every brake of the data sheet: it is blocked or not "
                "connected, or friction is greater or the motor weaker "
                f"(T_c and k_m in [ranges.{sheet.shield.ranges}], shield.break_away)"
            )
        if not abs(self.scale - 1.0) <= SCALE_ERROR:
            yield SafetyStopError(
                f"the angle travels {plain(self.scale)} times as far as by the velocity: a sign or scale of a sensor "
                "is wrong"
            )


@dataclass(frozen=True)
class Velocity:
    """Origin of the velocity: a sensor, unless a loop that derives it from the angle has a bandwidth."""

    bandwidth: float = 0.0  # Of the loop that is nearest [rad/s]
    least: float = 0.0  # Least bandwidth of the loop, which is declared [rad/s]
    most: float = 0.0  # Greatest bandwidth of the loop [rad/s]

    @property
    def sensors(self) -> Sensors:
        """As a bench file declares it."""
        return Sensors("observer", self.least) if self.least else Sensors()

    def __str__(self) -> str:
        if not self.least:
            return "a sensor's"
        return f"an observer's, bandwidth {self.bandwidth:.0f} rad/s, at least {self.least:.0f} rad/s"

    def problems(self, declared: Sensors) -> Iterator[EmbError]:
        """An observer that is slower than the declared one."""
        if self.least and not self.most >= (declared.bandwidth or math.inf):
            yield SafetyStopError(
                f'the velocity is {self}, and the bench file declares {declared}: declare velocity = "observer" and '
                f"observer_bandwidth = {self.least:.0f} in [sensors] {AGAIN}"
            )


@dataclass(frozen=True)
class Identification:
    """Parameters from the experiments so far."""

    values: Mapping[str, float]  # [SI]
    intervals: Mapping[str, tuple[float, float]]
    """Total (95 %) without the errors of J and of the angle's scale, which the shield shares."""
    halves: Mapping[str, tuple[float, float]]  # Repeatability and total, as shares of the value
    model: str  # Plant of the best model, with the added features
    fits: bool  # The residuals do not contradict the model
    ratio: float  # Mean square of the residuals, in variances of the noise at rest
    command_delay: int  # [samples]
    measurement_delay: int  # [samples]
    current_lag: tuple[float, float]  # Interval of the current loop's time constant [s]; zeros where none is needed
    features: Mapping[str, float]  # Features beyond eq. 3.12-3.14 that the model needed, by name [SI]
    noise: Noise  # Standard deviations of the residuals of slow motion
    velocity: Velocity = Velocity()
    objections: tuple[str, ...] = ()  # Alarms of the tests on the residuals, and their possible causes

    def __str__(self) -> str:
        found = [
            f"{name} {plain(self.values[name], 5)} {SI[name]} ± {in_percent(repeatability)} (± {in_percent(total)})"
            for name, (repeatability, total) in self.halves.items()
        ]
        misfit = "" if self.fits else f", which does not fit yet{self.reasons()}"
        result = f"± repeatability (± total), 95 %, k=2: {', '.join(found)}; model {self.model}{misfit}"
        return f"{result}; the velocity is {self.velocity}"

    def reasons(self) -> str:
        """Objections in brackets; "" without any."""
        return f" ({'; '.join(self.objections)})" if self.objections else ""

    def outside(self, sheet: Bench) -> list[str]:
        """Parameters whose interval and the data sheet's range have nothing in common."""
        ranges = {name: sheet_range(sheet, name) for name in self.intervals}
        return [n for n, (low, high) in self.intervals.items() if high < ranges[n][0] or low > ranges[n][1]]

    def not_inside(self, sheet: Bench, margin: float = 0.0) -> list[str]:
        """Parameters without an interval inside of the data sheet's range less a share of each border."""
        found = []
        for name, (low, high) in self.intervals.items():
            lowest, highest = sheet_range(sheet, name)
            if not ((1.0 + margin) * lowest <= low and high <= (1.0 - margin) * highest):
                found.append(name)
        return found

    def contradiction(self, sheet: Bench, names: Sequence[str]) -> str:
        """Words for parameters that may lie outside of the data sheet's ranges, with the remedy."""
        values = []
        for name in names:
            lowest, highest = (plain(end, 5) for end in sheet_range(sheet, name))
            values.append(f"{name} is {between(*self.intervals[name])} {SI[name]} (data sheet {lowest} to {highest})")
        return (
            f"by the estimate {' and '.join(values)}: widen {', '.join(names)} in [ranges.{sheet.shield.ranges}] of "
            f"the data sheet's bench file {AGAIN}"
        )

    def problems(self, sheet: Bench, *, is_first: bool) -> Iterator[EmbError]:
        """A parameter outside of its range; a delay or a lag beyond the data sheet's.

        The first estimate of a model that only almost fits does not count: a single small experiment does not tell
        features of the friction apart. Of such a model, another constant may be wrong too.
        """
        if names := self.outside(sheet):
            words = self.contradiction(sheet, names)
            if self.fits:
                yield BenchFileError(words)
            elif not is_first and self.ratio <= NEARLY:
                yield SafetyStopError("; or ".join((words, *self.objections)))
        late = self.command_delay + self.measurement_delay
        delays = f"{self.command_delay} of the command, {self.measurement_delay} of the measurement"
        yield from late_problems(late, f"answers act {late} samples late ({delays})", sheet)
        if self.fits and self.current_lag[0] > (1.0 + LAG_ERROR) * sheet.shield.current_lag:
            yield SafetyStopError(
                f"the current lags by {plain(self.current_lag[0])} s at least, and the data sheet's bench file allows "
                f"for {sheet.shield.current_lag:g} s: correct shield.current_lag {AGAIN}"
            )

    def changes(self, bench: Bench) -> Iterator[EmbError]:
        """Parameters outside of the ranges in the bench file that was found before."""
        for name, (low, high) in self.intervals.items() if self.fits else ():
            lowest, highest = sheet_range(bench, name)
            if not (high >= lowest and low <= highest):
                yield SafetyStopError(
                    f"by the run with the bench file that was found {name} is {between(low, high)} {SI[name]}, in the "
                    f"file {plain(lowest, 4)} to {plain(highest, 4)}: the brake is not that of the steps before, or "
                    "changes"
                )


@dataclass(frozen=True)
class Findings:
    """Findings of all steps, from which a bench file is made."""

    noise: Noise  # At rest, standard deviations
    current: CurrentCheck
    first_move: FirstMove
    identified: Identification  # From the last experiments with the data sheet's ranges


def sheet_range(bench: Bench, name: str) -> tuple[float, float]:
    """Range of a parameter in the set of a bench's shield."""
    ends = bench.range_set(bench.shield.ranges)
    return getattr(ends.low, name), getattr(ends.high, name)


def suspected(sheet: Bench, one: Identification | None) -> str:
    """Words for the numbers of a data sheet to check, where no brake of its set moves as this one does."""
    others = (
        "J and gamma of [brake], at break_away, f_l, current_lag and frame_age of [shield], and whether the brake "
        "turns freely"
    )
    if one is None:
        return f"no parameter was found yet: look at all of [ranges.{sheet.shield.ranges}] first, then at {others}"
    if names := one.not_inside(sheet, AT_BORDER):
        return f"{one.contradiction(sheet, names)}; or look at {others}"
    return f"no parameter that was found lies near a border of [ranges.{sheet.shield.ranges}]: look at {others}"
