"""The records of a log one by one, in the order of the file, which may be longer than the memory, cut, or damaged.

What cannot be believed is left out and told: every checksum is checked, a damaged chunk is left out as a whole, and
behind a record whose length is wrong the pass goes on with the next chunk that is whole. Who copies a log wants each
record as it was, and reads here; who evaluates one wants topics as columns, and reads with
:mod:`emb_bench.logs.contents`.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode

from emb_bench.logs.chunk import LARGEST, RECORD, require, unpack_chunk
from emb_bench.logs.contents import DAMAGE, LIBRARY, MAGIC, TOLD
from emb_runtime.errors import LogError

CAN_LIBRARY = "emb-excite-can/"
"""How the header of a file begins that python-can wrote through us: frames of a bus, but no run."""

Record = mcap.Schema | mcap.Channel | mcap.Message | mcap.Metadata | mcap.Attachment

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_BLOCK = 1 << 20
_NAMES = {int(opcode): opcode.name.lower().replace("_", " ") for opcode in Opcode}
# How a chunk of ours says that it is packed, and where in the record it does.
_PACKED = b"\x04\x00\x00\x00zstd"
_PACKED_AT = RECORD.size + 28


class Walk:
    """One pass over the records of a log.

    Args:
        path: what the file is called, for messages.
        file: the file.
        size: bytes of it that count; what is appended meanwhile does not.

    Raises:
        LogError: the file is empty, or not a log of ours.
    """

    def __init__(self, path: Path, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size
        self.missing: list[str] = []
        """What is missing, in words; grows as the pass goes on."""
        self._crc: int | None = zlib.crc32(MAGIC)  # over the data, then the summary; None if some of it was left out
        self._data_ended = False
        self._end: int | None = None  # where the footer ends
        if not size:
            raise LogError(f"{path}: the file is empty")
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise LogError(f"{path}: not an MCAP file")
        first = self._read(len(MAGIC))
        try:
            self.header = mcap.Header.read(_stream(first[1] if first else b""))
        except DAMAGE:
            first = None
        if first is None or not self.header.library.startswith((LIBRARY, CAN_LIBRARY)):
            raise LogError(f"{path}: an MCAP file, but not a log of emb-run")
        self._begin = len(MAGIC) + RECORD.size + len(first[1])
        self._add(*first)

    def records(self) -> Iterator[Record]:
        """Schemas and channels of a chunk come before its messages. For one pass only."""
        at = self._begin
        while at < self._size and self._end is None:
            record = self._read(at)
            if record is None:
                goes_on = self._next_chunk(at + 1)
                if goes_on is None:
                    self._say(f"the file is cut at byte {self._size}: the record that begins at byte {at} is not whole")
                    return
                at = self._skip(at, goes_on, "its length is wrong")
                continue
            opcode, body = record
            end = at + RECORD.size + len(body)
            try:
                yield from self._take(opcode, body, end)
            except DAMAGE as err:
                said = " ".join(str(err).split()) or type(err).__name__
                # If what follows is no record either, the damage is in the length.
                goes_on = None if self._is_record(end) else self._next_chunk(at + 1)
                if goes_on is not None:
                    at = self._skip(at, goes_on, said)
                    continue
                self._say(f"the {_NAMES.get(opcode, 'record')} at byte {at} is damaged ({said}) and left out")
            self._add(opcode, body)
            at = end
        self._look_at_the_end()

    def _take(self, opcode: int, body: bytes, end: int) -> Iterator[Record]:
        """What is in one record; raises one of ``DAMAGE``, before anything, if it is not what it should be."""
        match opcode:
            case Opcode.CHUNK:
                yield from _in_chunk(body)
            case Opcode.SCHEMA:
                yield mcap.Schema.read(_stream(body))
            case Opcode.CHANNEL:
                yield mcap.Channel.read(_stream(body))
            case Opcode.METADATA:
                yield mcap.Metadata.read(_stream(body))
            case Opcode.ATTACHMENT:
                require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"), "its checksum is wrong")
                yield mcap.Attachment.read(_stream(body))
            case Opcode.DATA_END:
                self._data_ended = True
                expected = mcap.DataEnd.read(_stream(body)).data_section_crc
                require(self._crc is None or expected in (0, self._crc), "the checksum over all data is wrong")
            case Opcode.FOOTER:
                self._end = end
                expected = mcap.Footer.read(_stream(body)).summary_crc
                require(self._data_ended, "the end of the data is missing")
                covered = zlib.crc32(RECORD.pack(opcode, len(body)) + body[:16], self._crc or 0)
                require(self._crc is None or expected in (0, covered), "the checksum over the summary is wrong")
            case Opcode.MESSAGE:
                raise ValueError("it lies outside of a chunk, where it has no checksum")
            case _:
                require(opcode in _NAMES or opcode >= 0x80, "no such record exists")

    def _add(self, opcode: int, body: bytes) -> None:
        """Take a record into the running checksum, which begins anew behind the data."""
        if opcode == Opcode.DATA_END:
            self._crc = 0
        elif self._crc is not None:
            self._crc = zlib.crc32(body, zlib.crc32(RECORD.pack(opcode, len(body)), self._crc))

    def _head(self, at: int) -> tuple[int, int] | None:
        """Opcode and length of the record that begins there; None if it is too long for the file, or for us."""
        if at + RECORD.size > self._size:
            return None
        self._file.seek(at)
        opcode, length = RECORD.unpack(self._file.read(RECORD.size))
        return (opcode, length) if length <= min(LARGEST, self._size - at - RECORD.size) else None

    def _read(self, at: int) -> tuple[int, bytes] | None:
        """Opcode and body of the record that begins there; None if there is none."""
        head = self._head(at)
        return head and (head[0], self._file.read(head[1]))

    def _is_record(self, at: int) -> bool:
        """Whether a record of a known kind begins there, as far as one can see; so does the end of the file."""
        head = self._head(at)
        return at == self._size or (head is not None and head[0] in _NAMES)

    def _next_chunk(self, at: int) -> int | None:
        """Where the first whole chunk from there on begins; None if there is none."""
        while at < self._size:
            self._file.seek(at)
            block = self._file.read(min(_BLOCK + _PACKED_AT + len(_PACKED), self._size - at))
            found = block.find(_PACKED, _PACKED_AT)
            while found >= 0:
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
        try:
            unpack_chunk(record[1])
        except DAMAGE:
            return False
        return True

    def _skip(self, at: int, goes_on: int, why: str) -> int:
        self._say(f"the record at byte {at} is damaged ({why}): {goes_on - at} bytes are left out")
        self._crc = None
        return goes_on

    def _look_at_the_end(self) -> None:
        """Say whether the file ends as an MCAP file does."""
        tail = b""
        if self._end is not None:
            self._file.seek(self._end)
            tail = self._file.read(min(self._size - self._end, len(MAGIC) + 1))
        if tail != MAGIC and MAGIC.startswith(tail):
            self._say(f"the file is cut at byte {self._size}, before its end")
        elif tail != MAGIC:
            self._say("the end of the file is not that of an MCAP file")

    def _say(self, what: str) -> None:
        """Of a file that is damaged all over, only what comes first."""
        if len(self.missing) < TOLD:
            self.missing.append(what)
        elif len(self.missing) == TOLD:
            self.missing.append("and more is damaged")


def _in_chunk(body: bytes) -> Iterator[Record]:
    """What is in a chunk, which as a whole can be believed or not."""
    unpacked = unpack_chunk(body)
    described: list[Record] = []
    for opcode, content in unpacked.others:
        if opcode == Opcode.SCHEMA:
            described.append(mcap.Schema.read(_stream(content)))
        elif opcode == Opcode.CHANNEL:
            described.append(mcap.Channel.read(_stream(content)))
    yield from described
    for at in unpacked.at.tolist():
        _, length, channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(unpacked.data, at)
        data = unpacked.data[at + _MESSAGE.size : at + RECORD.size + length]
        yield mcap.Message(channel, log_time, data, publish_time, sequence)


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))
