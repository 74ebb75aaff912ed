"""The records of a log's file: walked once from the front, each checksum checked, what is damaged left out and named.

Memory is bounded whatever the file says of itself: one record and one unpacked chunk at a time, neither larger than
``LARGEST``. Of a short log the unpacked chunks are kept. Of a long one only where they are, 24 bytes for each; whoever
asks for their messages unpacks and checks them again.
"""

from __future__ import annotations

import io
import struct
import zlib
from array import array
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

from emb_bench.logs.chunk import HEADER, LARGEST, PAD, RECORD, Integers, Unpacked, require, unpack_chunk
from emb_runtime.errors import LogError, UsageError

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "emb-excite/"
"""How the header of a log of ours begins."""
KEPT = 16 << 20
"""Unpacked chunks are kept as long as all of them take less than this [bytes]."""
BATCH = 4 << 20
"""Unpacked bytes that are decoded at a time."""
TOLD = 8
"""Kinds of damage that are told one by one."""

DAMAGE = (
    *(McapError, struct.error, UnicodeDecodeError, EOFError),
    *(zstandard.ZstdError, MemoryError, OverflowError, ValueError),
)
"""What a parser may say of bytes that passed, or have, no checksum."""

_NAMES = {int(opcode): opcode.name.lower().replace("_", " ") for opcode in Opcode}
_PIECE = 1 << 20


class Batch(NamedTuple):
    """Messages that follow each other in the file."""

    data: NDArray[np.uint8]
    """Unpacked chunks, and ``PAD`` zeros."""
    headers: NDArray[Any]
    """Of type ``HEADER``, one for each message."""
    begin: Integers
    """Where each payload begins in ``data``."""
    order: int
    """Number of the first of them among all messages of the log."""


class Place(NamedTuple):
    """Where a chunk is, and what was in it when it was checked."""

    at: int
    size: int
    messages: int


@dataclass
class Contents:
    """What the walk finds."""

    path: Path
    missing: list[str] = field(default_factory=list)
    """What is damaged or not there, in words."""
    header: mcap.Header | None = None
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    """Messages by channel."""
    span: tuple[int, int] | None = None
    """First and last publish time [Unix ns]."""
    footer: bool = False
    size: int = 0
    """Of all chunks once unpacked [bytes]."""
    places: NDArray[np.int64] = field(default_factory=lambda: np.empty((0, 3), np.int64))
    """Rows of :class:`Place`, one for each chunk that is whole."""
    kept: list[Unpacked] = field(default_factory=list)
    """All of them, unless they are too much."""

    @property
    def is_short(self) -> bool:
        """Whether everything is in memory."""
        return self.size <= KEPT

    def say(self, what: str) -> None:
        """Name something that is missing; of a file that is damaged all over, only what comes first."""
        if len(self.missing) < TOLD:
            self.missing.append(what)
        elif len(self.missing) == TOLD:
            self.missing.append("and more is damaged")

    def batches(self) -> Iterator[Batch]:
        """All messages, some at a time.

        Raises:
            LogError: the file has changed since it was checked.
        """
        return iter(self._short) if self.is_short else self._batches(self._again())

    @cached_property
    def _short(self) -> tuple[Batch, ...]:
        return tuple(self._batches(iter(self.kept)))

    def _batches(self, chunks: Iterator[Unpacked]) -> Iterator[Batch]:
        held: list[Unpacked] = []
        size = order = 0
        for unpacked in chunks:
            held.append(unpacked)
            size += len(unpacked.data)
            if size >= BATCH:
                yield (batch := _batch(held, order))
                order += len(batch.begin)
                held, size = [], 0
        if held:
            yield _batch(held, order)

    def _again(self) -> Iterator[Unpacked]:
        try:
            with self.path.open("rb") as file:
                for row in self.places:
                    place = Place(*row.tolist())
                    file.seek(place.at)
                    unpacked = unpack_chunk(file.read(place.size))
                    require(len(unpacked.at) == place.messages, "other messages than before")
                    yield unpacked
        except OSError as err:
            raise UsageError(f"{self.path}: cannot read the log: {err.strerror}") from err
        except DAMAGE as err:
            raise LogError(f"{self.path}: the log has changed while it was read: {_one_line(err)}") from err


def _batch(held: list[Unpacked], order: int) -> Batch:
    sizes = np.cumsum([0] + [len(unpacked.data) for unpacked in held])
    data = np.frombuffer(b"".join([*(unpacked.data for unpacked in held), bytes(PAD)]), np.uint8)
    at = np.concatenate([unpacked.at + base for unpacked, base in zip(held, sizes.tolist(), strict=False)])
    return Batch(data, np.concatenate([unpacked.headers for unpacked in held]), at + HEADER.itemsize, order)


def walk(path: Path) -> Contents:
    """Read every record that is whole.

    Raises:
        LogError: the file is empty, not MCAP, or not a log of ours.
        UsageError: it cannot be read.
    """
    contents = Contents(path)
    try:
        with path.open("rb") as file:
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            if not size:
                raise LogError(f"{path}: the file is empty")
            if file.read(len(MAGIC)) != MAGIC:
                raise LogError(f"{path}: not an MCAP file")
            _Walk(contents, file, size).run()
    except OSError as err:
        raise UsageError(f"{path}: cannot read the log: {err.strerror}") from err
    return contents


class _Walk:
    """One pass over the file."""

    def __init__(self, contents: Contents, file: BinaryIO, size: int) -> None:
        self._contents, self._file, self._size = contents, file, size
        self._crc = zlib.crc32(MAGIC)
        """Over the data section, then over the summary."""
        self._data_end = False
        self._places = array("q")

    def run(self) -> None:
        contents, size, at = self._contents, self._size, len(MAGIC)
        while at < size and not contents.footer:
            head = self._file.read(RECORD.size)
            opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, size)
            if at + RECORD.size + length > size:
                contents.say(f"the file is cut at byte {size}: the record that begins at byte {at} is not whole")
                break
            self._record(opcode, length, head, at)
            if at == len(MAGIC) and (contents.header is None or not contents.header.library.startswith(LIBRARY)):
                raise LogError(f"{contents.path}: an MCAP file, but not a log of emb-run")
            at += RECORD.size + length
        contents.places = np.array(self._places, np.int64).reshape(-1, len(Place._fields))
        tail = self._file.read(len(MAGIC) + 1) if contents.footer else MAGIC
        if (not contents.footer and at >= size) or (tail != MAGIC and MAGIC.startswith(tail)):
            contents.say(f"the file is cut at byte {size}, before its end")
        elif tail != MAGIC:
            contents.say("the end of the file is not that of an MCAP file")

    def _record(self, opcode: int, length: int, head: bytes, at: int) -> None:
        """Take one record; what is wrong with it is said."""
        try:
            if length > LARGEST:
                self._skip(length, head)
                raise ValueError(f"it has {length} bytes, more than any of ours")
            body = self._file.read(length)
            if opcode == Opcode.FOOTER:
                # The checksum covers this record up to where it stands.
                self._crc = zlib.crc32(body[:16], zlib.crc32(head, self._crc))
                self._footer(body)
                return
            if opcode == Opcode.DATA_END:
                before, self._crc, self._data_end = self._crc, 0, True
                expected = mcap.DataEnd.read(_stream(body)).data_section_crc
                require(expected in (0, before), "the checksum over all data is wrong")
                return
            self._crc = zlib.crc32(body, zlib.crc32(head, self._crc))
            self._take(opcode, body, at)
        except DAMAGE as err:
            what = _NAMES.get(opcode, "record")
            self._contents.say(f"the {what} at byte {at} is damaged ({_one_line(err)}) and left out")

    def _skip(self, length: int, head: bytes) -> None:
        self._crc = zlib.crc32(head, self._crc)
        while length > 0:
            piece = self._file.read(min(length, _PIECE))
            if not piece:
                break
            self._crc = zlib.crc32(piece, self._crc)
            length -= len(piece)

    def _footer(self, body: bytes) -> None:
        self._contents.footer = True
        footer = mcap.Footer.read(_stream(body))
        require(self._data_end, "the end of the data is missing")
        require(footer.summary_crc in (0, self._crc), "the checksum over the summary is wrong")

    def _take(self, opcode: int, body: bytes, at: int) -> None:
        """Take one record; raises one of ``DAMAGE`` if it is not what it should be."""
        contents = self._contents
        match opcode:
            case Opcode.HEADER:
                contents.header = mcap.Header.read(_stream(body))
            case Opcode.CHUNK:
                # A damaged chunk is left out as a whole: none of its records can be believed.
                self._chunk(unpack_chunk(body), Place(at + RECORD.size, len(body), 0))
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._described(opcode, body)
            case Opcode.METADATA:
                record = mcap.Metadata.read(_stream(body))
                contents.metadata[record.name] = record.metadata
            case Opcode.ATTACHMENT:
                require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"), "its checksum is wrong")
                attachment = mcap.Attachment.read(_stream(body))
                contents.attachments[attachment.name] = attachment.data
            case Opcode.MESSAGE:
                raise ValueError("it lies outside of a chunk, where it has no checksum")
            case _:
                require(opcode in _NAMES or opcode >= 0x80, "no such record exists")

    def _chunk(self, unpacked: Unpacked, place: Place) -> None:
        contents = self._contents
        described = [_description(opcode, content) for opcode, content in unpacked.others]
        for record in described:
            self._keep(record)
        headers = unpacked.headers
        counts = np.bincount(headers["channel"])
        for channel in np.flatnonzero(counts).tolist():
            contents.counts[channel] = contents.counts.get(channel, 0) + int(counts[channel])
        if len(headers):
            first, last = int(headers["publish"].min()), int(headers["publish"].max())
            span = contents.span or (first, last)
            contents.span = min(span[0], first), max(span[1], last)
        contents.size += len(unpacked.data)
        self._places.extend(place._replace(messages=len(unpacked.at)))
        if contents.is_short:
            contents.kept.append(unpacked)
        else:
            contents.kept.clear()

    def _described(self, opcode: int, body: bytes) -> None:
        self._keep(_description(opcode, body))

    def _keep(self, record: mcap.Schema | mcap.Channel | None) -> None:
        """What a number means cannot change within a file; two meanings come of damage, or of two logs in one."""
        contents = self._contents
        match record:
            case mcap.Schema() if contents.schemas.setdefault(record.id, record) != record:
                contents.say(f"schema {record.id} is described twice, differently; the first counts")
            case mcap.Channel() if contents.channels.setdefault(record.id, record) != record:
                contents.say(f"channel {record.id} is described twice, differently; the first counts")


@lru_cache(maxsize=256)
def _description(opcode: int, content: bytes) -> mcap.Schema | mcap.Channel | None:
    """A schema or a channel, which every log of one version has alike, and twice."""
    match opcode:
        case Opcode.SCHEMA:
            schema: mcap.Schema = mcap.Schema.read(_stream(content))
            return schema
        case Opcode.CHANNEL:
            channel: mcap.Channel = mcap.Channel.read(_stream(content))
            return channel
    return None


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _one_line(err: BaseException) -> str:
    return " ".join(str(err).split()) or type(err).__name__
