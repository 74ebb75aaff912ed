"""The MCAP reader: one pass over the records of a log's file, which may be cut or damaged.

A file is read from the front; its summary is never needed. Every checksum is checked, a damaged chunk is left out as a
whole, and behind a record whose length is wrong reading goes on with the next chunk that is whole. What is left out is
named in ``missing``.

Nobody vouches for a file. One record and one unpacked chunk are in memory at a time, neither larger than ``LARGEST``;
what is kept of descriptions, metadata and attachments has bounds. So memory is bounded, and time grows with the size of
the file and no faster.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from mcap import records as mcap
from mcap.opcode import Opcode

from emb_bench.logs.chunks import (
    CHUNK,
    DAMAGE,
    LARGEST,
    MOST_DESCRIBED,
    RECORD,
    Chunk,
    read_description,
    require,
    stream_of,
    unpack_chunk,
)
from emb_runtime.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "emb-excite/"  # Begin of the library's name in the header of a log
OUR_SCHEMAS = "emb."  # Begin of the names of our schemas, by which a log is known that another program has copied
PEEKED = 1000  # Records at the begin of a file of another program in which one of our schemas is looked for
MOST_CARRIED = 32 << 20  # Size of all attachments and metadata together [bytes]; a policy has 4 MiB at most
SEARCHED = 8  # Times the size of a file that is read, and ``LARGEST`` besides, to find whole chunks behind damage
MOST_NAMED = 8  # Kinds of damage that are named one by one

Record = mcap.Schema | mcap.Channel | mcap.Metadata | mcap.Attachment | Chunk

_NAMES = {int(opcode): opcode.name.lower().replace("_", " ") for opcode in Opcode}
_BLOCK = 1 << 20
# The name of the compression in a chunk's record, and its offset there [bytes].
_PACKED, _PACKED_AT = b"\x04\x00\x00\x00zstd", RECORD.size + CHUNK.size


class RecordReader:
    """One pass over the records of a file.

    Args:
        path: name of the file, for messages.
        file: the file.
        size: bytes of it that count; what is appended meanwhile does not.
        library: accepted beginning of the library's name in its header.

    Raises:
        LogError: the file is empty, or not a log of ours.
    """

    def __init__(self, path: Path, file: BinaryIO, size: int, library: str = LIBRARY) -> None:
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
            self.header = mcap.Header.read(stream_of(first[1]))
        except DAMAGE:
            self.header = mcap.Header("", "")
        self._begin = len(MAGIC) + RECORD.size + len(first[1])
        if first[0] != Opcode.HEADER or not (self.header.library.startswith(library) or self._is_copy()):
            raise LogError(f"{path}: an MCAP file, but not a log of emb-run")
        self._add(*first)

    def _is_copy(self) -> bool:
        """Returns True for a log of ours that another program has written again: its messages have our schemas."""
        reader = RecordReader(self._path, self._file, self._size, "")
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
            end = at + RECORD.size + len(body)
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
                    yield at + RECORD.size, end, found
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
                found = read_description(opcode, body)
            case Opcode.METADATA:
                found = mcap.Metadata.read(stream_of(body))
            case Opcode.ATTACHMENT:
                require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"), "its checksum is wrong")
                found = mcap.Attachment.read(stream_of(body))
            case Opcode.DATA_END:
                self._data_ended = True
                expected = mcap.DataEnd.read(stream_of(body)).data_section_crc
                require(self._crc is None or expected in (0, self._crc), "the checksum over all data is wrong")
            case Opcode.FOOTER:
                self._end = end
                expected = mcap.Footer.read(stream_of(body)).summary_crc
                require(self._data_ended, "the end of the data is missing")
                covered = zlib.crc32(RECORD.pack(opcode, len(body)) + body[:16], self._crc or 0)
                require(self._crc is None or expected in (0, covered), "the checksum over the summary is wrong")
            case Opcode.MESSAGE:
                raise ValueError("it lies outside of a chunk, where it has no checksum")
            case _:
                require(opcode in _NAMES or opcode >= 0x80, "no such record exists")
        return found  # type: ignore[no-any-return]

    def _add(self, opcode: int, body: bytes) -> None:
        """Take a record into the running checksum, which begins anew behind the data."""
        if opcode == Opcode.DATA_END:
            self._crc = 0
        elif self._crc is not None:
            self._crc = zlib.crc32(body, zlib.crc32(RECORD.pack(opcode, len(body)), self._crc))

    def _head(self, at: int) -> tuple[int, int] | None:
        """Opcode and length of the record that begins there; None if it is too long for the file."""
        if at + RECORD.size > self._size:
            return None
        self._file.seek(at)
        opcode, length = RECORD.unpack(self._file.read(RECORD.size))
        return (opcode, length) if length <= self._size - at - RECORD.size else None

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
        if head is not None and self._is_record(end := at + RECORD.size + head[1]):
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


def name_missing(missing: list[str], what: str) -> None:
    """Name something that is missing; of a file that is damaged all over, only what comes first."""
    if len(missing) < MOST_NAMED:
        missing.append(what)
    elif len(missing) == MOST_NAMED:
        missing.append("and more is damaged")


def message_of(err: BaseException) -> str:
    """An error's message in one line."""
    return " ".join(str(err).split()) or type(err).__name__
