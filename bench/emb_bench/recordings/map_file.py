"""The map file: the column and unit of each signal in a foreign file, and the parameters of the machine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
from msgspec import Meta

from emb_bench.brake.parameters import LINEAR, UNITS
from emb_bench.config.machine import COMMANDS, LOADS, PARAMETERS, WINDOW, Window
from emb_runtime.config import typed
from emb_runtime.config.typed import MAX_TOML_BYTES, FieldError, parse_toml
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import open_regular, read_text

KINDS: Mapping[str, str] = {
    ".csv": "csv", ".txt": "csv", ".tsv": "csv", ".parquet": "parquet", ".mat": "matlab",
    ".mf4": "mdf", ".mdf": "mdf", ".dat": "mdf",
    ".blf": "can", ".asc": "can", ".log": "can",
}  # fmt: skip
"""Kinds of files by their endings; a ``.dat`` is text unless it begins as an MDF does."""
TIMED = ("mdf", "can")  # Kinds of files whose values have times
MDF_BEGINS = (b"MDF", b"UnFinMF")
TIME: Mapping[str, float] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # Seconds in each
ALONG: Mapping[str, str] = {"angle": "m", "velocity": "m/s", "command": "N"}  # Units of a linear machine alone
AROUND: Mapping[str, str] = {"angle": "rad", "velocity": "rad/s", "command": "Nm"}  # Units of one that turns alone

Positive = Annotated[float, Meta(gt=0.0, description="a positive number")]
Row = Annotated[int, Meta(ge=1)]


class Place(NamedTuple):
    """A column of a file."""

    column: str
    group: int | None = None  # Number of its group in an MDF; None where the name is enough


class Signal(msgspec.Struct, frozen=True, kw_only=True):
    """One signal of a recording: its column, and the conversion to SI units."""

    column: str
    unit: str
    group: Annotated[int, Meta(ge=0)] | None = None  # Of an MDF that has several columns of this name
    scale: Positive = 1.0  # Factor from the column to ``unit``
    sign: Literal[-1, 1] = 1
    offset: float = 0.0  # Reading of the column at zero, before the factor
    noise: Positive = 0.0  # Standard deviation in ``unit``; 0 if it is not given
    delay: Annotated[float, Meta(ge=-1.0, le=1.0)] = 0.0  # Time by which it acts, or was measured, after its stamp [s]
    between: Literal["held", "linear"] = "held"  # Course of a command from its stamp to the next one
    range: tuple[float, float] = (-math.inf, math.inf)  # Values of the column that are believed
    special: tuple[float, ...] = ()  # Values of the column that say that there is none
    wrap: Positive = 0.0  # Period after which an angle wraps around, in the column's unit; 0 if it does not

    @property
    def place(self) -> Place:
        """Its column in the file."""
        return Place(self.column, self.group)


class Signals(msgspec.Struct, frozen=True, kw_only=True):
    """The signals of a recording."""

    angle: Signal
    velocity: Signal | None = None
    command: Signal | None = None
    current: Signal | None = None

    def __post_init__(self) -> None:
        """Check units and noise, and that a command or a current is there."""
        linear = self.angle.unit == ALONG["angle"]
        units = ALONG if linear else AROUND
        allowed = {
            "angle": (AROUND["angle"], ALONG["angle"]),
            "velocity": (units["velocity"],),
            "command": tuple(unit for unit in COMMANDS if unit not in LOADS or unit == units["command"]),
            "current": ("A",),
        }
        for name, signal in self.given.items():
            if signal.unit not in allowed[name]:
                expected = f"expected one of {', '.join(allowed[name])}, and scale as the factor to it"
                raise FieldError(f"{name}.unit", f"{expected}; got {typed.excerpt(signal.unit)}")
            if not signal.range[0] < signal.range[1]:
                raise FieldError(f"{name}.range", "expected the lower value first")
            if signal.wrap and name != "angle":
                raise FieldError(f"{name}.wrap", "expected of an angle alone")
            if name in ("angle", "velocity") and not signal.noise:
                raise FieldError(f"{name}.noise", "missing: standard deviation of the sensor, or its step over 3.5")
        if self.command is None and self.current is None:
            raise FieldError("command", "missing: expected what was commanded, or the current that was measured")

    @property
    def given(self) -> dict[str, Signal]:
        """The signals that there are, by name."""
        names = ("angle", "velocity", "command", "current")
        return {name: signal for name in names if (signal := getattr(self, name)) is not None}

    @property
    def acting(self) -> str:
        """Name of the signal that drives the machine: the current where it was measured, else the command."""
        return "command" if self.current is None else "current"


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """The file of a recording."""

    kind: Annotated[
        Literal["", "csv", "parquet", "matlab", "mdf", "can"], Meta(description="one of csv, parquet, matlab, mdf, can")
    ] = ""  # By its ending if it is not given
    dbc: str = ""  # Beside the map: columns are signals of the frames, ``MESSAGE.SIGNAL`` or ``SIGNAL``
    channel: str = ""  # Of the frames, where several buses were recorded
    encoding: str = ""  # Of a CSV file; empty: UTF-8, else cp1252
    head: Annotated[int, Meta(ge=0)] | None = None  # Line of a CSV file with the names; 0: columns are 1, 2, ...
    delimiter: Literal[",", ";", " ", "|", "tab"] = ","  # Between columns of a CSV file
    decimal: Literal[".", ","] = "."  # Decimal mark in a CSV file
    skip: Annotated[int, Meta(ge=0, le=1000)] = 0  # Lines of a CSV file after its head that are no numbers
    missing: tuple[str, ...] = ()  # Texts that stand for a missing number
    rows: tuple[Row, Row] | None = None  # First and last row that counts, the one after the head being 1

    def __post_init__(self) -> None:
        """Check the encoding and the order of the rows."""
        try:
            bytes(4).decode(self.encoding or "utf-8")  # without a byte it is not looked up
        except LookupError:
            raise FieldError("encoding", f"expected one such as utf-8, got {typed.excerpt(self.encoding)}") from None
        if self.rows is not None and self.rows[0] >= self.rows[1]:
            raise FieldError("rows", "expected the first row, then the last")


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """Times of the samples."""

    column: str = ""  # Empty where rows are ``sample_time`` apart, or the format has times of its own
    unit: Literal["s", "ms", "us", "ns"] = "s"  # Of the column
    tick: Positive = 0.0  # Time of one count of the column [s], in place of ``unit``
    wrap: Positive = 0.0  # Counts after which the column wraps around; 0 if it does not
    fraction: str = ""  # Second column, whose time is added: that within the second, say
    fraction_unit: Literal["s", "ms", "us", "ns"] = "us"
    sample_time: Annotated[float, Meta(ge=1e-4, le=0.1, description="a time from 0.0001 to 0.1 s")] = 0.0
    """[s]; 0: the median distance of the angle's samples."""


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters, of a linear machine by names of its own; 0 where it is not given."""

    J: Positive = 0.0  # [kg·m²]
    k_m: Positive = 0.0  # [N·m/A], [N/A] of a linear machine
    k_1: Positive = 0.0  # [N·m/rad] times ``gamma``
    gamma: Positive = 0.0
    T_c: Positive = 0.0  # [N·m]
    f_v: Positive = 0.0  # [N·m·s/rad]
    mass: Positive = 0.0  # [kg]
    F_c: Positive = 0.0  # [N]
    F_v: Positive = 0.0  # [N·s/m]

    @property
    def given(self) -> dict[str, float]:
        """The given ones, by their place in the equations."""
        found = dict[str, float]()
        for key, value in msgspec.structs.asdict(self).items():
            ours = LINEAR.get(key, key)
            if value and ours in found:
                raise FieldError(key, f"{ours} is given twice: as {ours} and as {key}")
            if value:
                found[ours] = value
        return found


class Machine(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the machine: given ones, and guesses of those to estimate."""

    guess: Parameters
    known: Parameters = Parameters()
    window: Window = WINDOW  # [s]
    nuisances: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check that the parameters make a machine."""
        known, guess, every = self.known.given, self.guess.given, self.parameters
        if twice := sorted({*known} & {*guess}):
            raise FieldError("guess", f"{', '.join(twice)}: known already: expected each once")
        for linear, name in LINEAR.items():
            if name not in every:
                raise FieldError("guess", f"{name} is missing, or {linear} of a linear machine: known, or a guess")
        if ("k_1" in every) != ("gamma" in every):
            raise FieldError("known", "k_1 and gamma go together: a spring needs both, a machine without one neither")
        if "gamma" in guess:
            raise FieldError("guess.gamma", "expected under [machine.known]: a gear ratio is not estimated")
        if not self.unknown:
            raise FieldError("guess", "expected at least one parameter that is not known")
        for i, name in enumerate(self.nuisances):
            if name not in UNITS:
                raise FieldError(f"nuisances[{i}]", f"expected one of {', '.join(UNITS)}, got {typed.excerpt(name)}")
        if {"J", "k_m"} <= {*guess} and not {"T_c", "f_v", "k_1"} & {*known}:
            raise FieldError(
                "guess", "k_m, J and all loads scale together: without a known one only their ratios can be estimated"
            )

    @property
    def parameters(self) -> dict[str, float]:
        """Known and guessed values, SI units."""
        return self.known.given | self.guess.given

    @property
    def unknown(self) -> tuple[str, ...]:
        """Parameters to be estimated."""
        return tuple(name for name in PARAMETERS if name in self.guess.given)


class RecordingMap(msgspec.Struct, frozen=True, kw_only=True):
    """A map file."""

    schema: Literal[1]
    name: str
    signals: Signals
    machine: Machine
    file: Source = Source()
    timing: Timing = Timing()

    def __post_init__(self) -> None:
        """Check that the machine has the parameters that the signals need."""
        unit, has_k_m = self.command_unit, "k_m" in self.machine.parameters
        if unit in LOADS and (has_k_m or self.signals.current is not None):
            raise FieldError("signals.command.unit", f"a command in {unit} has no k_m and no current: its k_m is 1")
        if unit not in LOADS and not has_k_m:
            raise FieldError("signals.command.unit", f"a command in {unit} needs [machine] k_m, known or guessed")

    @property
    def command_unit(self) -> str:
        """Unit of the command, or of the current where only that was measured."""
        return "A" if self.signals.command is None else self.signals.command.unit

    @property
    def time_unit(self) -> float:
        """Seconds in a unit of the time column."""
        return self.timing.tick or TIME[self.timing.unit]

    @property
    def places(self) -> tuple[Place, ...]:
        """All columns that are read, each once."""
        times = [Place(name) for name in (self.timing.column, self.timing.fraction) if name]
        return tuple(dict.fromkeys([*(signal.place for signal in self.signals.given.values()), *times]))

    def kind_of(self, recording: Path) -> str:
        """Kind of a recording's file."""
        kind = self.file.kind or ("can" if self.file.dbc else KINDS.get(recording.suffix.lower(), ""))
        if not self.file.kind and kind == "mdf" and recording.suffix.lower() == ".dat" and is_text(recording):
            kind = "csv"
        if not kind:
            raise UsageError(f"{recording}: expected a file that ends in {', '.join(KINDS)}, or [file] kind in the map")
        if (kind == "can") != bool(self.file.dbc):
            raise UsageError(f"[file] dbc: expected for CAN frames, and only there; the file is of kind {kind}")
        if kind in TIMED and self.timing.column:
            raise UsageError(f"[timing] column: a file of kind {kind} has times of its own: leave it out")
        if kind not in TIMED and not self.timing.column and not self.timing.sample_time:
            raise UsageError("[timing]: missing: column and unit of the time, or sample_time in s")
        return kind


def is_text(recording: Path) -> bool:
    """Returns True if a file is there and does not begin as an MDF does."""
    try:
        with open_regular(recording) as file:
            return not file.read(8).startswith(MDF_BEGINS)
    except OSError:
        return False


def read_map(path: Path) -> tuple[RecordingMap, str]:
    """A map file, and its text."""
    try:
        text = read_text(path, MAX_TOML_BYTES)
    except OSError as err:
        raise UsageError(f"{path}: cannot read the map file: {err.strerror}") from err
    except UnicodeDecodeError as err:
        raise UsageError(f"{path}: cannot read the map file: not UTF-8 text") from err
    return parse_map(text, str(path)), text


def parse_map(text: str, source: str) -> RecordingMap:
    """The map file's text, TOML, as a checked record; messages call it ``source``."""
    return typed.read(RecordingMap, parse_toml(text, source, UsageError), source, UsageError)
