"""Messages of ``emb.dbc``: plain little-endian signals, end-to-end protected; and a decoder by that table.

The loop uses functions that are generated from it (:mod:`emb_runtime.can.generated`); the guard, the log and the
reasons of a rejection use the table. What does not fit raises: nothing is masked or clipped into shape.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from importlib.metadata import distribution
from types import ModuleType
from typing import TYPE_CHECKING, Any

from emb_runtime.can import e2e
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame

if TYPE_CHECKING:
    from cantools.database.can import Database


Number = int | float  # An int where it has no fraction


class Fault(StrEnum):
    """Reasons to reject a frame, in the order of the checks."""

    KIND = "not a classical data frame of this message"
    LENGTH = "wrong length"
    CRC = "wrong CRC"
    COUNTER = "invalid alive counter"
    RESERVED = "reserved bit set"
    RANGE = "value out of range"


class FrameRejectedError(FrameError):
    """A received frame does not fit its message; ``fault`` is the reason."""

    def __init__(self, message: str, fault: Fault) -> None:
        super().__init__(message)
        self.fault = fault


@dataclass(frozen=True)
class Signal:
    """One signal: what it means, and where it is."""

    name: str
    unit: str
    minimum: Number  # Least value in ``unit``; beyond it nothing is sent and nothing believed
    maximum: Number
    factor: Number  # Step in ``unit``; 1 where the values are integers
    shift: int  # Bits below it in the payload as one little-endian word
    mask: int  # Bit mask of the signal's width
    sign: int  # Its sign bit; 0 if unsigned
    raw_minimum: int
    raw_maximum: int

    @property
    def range_text(self) -> str:
        """The range for a message."""
        return f"a value from {self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()

    def saturated(self, value: Number) -> Number:
        """A value within the range: a sensor beyond it shows its end; it does not wrap or stop sending."""
        return min(max(value, self.minimum), self.maximum)


@dataclass(frozen=True)
class Message:
    """One message."""

    name: str
    identifier: int
    length: int  # Payload bytes
    data_id: int  # End-to-end data id, 16 bits; on the bus in the CRC only
    cycle_time: float  # [s]
    signals: tuple[Signal, ...]  # As they lie in the payload: the CRC first, then the alive counter
    reserved: int  # Ones where no signal is, in the payload word
    crc_start: int  # :func:`emb_runtime.can.e2e.profile1_start` of the data id

    def decode(self, frame: Frame) -> dict[str, Number]:
        """Physical value of every signal by name, of a frame that is valid in all respects; else FrameRejectedError."""
        data = frame.data
        if frame.identifier != self.identifier or frame.extended or frame.remote or frame.error:
            raise self._rejected(Fault.KIND, f"expected 11-bit identifier {self.identifier:#05x}, got {frame}")
        if len(data) != self.length:
            raise self._rejected(Fault.LENGTH, f"expected {self.length} bytes, got {len(data)}")
        if not e2e.has_valid_crc(self.crc_start, data):
            raise self._rejected(Fault.CRC, f"{data.hex(' ')} is damaged, or its sender has another data id")
        if data[1] & 0x0F == e2e.NO_COUNTER:
            raise self._rejected(Fault.COUNTER, f"expected 0..{e2e.COUNTER_MODULUS - 1}, got {e2e.NO_COUNTER}")
        word = int.from_bytes(data, "little")
        if word & self.reserved:
            raise self._rejected(Fault.RESERVED, f"{data.hex(' ')}; does its sender speak another protocol version?")
        values: dict[str, Number] = {}
        for signal in self.signals:
            raw = (word >> signal.shift & signal.mask ^ signal.sign) - signal.sign
            value = values[signal.name] = raw * signal.factor
            if not signal.raw_minimum <= raw <= signal.raw_maximum:
                raise self._rejected(Fault.RANGE, f"{signal.name}: expected {signal.range_text}, got {value:g}")
        return values

    def refusal(self, values: Mapping[str, Number]) -> FrameError:
        """The error about the first of these values, by signal, that a frame cannot carry."""
        for name, value in values.items():
            signal = self.signal(name)
            if not signal.minimum <= value <= signal.maximum:  # this way round, NaN is refused
                return FrameError(f"{self.name}.{name}: expected {signal.range_text}, got {value!r}")
            if signal.factor == 1 and int(value) != value:
                return FrameError(f"{self.name}.{name}: expected a whole number, got {value!r}")
        raise ValueError(f"{self.name}: a frame can carry {values}")

    def _rejected(self, fault: Fault, detail: str) -> FrameRejectedError:
        return FrameRejectedError(f"{self.name}: frame rejected, {fault}: {detail}", fault)

    def signal(self, name: str) -> Signal:
        """The signal of that name."""
        return next(s for s in self.signals if s.name == name)

    @property
    def worst_bits(self) -> int:
        """Most bits that one frame takes on the bus, see :func:`worst_bits`."""
        return worst_bits(self.length)


def from_document(found: Mapping[str, Any]) -> Message:
    """A message of its fields as JSON has them; by hand: a compiled record has no types of fields."""
    return Message(**{**found, "signals": tuple(Signal(**signal) for signal in found["signals"])})


def worst_bits(length: int, *, extended: bool = False) -> int:
    """Most bits that a frame of a payload [bytes] takes on the bus, bit stuffing and interframe space included.

    With an 11-bit identifier 34 + 8n bits can be stuffed, with one of 29 bits 54 + 8n, one after every four at worst,
    and 13 cannot (Davis, Burns, Bril, Lukkien: "Controller Area Network (CAN) schedulability analysis", 2007, eq. 1
    and 2).
    """
    return (80 if extended else 55) + 10 * length


@contextmanager
def _database_only() -> Iterator[None]:
    """Import ``cantools.database`` without its package, whose imports (python-can) take a tenth of a second."""
    if "cantools" in sys.modules:
        yield
        return
    package = ModuleType("cantools")
    package.__path__ = [str(distribution("cantools").locate_file("cantools"))]
    sys.modules["cantools"] = package
    try:
        yield
    finally:
        del sys.modules["cantools"]


def parse(text: str) -> Database:
    """Read the text of a DBC file; raises FrameError if it is none."""
    with _database_only():  # here, for only a process that speaks CAN needs it
        from cantools.database.can import Database

    database = Database()
    try:
        database.add_dbc_string(text)
    except Exception as err:  # of any kind, by what is wrong in the text
        raise FrameError(f"DBC: not readable: {err}") from err
    return database


def describe(source: Any) -> Message:
    """The description of a message of ``emb.dbc``, of cantools'."""
    signals = tuple(map(_describe_signal, sorted(source.signals, key=lambda signal: signal.start)))
    data_id = int(source.dbc.attributes["DataId"].value)
    return Message(
        name=source.name,
        identifier=source.frame_id,
        length=source.length,
        data_id=data_id,
        cycle_time=source.cycle_time * 1e-3,
        signals=signals,
        reserved=((1 << 8 * source.length) - 1) & ~sum(s.mask << s.shift for s in signals),
        crc_start=e2e.profile1_start(data_id),
    )


def _describe_signal(source: Any) -> Signal:
    factor, minimum, maximum = map(_number, (source.scale, source.minimum, source.maximum))
    return Signal(
        name=source.name,
        unit=source.unit or "",
        minimum=minimum,
        maximum=maximum,
        factor=factor,
        shift=source.start,
        mask=(1 << source.length) - 1,
        sign=1 << (source.length - 1) if source.is_signed else 0,
        raw_minimum=round(minimum / factor),
        raw_maximum=round(maximum / factor),
    )


def _number(value: float) -> Number:
    """An int where the number has no fraction, so that counters and states decode to ints."""
    return int(value) if float(value).is_integer() else float(value)
