"""The one description of the bench: ``bench.toml`` as frozen, checked records.

Training draws from its ranges, the runtime takes its limits, the node its plant, the replay its nominal values.
:attr:`Bench.contract_hash` covers what a policy depends on and travels in the ONNX contract and in every log.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

from emb_runtime.config.machine import Machine, read_machine
from emb_runtime.config.plants import ASYMMETRIES, Plant, read_plants
from emb_runtime.config.systematic import Systematic, read_systematic
from emb_runtime.config.timing_budgets import Budgets, read_budgets
from emb_runtime.config.toml_text import MAX_TOML_BYTES, parse_toml
from emb_runtime.config.validation import Table
from emb_runtime.errors import BenchFileError
from emb_runtime.system.input_file import read_text

SCHEMA = 1

# Hard ceilings: a bench file can narrow them, never widen them.
CEILING_CURRENT = 6.0  # A
CEILING_ANGLE = (-10.0, 100.0)  # rad
CEILING_VELOCITY = 500.0  # rad/s
CEILING_MISSED = 400  # periods
CEILING_REJECTED = 100  # frames
CEILING_NODE_WATCHDOG = 0.5  # s
CEILING_HEARTBEAT = 0.5  # s
OLDEST_FRAME = 5  # samples
FAR = 1e9  # of a machine that is never driven, in SI units
AROUND = 3.0  # Factor around its nominal parameters within which searches for those of a machine begin
_SHA256 = re.compile("[0-9a-f]{64}")

DRIVEN = ("ranges", "shield", "watch", "guard", "node", "can")  # Tables that the file of a machine does not have
SHORTEST_SAMPLE = 1e-4  # s

# Ceilings of what is armed on a bus with a brake; up to those above, a file can be read and a bus without one driven.
LONGEST_MISSED = 20  # periods
LONGEST_REJECTED = 5  # frames
LONGEST_NODE_WATCHDOG = 0.010  # s
LONGEST_HEARTBEAT = 0.005  # s

ENVELOPES = ("braking", "coasting")
MODELS = ("flow", "euler")
LEARNING = ("learn", "model", "model_error", "current_error")
"""Keys of the shield that concern what it learns while it runs: no policy and no node depends on them."""

OPTIONAL = (
    *(
        "budgets",
        "estimator",
        "machine",
        "plants",
        "systematic",
        "shield.envelope",
        "shield.current_lag",
        "shield.break_away",
        "shield.f_l",
    ),
    *(f"shield.{key}" for key in LEARNING),
)
"""Keys that a bench file may leave out."""

FASTEST = 10.0  # No time constant of a brake is shorter than the sample time over this

PARAMETER_NAMES = ("k_m", "k_1", "T_c", "f_v")  # The parameters that are identified, in the thesis's order (eq. 4.3).


class BrakeParameters(NamedTuple):
    """Parameters of the simplified brake (thesis eq. 3.12-3.14). A named tuple of floats, so that numba takes it."""

    J: float  # Lumped inertia [kg·m²]
    gamma: float  # Gear ratio from motor angle to clamping travel [m]
    k_m: float  # Motor constant [N·m/A]
    k_1: float  # Stiffness [N/rad]
    T_c: float  # Coulomb friction torque [N·m]
    f_v: float  # Viscous friction coefficient [N·m·s/rad]


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

    current: float  # Largest command, both signs [A]
    angle: tuple[float, float]  # Lowest and highest angle [rad]
    velocity: float  # Largest speed, both signs [rad/s]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the sensors, white and Gaussian (thesis section 4.1)."""

    angle: float  # [rad]
    velocity: float  # [rad/s]


@dataclass(frozen=True)
class Timing:
    """The experiment's time grid."""

    sample_time: float  # [s]
    horizon: int  # Samples in one experiment

    @property
    def sample_time_ns(self) -> int:
        """The sample time in whole nanoseconds."""
        return round(self.sample_time * 1e9)


@dataclass(frozen=True)
class Shield:
    """Assumptions of the envelope shield, see :mod:`emb_runtime.safety.shield`."""

    ranges: str  # Name of the set of brakes for which the limits are guaranteed
    envelope: str  # ``braking`` or ``coasting``: what keeps the limits when no more commands come
    frame_age: tuple[int, int]  # Least and most samples between a measurement and the period in which its answer acts
    current_lag: float  # Largest time constant of the current loop [s]
    break_away: float  # Largest T_s0 / T_c (eq. 3.5).
    f_l: float  # Largest load-dependent static friction, T_s = T_s0 + f_l F_cl (eq. 3.6) [m].
    noise_sigmas: float  # Largest measurement error, in standard deviations
    angle_margin: float  # Kept from the angle limits [rad]
    home_angle: float  # |angle| that counts as home [rad]
    home_velocity: float  # |velocity| that counts as home [rad/s]
    learn: bool = False  # Narrows the set of brakes while it runs
    model: str = "flow"  # Brake that is learnt: ``flow``, one that sticks, or ``euler``, one under forward Euler
    model_error: float = 0.0  # Acceleration that the model lacks, at most [rad/s²]
    current_error: float = 1e-3  # By which a reported current may be off, at most [A]


@dataclass(frozen=True)
class Watch:
    """Time-outs and counts after which the runtime stops by itself."""

    soft_missed: int  # Consecutive periods without a valid sensor pair that are reported
    stop_missed: int  # Consecutive periods without a valid sensor pair that stop the run
    rejected: int  # Leaky count of rejected frames that stops the run
    start_timeout: float  # Time to wait for a first valid sensor pair [s]
    heartbeat: float  # Time without a sign of life from the loop until the watchdog process sends the stop frames [s]


@dataclass(frozen=True)
class GuardLimits:
    """Bounds of the guard, besides :class:`Limits`."""

    slew: float  # Fastest change from one command to the next [A/s]
    current_error: float  # By which a reported current may lie outside the last ones commanded [A]


@dataclass(frozen=True)
class Node:
    """Safe stop and time-outs of the node that owns the current."""

    watchdog: float  # Time without a fresh, valid, enabled command until the safe stop latches [s]
    stop: str  # ``damped`` or ``freewheel``
    damping_velocity: float  # Speed above which the damped stop brakes with the full current [rad/s]


@dataclass(frozen=True)
class Can:
    """The bus."""

    bitrate: int  # [bit/s]
    mapping: str = ""
    """SHA-256 of the mapping of a drive, and its DBC: no other one is taken then. Empty where the file names none."""


@dataclass(frozen=True)
class Bench:
    """Everything that is known about one bench."""

    name: str
    brake: BrakeParameters
    ranges: Mapping[str, Ranges]
    limits: Limits
    noise: Noise
    timing: Timing
    shield: Shield
    prior: str  # Name of the set of ranges that the running estimate begins with; the shield's where none is named
    watch: Watch
    guard: GuardLimits
    node: Node
    can: Can
    budgets: Budgets | None  # Timing budgets of a run; None if the file has none
    plants: Mapping[str, Plant]
    systematic: Systematic  # Systematic errors that an estimate has to allow for
    machine: Machine | None  # A machine that is no brake of ours, for analysis only; None for a brake, which is driven
    text: str  # The file as it was read: it goes into the log, so that the log replays alone

    def range_set(self, name: str) -> Ranges:
        """The named set of uncertain parameters; "nominal", where nothing is uncertain, is always there.

        Raises:
            BenchFileError: no set has that name.
        """
        try:
            return self.ranges[name]
        except KeyError:
            if name == "nominal":
                return Ranges(name, self.brake, self.brake)
            known = ", ".join(sorted(self.ranges))
            raise BenchFileError(f"no set of ranges is called '{name}'; this bench has: {known}") from None

    def plant(self, name: str) -> Plant:
        """The named brake to simulate or to evaluate with.

        Raises:
            BenchFileError: no plant has that name.
        """
        try:
            return self.plants[name]
        except KeyError:
            raise BenchFileError(f"no plant is called {name!r}; this bench has: {', '.join(self.plants)}") from None

    def refuse_long_timeouts(self) -> None:
        """Refuse time-outs and counts beyond those with which a brake is driven.

        Raises:
            BenchFileError: one is longer; the message names it.
        """
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
    def contract_hash(self) -> str:
        """SHA-256 of what a policy depends on: brake, ranges, limits, noise, timing, shield, drive's mapping if named.

        Not the time-outs; nor what the shield learns, which only widens what a policy may do.
        """
        record: dict[str, Any] = {
            "brake": self.brake._asdict(),
            "ranges": {k: [v.low._asdict(), v.high._asdict()] for k, v in self.ranges.items()},
            "limits": asdict(self.limits),
            "noise": asdict(self.noise),
            "timing": asdict(self.timing),
            "shield": {key: value for key, value in asdict(self.shield).items() if key not in LEARNING},
        }
        if self.can.mapping:
            record["mapping"] = self.can.mapping
        return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def shipped_bench_text() -> str:
    """The text of the shipped ``bench.toml``."""
    return resources.files("emb_runtime.config").joinpath("bench.toml").read_text(encoding="utf-8")


def load_bench(path: str | Path | None = None, *, analysis: bool = False) -> Bench:
    """Read a bench file; without a path, the shipped one.

    Args:
        path: the file.
        analysis: True where logs are evaluated and nothing is driven, designed or trained: takes ``[machine]`` too.

    Raises:
        BenchFileError: the file cannot be read, or says something unknown, of the wrong type, not finite,
            beyond a ceiling, or contradictory. The message has the file, the key and the reason.
    """
    if path is None:
        return parse_bench(shipped_bench_text(), "shipped bench.toml")
    try:
        text = read_text(path, MAX_TOML_BYTES)
    except (OSError, UnicodeDecodeError) as err:
        reason = err.strerror if isinstance(err, OSError) else "not UTF-8 text"
        raise BenchFileError(f"{path}: cannot read the bench file: {reason}") from err
    return parse_bench(text, str(path), analysis=analysis)


def parse_bench(text: str, source: str, *, analysis: bool = False) -> Bench:
    """Turn the text of a bench file into checked records.

    Args:
        text: TOML.
        source: what to call it in error messages.
        analysis: as for :func:`load_bench`.

    Raises:
        BenchFileError: see :func:`load_bench`.
    """
    try:
        document = parse_toml(text)
    except ValueError as err:
        raise BenchFileError(f"{source}: {err}") from err
    top = Table(source, "", document)
    if (schema := top.integer("schema")) != SCHEMA:
        raise BenchFileError(f"{source}: schema: expected {SCHEMA}, got {schema}")
    machine = read_machine(top.table("machine")) if "machine" in top.names() else None
    if machine is not None:
        if not analysis:
            raise top.fail("machine", "a machine for the analysis of recordings: nothing is driven or designed with it")
        top = Table(source, "", document := _never_driven(top, document))
        for key in ("schema", "machine"):
            top.get(key)
    if missing := _missing(document):
        raise BenchFileError(
            f"{source}: {', '.join(missing)}: missing; `emb-run --write-bench FILE` writes the shipped file, which has "
            f"{'it' if len(missing) == 1 else 'them'}"
        )
    name = top.text("name")
    brake = _brake(top.table("brake"), machine)
    ranges = _ranges(top.table("ranges"), brake)
    timing = _timing(top.table("timing"))
    _check_speed(top, timing, brake, *(entry.high for entry in ranges.values()))
    cycle = timing.sample_time if machine is None else SHORTEST_SAMPLE
    bench = Bench(
        name=name,
        brake=brake,
        ranges=ranges,
        limits=_limits(top.table("limits"), machine),
        noise=_noise(top.table("noise")),
        timing=timing,
        shield=(shield := _shield(top.table("shield"), ranges, brake)),
        prior=_prior(top, ranges) or shield.ranges,
        watch=_watch(top.table("watch"), cycle),
        guard=_guard(top.table("guard")),
        node=_node(top.table("node"), cycle),
        can=_can(top.table("can")),
        budgets=read_budgets(top.table("budgets")) if "budgets" in top.names() else None,
        plants=_plants(top, machine),
        systematic=read_systematic(top.table("systematic") if "systematic" in top.names() else None),
        machine=machine,
        text=text,
    )
    top.nothing_else(key for key in OPTIONAL if "." not in key)
    return bench


def _never_driven(top: Table, document: Mapping[str, Any]) -> dict[str, Any]:
    """The document of a machine with what only a driven brake needs as it is in the shipped file.

    The ranges, in which searches begin, are the nominal parameters over and times ``AROUND``.
    """
    for key in DRIVEN:
        if key in document:
            raise top.fail(key, "does not go with [machine], with which nothing is driven")
    shipped = parse_toml(shipped_bench_text())
    nominal = document.get("brake")
    around = {}
    for parameter in PARAMETER_NAMES:
        value = nominal.get(parameter) if isinstance(nominal, dict) else None
        if isinstance(value, int | float) and value > 0.0:
            around[parameter] = [value / AROUND, value * AROUND]
    ranges = {shipped["shield"]["ranges"]: around}
    return {**document, **{key: shipped[key] for key in DRIVEN}, "ranges": ranges}


def _missing(document: Mapping[str, Any]) -> list[str]:
    """Keys and whole tables that every bench file has and this one has not."""
    missing = []
    for name, value in parse_toml(shipped_bench_text()).items():
        if name not in document:
            missing += [name] if name not in OPTIONAL else []
        elif isinstance(value, dict) and isinstance(document[name], dict) and name not in ("ranges", *OPTIONAL):
            keys = [f"{name}.{key}" for key in value if key not in document[name]]
            missing += [key for key in keys if key not in OPTIONAL]
    return missing


def _positive(value: float) -> bool:
    return value > 0.0


def _brake(table: Table, machine: Machine | None) -> BrakeParameters:
    def number(name: str) -> float:
        if name == "k_1" and machine is not None:
            return table.number(name, lambda v: v >= 0.0, "a number from 0, which is no spring")
        return table.number(name, _positive, "a positive number")

    record = BrakeParameters(*(number(name) for name in BrakeParameters._fields))
    table.nothing_else()
    return record


def _ranges(table: Table, brake: BrakeParameters) -> dict[str, Ranges]:
    sets = {}
    for name in table.names():
        entry = table.table(name)
        low, high = brake, brake
        for parameter in entry.names():
            if parameter not in PARAMETER_NAMES:
                raise entry.fail(parameter, f"not a parameter; expected one of {', '.join(PARAMETER_NAMES)}")
            lo, hi = entry.number_pair(parameter)
            if lo <= 0.0:
                raise entry.fail(parameter, f"expected positive bounds, got {lo:g}")
            low, high = low._replace(**{parameter: lo}), high._replace(**{parameter: hi})
        sets[name] = Ranges(name, low, high)
    return sets


def _limits(table: Table, machine: Machine | None) -> Limits:
    """Limits below the ceilings; those of a machine that is never driven only bound what is searched."""
    most = (CEILING_CURRENT, CEILING_ANGLE, CEILING_VELOCITY)
    top_current, top_angle, top_velocity = most if machine is None else (FAR, (-FAR, FAR), FAR)
    current = table.number("current", lambda v: 0 < v <= top_current, f"a current in (0, {top_current:g}] A")
    low, high = table.number_pair("angle")
    if low < top_angle[0] or high > top_angle[1]:
        raise table.fail("angle", f"[{low:g}, {high:g}] reaches beyond the ceiling {list(top_angle)} rad")
    if not low < 0.0 < high:
        raise table.fail("angle", "the origin, where every experiment starts and ends, must lie inside")
    velocity = table.number("velocity", lambda v: 0 < v <= top_velocity, f"a speed in (0, {top_velocity:g}] rad/s")
    table.nothing_else()
    return Limits(current, (low, high), velocity)


def _plants(top: Table, machine: Machine | None) -> dict[str, Plant]:
    """The plants; friction by direction is outside the shield's assumptions, so that no brake that is driven has it."""
    plants = read_plants(top.table("plants") if "plants" in top.names() else None)
    for name, plant in plants.items():
        if machine is None and any(getattr(plant.mechanics, key) != 0.0 for key in ASYMMETRIES):
            raise top.fail(f"plants.{name}", f"{' and '.join(ASYMMETRIES)} go with [machine] only")
    return plants


def _noise(table: Table) -> Noise:
    record = Noise(
        table.number("angle", _positive, "a positive number"), table.number("velocity", _positive, "a positive number")
    )
    table.nothing_else()
    return record


def _timing(table: Table) -> Timing:
    sample_time = table.number("sample_time", lambda v: SHORTEST_SAMPLE <= v <= 0.1, "a time from 0.0001 to 0.1 s")
    record = Timing(sample_time, table.integer("horizon", 1, 1_000_000))
    table.nothing_else()
    return record


def _check_speed(top: Table, timing: Timing, *brakes: BrakeParameters) -> None:
    """Refuse a brake so fast that simulating it would take for ever: some number has another unit."""
    shortest = timing.sample_time / FASTEST
    for p in brakes:
        lasts = 1.0 / max(p.f_v / p.J, math.sqrt(p.gamma / p.J) * math.sqrt(p.k_1))
        if lasts < shortest:
            raise top.fail(
                "brake",
                f"expected J/f_v and sqrt(J/(gamma k_1)) of at least {shortest:g} s in all ranges, got {lasts:g} s",
            )


def _shield(table: Table, ranges: Mapping[str, Ranges], brake: BrakeParameters) -> Shield:
    name = table.text("ranges")
    if name not in ranges:
        raise table.fail("ranges", f"no set [ranges.{name}] in this file")
    for parameter in ranges[name].uncovered(brake, brake):
        raise table.fail(
            "ranges", f"[ranges.{name}] leaves out the nominal {parameter} = {getattr(brake, parameter):g}"
        )
    given = table.names()  # what a file leaves out, the brake does not have
    record = Shield(
        ranges=name,
        envelope=table.text("envelope", ENVELOPES) if "envelope" in given else ENVELOPES[0],
        frame_age=table.integer_pair("frame_age", OLDEST_FRAME),
        current_lag=_bound(table, "current_lag", lambda v: 0 <= v <= 0.1, "a time from 0 to 0.1 s", 0.0),
        break_away=_bound(table, "break_away", lambda v: 1 <= v <= 5, "a ratio from 1 to 5", 1.0),
        f_l=_bound(table, "f_l", lambda v: 0 <= v <= 1e-4, "a length from 0 to 1e-4 m", 0.0),
        noise_sigmas=table.number("noise_sigmas", lambda v: 1 <= v <= 10, "a number from 1 to 10"),
        angle_margin=table.number("angle_margin", lambda v: 0.02 <= v <= 5, "an angle from 0.02 to 5 rad"),
        home_angle=table.number("home_angle", lambda v: 0 < v <= 10, "an angle in (0, 10] rad"),
        home_velocity=table.number("home_velocity", lambda v: 0 < v <= 50, "a speed in (0, 50] rad/s"),
        learn=table.flag("learn") if "learn" in given else False,
        model=table.text("model", MODELS) if "model" in given else MODELS[0],
        model_error=_bound(table, "model_error", lambda v: 0 <= v <= 1e4, "an acceleration from 0 to 1e4 rad/s²", 0.0),
        current_error=_bound(table, "current_error", lambda v: 0 <= v <= 1, "a current from 0 to 1 A", 1e-3),
    )
    table.nothing_else(key.removeprefix("shield.") for key in OPTIONAL if key.startswith("shield."))
    return record


def _prior(top: Table, ranges: Mapping[str, Ranges]) -> str:
    if "estimator" not in top.names():
        return ""
    table = top.table("estimator")
    name = table.text("ranges")
    if name not in ranges:
        raise table.fail("ranges", f"no set [ranges.{name}] in this file")
    table.nothing_else()
    return name


def _bound(table: Table, name: str, check: Callable[[float], bool], wanted: str, absent: float) -> float:
    return table.number(name, check, wanted) if name in table.names() else absent


def _watch(table: Table, sample_time: float) -> Watch:
    shortest = max(0.002, 2.0 * sample_time)  # the loop gives a sign of life once per sample, or 1.5 periods after one
    record = Watch(
        soft_missed=table.integer("soft_missed", 1, CEILING_MISSED),
        stop_missed=table.integer("stop_missed", 1, CEILING_MISSED),
        rejected=table.integer("rejected", 1, CEILING_REJECTED),
        start_timeout=table.number("start_timeout", lambda v: 0 < v <= 60, "a time in (0, 60] s"),
        heartbeat=table.number(
            "heartbeat",
            lambda v: shortest <= v <= CEILING_HEARTBEAT,
            f"a time from {shortest:g} to {CEILING_HEARTBEAT:g} s",
        ),
    )
    if record.soft_missed > record.stop_missed:
        raise table.fail("soft_missed", f"{record.soft_missed} is above stop_missed = {record.stop_missed}")
    table.nothing_else()
    return record


def _guard(table: Table) -> GuardLimits:
    record = GuardLimits(
        slew=table.number("slew", _positive, "a positive number"),
        current_error=table.number(
            "current_error", lambda v: 0 < v <= 2 * CEILING_CURRENT, f"a current in (0, {2 * CEILING_CURRENT:g}] A"
        ),
    )
    table.nothing_else()
    return record


def _node(table: Table, sample_time: float) -> Node:
    shortest = 2.0 * sample_time  # one late command must not stop the brake
    record = Node(
        watchdog=table.number(
            "watchdog",
            lambda v: shortest <= v <= CEILING_NODE_WATCHDOG,
            f"a time from {shortest:g} to {CEILING_NODE_WATCHDOG:g} s",
        ),
        stop=table.text("stop", ("damped", "freewheel")),
        damping_velocity=table.number("damping_velocity", lambda v: 50 <= v <= 200, "a speed from 50 to 200 rad/s"),
    )
    table.nothing_else()
    return record


def _can(table: Table) -> Can:
    mapping = table.text("mapping") if "mapping" in table.names() else ""
    if mapping and not _SHA256.fullmatch(mapping):
        raise table.fail("mapping", "expected a SHA-256, 64 digits in lower case; the pre-flight has it")
    record = Can(table.integer("bitrate", 125_000, 1_000_000), mapping)
    table.nothing_else(("mapping",))
    return record
