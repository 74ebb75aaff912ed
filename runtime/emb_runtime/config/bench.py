"""The one description of the bench: ``bench.toml`` as frozen, checked records.

Training draws from its ranges, the runtime takes its limits, the node its plant, the replay its nominal values.
:attr:`Bench.identity_hash` is what the node reports and each log has: both sides have the same bench.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

from msgspec import Meta

from emb_runtime.config.typed import MAX_TOML_BYTES, FieldError, NotNegative, Positive, parse_toml, read
from emb_runtime.errors import BenchFileError, near
from emb_runtime.system.input_file import read_text

# Hard ceilings: a bench file can narrow them, never widen them.
CEILING_CURRENT = 6.0  # A
CEILING_ANGLE = (-10.0, 100.0)  # rad
CEILING_VELOCITY = 500.0  # rad/s
CEILING_MISSED = 400  # periods
CEILING_REJECTED = 100  # frames
CEILING_NODE_WATCHDOG = 0.5  # s
CEILING_HEARTBEAT = 0.5  # s
CEILINGS = CEILING_CURRENT, CEILING_ANGLE, CEILING_VELOCITY
OLDEST_FRAME = 5  # samples
HIGHEST_BUS_LOAD = 0.8  # Beyond it, at worst-case bit stuffing, frames wait for each other
FAR = 1e9  # of a machine that is never driven, in SI units
SHORTEST_SAMPLE = 1e-4  # s
PER_LAG = 0.9
"""Bandwidth of the second order that covers an observer, times the lag of that observer: L13 of the shield."""
LONGEST_PER_BANDWIDTH = 2.25  # Longest lag of an observer, and twice what its response overshoots, times its bandwidth
FASTEST_OBSERVER = 3.0
"""Bandwidth times sample time beyond which a sampled observer lags no less: it begins with two angles."""

# Ceilings of what is armed on a bus with a brake; up to those above, a file can be read and a bus without one driven.
LONGEST_MISSED = 20  # periods
LONGEST_REJECTED = 5  # frames
LONGEST_NODE_WATCHDOG = 0.010  # s
LONGEST_HEARTBEAT = 0.005  # s

ANALYSIS = ("budgets", "plants", "machine")  # Tables that only simulation and analysis read

FASTEST = 10.0  # No time constant of a brake is shorter than the sample time over this
REMEDY = "add it, as in the file that `emb-run --write-bench FILE` writes"

ParameterName = Literal["k_m", "k_1", "T_c", "f_v"]
PARAMETER_NAMES = get_args(ParameterName)  # The parameters that are identified, in the thesis's order (eq. 4.3).

Bitrate = Annotated[int, Meta(ge=125_000, le=1_000_000)]
Age = Annotated[int, Meta(ge=0, le=OLDEST_FRAME)]
Bandwidth = Annotated[float, Meta(gt=0, le=1e6)]  # [rad/s]
Lag = Annotated[float, Meta(gt=0, le=0.1)]  # [s]


class BrakeParameters(NamedTuple):
    """Parameters of the simplified brake (thesis eq. 3.12-3.14). A named tuple of floats, so that numba takes it."""

    J: Positive  # Lumped inertia [kg·m²]
    gamma: Positive  # Gear ratio from motor angle to clamping travel [m]
    k_m: Positive  # Motor constant [N·m/A]
    k_1: Annotated[float, Meta(ge=0)]  # Stiffness [N/rad]; 0, no spring, goes with [machine] only
    T_c: Positive  # Coulomb friction torque [N·m]
    f_v: Positive  # Viscous friction coefficient [N·m·s/rad]


@dataclass(frozen=True)
class Ranges:
    """A box of brakes: the lowest and the highest value of each parameter."""

    name: str
    low: BrakeParameters
    high: BrakeParameters

    def uncovered(self, low: BrakeParameters, high: BrakeParameters) -> tuple[str, ...]:
        """Names of the parameters in which brakes from ``low`` to ``high`` reach beyond this box (borders are in)."""
        return tuple(
            n for n, a, lo, b, hi in zip(low._fields, self.low, low, self.high, high, strict=True) if lo < a or hi > b
        )


@dataclass(frozen=True)
class Limits:
    """Limits of the brake's state and of the command."""

    current: Positive  # Largest command, both signs [A]
    angle: tuple[float, float]  # Lowest and highest angle [rad]
    velocity: Positive  # Largest speed, both signs [rad/s]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the sensors, white and Gaussian (thesis section 4.1)."""

    angle: Positive  # [rad]
    velocity: Positive  # [rad/s]


@dataclass(frozen=True)
class Sensors:
    """Origin of the measured velocity: an observer derives it from the angle, where it is not measured."""

    velocity: Literal["sensor", "observer"] = "sensor"
    observer_bandwidth: Bandwidth | None = None
    """Least bandwidth of an observer of second order with a damping from 0.7 to 1 [rad/s]"""
    velocity_lag: Lag | None = None
    """Longest lag of an observer that no bandwidth describes [s]"""

    @property
    def bandwidth(self) -> float | None:
        """Least bandwidth of an observer of second order that covers the declared one [rad/s]; None of a sensor."""
        return self.observer_bandwidth if self.velocity_lag is None else PER_LAG / self.velocity_lag

    def longest_lag(self, sample_time: float) -> float:
        """Change of the velocity that is not shown yet, at most, over the acceleration that it is due to [s]."""
        if self.bandwidth is None:
            return 0.0
        return LONGEST_PER_BANDWIDTH / min(self.bandwidth, FASTEST_OBSERVER / sample_time)

    def __str__(self) -> str:
        if self.velocity_lag is not None:
            return f"an observer's, {self.velocity_lag * 1e3:g} ms late at most"
        return (
            "a sensor's"
            if self.velocity == "sensor"
            else f"an observer's, with a bandwidth of at least {self.bandwidth:g} rad/s"
        )


@dataclass(frozen=True)
class Timing:
    """The experiment's time grid."""

    sample_time: Annotated[float, Meta(ge=SHORTEST_SAMPLE, le=0.1)]  # [s]
    horizon: Annotated[int, Meta(ge=1, le=1_000_000)]  # Samples in one experiment

    @property
    def sample_time_ns(self) -> int:
        """The sample time in nanoseconds."""
        return round(self.sample_time * 1e9)

    @property
    def duration(self) -> float:
        """Duration of one experiment [s]."""
        return self.horizon * self.sample_time


class Shield(NamedTuple):
    """Assumptions of the envelope shield, see :mod:`emb_runtime.safety.shield`."""

    ranges: str  # Name of the set of brakes for which the limits are guaranteed
    frame_age: tuple[Age, Age]  # Least and most samples between a measurement and the period in which its answer acts
    noise_sigmas: Annotated[float, Meta(ge=1, le=10)]  # Largest measurement error, in standard deviations
    angle_margin: Annotated[float, Meta(ge=0.02, le=5)]  # Kept from the angle limits [rad]
    home_angle: Annotated[float, Meta(gt=0, le=10)]  # |angle| that counts as home [rad]
    home_velocity: Annotated[float, Meta(gt=0, le=50)]  # |velocity| that counts as home [rad/s]
    envelope: Literal["braking", "coasting"] = "braking"  # What keeps the limits when no more commands come
    current_lag: Annotated[float, Meta(ge=0, le=0.1)] = 0.0  # Largest time constant of the current loop [s]
    break_away: Annotated[float, Meta(ge=1, le=5)] = 1.0  # Largest T_s0 / T_c (eq. 3.5)
    f_l: Annotated[float, Meta(ge=0, le=1e-4)] = 0.0  # Largest load-dependent friction, T_s = T_s0 + f_l F_cl [m]


@dataclass(frozen=True)
class Estimator:
    """The running estimate."""

    ranges: str  # Name of the set of brakes that it begins with


@dataclass(frozen=True)
class Watch:
    """Time-outs and counts after which the runtime stops by itself."""

    soft_missed: Annotated[int, Meta(ge=1, le=CEILING_MISSED)]  # Periods in a row without a valid pair: reported
    stop_missed: Annotated[int, Meta(ge=1, le=CEILING_MISSED)]  # Periods in a row without a valid pair: a stop
    rejected: Annotated[int, Meta(ge=1, le=CEILING_REJECTED)]  # Leaky count of rejected frames that stops the run
    start_timeout: Annotated[float, Meta(gt=0, le=60)]  # Time to wait for a first valid sensor pair [s]
    heartbeat: Positive
    """Time without a sign of life from the loop until the watchdog process sends the stop frames [s]"""


@dataclass(frozen=True)
class GuardLimits:
    """Bounds of the guard, besides :class:`Limits`."""

    slew: Positive  # Fastest change from one command to the next [A/s]
    current_error: Annotated[float, Meta(gt=0, le=2 * CEILING_CURRENT)]
    """By which a reported current may lie outside the last ones commanded [A]"""


@dataclass(frozen=True)
class Node:
    """Safe stop and time-outs of the node that drives the motor."""

    watchdog: Positive  # Time without a fresh, valid, enabled command until the safe stop latches [s]
    stop: Literal["damped", "freewheel"]
    damping_velocity: Annotated[float, Meta(ge=50, le=200)]
    """Speed above which the damped stop brakes with the full current [rad/s]"""


@dataclass(frozen=True)
class Can:
    """The bus."""

    bitrate: Bitrate  # Of the node's bus; that of a mapped drive is in its mapping file [bit/s]
    mapping: Annotated[str, Meta(pattern="^[0-9a-f]{64}$", description="a SHA-256, 64 digits in lower case")] = ""
    """SHA-256 of the mapping of a drive, and its DBC: no other one is taken then. Empty where the file names none."""


@dataclass(frozen=True)
class SensorErrors:
    """Errors of sensors and time grid. Most records determine them better than their priors: they are estimated too."""

    offset: NotNegative = 0.05  # Reading of the encoder at the true origin [rad]
    current_offset: NotNegative = 0.05
    """Current that acts beyond what the node reports; a friction that depends on the direction looks the same [A]."""
    delay: NotNegative = 0.3  # By which commands act late, or samples early [samples]
    velocity_gain: NotNegative = 0.02  # Relative error of the velocity's scale


@dataclass(frozen=True)
class SharedErrors(SensorErrors):
    """And errors that no record determines: each adds to the totals with its prior."""

    k_m: Positive | None = None  # Relative error of k_m in [brake], where it was measured; J is then estimated
    inertia: NotNegative = 0.01  # Relative error of J, which all four parameters share
    angle_scale: NotNegative = 0.003  # Relative error of the angle's scale, which k_m and T_c share
    current_scale: NotNegative = 0.0  # Relative error of the current's scale, where k_m is meant per true ampere
    time_scale: NotNegative = 1e-5  # Relative error of the node's clock, which all four parameters share
    held: NotNegative = 0.02  # Relative error of each parameter that is held at its nominal value


@dataclass(frozen=True)
class Systematic(SharedErrors):
    """Systematic errors that a bench cannot exclude by itself: ``[systematic]``; last, effects that the plant lacks.

    Standard deviations of Gaussian priors, with mean zero or the plant's value. 0 excludes an error.
    """

    quadratic: NotNegative = 1e-4  # Quadratic share of the stiffness that the plant lacks [1/rad]
    cubic: NotNegative = 1e-6  # Cubic share of the stiffness that the plant lacks [1/rad²]
    hysteresis: NotNegative = 1e-2  # Hysteresis of the clamping force that the plant lacks
    play: NotNegative = 0.2  # Clearance in the gear [rad]
    break_away: NotNegative = 0.1  # Static friction beyond the plant's, as a share of T_c
    f_l: NotNegative = 1e-7  # Load-dependent static friction beyond the plant's [m]
    current_lag: NotNegative = 5e-4  # Time constant of the current loop beyond the plant's [s]
    slow_friction: NotNegative = 0.1  # Friction that decays over 100 or 200 rad/s, as a share of T_c
    drag: NotNegative = 0.1  # Share by which f_v is larger at the limit of the velocity
    ripple: NotNegative = 0.1  # Torque that changes once a turn of the motor, as a share of T_c
    stiffness_ripple: NotNegative = 0.003  # Share of the stiffness that changes once a turn of the motor
    current_gain: NotNegative = 0.01  # Share by which k_m is larger at the limit of the current
    dead_current: NotNegative = 0.01  # Current by which less acts than the node reports, in either direction [A]
    drift: NotNegative = 0.003  # Change of each parameter from the start of a run to its end, as a share of it


@dataclass(frozen=True, kw_only=True)
class _Tables:
    """Tables of a bench file that are records as they stand."""

    name: str
    brake: BrakeParameters
    limits: Limits
    noise: Noise
    timing: Timing
    shield: Shield
    watch: Watch
    guard: GuardLimits
    node: Node
    can: Can
    systematic: Systematic = Systematic()
    sensors: Sensors = Sensors()


@dataclass(frozen=True, kw_only=True)
class _Document(_Tables):
    """A bench file as it stands."""

    schema: Literal[1]
    ranges: dict[str, dict[ParameterName, tuple[Positive, Positive]]]
    estimator: Estimator | None = None
    budgets: Any = None
    plants: Any = None
    machine: Any = None


@dataclass(frozen=True, kw_only=True)
class Bench(_Tables):
    """One bench: its file as records."""

    ranges: Mapping[str, Ranges]
    prior: str  # Name of the set of ranges that the running estimate begins with; the shield's where none is named
    text: str  # The file as it was read: it goes into the log, so that the log replays alone
    tables: Mapping[str, Any]  # Tables of ANALYSIS as they stand, which :mod:`emb_bench.config` reads

    def range_set(self, name: str) -> Ranges:
        """The named set of uncertain parameters; BenchFileError if there is none.

        "nominal", where nothing is uncertain, is always there.
        """
        try:
            return self.ranges[name]
        except KeyError:
            if name == "nominal":
                return Ranges(name, self.brake, self.brake)
            names = ", ".join(sorted(self.ranges))
            raise BenchFileError(
                f"no set of ranges is called '{name}'; this bench has: {names}{near(name, self.ranges)}"
            ) from None

    def refuse_long_timeouts(self) -> None:
        """Raise BenchFileError for a time-out or count beyond those with which a brake is driven."""
        for name, value, longest in (
            ("watch.stop_missed", self.watch.stop_missed, LONGEST_MISSED),
            ("watch.rejected", self.watch.rejected, LONGEST_REJECTED),
            ("watch.heartbeat", self.watch.heartbeat, LONGEST_HEARTBEAT),
            ("node.watchdog", self.node.watchdog, LONGEST_NODE_WATCHDOG),
        ):
            if value > longest:
                raise BenchFileError(
                    f"{name}: expected at most {longest:g}, got {value:g}: a time-out can be tightened only; on a bus "
                    "without a brake, --long-timeouts accepts it"
                )

    @property
    def identity_hash(self) -> str:
        """SHA-256 of what node and runtime must agree on: brake, ranges, limits, noise, timing, shield.

        And of the drive's mapping and the observer where they are declared; not of the time-outs.
        """
        record: dict[str, Any] = {
            "brake": self.brake._asdict(),
            "ranges": {k: [v.low._asdict(), v.high._asdict()] for k, v in self.ranges.items()},
            "limits": asdict(self.limits),
            "noise": asdict(self.noise),
            "timing": asdict(self.timing),
            "shield": self.shield._asdict(),
        }
        if self.can.mapping:
            record["mapping"] = self.can.mapping
        if self.sensors.velocity == "observer":
            record["sensors"] = asdict(self.sensors)
        return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def shipped_bench_text() -> str:
    """The text of the shipped ``bench.toml``."""
    return resources.files("emb_runtime.config").joinpath("bench.toml").read_text(encoding="utf-8")


def load_bench(path: str | Path | None = None) -> Bench:
    """Read a bench file; without a path, the shipped one.

    Raises:
        BenchFileError: the file cannot be read, or a key is unknown, of the wrong type, not finite,
            beyond a ceiling, or contradictory. The message has the file, the key and the reason.
    """
    return parse_bench(*read_bench_text(path))


def read_bench_text(path: str | Path | None = None) -> tuple[str, str]:
    """Text of a bench file, of the shipped one without a path, and its name; BenchFileError if it cannot be read."""
    if path is None:
        return shipped_bench_text(), "shipped bench.toml"
    try:
        return read_text(path, MAX_TOML_BYTES), str(path)
    except (OSError, UnicodeDecodeError) as err:
        reason = err.strerror if isinstance(err, OSError) else "not UTF-8 text"
        raise BenchFileError(f"{path}: cannot read the bench file: {reason}") from err


def parse_bench(text: str, source: str) -> Bench:
    """Checked records of the text of a bench file; BenchFileError calls it ``source``."""
    document = parse_toml(text, source, BenchFileError)
    if "machine" in document:
        reason = "a machine for the analysis of recordings: nothing is driven or designed with it"
        raise BenchFileError(f"{source}: machine: {reason}")
    return checked_bench(document, text, source)


def checked_bench(document: Mapping[str, Any], text: str, source: str, *, driven: bool = True) -> Bench:
    """The records of a bench file's tables, with the text in which they stand; BenchFileError calls it ``source``.

    A machine that is not ``driven`` is only analysed: the ceilings do not hold, and there may be no spring.
    """
    found = read(_Document, document, source, BenchFileError, remedy=REMEDY)
    try:
        bench = Bench(
            **{field.name: getattr(found, field.name) for field in fields(_Tables)},
            ranges={name: _ranges(name, table, found.brake) for name, table in found.ranges.items()},
            prior=found.shield.ranges if found.estimator is None else found.estimator.ranges,
            text=text,
            tables={key: document[key] for key in ANALYSIS if key in document},
        )
        for key, reason in (*_limit_problems(bench, driven), *_setting_problems(bench, driven)):
            raise FieldError(key, reason)
    except FieldError as err:
        raise BenchFileError(f"{source}: {err.key}: {err}") from err
    return bench


def _ranges(name: str, table: Mapping[ParameterName, tuple[float, float]], brake: BrakeParameters) -> Ranges:
    for parameter, pair in table.items():
        _check_pair(f"ranges.{name}.{parameter}", pair)
    low, high = ({parameter: pair[end] for parameter, pair in table.items()} for end in (0, 1))
    return Ranges(name, brake._replace(**low), brake._replace(**high))


def _check_pair(key: str, pair: tuple[float, float]) -> None:
    if pair[0] > pair[1]:
        raise FieldError(key, f"the lower value {pair[0]:g} is above the upper {pair[1]:g}")


def _limit_problems(bench: Bench, driven: bool) -> Iterator[tuple[str, str]]:
    """Keys of the brake and its limits that are beyond a ceiling or contradict each other, and why."""
    limits = bench.limits
    _check_pair("limits.angle", limits.angle)
    if driven and bench.brake.k_1 == 0.0:
        yield "brake.k_1", "expected a positive number, got 0"
    current, angle, velocity = CEILINGS if driven else (FAR, (-FAR, FAR), FAR)
    if limits.current > current:
        yield "limits.current", f"expected a current in (0, {current:g}] A, got {limits.current:g}"
    if limits.angle[0] < angle[0] or limits.angle[1] > angle[1]:
        yield "limits.angle", f"{list(limits.angle)} reaches beyond the ceiling {list(angle)} rad"
    if not limits.angle[0] < 0.0 < limits.angle[1]:
        yield "limits.angle", "the origin, where every experiment starts and ends, must lie inside"
    if limits.velocity > velocity:
        yield "limits.velocity", f"expected a speed in (0, {velocity:g}] rad/s, got {limits.velocity:g}"
    shortest = bench.timing.sample_time / FASTEST
    for p in (bench.brake, *(entry.high for entry in bench.ranges.values())):
        lasts = 1.0 / max(p.f_v / p.J, math.sqrt(p.gamma / p.J) * math.sqrt(p.k_1))
        if lasts < shortest:  # simulating it would take for ever: some number has another unit
            expected = f"expected J/f_v and sqrt(J/(gamma k_1)) of at least {shortest:g} s in all ranges"
            yield "brake", f"{expected}, got {lasts:g} s"


def _sensor_problems(sensors: Sensors) -> Iterator[tuple[str, str]]:
    """Keys of the velocity's origin that contradict each other, and why."""
    given = [key for key in ("observer_bandwidth", "velocity_lag") if getattr(sensors, key) is not None]
    if sensors.velocity == "sensor":
        yield from ((f"sensors.{key}", 'goes with velocity = "observer"') for key in given)
    elif not given:
        needed = "observer_bandwidth in rad/s, its least, or velocity_lag in s, its longest"
        yield "sensors", f'velocity = "observer" needs {needed}'
    elif len(given) == 2:
        yield "sensors.velocity_lag", "does not go with observer_bandwidth: expected one of the two"


def _setting_problems(bench: Bench, driven: bool) -> Iterator[tuple[str, str]]:
    """Keys of the shield and the time-outs that contradict others, and why."""
    shield, watch, covered = bench.shield, bench.watch, bench.ranges.get(bench.shield.ranges)
    yield from _sensor_problems(bench.sensors)
    _check_pair("shield.frame_age", shield.frame_age)
    if covered is None:
        yield "shield.ranges", f"no set [ranges.{shield.ranges}] in this file"
    else:
        for parameter in covered.uncovered(bench.brake, bench.brake):
            nominal = f"the nominal {parameter} = {getattr(bench.brake, parameter):g}"
            yield "shield.ranges", f"[ranges.{shield.ranges}] leaves out {nominal}"
    if bench.prior not in bench.ranges:
        yield "estimator.ranges", f"no set [ranges.{bench.prior}] in this file"
    if watch.soft_missed > watch.stop_missed:
        yield "watch.soft_missed", f"{watch.soft_missed} is above stop_missed = {watch.stop_missed}"
    # One late sample or command stops nothing: the loop gives a sign of life 1.5 periods after a sample at the latest.
    cycle = 2.0 * (bench.timing.sample_time if driven else SHORTEST_SAMPLE)
    for key, value, shortest, ceiling in (
        ("watch.heartbeat", watch.heartbeat, max(0.002, cycle), CEILING_HEARTBEAT),
        ("node.watchdog", bench.node.watchdog, cycle, CEILING_NODE_WATCHDOG),
    ):
        if not shortest <= value <= ceiling:
            yield key, f"expected a time from {shortest:g} to {ceiling:g} s, got {value:g}"
