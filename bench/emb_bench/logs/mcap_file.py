"""The records of an MCAP file, which may be cut or damaged, and protobuf messages of one kind as columns.

A file is read from the front; its summary is never needed. Every checksum is checked. A damaged record is skipped and
named in ``missing``. Nothing is read after a record with a wrong length.

Files are untrusted: sizes are bounded before anything is read or unpacked. One record and one unpacked chunk are in
memory at a time, neither larger than ``LARGEST``, and descriptions, metadata and attachments have bounds.

The ``mcap`` library parses single records. Its stream reader ends at the first damage, trusts the sizes in the file,
and makes an object of each message.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from emb_runtime.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
OUR_SCHEMAS = "emb."  # Begin of the names of our schemas: it marks a log of ours, also after a copy by another tool
LARGEST = 8 << 20
"""Largest record, and largest chunk once unpacked [bytes]; the chunks of a log have a quarter of a MiB."""
MOST_PACKED = 32
"""Largest ratio of a chunk's unpacked size, less ``SMALL``, to its packed size; in a log of ours it is 4."""
SMALL = 8 << 10  # Unpacked size up to which the ratio has no bound [bytes]
MOST_DESCRIBED = 500  # Schemas and channels of a log; one of ours has two times twenty
LARGEST_DESCRIPTION = 32 << 10  # Largest schema or channel [bytes]
MOST_CARRIED = 32 << 20  # Size of all attachments and metadata together [bytes]; a policy has 4 MiB at most
MOST_NAMED = 8  # Kinds of damage that are named one by one

RECORD = struct.Struct("<BQ")  # Begin of a record: its opcode, and the length of what follows
CHUNK = struct.Struct("<QQQI")  # Begin of a chunk's record: first and last time, size once unpacked, checksum
HEADER = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
"""Begin of a message's record; its payload follows."""
DAMAGE = (
    *(McapError, struct.error, UnicodeDecodeError, EOFError),
    *(zstandard.ZstdError, MemoryError, OverflowError, ValueError),
)
"""Exceptions of a parser for damaged bytes."""

_MESSAGE = int(Opcode.MESSAGE)
_NAMES = {int(opcode): opcode.name.lower().replace("_", " ") for opcode in Opcode}

Integers = NDArray[np.int64]


class OtherFormError(ValueError):
    """A record in a form that MCAP allows and that is not read."""


class Chunk(NamedTuple):
    """One chunk, unpacked."""

    data: bytes
    at: Integers  # Offset in ``data`` of each message's record [bytes]
    headers: NDArray[Any]  # Of type ``HEADER``, one for each message
    described: tuple[mcap.Schema | mcap.Channel, ...]  # Schemas and channels

    def payloads(self, channel: int) -> list[bytes]:
        """The content of each message of a channel."""
        mine = self.headers["channel"] == channel
        begin = self.at[mine]
        ends = begin + RECORD.size + self.headers["length"][mine].astype(np.int64)
        return [self.data[a:b] for a, b in zip((begin + HEADER.itemsize).tolist(), ends.tolist(), strict=True)]

    def messages(self) -> Iterator[mcap.Message]:
        """The messages one by one, for conversion."""
        ends = self.at + RECORD.size + self.headers["length"].astype(np.int64)
        for begin, end, header in zip(self.at.tolist(), ends.tolist(), self.headers.tolist(), strict=True):
            _, _, channel, sequence, log_time, publish_time = header
            yield mcap.Message(channel, log_time, self.data[begin + HEADER.itemsize : end], publish_time, sequence)


class McapFile:
    """An MCAP file that is read once, ``size`` bytes of it; bytes that are appended meanwhile do not count."""

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self._path, self._file, self._size = path, file, size
        # Content of the chunks and records read so far:
        self.schemas: dict[int, mcap.Schema] = {}
        self.channels: dict[int, mcap.Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.missing: list[str] = []
        self._carried = 0  # bytes of attachments and metadata
        self._crc: int | None = zlib.crc32(MAGIC)  # over the data, then the summary; None if some of it was skipped
        self._data_ended = False
        if not size:
            raise LogError(f"{path}: the file is empty")
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{path}: not an MCAP file")

    def chunks(self) -> Iterator[tuple[int, int, Chunk]]:
        """Each complete chunk, with the offset and the length of its record's body in the file.

        Raises:
            LogError: not one of our schemas is in the file, or it carries more than any log of ours.
        """
        at, opcode = len(MAGIC), 0
        while opcode != Opcode.FOOTER:
            self._file.seek(at)
            head = self._file.read(RECORD.size)
            opcode, length = RECORD.unpack(head) if at + len(head) <= self._size and len(head) == 9 else (0, self._size)
            body_at, end = at + RECORD.size, at + RECORD.size + length
            if end > self._size:
                self.name_missing(
                    f"the file is cut at byte {self._size}, or damaged: the record at byte {at} is not whole"
                )
                break
            name = f"the {_NAMES.get(opcode, 'record')} at byte {at}"
            if length > LARGEST:
                self.name_missing(f"{name} is left out: it has {length} bytes, more than any of ours")
                self._crc = None
            else:
                body = self._file.read(length)
                try:
                    chunk = self._take(opcode, body)
                except OtherFormError as err:
                    if str(err) not in self.missing:
                        self.name_missing(str(err))
                except DAMAGE as err:
                    self.name_missing(f"{name} is damaged ({message_of(err)}) and left out")
                else:
                    if chunk is not None:
                        if self.schemas:  # else they may be lost, and come again in the summary
                            self._require_ours()
                        yield body_at, length, chunk
                self._add_to_checksum(opcode, head, body)
            at = end
        else:
            self._check_end(at)
        self._require_ours()

    def name_missing(self, what: str) -> None:
        """Name a missing part; of many parts only the first ones."""
        if len(self.missing) < MOST_NAMED:
            self.missing.append(what)
        elif len(self.missing) == MOST_NAMED:
            self.missing.append("and more is damaged")

    def _take(self, opcode: int, body: bytes) -> Chunk | None:
        """Store the content of a record; returns it if it is a chunk.

        Raises:
            DAMAGE: the record is damaged.
        """
        chunk = None
        match opcode:
            case Opcode.HEADER:
                mcap.Header.read(stream_of(body))  # for its damage
            case Opcode.CHUNK:
                chunk = unpack_chunk(body)
                self._describe(*chunk.described)
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._describe(_parse_description(opcode, body))
            case Opcode.METADATA:
                metadata = mcap.Metadata.read(stream_of(body))
                self._carry(len(body))
                self.metadata[metadata.name] = metadata.metadata
            case Opcode.ATTACHMENT:
                _require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"), "its checksum is wrong")
                attachment = mcap.Attachment.read(stream_of(body))
                self._carry(len(body))
                self.attachments[attachment.name] = attachment.data
            case Opcode.DATA_END:
                self._data_ended = True
                expected = mcap.DataEnd.read(stream_of(body)).data_section_crc
                _require(self._crc is None or expected in (0, self._crc), "the checksum over all data is wrong")
            case Opcode.FOOTER:
                expected = mcap.Footer.read(stream_of(body)).summary_crc
                _require(self._data_ended, "the end of the data is missing")
                covered = zlib.crc32(RECORD.pack(opcode, len(body)) + body[:16], self._crc or 0)
                _require(self._crc is None or expected in (0, covered), "the checksum over the summary is wrong")
            case Opcode.MESSAGE:
                raise OtherFormError(
                    "messages outside of chunks, where they have no checksum, are left out: mcap compress writes them "
                    "into chunks"
                )
            case _:
                _require(opcode in _NAMES or opcode >= 0x80, "no such record exists")
        return chunk

    def _describe(self, *records: mcap.Schema | mcap.Channel) -> None:
        """Store schemas and channels; a different one of the same number means damage, or two logs in one file."""
        for record in records:
            described: dict[int, Any] = self.schemas if isinstance(record, mcap.Schema) else self.channels
            if described.setdefault(record.id, record) != record:
                kind = type(record).__name__.lower()
                self.name_missing(f"{kind} {record.id} is described twice, differently; the first counts")
        if len(self.schemas) + len(self.channels) > MOST_DESCRIBED:
            raise LogError(f"{self._path}: expected at most {MOST_DESCRIBED} schemas and channels: no log of ours")

    def _carry(self, size: int) -> None:
        self._carried += size
        if self._carried > MOST_CARRIED:
            most = MOST_CARRIED >> 20
            raise LogError(f"{self._path}: expected at most {most} MiB of attachments and metadata: no log of ours")

    def _add_to_checksum(self, opcode: int, head: bytes, body: bytes) -> None:
        """Add a record to the running checksum, which restarts after the data."""
        if opcode == Opcode.DATA_END:
            self._crc = 0
        elif self._crc is not None:
            self._crc = zlib.crc32(body, zlib.crc32(head, self._crc))

    def _check_end(self, at: int) -> None:
        """Report a file that does not end like an MCAP file."""
        self._file.seek(at)
        tail = self._file.read(min(self._size - at, len(MAGIC) + 1))
        if tail != MAGIC and MAGIC.startswith(tail):
            self.name_missing(f"the file is cut at byte {self._size}, before its end")
        elif tail != MAGIC:
            self.name_missing("the end of the file is not that of an MCAP file")

    def _require_ours(self) -> None:
        if any(schema.name.startswith(OUR_SCHEMAS) for schema in self.schemas.values()):
            return
        if self.schemas:
            raise LogError(f"{self._path}: an MCAP file, but not a log of emb-run")
        why = "; ".join(self.missing) or "it holds none"
        raise LogError(f"{self._path}: not one message is left in this log: {why}")


def unpack_chunk(body: bytes) -> Chunk:
    """The content of a chunk's record.

    Raises:
        DAMAGE: the record is damaged.
    """
    _, _, size, crc = CHUNK.unpack_from(body)
    at = CHUNK.size
    (name,) = struct.unpack_from("<I", body, at)
    compression = body[at + 4 : at + 4 + name].decode()
    at += 4 + name
    (packed,) = struct.unpack_from("<Q", body, at)
    at += 8
    _require(at + packed == len(body), "its lengths contradict each other")
    most = min(LARGEST, SMALL + MOST_PACKED * packed)
    _require(size <= most or not compression, f"it claims to unpack from {packed} to {size} bytes, none of ours does")
    data = _decompressed(memoryview(body)[at:], compression, size)
    _require(len(data) == size, f"it unpacks to {len(data)} bytes, not to {size}")
    _require(crc in (0, zlib.crc32(data)), "its checksum is wrong")
    return _split(data)


def _decompressed(packed: memoryview, compression: str, size: int) -> bytes:
    if not compression:
        return bytes(packed)
    if compression == "lz4":
        raise OtherFormError("chunks compressed with lz4 are left out: mcap compress writes them again with zstd")
    _require(compression == "zstd", f"expected zstd, got the compression {compression!r}")
    # zstd trusts the size in the frame more than the caller's.
    claimed = zstandard.frame_content_size(packed)
    _require(claimed in (-1, size), f"its frame claims to unpack to {claimed} bytes, not to {size}")
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)


def _split(packed: bytes) -> Chunk:
    """Part a chunk into records."""
    at, others, places, described = 0, 0, list[int](), list[mcap.Schema | mcap.Channel]()
    head, size, keep = RECORD.unpack_from, RECORD.size, places.append  # one pass for each message: an hour has 3e7
    while at + size <= len(packed):
        opcode, length = head(packed, at)
        if opcode == _MESSAGE:
            keep(at)
        else:
            others += 1
            _require(others <= MOST_DESCRIBED, f"more than {MOST_DESCRIBED} records in it are no messages")
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                described.append(_parse_description(opcode, packed[at + size : at + size + length]))
        at += size + length
    _require(at == len(packed), "a record in it is not whole")
    _require(not places or places[-1] + HEADER.itemsize <= at, "a message in it is not whole")
    # Raw bytes at each offset: numpy gathers them five times as fast as structured headers.
    begins = np.ndarray((max(0, at - HEADER.itemsize + 1),), f"V{HEADER.itemsize}", packed, strides=(1,))
    headers = begins[np.array(places, np.int64)].view(HEADER)
    _require(bool((headers["length"] >= HEADER.itemsize - RECORD.size).all()), "a message in it is not whole")
    return Chunk(packed, np.array(places, np.int64), headers, tuple(described))


@lru_cache(maxsize=256)
def _parse_description(opcode: int, content: bytes) -> mcap.Schema | mcap.Channel:
    """A schema or a channel; cached, as all logs of one version have the same ones, twice each."""
    _require(
        len(content) <= LARGEST_DESCRIPTION, f"a description in it has {len(content)} bytes, more than any of ours"
    )
    reads = {Opcode.SCHEMA: mcap.Schema.read, Opcode.CHANNEL: mcap.Channel.read}
    found: mcap.Schema | mcap.Channel = reads[Opcode(opcode)](stream_of(content))
    return found


def stream_of(body: bytes) -> ReadDataStream:
    """A record's body as a stream for the ``mcap`` library."""
    return ReadDataStream(io.BytesIO(body))


def _require(condition: bool, what: str) -> None:
    """Raise a ``ValueError``, one of ``DAMAGE``, unless this holds."""
    if not condition:
        raise ValueError(what)


def message_of(err: BaseException) -> str:
    """An error's message in one line."""
    return " ".join(str(err).split()) or type(err).__name__


MOST_FIELDS = 256  # Fields of a message; ours have fifty


@dataclass(frozen=True)
class Column:
    """Description of one column of a table."""

    name: str
    kind: str  # Name of numpy's type of its values, or ``text``, or ``bytes``
    unit: str = ""  # SI unit, empty if it has none
    choices: Mapping[int, str] | None = None  # Names of the values, where they are enumerated

    @property
    def title(self) -> str:
        """Name and unit, for a table's head."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def labels(self, values: NDArray[Any]) -> list[str]:
        """The names of enumerated values; of an unknown value its number."""
        choices = self.choices or {}
        return [choices.get(value, str(value)) for value in values.tolist()]


@lru_cache(maxsize=64)
def message_class(name: str, descriptors: bytes) -> Any:
    """The class of a message, from a serialised FileDescriptorSet.

    Raises:
        TypeError, KeyError, google.protobuf.message.DecodeError: the descriptors are damaged.
        ValueError: the message has more fields than any of ours.
    """
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    found = pool.FindMessageTypeByName(name)
    if len(found.fields) > MOST_FIELDS:
        raise ValueError(f"expected at most {MOST_FIELDS} fields, got {len(found.fields)}")
    return message_factory.GetMessageClass(found)


@lru_cache(maxsize=64)
def describe(factory: Any, units: str = "{}") -> tuple[Column, ...]:
    """Columns of a message's fields, without embedded messages; ``units`` are JSON by field.

    Raises:
        ValueError: the units are not JSON.
    """
    unit_of = json.loads(units)
    found = []
    for entry in factory.DESCRIPTOR.fields:
        if entry.cpp_type != entry.CPPTYPE_MESSAGE:
            kind = {entry.TYPE_STRING: "text", entry.TYPE_BYTES: "bytes"}.get(entry.type) or np.dtype(_type(entry)).name
            choices = {value.number: value.name for value in entry.enum_type.values} if entry.enum_type else None
            found.append(Column(entry.name, kind, unit_of.get(entry.name, ""), choices))
    return tuple(found)


def message_columns(factory: Any, payloads: Sequence[bytes]) -> dict[str, NDArray[Any]]:
    """The fields of n serialised messages, without embedded messages, each of shape (n,).

    Numbers are int64 or float64, bool is bool, text and bytes are objects. The messages are parsed as one message with
    repeated fields. This requires that all n messages have the field, as in a log of ours. If some lack it, or one is
    cut and takes the first bytes of the next, the field is parsed message by message.

    Raises:
        google.protobuf.message.DecodeError: a message is damaged.
        OverflowError: a number is beyond int64.
    """
    joined, found = _repeated(factory).FromString(b"".join(payloads)), dict[str, NDArray[Any]]()
    for entry in factory.DESCRIPTOR.fields:
        if entry.cpp_type != entry.CPPTYPE_MESSAGE:
            values = getattr(joined, entry.name)
            if len(values) != len(payloads):
                values = [getattr(factory.FromString(payload), entry.name) for payload in payloads]
            found[entry.name] = np.array(values, dtype=_type(entry))
            if entry.cpp_type == entry.CPPTYPE_UINT64 and found[entry.name].min(initial=0) < 0:
                raise OverflowError(f"{entry.name} is beyond 63 bits")
    return found


@lru_cache(maxsize=64)
def _repeated(factory: Any) -> Any:
    """Class of a message with the same fields, each repeated; without embedded messages."""
    file = descriptor_pb2.FileDescriptorProto(name="repeated.proto", syntax="proto3")
    message = file.message_type.add(name="Repeated")
    for entry in factory.DESCRIPTOR.fields:
        if entry.cpp_type != entry.CPPTYPE_MESSAGE:
            kind = entry.TYPE_INT32 if entry.enum_type else entry.type
            message.field.add(name=entry.name, number=entry.number, type=kind, label="LABEL_REPEATED")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("Repeated"))


def _type(entry: Any) -> type[Any]:
    """Numpy's type of a field's values."""
    return {
        entry.CPPTYPE_DOUBLE: np.float64,
        entry.CPPTYPE_FLOAT: np.float64,
        entry.CPPTYPE_STRING: np.object_,
        entry.CPPTYPE_BOOL: np.bool_,
    }.get(entry.cpp_type, np.int64)
