"""The chunks of a log: unpacked, their checksum checked, and parted into records without a loop over the messages."""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_left
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap.opcode import Opcode
from numpy.typing import NDArray

Integers = NDArray[np.int64]

LARGEST = 64 << 20
"""Largest record, and largest chunk once unpacked [bytes]; those of ours have a quarter of a MiB."""
RECORD = struct.Struct("<BQ")
"""What each record begins with: opcode, and length of what follows."""
HEADER = np.dtype(
    [("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
)
"""What a message begins with; its payload follows."""
PAD = 32
"""Bytes behind the data that may be looked at and mean nothing."""

_CHUNK = struct.Struct("<QQQI")
_MESSAGE = int(Opcode.MESSAGE)


class Unpacked(NamedTuple):
    """One chunk without its compression."""

    data: bytes
    at: Integers
    """Where each message's record begins in ``data``."""
    headers: NDArray[Any]
    """Of type ``HEADER``, one for each message."""
    others: tuple[tuple[int, bytes], ...]
    """Records that are no messages: opcode and content."""


def windows(data: NDArray[np.uint8], kind: Any) -> NDArray[Any]:
    """The bytes from each place on as a number or a record of one kind; a view."""
    dtype = np.dtype(kind)
    count = max(0, len(data) - dtype.itemsize + 1)
    return np.ndarray((count,), dtype, data, strides=(1,))


def gathered(records: NDArray[Any], index: Integers) -> NDArray[Any]:
    """Some of these records, which as plain bytes are gathered five times as fast."""
    return records.view(f"V{records.dtype.itemsize}")[index].view(records.dtype)


def unpack_chunk(body: bytes) -> Unpacked:
    """The records of a chunk.

    Raises:
        ValueError, struct.error, UnicodeDecodeError, zstandard.ZstdError, MemoryError: anything about it is not right.
    """
    _, _, size, crc = _CHUNK.unpack_from(body)
    at = _CHUNK.size
    (name,) = struct.unpack_from("<I", body, at)
    compression = body[at + 4 : at + 4 + name].decode()
    at += 4 + name
    (packed,) = struct.unpack_from("<Q", body, at)
    at += 8
    require(at + packed == len(body), "its lengths contradict each other")
    require(size <= LARGEST, f"it claims to unpack to {size} bytes, more than any of ours")
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


def _split(packed: bytes) -> Unpacked:
    """Part a chunk into records.

    Where a message may begin is seen at its opcode and the length behind it, at all places at once. It does begin there
    if the record before ends there: one leads to the next, from the first byte to the last.
    """
    data = np.frombuffer(packed + bytes(PAD), np.uint8)
    maybe = np.flatnonzero(data[: len(packed)] == _MESSAGE)
    lengths = windows(data, "<u8")[maybe + 1]
    fits = (lengths >= HEADER.itemsize - RECORD.size) & (lengths <= len(packed))
    maybe, ends = maybe[fits], maybe[fits] + lengths[fits].astype(np.int64) + RECORD.size
    # A run of messages that follow each other ends where the next place is not where this one leads.
    lasts, begins = [*np.flatnonzero(ends[:-1] != maybe[1:]).tolist(), len(maybe) - 1], maybe.tolist()
    at, parts, others = 0, [maybe[:0]], list[tuple[int, bytes]]()
    while at < len(packed):
        k = bisect_left(begins, at)
        if k < len(begins) and begins[k] == at:
            last = lasts[bisect_left(lasts, k)]
            parts.append(maybe[k : last + 1])
            at = int(ends[last])
        else:
            opcode, length = RECORD.unpack_from(packed, at)
            require(opcode != _MESSAGE, "a message in it is not whole")
            others.append((opcode, packed[at + RECORD.size : at + RECORD.size + length]))
            at += RECORD.size + length
    places = np.concatenate(parts)
    require(at == len(packed), "a record in it is not whole")
    return Unpacked(packed, places, gathered(windows(data, HEADER), places), tuple(others))


def require(condition: bool, what: str) -> None:
    """Raise ValueError if something is not as it should be."""
    if not condition:
        raise ValueError(what)
