"""A ring in shared memory from the 1 kHz loop to the recorder: one producer, one consumer, nobody waits.

The producer copies a payload into a slot and then publishes its index; a full ring drops the new record and counts
it, in the shared memory, so that both sides can read the count. Python promises no order of stores between
processes on every processor, so each slot carries a checksum seeded with its index: a slot whose parts are not all
visible yet reads as not written yet, and is read again later. A torn record can therefore not come out.

The second half of the module is what travels: each record as a small fixed ``struct`` after a type byte.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from enum import IntEnum
from typing import Final, NamedTuple

from emb_runtime.records import CYCLE_UNITS, CycleRecord, Frame
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES

SLOT: Final = 256  # Bytes of one slot
MAX_PAYLOAD: Final = SLOT - 8  # Bytes that a record may have

_HEADER: Final = 4096  # one page: magic, slot count, and each index on a cache line of its own
_MAGIC = 0x3130474E49524D45
_SLOTS_AT: Final = 1
_HEAD_AT: Final = 8
_TAIL_AT: Final = 16
_DROPPED_AT: Final = 24
_SLOT_HEAD: Final = struct.Struct("<IHBx")  # checksum, length, kind


def _checksum(index: int, kind: int, payload: bytes) -> int:
    return zlib.crc32(payload, (index ^ (kind << 24) ^ (len(payload) << 12)) & 0xFFFFFFFF)


class Ring:
    """One end of the ring. Exactly one process pushes and exactly one pops.

    Args:
        fd: file descriptor of the shared memory, from :meth:`create` or inherited from the creator; -1 where it is
            memory of this process alone.
        memory: such memory, mapped.

    Raises:
        ValueError: the memory is not a ring of this version.
    """

    def __init__(self, fd: int, memory: mmap.mmap | None = None) -> None:
        size = os.fstat(fd).st_size if memory is None else len(memory)
        if size < _HEADER + SLOT:
            raise ValueError(f"expected a ring in shared memory, got {size} bytes")
        self.fd = fd
        self._memory = mmap.mmap(fd, size) if memory is None else memory
        # Items of a cast view are stored and loaded as whole machine words: an index is never half written.
        self._view = memoryview(self._memory)
        self._words = self._view[:_HEADER].cast("Q")
        self.slots = self._words[_SLOTS_AT]
        """Capacity in records."""
        if self._words[0] != _MAGIC or size != _HEADER + self.slots * SLOT:
            self.close()
            raise ValueError("the shared memory is not a ring of this version")
        self._mask = self.slots - 1
        self._head = self._words[_HEAD_AT]
        self._tail = self._words[_TAIL_AT]

    @classmethod
    def create(cls, slots: int = 1 << 14) -> Ring:
        """A new, empty ring in anonymous shared memory; every page is touched, so that no push faults one in.

        Where there are no processes of our own, both ends are in this one.

        Args:
            slots: how many records fit; a power of two. The default holds about 2 s of a 1 kHz run in 4 MiB.

        Raises:
            ValueError: ``slots`` is no power of two.
            OSError: the system has no memory for it.
        """
        if slots < 1 or slots & (slots - 1):
            raise ValueError(f"expected a power of two of slots, got {slots}")
        size = _HEADER + slots * SLOT
        fd = -1
        if HAS_CHILD_PROCESSES:
            fd = os.memfd_create("emb-ring", os.MFD_CLOEXEC)
            os.ftruncate(fd, size)
        memory = mmap.mmap(fd, size)
        memory.write(bytes(size))
        memory[: 2 * 8] = struct.pack("=QQ", _MAGIC, slots)
        return cls(fd, memory)

    def push(self, kind: int, payload: bytes) -> bool:
        """Append one record (producer only).

        Args:
            kind: a type byte.
            payload: at most :data:`MAX_PAYLOAD` bytes.

        Returns:
            False if the ring was full: the record is dropped and counted.

        Raises:
            ValueError: the payload is too long.
        """
        head = self._head
        if head - self._words[_TAIL_AT] >= self.slots:
            self._words[_DROPPED_AT] += 1
            return False
        length = len(payload)
        if length > MAX_PAYLOAD:
            raise ValueError(f"a record has at most {MAX_PAYLOAD} bytes, got {length}")
        at = _HEADER + (head & self._mask) * SLOT
        _SLOT_HEAD.pack_into(self._memory, at, _checksum(head, kind, payload), length, kind)
        self._view[at + 8 : at + 8 + length] = payload
        self._head = head + 1
        self._words[_HEAD_AT] = head + 1  # published last
        return True

    def pop(self) -> tuple[int, bytes] | None:
        """Take the oldest record as (kind, payload) (consumer only); None if there is none to read now."""
        tail = self._tail
        if self._words[_HEAD_AT] == tail:
            return None
        at = _HEADER + (tail & self._mask) * SLOT
        checksum, length, kind = _SLOT_HEAD.unpack_from(self._memory, at)
        if length > MAX_PAYLOAD:
            return None
        payload = bytes(self._view[at + 8 : at + 8 + length])
        if _checksum(tail, kind, payload) != checksum:
            return None  # its parts are not all visible to this process yet
        self._tail = tail + 1
        self._words[_TAIL_AT] = tail + 1  # hands the slot back
        return kind, payload

    def __len__(self) -> int:
        """Records that were published and not taken yet."""
        return self._words[_HEAD_AT] - self._words[_TAIL_AT]

    @property
    def dropped(self) -> int:
        """Records that did not fit since the ring was created."""
        return self._words[_DROPPED_AT]

    def close(self) -> None:
        """Unmap and close; the other side keeps its own mapping."""
        self._words.release()
        self._view.release()
        self._memory.close()
        if self.fd >= 0:
            os.close(self.fd)


class Kind(IntEnum):
    """The type byte of a record in the ring."""

    FRAME = 1
    CYCLE = 2
    EVENT = 3
    CLOCK = 4
    LINE = 5
    ESTIMATE = 6
    LEARNT = 7


class Direction(IntEnum):
    """Direction of a frame."""

    RX = 0
    TX = 1
    DRIVE_RX = 2  # On the bus of a mapped drive, which is not ours
    DRIVE_TX = 3


class Level(IntEnum):
    """Severity of a log line; the numbers are those of ``foxglove.Log``."""

    DEBUG = 1
    INFO = 2
    WARNING = 3
    ERROR = 4
    FATAL = 5


class FrameRecord(NamedTuple):
    """A frame that was received or sent."""

    direction: Direction
    frame: Frame
    read_ns: int = 0  # Time at which the loop had it, monotonic [ns]; 0 if more frames of the same read follow


class EventRecord(NamedTuple):
    """Something that the safety chain did."""

    time_ns: int  # Monotonic [ns]
    code: str  # A short, stable name
    text: str  # Description for a person


class ClockRecord(NamedTuple):
    """One reading of both clocks."""

    monotonic_ns: int
    wall_ns: int  # Unix time [ns]


class LineRecord(NamedTuple):
    """A line of text for a person."""

    time_ns: int  # Monotonic [ns]
    level: Level
    text: str


class EstimateRecord(NamedTuple):
    """Estimate of the actor at a sample."""

    time_ns: int  # Arrival time of the sample, monotonic [ns]
    step: int
    numbers: tuple[float, ...]  # Values, then their standard deviations


class LearntRecord(NamedTuple):
    """Brakes and states that the shield has left as possible at a sample."""

    time_ns: int  # Arrival time of the sample, monotonic [ns]
    step: int
    numbers: tuple[float, ...]  # See :func:`emb_runtime.learning.known.numbers`


Record = FrameRecord | CycleRecord | EventRecord | ClockRecord | LineRecord | EstimateRecord | LearntRecord

_FRAME: Final = struct.Struct("<qQIBBB8sq")
_CYCLE: Final = struct.Struct(
    "<"
    + "".join(
        "d" if name in CYCLE_UNITS else "q" if name.endswith("_ns") else "i"
        for name in CycleRecord._fields  # in their order
    )
)
_EVENT: Final = struct.Struct("<qB")
_CLOCK: Final = struct.Struct("<qq")
_LINE: Final = struct.Struct("<qB")
_ESTIMATE: Final = struct.Struct("<qi")
_MAX_CODE: Final = 40


def _clipped(text: str, room: int) -> bytes:
    """UTF-8 of a text that fits, cut between characters."""
    data = text.encode("utf-8", "replace")
    return data if len(data) <= room else data[: room - 3].decode("utf-8", "ignore").encode() + "…".encode()


def pack(record: Record) -> tuple[Kind, bytes]:
    """Kind and payload of a record."""
    if isinstance(record, FrameRecord):
        return Kind.FRAME, pack_frame(*record)
    if isinstance(record, CycleRecord):
        return Kind.CYCLE, pack_cycle(record)
    if isinstance(record, EstimateRecord):
        return Kind.ESTIMATE, pack_estimate(*record)
    if isinstance(record, LearntRecord):
        return Kind.LEARNT, pack_estimate(*record)
    if isinstance(record, EventRecord):
        return Kind.EVENT, pack_event(*record)
    if isinstance(record, LineRecord):
        return Kind.LINE, pack_line(*record)
    return Kind.CLOCK, pack_clock(*record)


def pack_frame(direction: Direction, frame: Frame, read_ns: int = 0) -> bytes:
    """Payload of a frame."""
    identifier, data, time_ns, extended, remote, error, own, dropped = frame
    flags = extended | remote << 1 | error << 2 | own << 3
    return _FRAME.pack(time_ns, dropped, identifier, flags, direction, len(data), data, read_ns)


def pack_cycle(record: CycleRecord) -> bytes:
    """Payload of a cycle record."""
    return _CYCLE.pack(*record)


def pack_event(time_ns: int, code: str, text: str) -> bytes:
    """Payload of a safety event; a code beyond 40 bytes and a text beyond the slot are cut."""
    name = _clipped(code, _MAX_CODE)
    head = _EVENT.pack(time_ns, len(name)) + name
    return head + _clipped(text, MAX_PAYLOAD - len(head))


def pack_clock(monotonic_ns: int, wall_ns: int) -> bytes:
    """Payload of a clock reading."""
    return _CLOCK.pack(monotonic_ns, wall_ns)


def pack_line(time_ns: int, level: Level, text: str) -> bytes:
    """Payload of a log line; a text beyond the slot is cut."""
    return _LINE.pack(time_ns, level) + _clipped(text, MAX_PAYLOAD - _LINE.size)


def pack_estimate(time_ns: int, step: int, numbers: tuple[float, ...]) -> bytes:
    """Payload of an estimate; :data:`emb_runtime.policy.contract.MAX_ESTIMATES` of them fit."""
    return _ESTIMATE.pack(time_ns, step) + struct.pack(f"<{len(numbers)}d", *numbers)


def unpack(kind: int, payload: bytes) -> Record:
    """Unpacks a record of :func:`pack_frame` and its siblings.

    Raises:
        ValueError: ``kind`` is unknown.
        struct.error: the payload has the wrong length for it.
    """
    match kind:
        case Kind.FRAME:
            time_ns, dropped, identifier, flags, direction, length, data, read_ns = _FRAME.unpack(payload)
            extended, remote, error, own = (bool(flags & 1 << i) for i in range(4))
            frame = Frame(identifier, data[:length], time_ns, extended, remote, error, own, dropped)
            return FrameRecord(Direction(direction), frame, read_ns)
        case Kind.CYCLE:
            return CycleRecord._make(_CYCLE.unpack(payload))
        case Kind.EVENT:
            time_ns, length = _EVENT.unpack_from(payload)
            code, text = payload[_EVENT.size : _EVENT.size + length], payload[_EVENT.size + length :]
            return EventRecord(time_ns, code.decode(), text.decode())
        case Kind.CLOCK:
            return ClockRecord._make(_CLOCK.unpack(payload))
        case Kind.LINE:
            time_ns, level = _LINE.unpack_from(payload)
            return LineRecord(time_ns, Level(level), payload[_LINE.size :].decode())
        case Kind.ESTIMATE | Kind.LEARNT:
            time_ns, step = _ESTIMATE.unpack_from(payload)
            count = (len(payload) - _ESTIMATE.size) // 8
            numbers = struct.unpack_from(f"<{count}d", payload, _ESTIMATE.size)
            return (EstimateRecord if kind == Kind.ESTIMATE else LearntRecord)(time_ns, step, numbers)
        case _:
            raise ValueError(f"no record in the ring has the kind {kind}")
