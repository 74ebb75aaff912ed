"""Reading a log: finished, cut by ``kill -9``, or damaged. What can be read is read, what is missing is said.

A finished file and a cut one take the same way: its records are walked from the front, every checksum is checked, and
the first record that does not fit into the file ends the walk. The summary at the end is never needed. The messages
are decoded with the descriptors that the file itself carries.
"""

from __future__ import annotations

import io
import math
import mmap
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.stream_reader import CRCValidationError, breakup_chunk
from numpy.typing import NDArray

from emb_runtime.bench import Bench, BrakeParameters, parse_bench
from emb_runtime.errors import BenchFileError, FrameError, LogError, UsageError
from emb_runtime.frames import Layout, load_layout
from emb_runtime.records import CycleRecord, Frame

MAGIC = b"\x89MCAP0\r\n"
LIBRARY = "emb-excite/"
"""How the header of a log of ours begins."""

Table = Mapping[str, NDArray[Any]]
"""One topic: its fields as columns, ``publish_time`` and ``log_time`` [Unix ns], and ``order`` in the file."""

# What a parser may say of bytes that passed, or have, no checksum.
_DAMAGE = (
    *(McapError, CRCValidationError, struct.error, UnicodeDecodeError, EOFError),
    *(zstandard.ZstdError, MemoryError, OverflowError, ValueError),
)

_NAMES = {int(opcode): opcode.name.lower().replace("_", " ") for opcode in Opcode}


class Event(NamedTuple):
    """Something that the safety chain did."""

    time_ns: int
    """Unix time [ns]."""
    code: str
    text: str


class Line(NamedTuple):
    """A line of text for a person."""

    time_ns: int
    """Unix time [ns]."""
    level: int
    """As in ``foxglove.Log``: 1 debug to 5 fatal."""
    text: str


@dataclass(frozen=True, eq=False)
class RunLog:
    """Everything that one log says."""

    path: Path
    complete: bool
    """The file was closed properly, every checksum is right, and no record was dropped."""
    missing: str
    """What is missing if it is not, in words; empty if it is."""
    metadata: Mapping[str, Mapping[str, str]]
    """Metadata records by name."""
    attachments: Mapping[str, bytes]
    """Attached files by name."""
    tables: Mapping[str, Table]
    """Messages by topic."""

    @property
    def run(self) -> Mapping[str, str]:
        """The run's identity."""
        return self.metadata.get("emb.run", {})

    @property
    def end(self) -> Mapping[str, str]:
        """The run's outcome; empty in a cut log."""
        return self.metadata.get("emb.end", {})

    @property
    def exit_reason(self) -> str:
        """Why the run ended."""
        return self.end.get("exit_reason", "unknown: the log ends before the run does")

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic."""
        return {topic: len(table["log_time"]) for topic, table in self.tables.items()}

    @property
    def cycles(self) -> Table:
        """The control cycles, one column per field of CycleRecord.

        Raises:
            LogError: the log has no such topic.
        """
        table = self.tables.get("/cycle", {})
        if not set(CycleRecord._fields) <= set(table):
            raise LogError(f"{self.path}: the control cycles are missing or have other fields")
        return table

    def signals(self, message: str) -> Table:
        """The decoded signals of one DBC message, as columns.

        Raises:
            LogError: the log has no such message.
        """
        try:
            return self.tables[f"/emb/{message}"]
        except KeyError:
            raise LogError(f"{self.path}: no decoded message is called {message}") from None

    @property
    def wall_offset_ns(self) -> int:
        """What to add to the run's monotonic clock for Unix time [ns].

        Raises:
            LogError: the log has no reading of the clocks.
        """
        clock = self.tables.get("/clock", {})
        if not len(clock.get("monotonic_ns", ())):
            raise LogError(f"{self.path}: no reading of the clocks is left")
        return int(clock["publish_time"][0] - clock["monotonic_ns"][0])

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """Every frame in the order in which it was recorded, on the run's monotonic clock; ``own`` if it was sent."""
        rows: list[tuple[int, Frame]] = []
        for topic, own in (("/can/rx", False), ("/can/tx", True)):
            names = ("order", "publish_time", "id", "data", "is_extended", "is_rtr", "is_error", "dropped")
            for order, when, identifier, data, extended, remote, error, dropped in self._rows(topic, *names):
                time_ns = when - self.wall_offset_ns
                rows.append((order, Frame(identifier, data, time_ns, extended, remote, error, own, dropped)))
        return tuple(frame for _, frame in sorted(rows))

    @property
    def events(self) -> tuple[Event, ...]:
        """The safety events."""
        return tuple(Event(*row) for row in self._rows("/safety", "publish_time", "code", "text"))

    @property
    def lines(self) -> tuple[Line, ...]:
        """The lines of text."""
        return tuple(Line(*row) for row in self._rows("/log", "publish_time", "level", "message"))

    def _rows(self, topic: str, *columns: str) -> Iterator[tuple[Any, ...]]:
        table = self.tables.get(topic, {})
        if not set(columns) <= set(table):
            return iter(())
        return zip(*(table[name].tolist() for name in columns), strict=True)

    @cached_property
    def bench(self) -> Bench:
        """The bench that the run was made on.

        Raises:
            LogError: the log carries no bench file, or a broken one.
        """
        try:
            return parse_bench(self._text("bench.toml"), f"{self.path}: bench.toml")
        except BenchFileError as err:
            raise LogError(f"the bench file inside the log is refused: {err}") from err

    @cached_property
    def layout(self) -> Layout:
        """The CAN layout of the run.

        Raises:
            LogError: the log carries no DBC, or a broken one.
        """
        try:
            return load_layout(self._text("emb.dbc"))
        except FrameError as err:
            raise LogError(f"{self.path}: the DBC inside the log is refused: {err}") from err

    @property
    def truth(self) -> BrakeParameters | None:
        """The brake's true parameters, which a simulated one knows; None otherwise.

        Raises:
            LogError: what the log says of them is incomplete or not a number.
        """
        if "emb.truth" not in self.metadata:
            return None
        record = self.metadata["emb.truth"]
        try:
            truth = BrakeParameters(*(float(record[name]) for name in BrakeParameters._fields))
        except (KeyError, ValueError) as err:
            raise LogError(f"{self.path}: the true parameters in the log are not readable: {err}") from err
        if not all(math.isfinite(value) and value > 0.0 for value in truth):
            raise LogError(f"{self.path}: the true parameters in the log are not positive numbers")
        return truth

    @property
    def true_plant(self) -> str | None:
        """Name of the plant that was simulated; None for a real bench, and for a log that does not say."""
        return self.metadata.get("emb.truth", {}).get("plant")

    def _text(self, name: str) -> str:
        if name not in self.attachments:
            raise LogError(f"{self.path}: the log carries no {name}")
        try:
            return self.attachments[name].decode()
        except UnicodeDecodeError as err:
            raise LogError(f"{self.path}: {name} inside the log is not UTF-8 text") from err


def read_log(path: str | Path) -> RunLog:
    """Read a log, or what is left of one.

    Raises:
        LogError: the file cannot be read, is empty, not MCAP or not a log of ours, or not one message is left.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            if not path.stat().st_size:
                raise LogError(f"{path}: the file is empty")
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                content = _walk(path, data)
    except OSError as err:
        raise UsageError(f"{path}: cannot read the log: {err.strerror}") from err
    except ValueError as err:
        raise LogError(f"{path}: cannot read the log: {err}") from err
    if not content.count:
        raise LogError(f"{path}: not one message is left in this log: {'; '.join(content.missing)}")
    tables = _tables(path, content)
    dropped = content.metadata.get("emb.end", {}).get("dropped_records", "0")
    if dropped != "0":
        content.missing.append(f"{dropped} records were dropped while recording")
    return RunLog(
        path=path,
        complete=not content.missing,
        missing="; ".join(content.missing),
        metadata=content.metadata,
        attachments=content.attachments,
        tables=tables,
    )


@dataclass
class _Content:
    """What the walk finds."""

    missing: list[str] = field(default_factory=list)
    header: mcap.Header | None = None
    metadata: dict[str, Mapping[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    messages: dict[int, list[mcap.Message]] = field(default_factory=lambda: defaultdict(list))
    """By channel."""
    count: int = 0
    """Messages so far."""
    orders: dict[int, list[int]] = field(default_factory=lambda: defaultdict(list))
    """Where each of them is among all messages."""
    footer: int | None = None
    """Where the footer ends."""
    data_end: int | None = None
    """Where the data section ends."""
    summary: int = 0
    """Where the summary begins."""


def _walk(path: Path, data: mmap.mmap) -> _Content:
    """Read every record that is whole."""
    content = _Content()
    if data[: len(MAGIC)] != MAGIC:
        raise LogError(f"{path}: not an MCAP file")
    at, size = len(MAGIC), len(data)
    while at < size and content.footer is None:
        length = struct.unpack_from("<Q", data, at + 1)[0] if at + 9 <= size else size
        if at + 9 + length > size:
            content.missing.append(f"the file is cut at byte {size}: the record that begins at byte {at} is not whole")
            break
        body = data[at + 9 : at + 9 + length]
        try:
            _take(content, data[at], body, data, at)
        except _DAMAGE as err:
            what = _NAMES.get(data[at], "record")
            content.missing.append(f"the {what} at byte {at} is damaged ({_one_line(err)}) and left out")
        at += 9 + length
        if at == 17 + length and (content.header is None or not content.header.library.startswith(LIBRARY)):
            raise LogError(f"{path}: an MCAP file, but not a log of emb-run")
    tail = MAGIC if content.footer is None else data[content.footer :]
    if (content.footer is None and at >= size) or (tail != MAGIC and MAGIC.startswith(tail)):
        content.missing.append(f"the file is cut at byte {size}, before its end")
    elif tail != MAGIC:
        content.missing.append("the end of the file is not that of an MCAP file")
    return content


def _take(content: _Content, opcode: int, body: bytes, data: mmap.mmap, at: int) -> None:
    """Take one record; raises one of ``_DAMAGE`` if it is not what it should be."""
    stream = ReadDataStream(io.BytesIO(body))
    match opcode:
        case Opcode.HEADER:
            content.header = mcap.Header.read(stream)
        case Opcode.CHUNK:
            # A damaged chunk is left out as a whole: none of its records can be believed.
            for record in breakup_chunk(mcap.Chunk.read(stream), validate_crc=True):
                _take_inner(content, record)
        case Opcode.SCHEMA:
            _take_inner(content, mcap.Schema.read(stream))
        case Opcode.CHANNEL:
            _take_inner(content, mcap.Channel.read(stream))
        case Opcode.METADATA:
            record = mcap.Metadata.read(stream)
            content.metadata[record.name] = record.metadata
        case Opcode.ATTACHMENT:
            _require(zlib.crc32(body[:-4]) == int.from_bytes(body[-4:], "little"), "its checksum is wrong")
            attachment = mcap.Attachment.read(stream)
            content.attachments[attachment.name] = attachment.data
        case Opcode.DATA_END:
            expected = mcap.DataEnd.read(stream).data_section_crc
            content.data_end = at
            content.summary = at + 9 + len(body)
            _require(expected in (0, zlib.crc32(memoryview(data)[:at])), "the checksum over all data is wrong")
        case Opcode.FOOTER:
            footer = mcap.Footer.read(stream)
            content.footer = at + 9 + len(body)
            covered = memoryview(data)[content.summary : at + 9 + 16]
            _require(content.data_end is not None, "the end of the data is missing")
            _require(footer.summary_crc in (0, zlib.crc32(covered)), "the checksum over the summary is wrong")
        case _:
            _require(opcode in _NAMES or opcode >= 0x80, "no such record exists")


def _take_inner(content: _Content, record: mcap.McapRecord) -> None:
    match record:
        case mcap.Schema():
            content.schemas[record.id] = record
        case mcap.Channel():
            content.channels[record.id] = record
        case mcap.Message():
            content.orders[record.channel_id].append(content.count)
            content.count += 1
            content.messages[record.channel_id].append(record)


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise ValueError(what)


def _one_line(err: BaseException) -> str:
    return " ".join(str(err).split()) or type(err).__name__


def _tables(path: Path, content: _Content) -> dict[str, Table]:
    """Decode the messages with the descriptors in the file; a topic that cannot be decoded is named as missing."""
    tables: dict[str, Table] = {}
    for number in sorted(content.channels.keys() | content.messages.keys()):
        messages = content.messages.get(number, [])
        channel = content.channels.get(number)
        schema = content.schemas.get(channel.schema_id) if channel else None
        if channel is None or schema is None:
            content.missing.append(f"{len(messages)} messages of a topic whose description is lost")
            continue
        try:
            tables[channel.topic] = _columns(schema, messages, content.orders[number])
        except (DecodeError, TypeError, KeyError, OverflowError, *_DAMAGE) as err:
            content.missing.append(f"{len(messages)} messages of {channel.topic}, not readable ({_one_line(err)})")
    if not tables:
        raise LogError(f"{path}: nothing in this log can be decoded: {'; '.join(content.missing)}")
    return tables


def _columns(schema: mcap.Schema, messages: list[mcap.Message], orders: list[int]) -> Table:
    factory = _message_class(schema.name, schema.data)
    parsed = [factory.FromString(message.data) for message in messages]
    columns: dict[str, NDArray[Any]] = {
        "publish_time": np.array([m.publish_time for m in messages], dtype=np.int64),
        "log_time": np.array([m.log_time for m in messages], dtype=np.int64),
        "order": np.array(orders, dtype=np.int64),
    }
    for entry in factory.DESCRIPTOR.fields:
        if entry.cpp_type == entry.CPPTYPE_MESSAGE:
            continue  # the time stamp inside foxglove.Log, which is the publish time
        values = [getattr(message, entry.name) for message in parsed]
        columns[entry.name] = _column(entry, values)
    return columns


@lru_cache(maxsize=64)
def _message_class(name: str, descriptors: bytes) -> Any:
    """The class of a message, from a serialised FileDescriptorSet."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def _column(entry: Any, values: list[Any]) -> NDArray[Any]:
    if entry.cpp_type in (entry.CPPTYPE_DOUBLE, entry.CPPTYPE_FLOAT):
        return np.array(values, dtype=np.float64)
    if entry.cpp_type == entry.CPPTYPE_STRING:
        column = np.empty(len(values), dtype=object)
        column[:] = values
        return column
    return np.array(values, dtype=bool if entry.cpp_type == entry.CPPTYPE_BOOL else np.int64)
