"""A ring in shared memory from the 1 kHz loop to the recorder: one producer, one consumer, nobody waits.

The producer copies a payload into a slot and then publishes its index; a full ring drops the new record and counts
it, in the shared memory, so that both sides can read the count. Python promises no order of stores between
processes on every processor, so each slot carries a checksum seeded with its index: a slot whose parts are not all
visible yet reads as not written yet, and is read again later. A torn record can therefore not come out.

The second half of the module is what travels: the header of the log, and the records of :data:`TOPICS`, each as
MessagePack after a type byte.
"""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, cast

from msgspec import msgpack

from emb_runtime.can.codec import Message
from emb_runtime.records import CycleRecord, Frame
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES

SLOT: Final = 256  # Bytes of one slot
MAX_PAYLOAD: Final = SLOT - 8  # Bytes that a record may have

_HEADER: Final = 4096  # one page: magic, slot count, and one cache line for each index
_MAGIC = 0x3130474E49524D45
_SLOTS_AT: Final = 1
_HEAD_AT: Final = 8
_TAIL_AT: Final = 16
_DROPPED_AT: Final = 24
_SLOT_HEAD: Final = struct.Struct("<IHBx")  # checksum, length, kind
_SLOT: Final = struct.Struct(f"<IHBx{MAX_PAYLOAD}s")  # the same, and the payload


def _checksum(index: int, kind: int, payload: bytes) -> int:
    return zlib.crc32(payload, (index ^ (kind << 24) ^ (len(payload) << 12)) & 0xFFFFFFFF)


class Ring:
    """One end of the ring. Exactly one process pushes and exactly one pops.

    The shared memory is that of a file descriptor; -1 with memory of this process alone.
    """

    def __init__(self, fd: int, memory: mmap.mmap | None = None) -> None:
        size = os.fstat(fd).st_size if memory is None else len(memory)
        if size < _HEADER + SLOT:
            raise ValueError(f"expected a ring in shared memory, got {size} bytes")
        self.fd = fd
        self._memory = mmap.mmap(fd, size) if memory is None else memory
        # Items of a cast view are stored and loaded as machine words: an index is never half written.
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

        The slots are a power of two; the default holds about 2 s of a 1 kHz run in 4 MiB. Without child processes
        both ends are in this one.
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
        """Append one record by its type byte (producer only); False if the ring was full: it is dropped and counted."""
        head = self._head
        if head - self._words[_TAIL_AT] >= self.slots:
            self._words[_DROPPED_AT] += 1
            return False
        length = len(payload)
        if length > MAX_PAYLOAD:
            raise ValueError(f"a record has at most {MAX_PAYLOAD} bytes, got {length}")
        at = _HEADER + (head & self._mask) * SLOT
        _SLOT.pack_into(self._memory, at, _checksum(head, kind, payload), length, kind, payload)
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
        """Unmap and close; the other side has its mapping still."""
        self._words.release()
        self._view.release()
        self._memory.close()
        if self.fd >= 0:
            os.close(self.fd)


class Attachment(NamedTuple):
    """A file inside the log."""

    name: str
    media_type: str
    data: bytes


@dataclass(frozen=True)
class LogHeader:
    """Identity of a run, complete before it begins."""

    start_ns: int  # The clock's monotonic time now [ns]
    wall_offset_ns: int  # From monotonic to Unix time [ns]; constant in a log, so that it has one epoch
    simulated: bool  # The clock does not follow the computer's: records are written when they happened
    dbc: str  # Text of the DBC: it decodes the frames, and travels as the attachment ``emb.dbc``
    metadata: Mapping[str, Mapping[str, str]]  # Metadata records by name; ``emb.run`` has the run's identity
    messages: tuple[Message, ...] = ()  # Of that DBC: these are decoded
    attachments: Sequence[Attachment] = ()  # Further files: ``policy.onnx``, ``bench.toml``
    topics: Sequence[str] = ()  # Topics that not every log has, and this one will have, but the drive's
    drive_bus: str = ""  # Bus of a mapped drive, whose frames the recorder reads by itself; "" for none


class FrameRecord(NamedTuple):
    """A frame that was received, or one that was sent, whose echo (``own``) came back."""

    frame: Frame
    read_ns: int = 0  # Time at which the loop had it, monotonic [ns]; 0 if more frames of the same read follow

    @property
    def time_ns(self) -> int:
        """Time at which it was on the bus, monotonic [ns]."""
        return self.frame.time_ns


class InputRecord(NamedTuple):
    """Input of the core beside frames: a call of its driver. It stands before the records of what came of it."""

    time_ns: int  # That the driver gave; of an answer, when it was decided, monotonic [ns]
    call: int  # :class:`emb_runtime.records.Call`
    send_time_ns: int = 0  # Of an answer: when it had been handed to the bus, monotonic [ns]; 0 if it was not
    code: str = ""  # Of a fault, or of an event
    text: str = ""  # Description of it; of an answer, why the bus had no room


class EventRecord(NamedTuple):
    """Something that the safety chain did."""

    time_ns: int  # Monotonic [ns]
    code: str  # A short, stable name
    text: str  # Description for a person


class ClockRecord(NamedTuple):
    """One reading of both clocks."""

    monotonic_ns: int
    wall_ns: int  # Unix time [ns]

    @property
    def time_ns(self) -> int:
        """Time of the reading, monotonic [ns]."""
        return self.monotonic_ns


class EstimateRecord(NamedTuple):
    """Running estimate at a sample."""

    time_ns: int  # Arrival time of the sample, monotonic [ns]
    step: int
    numbers: tuple[float, ...]  # See :attr:`emb_runtime.estimator.estimator.Estimator.estimate`


Record = FrameRecord | CycleRecord | EventRecord | ClockRecord | EstimateRecord | InputRecord


TOPICS: Final[dict[type[Any], tuple[str, str]]] = {
    FrameRecord: ("/can/rx", "CanFrame"),  # One that was sent goes to /can/tx
    CycleRecord: ("/cycle", "Cycle"),
    EventRecord: ("/safety", "SafetyEvent"),
    ClockRecord: ("/clock", "ClockSample"),
    EstimateRecord: ("/estimate", "Estimate"),
    InputRecord: ("/input", "Input"),
}
"""Topic of each record, and its message in ``emb.proto``, whose fields are those of the record but its ``time_ns``. A
record's place here is its type byte in the ring."""

_MAX_CODE: Final = 40  # Bytes of an event's code
_MAX_TEXT: Final = MAX_PAYLOAD - _MAX_CODE - 16

_ENCODER: Final = msgpack.Encoder(enc_hook=lambda number: number.item())  # of numpy
_TYPE_BYTES: Final = {record: place for place, record in enumerate(TOPICS)}
_DECODERS: Final = tuple(map(msgpack.Decoder, TOPICS))


def pack(record: Record) -> tuple[int, bytes]:
    """Type byte and payload of a record: MessagePack of its fields. Texts beyond the slot are cut."""
    if isinstance(record, (EventRecord, InputRecord)) and (record.code or record.text):
        record = record._replace(code=_clipped(record.code, _MAX_CODE), text=_clipped(record.text, _MAX_TEXT))
    return _TYPE_BYTES[type(record)], _ENCODER.encode(record)


def unpack(kind: int, payload: bytes) -> Record:
    """The record of a :func:`pack`."""
    return cast(Record, _DECODERS[kind].decode(payload))


def encodable(text: str) -> str:
    """A text that UTF-8 can say: a lone surrogate, as of a name that is no UTF-8, becomes an escape sequence."""
    return text.encode("utf-8", "backslashreplace").decode()


def _clipped(text: str, room: int) -> str:
    """A text whose UTF-8 fits into so many bytes, cut between characters."""
    data = encodable(text).encode()
    return data.decode() if len(data) <= room else data[: room - 3].decode("utf-8", "ignore") + "…"
