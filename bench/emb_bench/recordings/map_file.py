"""The map file: which column of a foreign file is what, in which unit, and what is known of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from emb_bench.brake.parameters import UNITS
from emb_bench.brake.quantities import LINEAR, in_motor_coordinates
from emb_runtime.config.machine import PARAMETERS, WINDOWS, read_units
from emb_runtime.config.plants import ASYMMETRIES
from emb_runtime.config.toml_text import MAX_TOML_BYTES, parse_toml
from emb_runtime.config.units import ANGLE, ANGULAR_SPEED, CURRENT, FORCE, LENGTH, SPEED, TIME, TORQUE
from emb_runtime.config.validation import Rules, Table
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import read_text

SCHEMA = 1
KINDS: Mapping[str, tuple[str, ...]] = {
    "csv": (".csv", ".txt", ".tsv"),
    "parquet": (".parquet",),
    "matlab": (".mat",),
    "mdf": (".mf4", ".mdf", ".dat"),
    "can": (".log", ".blf", ".asc", ".trc"),
}
"""Kinds of files, and the endings by which they are known."""
MEASURED_UNITS: Mapping[str, Mapping[str, float]] = {
    "angle": {**ANGLE, **LENGTH},
    "velocity": {**ANGULAR_SPEED, **SPEED},
    "command": {**CURRENT, **TORQUE, **FORCE},
    "current": CURRENT,
}
"""Signals, and the units that each can have."""
BETWEEN = ("open", "held", "linear")  # Courses of a command between its stamps; open: the recording chooses
POSITIVE = (lambda v: v > 0.0, "a positive number")
_LONGEST_TEXT = 200
RULES = Rules(UsageError, _LONGEST_TEXT, 1e-30)


@dataclass(frozen=True)
class Signal:
    """One signal of a recording: its column, and how it becomes ours."""

    column: str
    unit: str
    scale: float  # Factor to ``unit``, sign included
    offset: float  # Reading of the column at zero, before the factor
    noise: float  # Standard deviation in ``unit``; 0 if it is not said
    delay: float  # Time by which what the column says acts, or was measured, later than its stamp [s]
    between: str  # Course of a command from its stamp to the next one, one of ``BETWEEN``


@dataclass(frozen=True)
class Source:
    """The file of a recording."""

    kind: str  # A key of ``KINDS``
    delimiter: str  # Between columns of a CSV file
    decimal: str  # Decimal mark in a CSV file
    skip: int  # Lines of a CSV file after its head that are no numbers, such as units
    dbc: Path | None  # DBC file of a CAN log


@dataclass(frozen=True)
class MachineMap:
    """Known facts about the machine, in coordinates of its motor."""

    travel: float  # Metres per radian of a linear machine; 0 for one that turns
    parameters: Mapping[str, float]  # Known and guessed values, SI units
    unknown: tuple[str, ...]  # Parameters to be estimated
    nuisances: tuple[str, ...]
    window: float  # [s]; 0: the recording chooses
    units: Mapping[str, str]  # Units in which results are shown, by ``angle`` and ``command``
    between: str = "held"  # ``open`` where the recording is to choose what a command does between its stamps


@dataclass(frozen=True)
class RecordingMap:
    """A map file."""

    name: str
    source: Source
    time_column: str | None  # None where rows are ``sample_time`` apart, or the format has times of its own
    time_unit: float  # Seconds in a unit of the time column
    sample_time: float  # [s]; 0: the median distance of the angle's samples
    signals: Mapping[str, Signal]  # By ``angle``, ``velocity``, ``command`` and ``current``
    machine: MachineMap
    text: str  # The file, which goes into the log


def read_map(path: Path, recording: Path) -> RecordingMap:
    """Reads a map file for a recording.

    Raises:
        UsageError: it cannot be read, or says something unknown, of the wrong type or unit, or contradictory.
    """
    try:
        text = read_text(path, MAX_TOML_BYTES)
    except OSError as err:
        raise UsageError(f"{path}: cannot read the map file: {err.strerror}") from err
    except UnicodeDecodeError as err:
        raise UsageError(f"{path}: cannot read the map file: not UTF-8 text") from err
    return parse_map(text, str(path), recording, path.parent)


def parse_map(text: str, source: str, recording: Path, folder: Path) -> RecordingMap:
    """The map file's text as checked records.

    Args:
        text: TOML.
        source: what to call it in messages.
        recording: the file that it is for, whose ending says its kind where the map does not.
        folder: that a DBC file is sought in.

    Raises:
        UsageError: see :func:`read_map`.
    """
    try:
        document = parse_toml(text)
    except ValueError as err:
        raise UsageError(f"{source}: {err}") from err
    top = Table(source, "", document, RULES)
    top.schema(SCHEMA)
    name = top.text("name")
    file = _source(_optional(top, "file"), recording, folder)
    machine = _machine(top.table("machine"))
    column, unit, sample_time = _timing(_optional(top, "timing"), file)
    signals = _signals(top.table("signals"), machine)
    chooses = "current" not in signals and signals["command"].between == "open"
    units = _shown(top.table("machine"), machine.units, signals)
    machine = replace(machine, units=units, between="open" if chooses else "held")
    if {"J", "k_m"} <= {*machine.unknown} and not {"T_c", "f_v", "k_1"} & {*machine.parameters} - {*machine.unknown}:
        raise top.fail(
            "machine.guess", "k_m, J and all loads scale together: without one that is known only ratios can be told"
        )
    top.nothing_else(("file", "timing"))
    return RecordingMap(name, file, column, unit, sample_time, signals, machine, text)


def _optional(table: Table, name: str) -> Table:
    if name in table.names():
        return table.table(name)
    return Table("", name, {}, RULES)


def _source(table: Table, recording: Path, folder: Path) -> Source:
    given = table.names()
    by_ending = next((kind for kind, endings in KINDS.items() if recording.suffix.lower() in endings), None)
    if by_ending is None and "kind" not in given:
        endings = ", ".join(ending for some in KINDS.values() for ending in some)
        raise UsageError(f"{recording}: expected a file that ends in {endings}, or [file] kind in the map")
    kind = table.text("kind", tuple(KINDS)) if "kind" in given else str(by_ending)
    decimal = table.text("decimal", (".", ",")) if "decimal" in given else "."
    dbc = folder / table.text("dbc") if "dbc" in given else None
    if kind == "can" and dbc is None:
        raise table.fail("dbc", "missing: a CAN log is read with the DBC of its bus")
    delimiter = table.text("delimiter", (",", ";", " ", "|", "tab")) if "delimiter" in given else ","
    skip = table.integer("skip", 0, 1000) if "skip" in given else 0
    table.nothing_else(("kind", "decimal", "dbc", "delimiter", "skip"))
    return Source(kind, "\t" if delimiter == "tab" else delimiter, decimal, skip, dbc)


def _timing(table: Table, file: Source) -> tuple[str | None, float, float]:
    given = table.names()
    column = table.text("column") if "column" in given else None
    unit = TIME[table.text("unit", tuple(TIME))] if column is not None else 1.0
    wanted = "a time from 0.0001 to 0.1 s"
    sample_time = table.number("sample_time", lambda v: 1e-4 <= v <= 0.1, wanted) if "sample_time" in given else 0.0
    table.nothing_else(("column", "unit", "sample_time"))
    if file.kind in ("mdf", "can") and column is not None:
        raise UsageError(f"[timing] column: a file of kind {file.kind} has times of its own: leave it out")
    if file.kind not in ("mdf", "can") and column is None and not sample_time:
        raise UsageError("[timing]: missing: column and unit of the time, or sample_time in s")
    return column, unit, sample_time


def _signals(table: Table, machine: MachineMap) -> dict[str, Signal]:
    found = {}
    for name, units in MEASURED_UNITS.items():
        if name in table.names():
            found[name] = _signal(table.table(name), units, machine)
    table.nothing_else(MEASURED_UNITS)
    if "angle" not in found:
        raise table.fail("angle", "missing: an angle or a position is what everything is estimated from")
    for name in ("angle", "velocity"):
        if name in found and not found[name].noise:
            raise table.fail(f"{name}.noise", "missing: standard deviation of the sensor, or its step over 3.5")
    if not {"command", "current"} & {*found}:
        raise table.fail("command", "missing: expected what was commanded, or the current that was measured")
    unit = found["command"].unit if "command" in found else "A"
    if unit in (*TORQUE, *FORCE):
        if "k_m" in machine.parameters or "current" in found:
            raise table.fail("command.unit", f"a command in {unit} has no k_m and no current: its k_m is 1 N·m per A")
    elif "k_m" not in machine.parameters:
        raise table.fail(
            "command.unit", f"a command in {unit} needs [machine] k_m, known or guessed, in N·m per {unit}"
        )
    return found


def _signal(table: Table, units: Mapping[str, float], machine: MachineMap) -> Signal:
    given = table.names()
    column, unit = table.text("column"), table.text("unit", tuple(units))
    if unit in (*LENGTH, *SPEED, *FORCE) and not machine.travel:
        raise table.fail("unit", f"{unit} needs [machine] travel, in m per rad of the motor")
    scale = table.number("scale", *POSITIVE) if "scale" in given else 1.0
    sign = table.integer("sign", -1, 1) if "sign" in given else 1
    if sign == 0:
        raise table.fail("sign", "expected 1 or -1, got 0")
    offset = table.number("offset") if "offset" in given else 0.0
    noise = table.number("noise", *POSITIVE) if "noise" in given else 0.0
    delay = table.number("delay", lambda v: abs(v) <= 1.0, "a time from -1 to 1 s") if "delay" in given else 0.0
    between = table.text("between", BETWEEN) if "between" in given else BETWEEN[0]
    table.nothing_else(("scale", "sign", "offset", "noise", "delay", "between"))
    return Signal(column, unit, scale * sign, offset, noise, delay, between)


def _machine(table: Table) -> MachineMap:
    given = table.names()
    travel = table.number("travel", *POSITIVE) if "travel" in given else 0.0
    known = _parameters(table, "known", travel)
    guessed = _parameters(table, "guess", travel)
    if twice := sorted({*known} & {*guessed}):
        raise table.fail("guess", f"{', '.join(twice)}: known already: expected each once")
    every = known | guessed
    for name in ("J", "T_c", "f_v"):
        if name not in every:
            linear = next(key for key, ours in LINEAR.items() if ours == name)
            raise table.fail("guess", f"{name} is missing{f', or {linear}' if travel else ''}: known, or a first guess")
    if ("k_1" in every) != ("gamma" in every):
        raise table.fail("known", "k_1 and gamma go together: a spring needs both, a machine without one neither")
    if "gamma" in guessed:
        raise table.fail("guess.gamma", "expected under [machine.known]: a gear ratio is not estimated")
    directions = table.texts("by_direction", ASYMMETRIES) if "by_direction" in given else ()
    unknown = (*(name for name in PARAMETERS if name in guessed), *directions)
    if not unknown:
        raise table.fail("guess", "expected at least one parameter that is not known")
    nuisances = table.texts("nuisances", tuple(UNITS)) if "nuisances" in given else ()
    window = table.number("window", *WINDOWS) if "window" in given else 0.0
    units = read_units(table.table("units"), travel) if "units" in given else {}
    table.nothing_else(("travel", "window", "by_direction", "nuisances", "known", "guess", "units"))
    return MachineMap(travel, every, unknown, nuisances, window, units)


def _shown(table: Table, wanted: Mapping[str, str], signals: Mapping[str, Signal]) -> dict[str, str]:
    """Units in which results are shown: those of the recording where the map does not say others."""
    own = signals["command"].unit if "command" in signals else "A"
    unit = wanted.get("command", own)
    if (unit in CURRENT) != (own in CURRENT):
        raise table.fail("units.command", f"{own} is what was commanded, and no conversion makes {unit} of it")
    return {"angle": signals["angle"].unit, "command": own, **wanted}


def _parameters(table: Table, name: str, travel: float) -> dict[str, float]:
    """Known or guessed parameters in coordinates of the motor; those of a linear machine by its travel."""
    if name not in table.names():
        return {}
    inner = table.table(name)
    found = {}
    for key in inner.names():
        ours = LINEAR.get(key, key)
        if ours not in ("J", "k_m", "k_1", "T_c", "f_v", "gamma"):
            raise inner.fail(key, "not a parameter; expected some of J, k_m, k_1, gamma, T_c, f_v, mass, F_c, F_v")
        if key in LINEAR and not travel:
            raise inner.fail(key, "needs [machine] travel, in m per rad of the motor")
        if ours in found:
            raise inner.fail(key, f"{ours} is given twice: as {ours} and as {key}")
        found[ours] = inner.number(key, *POSITIVE) * (in_motor_coordinates(ours, travel) if key in LINEAR else 1.0)
    return found
