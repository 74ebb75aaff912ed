"""The content of a log's file: what it carries, and its messages in batches."""

from __future__ import annotations

import io
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap import records as mcap
from numpy.typing import NDArray

from emb_bench.logs.chunks import DAMAGE, HEADER, PAD, Chunk, Integers, require, unpack_chunk
from emb_bench.logs.mcap_reader import Record, RecordReader, message_of, name_missing
from emb_runtime.errors import LogError, UsageError
from emb_runtime.system.input_file import open_regular

KEPT = 16 << 20  # Unpacked chunks are kept in memory if all of them take no more than this [bytes]
BATCH = 4 << 20  # Unpacked bytes that are decoded at a time


class Batch(NamedTuple):
    """Messages that follow each other in the file."""

    data: NDArray[np.uint8]  # Unpacked chunks, and ``PAD`` zeros
    headers: NDArray[Any]  # Of type ``HEADER``, one for each message
    begin: Integers  # Offset in ``data`` of each payload [bytes]
    order: int  # Number of the first of them among all messages of the log


class _Place(NamedTuple):
    """Offset and size of a chunk's body in the file [bytes], and its count of messages when it was checked."""

    at: int
    size: int
    messages: int


@dataclass
class Contents:
    """The content of a log's file: its messages are kept if they are few, and else read again."""

    path: Path
    size: int = 0  # Of the file [bytes]
    missing: list[str] = field(default_factory=list)  # Descriptions of the missing parts
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)  # Messages by channel
    span: tuple[int, int] | None = None  # First and last publish time [Unix ns]
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
                    require(len(chunk.at) == place.messages, "other messages than before")
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
            reader = RecordReader(path, file, contents.size)
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
