"""A drive as its mapping file describes it: what the signals of its DBC are to a brake, and its fit to a bench.

:mod:`emb_runtime.drives.mapping_file` reads the records.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from collections.abc import Mapping as Dictionary
from dataclasses import dataclass
from typing import TYPE_CHECKING

from emb_runtime.can.codec import worst_bits
from emb_runtime.config.bench import HIGHEST_BUS_LOAD, Bench, Sensors
from emb_runtime.drives.signals import Field, Protection
from emb_runtime.errors import BenchFileError, UsageError
from emb_runtime.records import Frame
from emb_runtime.safety.end_stop import released_speed

if TYPE_CHECKING:
    from cantools.database.can import Message as DbcMessage

PROPERTIES = {
    "no_answers": "the drive does not check which sample a command answers: a late command still acts",
    "no_echo": "the drive does not report which command it obeyed: every sent command counts as obeyed",
    "no_device_time": "the samples have no time stamps of the drive: this computer's times are used, on a grid",
    "no_identity": "the drive has no identity on the bus: a wrong drive is not refused",
    "hold_on_loss": "without host or cable the drive holds its last current for its time-out, then switches it off",
    "no_counter": "the sensor messages have no counter: a repeated one is not noticed, nor is a frozen sensor at rest",
    "no_crc": "the sensor messages have no checksum",
    "no_command_crc": "the command message has no checksum",
    "no_current": "the current is not measured: the commanded current is used instead",
    "no_state": "the drive does not report whether it is armed: its time-out cannot be proved",
    "relative_k_m": "the command is not a current: only the ratio of k_m to per_ampere can be estimated",
}
"""Properties that a drive may lack, and what is lost with each. Each must be accepted by name."""


PASSED_PERIODS = 2
"""Periods by which the proof of a time-out lets it be longer: the drive looks at its clock, its message waits."""


class MappingError(UsageError):
    """A mapping file, or its DBC, is missing, malformed, incomplete, or lacks what nothing replaces."""


@dataclass(frozen=True)
class Measured:
    """A signal that measures something."""

    message: str
    field: Field
    factor: float  # SI units per DBC unit, sign included
    offset: float  # SI value at zero
    low: float
    high: float  # Least and largest value that is believed [DBC units]
    wrap: float  # Period after which it wraps around [DBC units]; 0 if it does not

    def si(self, value: float) -> float:
        """A value in DBC units in SI units."""
        return value * self.factor + self.offset

    @property
    def ends(self) -> tuple[float, float]:
        """Values that it may have [SI units]; all where it wraps around."""
        return (-math.inf, math.inf) if self.wrap else (self.si(self.low), self.si(self.high))


@dataclass(frozen=True)
class Commanded:
    """The signal that commands, and its message."""

    message: str
    field: Field
    factor: float  # DBC units per ampere, sign included
    low: float
    high: float  # Least and largest value that may leave [DBC units]
    others: Dictionary[str, float]  # Values of the message's other signals, protection excepted [DBC units]
    is_current: bool  # False for a torque, of which ``per_ampere`` makes an ampere


@dataclass(frozen=True)
class State:
    """The signal of the drive's state."""

    message: str
    field: Field
    idle: tuple[int, ...]
    active: tuple[int, ...]
    timeout: float  # Age at which a report is no longer believed [s]
    error: Field | None  # Signal of the same message that is 0 where the drive is well


@dataclass(frozen=True)
class MessageInfo:
    """One message, of a multiplexed one what has one value of its multiplexor."""

    name: str  # ``MESSAGE``, or ``MESSAGE[value]``
    dbc: DbcMessage  # As cantools encodes and decodes it
    identifier: int
    extended: bool
    length: int  # Payload bytes
    fields: Dictionary[str, Field]
    protection: Protection
    page: Field | None = None  # Multiplexor; None where there is none
    page_value: int = 0  # Its value

    @property
    def worst_bits(self) -> int:
        """Most bits that one frame takes on the bus, see :func:`emb_runtime.can.codec.worst_bits`."""
        return worst_bits(self.length, extended=self.extended)

    def frame(self, data: bytes) -> Frame:
        """A frame with this payload."""
        return Frame(self.identifier, data, extended=self.extended)


@dataclass(frozen=True)
class ConstantFrame:
    """A frame of a sequence: always the same."""

    message: str
    data: bytes
    values: Dictionary[str, float] | None  # Values of its signals [DBC units]; None where the file gives the bytes


@dataclass(frozen=True)
class Step:
    """A step of a sequence: frames, then a wait."""

    frames: tuple[ConstantFrame, ...]
    state: str  # ``idle`` or ``active``: state to wait for; empty for a pause of ``timeout``
    timeout: float  # [s]


@dataclass(frozen=True)
class Mapping:
    """A drive, as its mapping file describes it."""

    name: str
    polled: bool  # The drive answers each command, and sends nothing by itself
    bitrate: int  # Of the drive's bus [bit/s]
    pair_within: float  # Longest time between the messages of one sample [s]
    messages: Dictionary[str, MessageInfo]  # Those that are used, by name
    angle: Measured
    velocity: Measured
    sensors: Sensors  # Origin of the velocity; a sensor where the file has none
    current: Measured | None
    conditions: Dictionary[str, Measured]  # Temperature [degC] and supply voltage [V], by name: nothing acts on them
    command: Commanded
    state: State | None
    arm: tuple[Step, ...]
    disarm: tuple[Step, ...]
    watchdog: float  # The drive's time-out [s]
    end_stop_speed: float  # Speed into an end stop that the brake bears [rad/s]: without host or cable nothing stops it
    text: str
    dbc_text: str

    @property
    def sha256(self) -> str:
        """See :func:`mapping_hash`."""
        return mapping_hash(self.text, self.dbc_text)

    def longest_hold(self, sample_time: float) -> float:
        """Longest time for which an armed drive holds its last current without commands, for a sample time [s]."""
        return self.watchdog + PASSED_PERIODS * sample_time

    @property
    def lost(self) -> tuple[str, ...]:
        """Names in :data:`PROPERTIES` of what the drive cannot give."""
        sensors = [self.messages[measured.message].protection for measured in (self.angle, self.velocity)]
        has = {
            "no_counter": all(protection.counter is not None for protection in sensors),
            "no_crc": all(protection.checksum is not None for protection in sensors),
            "no_command_crc": self.messages[self.command.message].protection.checksum is not None,
            "no_current": self.current is not None,
            "no_state": self.state is not None,
            "relative_k_m": self.command.is_current,
        }
        return tuple(name for name in PROPERTIES if not has.get(name))

    @property
    def measured(self) -> tuple[Measured, ...]:
        """Signals that make a sample."""
        return self.angle, self.velocity, *([] if self.current is None else [self.current])

    @property
    def sensor_messages(self) -> frozenset[str]:
        """Names of the messages that make a sample."""
        return frozenset(measured.message for measured in self.measured)

    def bus_load(self, sample_time: float) -> float:
        """Worst-case share of the drive's bus that a run takes at a sample time [s], 1.0 being all of it.

        Sensor messages and command come each sample; a message with the state alone comes once in its time-out.
        """
        each = sum(self.messages[name].worst_bits for name in (*self.sensor_messages, self.command.message))
        load = each / sample_time
        if self.state is not None and self.state.message not in self.sensor_messages:
            load += self.messages[self.state.message].worst_bits / self.state.timeout
        return load / self.bitrate


def mapping_hash(text: str, dbc_text: str) -> str:
    """SHA-256 of a mapping file and its DBC: the drive's part of a bench's identity."""
    return hashlib.sha256(f"{text}\0{dbc_text}".encode()).hexdigest()


COARSEST_CURRENT = 0.1  # Coarsest step of a command [A]
LONGEST_PAIR_PERIODS = 0.5  # Longest ``can.pair_within``, in periods: later frames are of the next sample


def require_fit(mapping: Mapping, bench: Bench) -> None:
    """Refuse a mapping that does not cover what the bench may command and measure.

    Raises:
        MappingError: a range or step of the mapping is not enough for the bench, or a time-out too long.
        BenchFileError: the bench file does not declare what the drive does.
    """
    if bench.can.mapping not in ("", mapping.sha256):
        raise MappingError(
            f"{mapping.name}: its SHA-256 with its DBC is {mapping.sha256}, the bench file was made for another "
            f"(can.mapping = {bench.can.mapping[:12]}…)"
        )
    for key, reason in _fit_problems(mapping, bench):
        raise MappingError(f"{mapping.name}: {key}: {reason}")
    of_drive, declared = mapping.sensors.bandwidth, bench.sensors.bandwidth
    if of_drive is not None and (declared is None or declared > of_drive):
        raise BenchFileError(
            f"sensors: the velocity of {mapping.name} is {mapping.sensors} (can.signals.velocity of the mapping), and "
            f"the bench file declares {bench.sensors}: declare it as the mapping does, or slower"
        )
    least = 1 if mapping.polled else 0
    low, high = bench.shield.frame_age
    if high < 1 or low != least:
        raise BenchFileError(
            f"shield.frame_age: a mapped drive does not answer by sample: declare [{least}, 1] or a later end, got "
            f"[{low}, {high}]; --zero measures it"
        )


def _fit_problems(mapping: Mapping, bench: Bench) -> Iterator[tuple[str, str]]:
    """Keys of a mapping that are not enough for a bench, or too long, and why."""
    limits, command = bench.limits, mapping.command
    currents = -limits.current, limits.current
    for name, ends, needed, unit in (
        ("command", (command.low / command.factor, command.high / command.factor), currents, "A"),
        ("angle", mapping.angle.ends, limits.angle, "rad"),
        ("velocity", mapping.velocity.ends, (-limits.velocity, limits.velocity), "rad/s"),
    ):
        low, high = sorted(ends)
        covers = low <= needed[0] and needed[1] <= high
        if name == "command":  # as the encoder compares: a quotient may be rounded the other way
            covers = all(command.low <= current * command.factor <= command.high for current in needed)
        if not covers:
            covered = f"{low:.4g} to {high:.4g} {unit} does not cover"
            yield f"can.signals.{name}.range", f"{covered} the bench's {needed[0]:g} to {needed[1]:g} {unit}"
    step = max(map(command.field.step, (command.low, command.high))) / abs(command.factor)
    if not step <= COARSEST_CURRENT:
        yield "can.signals.command", f"a step of {step:.3g} A is too coarse, expected at most {COARSEST_CURRENT:g} A"
    if mapping.pair_within > LONGEST_PAIR_PERIODS * bench.timing.sample_time:
        yield "can.pair_within", f"expected at most half of the bench's sample time, got {mapping.pair_within:g} s"
    if mapping.watchdog > bench.node.watchdog:
        longest = f"the bench's node.watchdog = {bench.node.watchdog:g} s"
        yield "node.watchdog", f"{mapping.watchdog:g} s is longer than {longest}"
    hold = mapping.longest_hold(bench.timing.sample_time)
    if (worst := released_speed(bench, hold)) > mapping.end_stop_speed:
        yield (
            "node.end_stop_speed",
            f"without host or cable the drive holds its current for up to {hold:g} s, then switches it off: the "
            f"brake may reach {worst:.4g} rad/s, and bears {mapping.end_stop_speed:g} rad/s; narrow the bench's limits",
        )
    if (load := mapping.bus_load(bench.timing.sample_time)) > HIGHEST_BUS_LOAD:
        taken = f"at {mapping.bitrate} bit/s its frames take {load:.0%} of its bus at worst"
        yield "can.bitrate", f"{taken}, expected at most {HIGHEST_BUS_LOAD:.0%}"
