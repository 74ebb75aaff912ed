"""The MCAP reader: the records of a log's file, and its messages in batches, from a file that may be cut or damaged.

A file is read from the front; its summary is never needed. Every checksum is checked, a damaged chunk is left out as a
whole, and behind a record whose length is wrong reading goes on with the next chunk that is whole. What is left out is
named in ``missing``.

Nobody vouches for a file. One record and one unpacked chunk are in memory at a time, neither larger than ``LARGEST``; a
chunk that claims to unpack to many times its size is left out before it is unpacked; what is kept of descriptions,
metadata and attachments has bounds. So memory is bounded, and time grows with the size of the file and no faster.

The ``mcap`` library parses single records; its stream reader makes an object of each message, takes four times as long
as parting a chunk with numpy, and trusts the sizes in the file.
"""

from __future__ import annotations

import io
import struct
import zlib
from array import array
from bisect import bisect_left
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from emb_runtime.errors import LogError, UsageError
from emb_runtime.system.input_file import open_regular

Integers = NDArray[np.int64]

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "emb-excite/"
"""Begin of the library's name in the header of a log."""
CAN_LIBRARY = "emb-excite-can/"
"""Begin of that name in a file that python-can wrote: frames of a bus, but no run."""
OUR_SCHEMAS = "emb."
"""Begin of the names of our schemas, by which a log is known that another program has copied."""
PEEKED = 1000
"""Records at the begin of a file of another program in which one of our schemas is looked for."""
LARGEST = 8 << 20
"""Largest record, and largest chunk once unpacked [bytes]; the chunks of a log have a quarter of a MiB."""
MOST_PACKED = 32
"""Times by which a chunk may be larger once unpacked, besides ``SMALL``; those of a log are larger by 4 times."""
SMALL = 8 << 10
"""Size of a chunk that may be packed as well as it can be [bytes]."""
MOST_DESCRIBED = 500
"""Schemas and channels of a log; one of ours has two times twenty."""
LARGEST_DESCRIPTION = 32 << 10
"""Largest schema or channel [bytes]."""
MOST_CARRIED = 32 << 20
"""Size of all attachments and metadata together [bytes]; a policy has 4 MiB at most."""
SEARCHED = 8
"""Times the size of a file that is read, and ``LARGEST`` besides, to find whole chunks behind damage."""
KEPT = 16 << 20
"""Unpacked chunks are kept in memory if all of them take no more than this [bytes]."""
BATCH = 4 << 20
"""Unpacked bytes that are decoded at a time."""
MOST_NAMED = 8
"""Kinds of damage that are named one by one."""
PAD = 32
"""Zeros behind the data of a batch, so that a number may be read at its last byte."""
HEADER = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
"""Begin of a message's record; its payload follows."""

DAMAGE = (
    *(McapError, struct.error, UnicodeDecodeError, EOFError),
    *(zstandard.ZstdError, MemoryError, OverflowError, ValueError),
)
"""Exceptions of a parser on bytes that passed, or have, no checksum."""

_RECORD = struct.Struct("<BQ")  # opcode, length of what follows
_CHUNK = struct.Struct("<QQQI")  # first and last time, size, checksum
_MESSAGE = int(Opcode.MESSAGE)
_NAMES = {int(opcode): opcode.name.lower().replace("_", " ") for opcode in Opcode}
_BLOCK = 1 << 20
# The name of the compression in a chunk's record, and its offset there [bytes].
_PACKED, _PACKED_AT = b"\x04\x00\x00\x00zstd", _RECORD.size + _CHUNK.size


class Chunk(NamedTuple):
    """One chunk, unpacked."""

    data: bytes
    at: Integers
    """Offset in ``data`` of each message's record [bytes]."""
    headers: NDArray[Any]
    """Of type ``HEADER``, one for each message."""
    described: tuple[mcap.Schema | mcap.Channel, ...]
    """Schemas and channels."""

    def messages(self) -> Iterator[mcap.Message]:
        """The messages one by one, for copying or conversion."""
        ends = self.at + _RECORD.size + self.headers["length"].astype(np.int64)
        for begin, end, header in zip(self.at.tolist(), ends.tolist(), self.headers.tolist(), strict=True):
            _, _, channel, sequence, log_time, publish_time = header
            yield mcap.Message(channel, log_time, self.data[begin + HEADER.itemsize : end], publish_time, sequence)


Record = mcap.Schema | mcap.Channel | mcap.Metadata | mcap.Attachment | Chunk


def windows(data: NDArray[np.uint8], kind: Any) -> NDArray[Any]:
    """The bytes from each place on as a number or a record of one kind; a view."""
    dtype = np.dtype(kind)
    count = max(0, len(data) - dtype.itemsize + 1)
    return np.ndarray((count,), dtype, data, strides=(1,))


def gathered(records: NDArray[Any], index: Integers) -> NDArray[Any]:
    """Some of these records, which as plain bytes are gathered five times as fast."""
    return records.view(f"V{records.dtype.itemsize}")[index].view(records.dtype)


def unpack_chunk(body: bytes) -> Chunk:
    """The content of a chunk's record.

    Raises:
        ValueError, struct.error, UnicodeDecodeError, zstandard.ZstdError, MemoryError: it is damaged.
    """
    _, _, size, crc = _CHUNK.unpack_from(body)
    at = _CHUNK.size
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
    _require(compression == "zstd", f"expected zstd, got the compression {compression!r}")
    # zstd takes the frame's own word for its size before the caller's.
    claimed = zstandard.frame_content_size(packed)
    _require(claimed in (-1, size), f"its frame claims to unpack to {claimed} bytes, not to {size}")
    return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)


def _split(packed: bytes) -> Chunk:
    """Part a chunk into records, without a loop over the messages.

    Where a message may begin is seen at its opcode and the length behind it, at all places at once. It does begin there
    if the record before ends there: one leads to the next, from the first byte to the last.
    """
    data = np.frombuffer(packed + bytes(PAD), np.uint8)
    found = [_places(data, begin, min(begin + _BLOCK, len(packed))) for begin in range(0, len(packed), _BLOCK)]
    maybe, ends = (np.concatenate([pair[k] for pair in found] or [np.empty(0, np.int64)]) for k in range(2))
    # A run of messages that follow each other ends where the next place is not where this one leads.
    lasts, begins = [*np.flatnonzero(ends[:-1] != maybe[1:]).tolist(), len(maybe) - 1], maybe.tolist()
    at, others, parts, described = 0, 0, [maybe[:0]], list[mcap.Schema | mcap.Channel]()
    while at < len(packed):
        k = bisect_left(begins, at)
        if k < len(begins) and begins[k] == at:
            last = lasts[bisect_left(lasts, k)]
            parts.append(maybe[k : last + 1])
            at = int(ends[last])
        else:
            opcode, length = _RECORD.unpack_from(packed, at)
            _require(opcode != _MESSAGE, "a message in it is not whole")
            others += 1
            _require(others <= MOST_DESCRIBED, f"more than {MOST_DESCRIBED} records in it are no messages")
            if (record := _description(opcode, packed[at + _RECORD.size : at + _RECORD.size + length])) is not None:
                described.append(record)
            at += _RECORD.size + length
    _require(at == len(packed), "a record in it is not whole")
    places = np.concatenate(parts)
    return Chunk(packed, places, gathered(windows(data, HEADER), places), tuple(described))


def _places(data: NDArray[np.uint8], begin: int, end: int) -> tuple[Integers, Integers]:
    """Places in a part of a chunk at which a message may begin, and where each of them would end."""
    maybe = np.flatnonzero(data[begin:end] == _MESSAGE) + begin
    lengths = windows(data, "<u8")[maybe + 1]
    fits = (lengths >= HEADER.itemsize - _RECORD.size) & (lengths < len(data))
    return maybe[fits], maybe[fits] + lengths[fits].astype(np.int64) + _RECORD.size


def _description(opcode: int, content: bytes) -> mcap.Schema | mcap.Channel | None:
    """A schema or a channel; None of another record."""
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return None
    _require(
        len(content) <= LARGEST_DESCRIPTION, f"a description in it has {len(content)} bytes, more than any of ours"
    )
    return _read_description(opcode, content)


@lru_cache(maxsize=256)
def _read_description(opcode: int, content: bytes) -> mcap.Schema | mcap.Channel:
    """A schema or a channel, which every log of one version has alike, and twice."""
    reads = {Opcode.SCHEMA: mcap.Schema.read, Opcode.CHANNEL: mcap.Channel.read}
    found: mcap.Schema | mcap.Channel = reads[Opcode(opcode)](_stream(content))
    return found


class RecordReader:
    """One pass over the records of a file.

    Args:
        path: name of the file, for messages.
        file: the file.
        size: bytes of it that count; what is appended meanwhile does not.
        libraries: accepted beginnings of the library's name in its header.

    Raises:
        LogError: the file is empty, or not a log of ours.
    """

    def __init__(
        self, path: Path, file: BinaryIO, size: int, libraries: tuple[str, ...] = (LIBRARY, CAN_LIBRARY)
    ) -> None:
        self._path, self._file, self._size = path, file, size
        self._carried = 0  # bytes of attachments and metadata
        self._described: dict[tuple[bool, int], mcap.Schema | mcap.Channel] = {}
        self._descriptions = 0
        self._searchable = LARGEST + SEARCHED * size
        self.missing: list[str] = []
        """Descriptions of the missing parts; complete at the end of the pass."""
        self._crc: int | None = zlib.crc32(MAGIC)  # over the data, then the summary; None if some of it was left out
        self._data_ended = False
        self._end: int | None = None  # where the footer ends
        if not size:
            raise LogError(f"{path}: the file is empty")
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{path}: not an MCAP file")
        first = self._read(len(MAGIC))
        if first is None:
            raise LogError(f"{path}: not one message is left in this log: the file is cut at byte {size}")
        try:
            self.header = mcap.Header.read(_stream(first[1]))
        except DAMAGE:
            self.header = mcap.Header("", "")
        self._begin = len(MAGIC) + _RECORD.size + len(first[1])
        if first[0] != Opcode.HEADER or not (self.header.library.startswith(libraries) or self._is_copy()):
            raise LogError(f"{path}: an MCAP file, but not a log of emb-run")
        self._add(*first)

    def _is_copy(self) -> bool:
        """Returns True for a log of ours that another program has written again: its messages have our schemas."""
        if self.header.library.startswith((LIBRARY, CAN_LIBRARY)):
            return False  # of a kind that is not accepted here
        reader = RecordReader(self._path, self._file, self._size, ("",))
        for n, record in enumerate(reader.one_by_one()):
            if isinstance(record, mcap.Schema) and record.name.startswith(OUR_SCHEMAS):
                return True
            if n >= PEEKED:
                break
        return False

    def records(self) -> Iterator[tuple[int, int, Record]]:
        """Each record: where its body begins, where it ends, and its content. For one pass only."""
        at = self._begin
        while at < self._size and self._end is None:
            record = self._read(at)
            if record is None:
                if (end := self._behind(at)) is None:
                    self._name_missing(
                        f"the file is cut at byte {self._size}: the record that begins at byte {at} is not whole"
                    )
                    return
                at = end
                continue
            opcode, body = record
            end = at + _RECORD.size + len(body)
            try:
                found = self._parsed(opcode, body, end)
            except DAMAGE as err:
                why = message_of(err)
                # If what follows is no record either, the damage is in the length.
                goes_on = None if self._is_record(end) else self._next_chunk(at + 1)
                if goes_on is not None:
                    at = self._skip(at, goes_on, why)
                    continue
                self._name_missing(f"the {_NAMES.get(opcode, 'record')} at byte {at} is damaged ({why}) and left out")
            else:
                if found is not None:
                    self._require_bounded(found, len(body))
                    yield at + _RECORD.size, end, found
            self._add(opcode, body)
            at = end
        self._check_end()

    def _require_bounded(self, record: Record, size: int) -> None:
        """Refuse a file that carries more than any of ours besides its messages."""
        match record:
            case mcap.Metadata() | mcap.Attachment():
                self._carried += size
            case Chunk():
                for each in record.described:
                    self._describe(each)
            case _:
                self._describe(record)
        if self._descriptions > MOST_DESCRIBED or self._carried > MOST_CARRIED:
            raise LogError(
                f"{self._path}: expected at most {MOST_DESCRIBED} schemas and channels and {MOST_CARRIED >> 20} MiB of "
                "attachments and metadata, and there are more: no log of ours"
            )

    def _describe(self, record: mcap.Schema | mcap.Channel) -> None:
        """Count a description that has not been there."""
        key = isinstance(record, mcap.Schema), record.id
        if self._described.get(key) != record:
            self._described[key] = record
            self._descriptions += 1

    def one_by_one(self) -> Iterator[mcap.Schema | mcap.Channel | mcap.Message | mcap.Metadata | mcap.Attachment]:
        """The records with those in the chunks, whose schemas and channels come before their messages."""
        for _, _, record in self.records():
            if isinstance(record, Chunk):
                yield from record.described
                yield from record.messages()
            else:
                yield record

    def _parsed(self, opcode: int, body: bytes, end: int) -> Record | None:
        """The content of one record, if it has any; raises one of ``DAMAGE`` if it is not what it should be."""
        found: Any = None
        match opcode:
            case Opcode.CHUNK:
                found = unpack_chunk(body)
            case Opcode.SCHEMA | Opcode.CHANNEL:
                found = _description(opcode, body)
            case Opcode.METADATA:
                found = mcap.Metadata.read(_stream(body))
            case Opcode.ATTACHMENT:
                _require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"), "its checksum is wrong")
                found = mcap.Attachment.read(_stream(body))
            case Opcode.DATA_END:
                self._data_ended = True
                expected = mcap.DataEnd.read(_stream(body)).data_section_crc
                _require(self._crc is None or expected in (0, self._crc), "the checksum over all data is wrong")
            case Opcode.FOOTER:
                self._end = end
                expected = mcap.Footer.read(_stream(body)).summary_crc
                _require(self._data_ended, "the end of the data is missing")
                covered = zlib.crc32(_RECORD.pack(opcode, len(body)) + body[:16], self._crc or 0)
                _require(self._crc is None or expected in (0, covered), "the checksum over the summary is wrong")
            case Opcode.MESSAGE:
                raise ValueError("it lies outside of a chunk, where it has no checksum")
            case _:
                _require(opcode in _NAMES or opcode >= 0x80, "no such record exists")
        return found  # type: ignore[no-any-return]

    def _add(self, opcode: int, body: bytes) -> None:
        """Take a record into the running checksum, which begins anew behind the data."""
        if opcode == Opcode.DATA_END:
            self._crc = 0
        elif self._crc is not None:
            self._crc = zlib.crc32(body, zlib.crc32(_RECORD.pack(opcode, len(body)), self._crc))

    def _head(self, at: int) -> tuple[int, int] | None:
        """Opcode and length of the record that begins there; None if it is too long for the file."""
        if at + _RECORD.size > self._size:
            return None
        self._file.seek(at)
        opcode, length = _RECORD.unpack(self._file.read(_RECORD.size))
        return (opcode, length) if length <= self._size - at - _RECORD.size else None

    def _read(self, at: int) -> tuple[int, bytes] | None:
        """Opcode and body of the record that begins there; None if it is too long for the file, or for a log."""
        head = self._head(at)
        return (head[0], self._file.read(head[1])) if head is not None and head[1] <= LARGEST else None

    def _is_record(self, at: int) -> bool:
        """Returns True if a record of a known kind begins there, as far as one can see, or the file ends."""
        head = self._head(at)
        return at == self._size or (head is not None and head[0] in _NAMES)

    def _behind(self, at: int) -> int | None:
        """Place in the file at which to read on behind a record that is too long, which is named; None if nowhere."""
        head = self._head(at)
        if head is not None and self._is_record(end := at + _RECORD.size + head[1]):
            return self._skip(at, end, f"it has {head[1]} bytes, more than any of ours")
        goes_on = self._next_chunk(at + 1)
        return None if goes_on is None else self._skip(at, goes_on, "its length is wrong")

    def _next_chunk(self, at: int) -> int | None:
        """Place in the file of the first whole chunk from ``at`` on; None if there is none."""
        while at < self._size and self._searchable > 0:
            self._file.seek(at)
            block = self._file.read(min(_BLOCK + _PACKED_AT + len(_PACKED), self._size - at))
            self._searchable -= len(block)
            found = block.find(_PACKED, _PACKED_AT)
            while found >= 0 and self._searchable > 0:
                begin = at + found - _PACKED_AT
                if self._is_chunk(begin):
                    return begin
                found = block.find(_PACKED, found + 1)
            at += _BLOCK
        return None

    def _is_chunk(self, at: int) -> bool:
        record = self._read(at)
        if record is None or record[0] != Opcode.CHUNK:
            return False
        self._searchable -= len(record[1])
        try:
            unpack_chunk(record[1])
        except DAMAGE:
            return False
        return True

    def _skip(self, at: int, goes_on: int, why: str) -> int:
        self._name_missing(f"the record at byte {at} is damaged ({why}): {goes_on - at} bytes are left out")
        self._crc = None
        return goes_on

    def _check_end(self) -> None:
        """Name it if the file does not end as an MCAP file does."""
        tail = b""
        if self._end is not None:
            self._file.seek(self._end)
            tail = self._file.read(min(self._size - self._end, len(MAGIC) + 1))
        if tail != MAGIC and MAGIC.startswith(tail):
            self._name_missing(f"the file is cut at byte {self._size}, before its end")
        elif tail != MAGIC:
            self._name_missing("the end of the file is not that of an MCAP file")

    def _name_missing(self, what: str) -> None:
        name_missing(self.missing, what)


class Batch(NamedTuple):
    """Messages that follow each other in the file."""

    data: NDArray[np.uint8]
    """Unpacked chunks, and ``PAD`` zeros."""
    headers: NDArray[Any]
    """Of type ``HEADER``, one for each message."""
    begin: Integers
    """Offset in ``data`` of each payload [bytes]."""
    order: int
    """Number of the first of them among all messages of the log."""


class _Place(NamedTuple):
    """Offset and size of a chunk's body in the file [bytes], and its count of messages when it was checked."""

    at: int
    size: int
    messages: int


@dataclass
class Contents:
    """The content of a log's file: its messages are kept if they are few, and else read again."""

    path: Path
    size: int = 0
    """Of the file [bytes]."""
    missing: list[str] = field(default_factory=list)
    """Descriptions of the missing parts."""
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    """Messages by channel."""
    span: tuple[int, int] | None = None
    """First and last publish time [Unix ns]."""
    _size: int = 0  # of all chunks once unpacked [bytes]
    _places: array[int] = field(default_factory=lambda: array("q"))  # a row of _Place for each whole chunk
    _kept: list[Chunk] = field(default_factory=list)  # all of them, unless they are too much

    @property
    def is_short(self) -> bool:
        """All messages are in memory."""
        return self._size <= KEPT

    def name_missing(self, what: str) -> None:
        """Name something that is missing."""
        name_missing(self.missing, what)

    def batches(self) -> Iterator[Batch]:
        """All messages, some at a time.

        Raises:
            LogError: the file has changed since it was checked.
        """
        return iter(self._short) if self.is_short else _batches(self._chunks_again())

    @cached_property
    def _short(self) -> tuple[Batch, ...]:
        return tuple(_batches(iter(self._kept)))

    def _chunks_again(self) -> Iterator[Chunk]:
        try:
            with open_regular(self.path) as file:
                for row in range(0, len(self._places), len(_Place._fields)):
                    place = _Place(*self._places[row : row + len(_Place._fields)])
                    file.seek(place.at)
                    chunk = unpack_chunk(file.read(place.size))
                    _require(len(chunk.at) == place.messages, "other messages than before")
                    yield chunk
        except OSError as err:
            raise UsageError(f"{self.path}: cannot read the log: {err.strerror}") from err
        except DAMAGE as err:
            raise LogError(f"{self.path}: the log has changed while it was read: {message_of(err)}") from err

    def add(self, begin: int, end: int, record: Record) -> None:
        """Take one record, which lies between two places in the file."""
        match record:
            case mcap.Metadata():
                self.metadata[record.name] = record.metadata
            case mcap.Attachment():
                self.attachments[record.name] = record.data
            case Chunk():
                self._add_chunk(record, _Place(begin, end - begin, len(record.at)))
            case _:
                self._describe(record)

    def _add_chunk(self, chunk: Chunk, place: _Place) -> None:
        for record in chunk.described:
            self._describe(record)
        counts = np.bincount(chunk.headers["channel"])
        for channel in np.flatnonzero(counts).tolist():
            self.counts[channel] = self.counts.get(channel, 0) + int(counts[channel])
        if len(chunk.headers):
            first, last = int(chunk.headers["publish"].min()), int(chunk.headers["publish"].max())
            span = self.span or (first, last)
            self.span = min(span[0], first), max(span[1], last)
        self._size += len(chunk.data)
        self._places.extend(place)
        if self.is_short:
            self._kept.append(chunk)
        else:
            self._kept.clear()

    def _describe(self, record: mcap.Schema | mcap.Channel) -> None:
        """Keep a schema or channel; a second one of the same number comes of damage, or of two logs in one file."""
        known: dict[int, Any] = self.schemas if isinstance(record, mcap.Schema) else self.channels
        if known.setdefault(record.id, record) != record:
            kind = "schema" if isinstance(record, mcap.Schema) else "channel"
            self.name_missing(f"{kind} {record.id} is described twice, differently; the first counts")


def read_contents(path: Path) -> Contents:
    """Read every record of a log that is whole.

    Raises:
        LogError: the file is empty, not MCAP, or not a log of ours.
        UsageError: it cannot be read.
    """
    contents = Contents(path)
    try:
        with open_regular(path) as file:
            contents.size = file.seek(0, io.SEEK_END)
            reader = RecordReader(path, file, contents.size, (LIBRARY,))
            contents.missing = reader.missing
            for begin, end, record in reader.records():
                contents.add(begin, end, record)
    except OSError as err:
        raise UsageError(f"{path}: cannot read the log: {err.strerror}") from err
    return contents


def _batches(chunks: Iterator[Chunk]) -> Iterator[Batch]:
    held: list[Chunk] = []
    size = order = 0
    for chunk in chunks:
        held.append(chunk)
        size += len(chunk.data)
        if size >= BATCH:
            yield (batch := _batch(held, order))
            order += len(batch.begin)
            held, size = [], 0
    if held:
        yield _batch(held, order)


def _batch(held: list[Chunk], order: int) -> Batch:
    sizes = np.cumsum([0] + [len(chunk.data) for chunk in held])
    data = np.frombuffer(b"".join([*(chunk.data for chunk in held), bytes(PAD)]), np.uint8)
    at = np.concatenate([chunk.at + base for chunk, base in zip(held, sizes.tolist(), strict=False)])
    return Batch(data, np.concatenate([chunk.headers for chunk in held]), at + HEADER.itemsize, order)


def name_missing(missing: list[str], what: str) -> None:
    """Name something that is missing; of a file that is damaged all over, only what comes first."""
    if len(missing) < MOST_NAMED:
        missing.append(what)
    elif len(missing) == MOST_NAMED:
        missing.append("and more is damaged")


def message_of(err: BaseException) -> str:
    """An error's message in one line."""
    return " ".join(str(err).split()) or type(err).__name__


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise ValueError(what)
