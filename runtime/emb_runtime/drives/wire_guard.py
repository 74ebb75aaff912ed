"""The second guard: the only code that sends a frame on the drive's bus.

It decodes the bytes of the frame bit by bit (:mod:`emb_runtime.drives.signals`, not the encoder's library), and
compares them with the intended current, the message's other signals, checksum and counter. It rejects frames and does
not correct them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from emb_runtime.drives.mapping import ConstantFrame, Mapping, MessageInfo
from emb_runtime.drives.signals import EXACT, Field, physical_value, raw_value
from emb_runtime.errors import SafetyStopError
from emb_runtime.records import Frame

ROUNDING = 1e-6  # Part of a step by which floating-point numbers may be off, beyond half a step


class WireGuardError(SafetyStopError):
    """A frame that the second guard did not send."""


class WireGuard:
    """Sends frames to the drive if they agree with the intended values, with currents up to a limit [A].

    No other object has ``send``, which puts a frame on the bus.
    """

    def __init__(self, mapping: Mapping, limit: float, send: Callable[[Frame], None]) -> None:
        if not 0.0 <= limit < math.inf:
            raise ValueError(f"limit: expected a finite current, got {limit}")
        self._mapping = mapping
        self._limit = limit
        self._send = send
        self._covered = {name: _covered_bits(info) for name, info in mapping.messages.items()}
        self._counter: int | None = None
        self.passed = 0
        self.rejected = 0

    def command(self, frame: Frame, meant: float) -> float:
        """Check a command against the current that it is to carry [A], and send it.

        Returns:
            The current in the bytes, which may differ from the intended one by half a step [A].

        Raises:
            WireGuardError: nothing was sent.
            BusError: the bus did not take it.
        """
        current = self._checked(frame, meant)
        self._send(frame)
        self.passed += 1
        return current

    def constant(self, frame: Frame, constant: ConstantFrame) -> None:
        """Check a frame of a sequence, and send it; raises as :meth:`command`."""
        info = self._mapping.messages[constant.message]
        self._check_kind(frame, info)
        for name, value in (constant.values or {}).items():
            self._check_value(info.fields[name], frame.data, value)
        if frame.data != constant.data:
            raise self._refused(f"{frame.data.hex(' ')} is not the frame of the file")
        self._check_unused(frame.data, info)
        self._send(frame)
        self.passed += 1

    def _checked(self, frame: Frame, meant: float) -> float:
        command = self._mapping.command
        info = self._mapping.messages[command.message]
        self._check_kind(frame, info)
        data, protection = frame.data, info.protection
        value = physical_value(command.field, data)
        least, most = ((0.5 + ROUNDING) * command.field.step(end) for end in (command.low, command.high))
        if not command.low - least <= value <= command.high + most:  # this way round, NaN is refused
            raise self._refused(f"its bytes say {value:g}, the file allows {command.low:g} to {command.high:g}")
        current, step = value / command.factor, command.field.step(value) / abs(command.factor)
        if not abs(meant) <= self._limit:
            raise self._refused(f"{meant:g} A is beyond {self._limit:g} A")
        if not _agrees(current, meant, step):  # so it is within the limit as well, to half a step
            raise self._refused(f"its bytes say {current:g} A, expected {meant:g} A")
        for name, other in command.others.items():
            self._check_value(info.fields[name], data, other)
        self._check_unused(data, info)
        if protection.checksum is not None and raw_value(protection.checksum, data) != protection.checksum_of(data):
            raise self._refused("its checksum is wrong")
        if protection.counter is not None:
            counter = raw_value(protection.counter, data)
            expected = 0 if self._counter is None else protection.next_counter(self._counter)
            if counter != expected:
                raise self._refused(f"its counter is {counter}, expected {expected}")
            self._counter = counter
        return current

    def _check_kind(self, frame: Frame, info: MessageInfo) -> None:
        if (frame.identifier, frame.extended) != (info.identifier, info.extended) or frame.remote or frame.error:
            raise self._refused(f"identifier {frame.identifier:#x} is not that of {info.name}")
        if len(frame.data) != info.length:
            raise self._refused(f"{info.name}: expected {info.length} bytes, got {len(frame.data)}")

    def _check_value(self, field: Field, data: bytes, meant: float) -> None:
        value = physical_value(field, data)
        if not _agrees(value, meant, field.step(value)):
            raise self._refused(f"{field.name} is {value:g}, expected {meant:g}")

    def _check_unused(self, data: bytes, info: MessageInfo) -> None:
        """Refuse a bit that no signal covers."""
        if int.from_bytes(data, "little") & ~self._covered[info.name]:
            raise self._refused(f"{data.hex(' ')} has a bit that no signal covers")

    def _refused(self, reason: str) -> WireGuardError:
        self.rejected += 1
        return WireGuardError(f"the second guard refused a frame: {reason}")


def _agrees(value: float, meant: float, step: float) -> bool:
    """Returns True if a value is the step nearest to the intended one, within floating-point accuracy."""
    return abs(value - meant) <= (0.5 + ROUNDING) * step + EXACT * abs(meant)


def _covered_bits(info: MessageInfo) -> int:
    """Bits of a message's payload, read as one little-endian number, that a signal covers."""
    return sum(1 << position for position in {p for field in info.fields.values() for p in field.positions})
