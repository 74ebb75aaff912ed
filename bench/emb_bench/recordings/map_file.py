"""The map file: which column of a foreign file is what, in which unit, and what is known of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from emb_bench.brake.parameters import LINEAR, UNITS, in_motor_coordinates
from emb_bench.config.machine import ANGLE, ANGULAR_SPEED, CURRENT, FORCE, LENGTH, PARAMETERS, SPEED, TIME, TORQUE
from emb_runtime.config import typed
from emb_runtime.config.typed import MAX_TOML_BYTES, FieldError, parse_toml
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import read_text

KINDS: Mapping[str, tuple[str, ...]] = {
    "csv": (".csv", ".txt", ".tsv"),
    "parquet": (".parquet",),
    "matlab": (".mat",),
    "mdf": (".mf4", ".mdf", ".dat"),
}
"""Kinds of files, and the endings by which they are known."""
TIMED = "mdf"  # Kind of files whose values have times
MEASURED_UNITS: Mapping[str, Mapping[str, float]] = {
    "angle": {**ANGLE, **LENGTH},
    "velocity": {**ANGULAR_SPEED, **SPEED},
    "command": {**CURRENT, **TORQUE, **FORCE},
    "current": CURRENT,
}
"""Signals, and the units that each can have."""

Positive = Annotated[float, Meta(gt=0.0, description="a positive number")]


class Signal(msgspec.Struct, frozen=True, kw_only=True):
    """One signal of a recording: its column, and how it becomes ours."""

    column: str
    unit: str
    scale: Positive = 1.0  # Factor to ``unit``
    sign: Literal[-1, 1] = 1
    offset: float = 0.0  # Reading of the column at zero, before the factor
    noise: Positive = 0.0  # Standard deviation in ``unit``; 0 if it is not given
    delay: Annotated[float, Meta(ge=-1.0, le=1.0)] = 0.0  # Time by which it acts, or was measured, after its stamp [s]
    between: Literal["open", "held", "linear"] = "open"
    """Course of a command from its stamp to the next one; ``open``: the recording chooses."""


class Signals(msgspec.Struct, frozen=True, kw_only=True):
    """The signals of a recording."""

    angle: Signal
    velocity: Signal | None = None
    command: Signal | None = None
    current: Signal | None = None

    def __post_init__(self) -> None:
        """Check units and noise, and that what acted is known."""
        for name, signal in self.given.items():
            if signal.unit not in MEASURED_UNITS[name]:
                known = ", ".join(MEASURED_UNITS[name])
                raise FieldError(f"{name}.unit", f"expected one of {known}, got {typed.shown(signal.unit)}")
            if name in ("angle", "velocity") and not signal.noise:
                raise FieldError(f"{name}.noise", "missing: standard deviation of the sensor, or its step over 3.5")
        if self.command is None and self.current is None:
            raise FieldError("command", "missing: expected what was commanded, or the current that was measured")

    @property
    def given(self) -> dict[str, Signal]:
        """The signals that there are, by name."""
        return {name: signal for name in MEASURED_UNITS if (signal := getattr(self, name)) is not None}


class Source(msgspec.Struct, frozen=True, kw_only=True):
    """The file of a recording."""

    kind: Annotated[Literal["", "csv", "parquet", "matlab", "mdf"], Meta(description=f"one of {', '.join(KINDS)}")] = (
        ""  # By its ending if it is not given
    )
    delimiter: Literal[",", ";", " ", "|", "tab"] = ","  # Between columns of a CSV file
    decimal: Literal[".", ","] = "."  # Decimal mark in a CSV file
    skip: Annotated[int, Meta(ge=0, le=1000)] = 0  # Lines of a CSV file after its head that are no numbers


class Timing(msgspec.Struct, frozen=True, kw_only=True):
    """Times of the samples."""

    column: str = ""  # Empty where rows are ``sample_time`` apart, or the format has times of its own
    unit: Literal["s", "ms", "us", "ns"] = "s"  # Of the column
    sample_time: Annotated[float, Meta(ge=1e-4, le=0.1, description="a time from 0.0001 to 0.1 s")] = 0.0
    """[s]; 0: the median distance of the angle's samples."""


class Parameters(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters, each in coordinates of the motor or as those of a linear machine; 0 where it is not given."""

    J: Positive = 0.0  # [kg·m²]
    k_m: Positive = 0.0  # [N·m/A]
    k_1: Positive = 0.0  # [N·m/rad] times ``gamma``
    gamma: Positive = 0.0
    T_c: Positive = 0.0  # [N·m]
    f_v: Positive = 0.0  # [N·m·s/rad]
    mass: Positive = 0.0  # [kg]
    F_c: Positive = 0.0  # [N]
    F_v: Positive = 0.0  # [N·s/m]

    def of_the_motor(self, travel: float) -> dict[str, float]:
        """The given ones in coordinates of the motor, of which a radian is ``travel`` metres."""
        found = dict[str, float]()
        for key, value in msgspec.structs.asdict(self).items():
            ours = LINEAR.get(key, key)
            if value and key in LINEAR and not travel:
                raise FieldError(key, "needs [machine] travel, in m per rad of the motor")
            if value and ours in found:
                raise FieldError(key, f"{ours} is given twice: as {ours} and as {key}")
            if value:
                found[ours] = value * (in_motor_coordinates(ours, travel) if key in LINEAR else 1.0)
        return found


class Machine(msgspec.Struct, frozen=True, kw_only=True):
    """Known facts about the machine."""

    guess: Parameters
    known: Parameters = Parameters()
    travel: Positive = 0.0  # Metres per radian of a linear machine; 0 for one that turns
    window: Annotated[float, Meta(ge=1e-3, le=3600.0)] = 0.0  # [s]; 0: the recording chooses
    nuisances: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check that the parameters make a machine."""
        known, guess, every = (self._of_the_motor(name) for name in ("known", "guess", ""))
        if twice := sorted({*known} & {*guess}):
            raise FieldError("guess", f"{', '.join(twice)}: known already: expected each once")
        for name, linear in (("J", "mass"), ("T_c", "F_c"), ("f_v", "F_v")):
            if name not in every:
                other = f", or {linear}" if self.travel else ""
                raise FieldError("guess", f"{name} is missing{other}: known, or a first guess")
        if ("k_1" in every) != ("gamma" in every):
            raise FieldError("known", "k_1 and gamma go together: a spring needs both, a machine without one neither")
        if "gamma" in guess:
            raise FieldError("guess.gamma", "expected under [machine.known]: a gear ratio is not estimated")
        if not self.unknown:
            raise FieldError("guess", "expected at least one parameter that is not known")
        for i, name in enumerate(self.nuisances):
            if name not in UNITS:
                raise FieldError(f"nuisances[{i}]", f"expected one of {', '.join(UNITS)}, got {typed.shown(name)}")
        if {"J", "k_m"} <= {*guess} and not {"T_c", "f_v", "k_1"} & {*known}:
            raise FieldError(
                "guess", "k_m, J and all loads scale together: without one that is known only ratios can be told"
            )

    def _of_the_motor(self, name: str) -> dict[str, float]:
        if not name:
            return self._of_the_motor("known") | self._of_the_motor("guess")
        parameters: Parameters = getattr(self, name)
        try:
            return parameters.of_the_motor(self.travel)
        except FieldError as err:
            raise FieldError(f"{name}.{err.key}", str(err)) from err

    @property
    def parameters(self) -> dict[str, float]:
        """Known and guessed values in coordinates of the motor, SI units."""
        return self._of_the_motor("")

    @property
    def unknown(self) -> tuple[str, ...]:
        """Parameters to be estimated."""
        guess = self._of_the_motor("guess")
        return tuple(name for name in PARAMETERS if name in guess)


class RecordingMap(msgspec.Struct, frozen=True, kw_only=True):
    """A map file."""

    schema: Literal[1]
    name: str
    signals: Signals
    machine: Machine
    file: Source = Source()
    timing: Timing = Timing()

    def __post_init__(self) -> None:
        """Check what the signals need of the machine."""
        machine = self.machine
        for name, signal in self.signals.given.items():
            if signal.unit in (*LENGTH, *SPEED, *FORCE) and not machine.travel:
                raise FieldError(
                    f"signals.{name}.unit", f"{signal.unit} needs [machine] travel, in m per rad of the motor"
                )
        unit, has_k_m = self.command_unit, "k_m" in machine.parameters
        if unit in (*TORQUE, *FORCE) and (has_k_m or self.signals.current is not None):
            raise FieldError(
                "signals.command.unit", f"a command in {unit} has no k_m and no current: its k_m is 1 N·m per A"
            )
        if unit in CURRENT and not has_k_m:
            raise FieldError(
                "signals.command.unit",
                f"a command in {unit} needs [machine] k_m, known or guessed, in N·m per {unit}",
            )

    @property
    def command_unit(self) -> str:
        """Unit of what was commanded, or of the current where only that was measured."""
        return "A" if self.signals.command is None else self.signals.command.unit

    @property
    def between(self) -> str:
        """``open`` where the recording is to choose the course of a command between its stamps, else ``held``."""
        command = self.signals.command
        return "open" if self.signals.current is None and command is not None and command.between == "open" else "held"

    @property
    def shown(self) -> dict[str, str]:
        """Units in which results are shown: those of the recording."""
        return {"angle": self.signals.angle.unit, "command": self.command_unit}

    @property
    def time_unit(self) -> float:
        """Seconds in a unit of the time column."""
        return TIME[self.timing.unit]

    def kind_of(self, recording: Path) -> str:
        """Kind of a recording's file, a key of ``KINDS``."""
        by_ending = (kind for kind, endings in KINDS.items() if recording.suffix.lower() in endings)
        kind = str(self.file.kind) or next(by_ending, "")
        if not kind:
            endings = ", ".join(ending for some in KINDS.values() for ending in some)
            raise UsageError(f"{recording}: expected a file that ends in {endings}, or [file] kind in the map")
        if kind == TIMED and self.timing.column:
            raise UsageError(f"[timing] column: a file of kind {kind} has times of its own: leave it out")
        if kind != TIMED and not self.timing.column and not self.timing.sample_time:
            raise UsageError("[timing]: missing: column and unit of the time, or sample_time in s")
        return kind


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
    try:
        document = parse_toml(text)
    except ValueError as err:
        raise UsageError(f"{source}: {err}") from err
    return typed.read(RecordingMap, document, source, UsageError)
