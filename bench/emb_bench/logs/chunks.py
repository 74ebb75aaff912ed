"""The chunks of an MCAP file: unpacked, checked, and parted into messages without a loop over them.

Nobody vouches for a file: a chunk that claims to unpack to many times its size is refused before it is unpacked, and
what is no message in it has bounds.

The ``mcap`` library parses single records; its stream reader makes an object of each message, takes four times as long
as parting a chunk with numpy, and trusts the sizes in the file.
"""

from __future__ import annotations

import io
import struct
import zlib
from bisect import bisect_left
from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

Integers = NDArray[np.int64]

LARGEST = 8 << 20
"""Largest record, and largest chunk once unpacked [bytes]; the chunks of a log have a quarter of a MiB."""
MOST_PACKED = 32
"""Times by which a chunk may be larger once unpacked, besides ``SMALL``; those of a log are larger by 4 times."""
SMALL = 8 << 10  # Size of a chunk that may be packed as well as it can be [bytes]
MOST_DESCRIBED = 500  # Schemas and channels of a log; one of ours has two times twenty
LARGEST_DESCRIPTION = 32 << 10  # Largest schema or channel [bytes]
PAD = 32  # Zeros behind the data of a chunk or a batch, so that a number may be read at its last byte
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
"""Exceptions of a parser on bytes that passed, or have, no checksum."""

_MESSAGE = int(Opcode.MESSAGE)
_BLOCK = 1 << 20


class Chunk(NamedTuple):
    """One chunk, unpacked."""

    data: bytes
    at: Integers  # Offset in ``data`` of each message's record [bytes]
    headers: NDArray[Any]  # Of type ``HEADER``, one for each message
    described: tuple[mcap.Schema | mcap.Channel, ...]  # Schemas and channels

    def messages(self) -> Iterator[mcap.Message]:
        """The messages one by one, for copying or conversion."""
        ends = self.at + RECORD.size + self.headers["length"].astype(np.int64)
        for begin, end, header in zip(self.at.tolist(), ends.tolist(), self.headers.tolist(), strict=True):
            _, _, channel, sequence, log_time, publish_time = header
            yield mcap.Message(channel, log_time, self.data[begin + HEADER.itemsize : end], publish_time, sequence)


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
    _, _, size, crc = CHUNK.unpack_from(body)
    at = CHUNK.size
    (name,) = struct.unpack_from("<I", body, at)
    compression = body[at + 4 : at + 4 + name].decode()
    at += 4 + name
    (packed,) = struct.unpack_from("<Q", body, at)
    at += 8
    require(at + packed == len(body), "its lengths contradict each other")
    most = min(LARGEST, SMALL + MOST_PACKED * packed)
    require(size <= most or not compression, f"it claims to unpack from {packed} to {size} bytes, none of ours does")
    data = _decompressed(memoryview(body)[at:], compression, size)
    require(len(data) == size, f"it unpacks to {len(data)} bytes, not to {size}")
    require(crc in (0, zlib.crc32(data)), "its checksum is wrong")
    return _split(data)


def _decompressed(packed: memoryview, compression: str, size: int) -> bytes:
    if not compression:
        return bytes(packed)
    require(compression == "zstd", f"expected zstd, got the compression {compression!r}")
    # zstd takes the frame's own word for its size before the caller's.
    claimed = zstandard.frame_content_size(packed)
    require(claimed in (-1, size), f"its frame claims to unpack to {claimed} bytes, not to {size}")
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
            opcode, length = RECORD.unpack_from(packed, at)
            require(opcode != _MESSAGE, "a message in it is not whole")
            others += 1
            require(others <= MOST_DESCRIBED, f"more than {MOST_DESCRIBED} records in it are no messages")
            if (record := read_description(opcode, packed[at + RECORD.size : at + RECORD.size + length])) is not None:
                described.append(record)
            at += RECORD.size + length
    require(at == len(packed), "a record in it is not whole")
    places = np.concatenate(parts)
    return Chunk(packed, places, gathered(windows(data, HEADER), places), tuple(described))


def _places(data: NDArray[np.uint8], begin: int, end: int) -> tuple[Integers, Integers]:
    """Places in a part of a chunk at which a message may begin, and where each of them would end."""
    maybe = np.flatnonzero(data[begin:end] == _MESSAGE) + begin
    lengths = windows(data, "<u8")[maybe + 1]
    fits = (lengths >= HEADER.itemsize - RECORD.size) & (lengths < len(data))
    return maybe[fits], maybe[fits] + lengths[fits].astype(np.int64) + RECORD.size


def read_description(opcode: int, content: bytes) -> mcap.Schema | mcap.Channel | None:
    """A schema or a channel; None of another record."""
    if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return None
    require(len(content) <= LARGEST_DESCRIPTION, f"a description in it has {len(content)} bytes, more than any of ours")
    return _parse_description(opcode, content)


@lru_cache(maxsize=256)
def _parse_description(opcode: int, content: bytes) -> mcap.Schema | mcap.Channel:
    """A schema or a channel, which every log of one version has alike, and twice."""
    reads = {Opcode.SCHEMA: mcap.Schema.read, Opcode.CHANNEL: mcap.Channel.read}
    found: mcap.Schema | mcap.Channel = reads[Opcode(opcode)](stream_of(content))
    return found


def stream_of(body: bytes) -> ReadDataStream:
    """A record's body as what the ``mcap`` library reads from."""
    return ReadDataStream(io.BytesIO(body))


def require(condition: bool, what: str) -> None:
    """Raise a ``ValueError``, one of ``DAMAGE``, unless this holds."""
    if not condition:
        raise ValueError(what)
