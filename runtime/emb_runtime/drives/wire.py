"""Translation of a drive's frames: current to bytes, bytes to samples. cantools is the codec.

Pure, but for :class:`Outlet`, which hands each frame to the second guard.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple

from emb_runtime.can.e2e import LeakyCount
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.drives.mapping import ConstantFrame, Mapping, MessageInfo
from emb_runtime.drives.signals import physical_value, raw_value
from emb_runtime.drives.wire_guard import WireGuard, WireGuardError
from emb_runtime.errors import FrameError
from emb_runtime.records import Frame


class DriveState(StrEnum):
    """State of the drive, as far as it reports one."""

    UNKNOWN = "unknown"  # It has reported nothing yet, or its last report is too old
    IDLE = "idle"
    ACTIVE = "active"
    FAULT = "fault"  # It reports an error, or a state that the file does not name


class DriveSample(NamedTuple):
    """Measurements of one sample."""

    angle: float  # [rad]
    velocity: float  # [rad/s]
    current: float  # Measured [A]; NaN where the drive does not measure it
    time_ns: int  # Arrival of the first of its frames [ns]


class Encoder:
    """Makes the frames that command a drive."""

    def __init__(self, mapping: Mapping) -> None:
        self._mapping = mapping
        self._info = mapping.messages[mapping.command.message]
        self._counter = 0

    def command(self, current: float) -> Frame:
        """The frame that commands a current [A]; FrameError if it is not finite, or beyond the file's range."""
        command = self._mapping.command
        value = current * command.factor
        if not command.low <= value <= command.high:  # this way round, NaN is refused
            raise FrameError(
                f"{command.message}.{command.field.name}: expected {command.low:g} to {command.high:g}, got {value:g}"
            )
        return self.value(value)

    def value(self, value: float) -> Frame:
        """The frame with a value of the command's signal [DBC units]; FrameError if it cannot be encoded."""
        command, protection = self._mapping.command, self._info.protection
        values = {**command.others, command.field.name: value}
        for field, raw in ((protection.counter, self._counter), (protection.checksum, 0)):
            if field is not None:
                values[field.name] = raw * field.scale + field.offset
        try:
            data = bytearray(self._info.dbc.encode(values, padding=False, strict=True))
        except Exception as err:  # of several kinds, by what does not fit
            raise FrameError(f"{command.message}: {' '.join(str(err).split())}") from err
        if protection.checksum is not None:
            size, big = protection.checksum.length // 8, protection.checksum.big_endian
            first = min(protection.checksum.positions) // 8
            data[first : first + size] = protection.checksum_of(bytes(data)).to_bytes(size, "big" if big else "little")
        if protection.counter is not None:
            self._counter = protection.next_counter(self._counter)
        return self._info.frame(bytes(data))


class Outlet:
    """Sends frames to a drive, with currents up to a limit [A]; one that the full queue refuses is lost and counted.

    Its methods raise BusError if the bus is lost.
    """

    def __init__(self, mapping: Mapping, limit: float, send: Callable[[Frame], None]) -> None:
        self._mapping, self._encoder = mapping, Encoder(mapping)
        self.guard = WireGuard(mapping, limit, send)
        self.not_sent = 0
        self.currents = (0.0, 0.0)
        """Currents that the last two commands carried, the newest last [A]."""
        self.largest = 0.0
        """Largest current of the latest run [A]."""

    def command(self, current: float) -> bool:
        """Send a current [A]; returns True if it was sent. A refused current raises FrameError or WireGuardError."""
        try:
            carried = self.guard.command(self._encoder.command(current), current)
        except TransmitQueueFullError:
            self.not_sent += 1
            return False
        self.currents = self.currents[1], carried
        self.largest = max(self.largest, abs(current))
        return True

    def send(self, constant: ConstantFrame) -> str:
        """Send a frame of a sequence; returns the reason if it is refused, else nothing."""
        try:
            self.guard.constant(self._mapping.messages[constant.message].frame(constant.data), constant)
        except TransmitQueueFullError:
            self.not_sent += 1
        except WireGuardError as refused:
            return str(refused)
        return ""

    def applied(self, sample: DriveSample) -> float:
        """Current in the period that ended [A]: measured; commanded if both agree within a step of the measurement."""
        measured, commanded = self._mapping.current, self.currents[0 if self._mapping.polled else 1]
        if measured is None:  # a polled drive packs its answer before it applies the command
            return commanded
        step = measured.field.step(sample.current / measured.factor) * abs(measured.factor)
        return commanded if abs(sample.current - commanded) <= step else sample.current


class Receiver:
    """Makes samples of the drive's frames.

    A sample is complete when each of its messages has come once, all within ``pair_within``. A leaky count limits the
    frames that are missing by a message's counter: ``tolerated`` in a row are too many, and so is a large share.
    """

    def __init__(self, mapping: Mapping, tolerated: int) -> None:
        self._mapping = mapping
        self._sensors = mapping.sensor_messages
        received = self._sensors | ({mapping.state.message} if mapping.state else set())
        self._infos: dict[tuple[bool, int], list[MessageInfo]] = {}
        for info in (mapping.messages[name] for name in sorted(received)):
            self._infos.setdefault((info.extended, info.identifier), []).append(info)
        self._counters: dict[str, int] = {}
        self._missing = {name: LeakyCount(tolerated) for name in received}
        self._waiting: dict[str, tuple[dict[str, float], int]] = {}
        self._turns = 0.0
        self._wrapped: float | None = None
        self.last_state = DriveState.UNKNOWN  # State in the latest message with it, of any age
        self.state_ns = 0
        """Arrival of the latest message with the state [ns]."""
        self.rejected: dict[str, int] = {}
        """Number of rejected frames by reason."""
        self.refusal = ""
        """Latest rejected frame, with the found and the expected value; empty if there is none."""
        self.reported = ""  # State in the latest message, and the expected ones

    @property
    def frames_missing(self) -> str:
        """Name of a message with too many missing frames by its counter; empty if there is none."""
        return next((name for name, missing in self._missing.items() if missing.exceeded), "")

    def state(self, now_ns: int) -> DriveState:
        """State of the drive now (monotonic [ns])."""
        state = self._mapping.state
        if state is not None and now_ns - self.state_ns > state.timeout * 1e9:
            return DriveState.UNKNOWN
        return self.last_state

    def add_frame(self, frame: Frame) -> DriveSample | None:
        """Add a frame from the bus; returns the sample that it completes.

        Frames of other nodes are ignored; invalid frames are counted.
        """
        sample = None
        for info in self._infos.get((frame.extended, frame.identifier), ()):
            if frame.own or frame.error or not _is_of(info, frame) or (values := self._valid(info, frame)) is None:
                continue
            if self._mapping.state is not None and info.name == self._mapping.state.message:
                self._take_state(values, frame.time_ns)
            if info.name in self._sensors:
                sample = self._pair(info.name, values, frame.time_ns) or sample
        return sample

    def _valid(self, info: MessageInfo, frame: Frame) -> dict[str, float] | None:
        """Values of a valid frame, else None."""
        if frame.remote or len(frame.data) != info.length:
            lengths = f"{len(frame.data)} bytes came, the DBC has {info.length}"
            self._reject("wrong length", f"{info.name}: wrong length: {lengths}")
            return None
        if why := info.protection.fault(frame.data):
            self._reject(why, f"{info.name}: {why}")
            return None
        counter = info.protection.counter
        if counter is not None:
            count = raw_value(counter, frame.data)
            if self._counters.get(info.name) == count:
                self._reject("repeated", f"{info.name}: repeated")
                return None
            self._missing[info.name].forgive()
            if info.name in self._counters:
                self._missing[info.name].reject((count - self._counters[info.name]) % info.protection.modulus - 1)
            self._counters[info.name] = count
        decoded = info.dbc.decode(frame.data, decode_choices=False)
        assert isinstance(decoded, dict)
        values = {name: float(value) for name, value in decoded.items() if isinstance(value, int | float)}
        for measured in self._mapping.measured:
            if measured.message == info.name:
                value = values[measured.field.name]
                if not measured.low <= value <= measured.high:  # this way round, NaN is refused
                    name, ends = measured.field.name, f"{measured.low:g} to {measured.high:g}"
                    self._reject(f"{name} out of range", f"{info.name}.{name} out of range: {value:g}, not {ends}")
                    return None
        return values

    def _reject(self, reason: str, refusal: str) -> None:
        self.rejected[reason] = self.rejected.get(reason, 0) + 1
        self.refusal = refusal

    def _take_state(self, values: dict[str, float], time_ns: int) -> None:
        state = self._mapping.state
        assert state is not None
        value = values[state.field.name]
        named = f"idle is {', '.join(map(str, state.idle))}, active {', '.join(map(str, state.active))}"
        self.reported = f"{state.message}.{state.field.name} is {value:.0f}; {named}"
        if state.error is not None and values[state.error.name] != 0.0:
            self.last_state = DriveState.FAULT
            self.reported = f"{state.message}.{state.error.name} is {values[state.error.name]:.0f}, not 0"
        elif value in state.idle:
            self.last_state = DriveState.IDLE
        else:
            self.last_state = DriveState.ACTIVE if value in state.active else DriveState.FAULT
        self.state_ns = time_ns

    def _pair(self, name: str, values: dict[str, float], time_ns: int) -> DriveSample | None:
        waiting = self._waiting
        waiting[name] = values, time_ns
        apart_ns = self._mapping.pair_within * 1e9
        for other in [other for other, (_, since_ns) in waiting.items() if time_ns - since_ns > apart_ns]:
            del waiting[other]  # its partner did not come
        if waiting.keys() != self._sensors:
            return None
        angle, *others = (waiting[of.message][0][of.field.name] for of in self._mapping.measured)
        velocity, *current = (of.si(v) for of, v in zip(self._mapping.measured[1:], others, strict=True))
        begun_ns = min(since_ns for _, since_ns in waiting.values())
        waiting.clear()
        return DriveSample(self._angle(angle), velocity, current[0] if current else math.nan, begun_ns)

    def _angle(self, value: float) -> float:
        """Angle [rad]; one that wraps around is continued from the last one, the first within half a turn.

        Between two samples the motor must turn by less than half a turn.
        """
        measured = self._mapping.angle
        if measured.wrap:
            last = 0.0 if self._wrapped is None else self._wrapped
            self._turns -= measured.wrap * round((value + self._turns - last) / measured.wrap)
            value = self._wrapped = value + self._turns
        return measured.si(value)


def conditions_in(mapping: Mapping, frame: Frame) -> dict[str, float]:
    """Temperature [degC] and supply voltage [V] in a frame of the drive, by name, if they are valid."""
    found = {}
    for name, one in mapping.conditions.items():
        info = mapping.messages[one.message]
        if (frame.identifier, frame.extended, frame.own, frame.error) != (info.identifier, info.extended, False, False):
            continue
        is_complete = not frame.remote and len(frame.data) == info.length and not info.protection.fault(frame.data)
        if is_complete and _is_of(info, frame):
            value = physical_value(one.field, frame.data)
            if one.low <= value <= one.high:  # this way round, NaN is none
                found[name] = one.si(value)
    return found


def _is_of(info: MessageInfo, frame: Frame) -> bool:
    """True if a frame of the message's identifier has its multiplexor value, or is too short to have one."""
    is_complete = not frame.remote and len(frame.data) == info.length
    return info.page is None or not is_complete or raw_value(info.page, frame.data) == info.page_value
