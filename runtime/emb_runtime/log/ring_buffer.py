"""A ring in shared memory from the 1 kHz loop to the recorder: one producer, one consumer, nobody waits.

The producer copies a payload into a slot and then publishes its index; a full ring drops the new record and counts
it, in the shared memory, so that both sides can read the count. Python promises no order of stores between
processes on every processor, so each slot carries a checksum seeded with its index: a slot whose parts are not all
visible yet reads as not written yet, and is read again later. A torn record can therefore not come out.

The second half of the module is what travels: the records, each as MessagePack after a type byte.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from enum import IntEnum
from typing import Final, NamedTuple, cast

from msgspec import msgpack

from emb_runtime.records import CycleRecord, Frame
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
        self.slots = self._words[_SLOTS_AT]  # Capacity in records
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


class Direction(IntEnum):
    """Direction of a frame."""

    RX = 0
    TX = 1


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

RECORDS: Final = (FrameRecord, CycleRecord, EventRecord, ClockRecord, LineRecord, EstimateRecord, LearntRecord)
"""Types of the records; a type's place is its type byte in the ring."""
KINDS: Final = {record: kind for kind, record in enumerate(RECORDS)}

_MAX_CODE: Final = 40  # Bytes of an event's code
_MAX_EVENT_TEXT: Final = MAX_PAYLOAD - _MAX_CODE - 16
_MAX_LINE: Final = MAX_PAYLOAD - 16

_ENCODER: Final = msgpack.Encoder(enc_hook=lambda number: number.item())  # of numpy
_DECODERS: Final = tuple(msgpack.Decoder(record) for record in RECORDS)


def pack(record: Record) -> tuple[int, bytes]:
    """Type byte and payload of a record: MessagePack of its fields. Texts beyond the slot are cut."""
    if isinstance(record, EventRecord):
        time_ns, code, text = record
        record = EventRecord(time_ns, _clipped(code, _MAX_CODE), _clipped(text, _MAX_EVENT_TEXT))
    elif isinstance(record, LineRecord):
        record = record._replace(text=_clipped(record.text, _MAX_LINE))
    return KINDS[type(record)], _ENCODER.encode(record)


def unpack(kind: int, payload: bytes) -> Record:
    """Unpacks a record of :func:`pack`.

    Raises:
        IndexError: ``kind`` is unknown.
        msgspec.DecodeError: the payload is no such record.
    """
    return cast(Record, _DECODERS[kind].decode(payload))


def _clipped(text: str, room: int) -> str:
    """A text whose UTF-8 fits into so many bytes, cut between characters."""
    data = text.encode("utf-8", "replace")
    return data.decode() if len(data) <= room else data[: room - 3].decode("utf-8", "ignore") + "…"
