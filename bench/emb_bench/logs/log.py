"""A log of a run: finished, cut by ``kill -9``, or damaged. All that can be read is read; what is missing is named.

The messages are decoded with the descriptors inside the file, when they are requested: as tables, or of a long log in
batches. The chunks are read again each time.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property, lru_cache, wraps
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from emb_bench.config.bench import Bench, parse_bench
from emb_bench.config.conditions import CONDITIONS
from emb_bench.documents import ByName
from emb_bench.logs.mcap_file import (
    DAMAGE,
    HEADER,
    Chunk,
    Column,
    McapFile,
    describe,
    message_class,
    message_columns,
    message_of,
    unpack_chunk,
)
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.drives.mapping import PROPERTIES, MappingError
from emb_runtime.drives.mapping import Mapping as DriveMapping
from emb_runtime.drives.mapping_file import parse_mapping
from emb_runtime.drives.wire import conditions_in
from emb_runtime.errors import BenchFileError, LogError, UsageError, near
from emb_runtime.log import topics
from emb_runtime.records import CycleRecord, Frame, RunType
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.system import terminal
from emb_runtime.system.input_file import open_regular

Table = Mapping[str, NDArray[Any]]
"""One topic: its fields as columns, ``publish_time`` and ``log_time`` [Unix ns], and ``order`` in the file."""

BATCH = 2 << 20  # Unpacked bytes that are decoded at a time
SMALL_TABLE = 64 << 20  # Size of a table that any log may have [bytes]
TABLE = 16  # Times the size of the file by which it may be larger; the cycles of a log take about the size of its file
LONGEST_REASON = 200  # Characters of the reason for a run's end
LONGEST_BUS = 40  # Characters of the name of a bus
LARGEST_TEXT = 64 << 10  # Largest bench file and DBC in a log [bytes]

TIMES = ("publish_time", "log_time", "order")  # Columns that every topic has besides its fields
FRAME = ("id", "data", "publish_time", "is_extended", "is_rtr", "is_error", "dropped")  # Columns of a frame
TIME = Column("time", "float64", "s")  # Since the first message of the log; all topics have the same zero
UNIX_TIME = Column("unix_time", "int64", "ns")

UNREADABLE = (DecodeError, TypeError, KeyError, AttributeError, RecursionError, *DAMAGE)
"""Exceptions of descriptors and messages that are damaged, or mean something else."""


class Event(NamedTuple):
    """Something that the safety chain did."""

    time_ns: int  # Unix time [ns]
    code: str
    text: str


class _Topic(NamedTuple):
    """One channel that can be decoded."""

    channel: int
    messages: int
    factory: Any
    units: str  # SI units by field, as JSON


class _Place(NamedTuple):
    """Place of a chunk's record in the file."""

    at: int  # [bytes]
    length: int  # [bytes]
    messages: int  # Number of them in the chunk
    channels: frozenset[int]  # Of these messages


@dataclass(frozen=True)
class Chunks:
    """The complete chunks of a log, read from the file each time: a long log takes more than the memory."""

    path: Path
    places: Sequence[_Place]

    def of(self, channels: Set[int]) -> Iterator[tuple[int, Chunk]]:
        """Those with a message of some channels, each behind the number of messages before it in the log."""
        before = 0
        try:
            with open_regular(self.path) as file:
                for place in self.places:
                    if not channels.isdisjoint(place.channels):
                        file.seek(place.at)
                        chunk = unpack_chunk(file.read(place.length))
                        if len(chunk.at) != place.messages:
                            raise ValueError("other messages than before")
                        yield before, chunk
                    before += place.messages
        except OSError as err:
            raise UsageError(f"{self.path}: cannot read the log: {err.strerror}") from err
        except DAMAGE as err:
            raise LogError(f"{self.path}: the log has changed while it was read: {message_of(err)}") from err


class _Tables(Mapping[str, Table]):
    """All topics of a log, each decoded when it is requested."""

    def __init__(self, log: RunLog) -> None:
        self._log, self._decoded = log, dict[str, Table]()

    def __getitem__(self, topic: str) -> Table:
        if topic not in self._decoded:
            ByName(self._log.topics)[topic]  # or names the one that was meant
            self._decoded[topic] = self._log.table(topic)
        return self._decoded[topic]

    def __iter__(self) -> Iterator[str]:
        return iter(self._log.topics)

    def __len__(self) -> int:
        return len(self._log.topics)


@dataclass(frozen=True, eq=False, repr=False)
class RunLog:
    """The content of one log. A message that cannot be decoded is refused when it is requested."""

    is_recording: ClassVar[bool] = False  # True if others made it, and the file is no log
    path: Path
    complete: bool  # The file was closed properly, every checksum is right, and no record was dropped
    missing: str  # Description of the missing parts of an incomplete log; empty if it is complete
    metadata: Mapping[str, Mapping[str, str]]  # Metadata records by name
    attachments: Mapping[str, bytes]  # Attached files by name
    size: int  # Of the file [bytes]
    span: tuple[int, int]  # First and last publish time of the messages [Unix ns]
    chunks: Chunks = field(repr=False)  # The complete ones of the file
    topics: Mapping[str, _Topic] = field(repr=False)  # The topics that can be decoded, by name

    def __repr__(self) -> str:
        """Path, end and completeness in one line."""
        return f"<RunLog {self.path}: {self.exit_reason}, {'complete' if self.complete else self.missing}>"

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy in another process reads the file again."""
        return read_log, (self.path,)

    @cached_property
    def tables(self) -> Mapping[str, Table]:
        """Messages by topic, each topic in one table, which of a long log takes much memory."""
        return _Tables(self)

    def table(self, topic: str) -> Table:
        """All messages of a topic, which of a long log take much memory."""
        size = 8 * len(describe(self.topics[topic].factory)) * self.topics[topic].messages
        if size > SMALL_TABLE + TABLE * self.size:
            what = f"{topic} would take {size >> 20} MiB as a table, from {self.size} bytes"
            raise LogError(f"{self.path}: {what}: no log of ours")
        parts = [part[topic] for part in self.batches(topic)]
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def batches(self, *names: str) -> Iterator[dict[str, Table]]:
        """Messages of some topics, some at a time and in the order of the file: for a log of any length.

        Topics that the log does not have are skipped.
        """
        topics = {name: self.topics[name] for name in names if name in self.topics}
        chunks, size, some = list[tuple[int, Chunk]](), 0, False
        for before, chunk in self.chunks.of({topic.channel for topic in topics.values()}):
            chunks.append((before, chunk))
            size += len(chunk.data)
            if size >= BATCH:
                yield {name: self._decoded(chunks, name) for name in topics}
                chunks, size, some = [], 0, True
        if chunks or not some:
            yield {name: self._decoded(chunks, name) for name in topics}

    def _decoded(self, chunks: Sequence[tuple[int, Chunk]], topic: str) -> Table:
        """The messages of a topic in chunks, each behind the number of messages before it."""
        channel, _, factory, _ = self.topics[topic]
        headers, orders = [np.empty(0, HEADER)], [np.empty(0, np.int64)]
        for before, chunk in chunks:
            places = np.flatnonzero(chunk.headers["channel"] == channel)
            headers.append(chunk.headers[places])
            orders.append(before + places)
        times, order = np.concatenate(headers), np.concatenate(orders)
        payloads = [data for _, chunk in chunks for data in chunk.payloads(channel)]
        log_time, sequence = times["log"].astype(np.int64), times["sequence"].astype(np.int64)
        if ((np.diff(log_time) == 0) & (np.diff(sequence) < 0)).any():  # equal times in an order of another tool's
            right = np.lexsort((sequence, np.cumsum(np.diff(log_time, prepend=0) != 0)))
            times, payloads = times[right], [payloads[i] for i in right.tolist()]
        try:
            fields = message_columns(factory, payloads)
            return _times(times["publish"], times["log"]) | {"order": order} | fields
        except UNREADABLE as err:
            raise LogError(f"{self.path}: the messages of {topic} are not readable: {message_of(err)}") from err

    def rows(self, topic: str, *names: str) -> Iterator[tuple[Any, ...]]:
        """Some columns of a topic, message by message; nothing if the log does not have it."""
        for part in self.batches(topic) if self._has(topic, names) else ():
            yield from zip(*(part[topic][name].tolist() for name in names), strict=True)

    def last(self, topic: str, *names: str) -> tuple[Any, ...]:
        """Some columns of the last message of a topic, read without those before it; empty if there is none."""
        if not self._has(topic, names):
            return ()
        channel = self.topics[topic].channel
        places = [place for place in self.chunks.places if channel in place.channels]
        table = self._decoded([*replace(self.chunks, places=places[-1:]).of({channel})], topic)
        return next(zip(*(table[name][-1:].tolist() for name in names), strict=True), ())

    def _has(self, topic: str, names: Sequence[str]) -> bool:
        """Returns True if the log has a topic; raises LogError if one of ours lacks some of these fields."""
        if topic in self.topics and topic in topics.TOPICS:
            self.require(topic, [name for name in names if name not in TIMES])
        return topic in self.topics

    def describe(self, topic: str) -> tuple[Column, ...]:
        """The columns of a topic: two times, then every field."""
        if topic not in self.topics:
            raise UsageError(
                f"expected a topic of {self.path}, {', '.join(self.topics)}; got {topic!r}{near(topic, self.topics)}"
            )
        try:
            return (TIME, UNIX_TIME, *describe(self.topics[topic].factory, self.topics[topic].units))
        except (ValueError, AttributeError, RecursionError) as err:
            raise LogError(f"{self.path}: the units of {topic} are not readable: {message_of(err)}") from err

    def values(self, table: Table, column: Column) -> NDArray[Any]:
        """One described column of a topic's messages, of all of them or of a batch."""
        if column is TIME:
            return (table["publish_time"] - self.span[0]) / 1e9
        return table["publish_time" if column is UNIX_TIME else column.name]

    @property
    def run(self) -> Mapping[str, str]:
        """The run's identity."""
        return self.metadata.get("emb.run", {})

    @property
    def simulated(self) -> str:
        """Simulation in place of a real machine, by the log's metadata; empty if they name none."""
        bus = self.metadata.get("emb.drive", {}).get("bus") or self.run.get("iface", "")
        if "emb.truth" in self.metadata or bus.partition(":")[0] == "sim":
            return "a simulated brake"
        virtual = bus.startswith(("vcan", "vxcan"))
        return f"a node on a virtual bus ({terminal.one_line(bus, LONGEST_BUS)})" if virtual else ""

    @property
    def source(self) -> str:
        """Machine that was driven: a simulated one, or the bench on its interface; or a recording of others."""
        if self.is_recording:
            return "recording of another machine"
        return self.simulated or f"bench on {self.run.get('iface', 'an unknown interface')}"

    @property
    def began(self) -> str:
        """Begin of the run in UTC, by the clock of the computer that recorded it; empty if the log has none."""
        first, _ = self.span
        if not 0 < first < 2**62:
            return ""
        return datetime.fromtimestamp(first // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the file."""
        try:
            with open_regular(self.path) as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as err:
            raise LogError(f"{self.path}: {err.strerror}") from err

    @property
    def drive_lacks(self) -> dict[str, str]:
        """Properties that a mapped drive lacks, which its mapping file accepts: name and consequence; else empty."""
        names = self.metadata.get("emb.drive", {}).get("lost", "").split(", ")
        return {terminal.one_line(name): PROPERTIES.get(name, "not known to this version") for name in names if name}

    @property
    def drive_files(self) -> tuple[str, str] | None:
        """Mapping file and DBC of a mapped drive, as text; None for the log of any other run."""
        if "emb.drive" not in self.metadata:
            return None
        mapping, dbc = (self.attachments.get(f"drive.{kind}", b"").decode(errors="replace") for kind in ("toml", "dbc"))
        return mapping, dbc

    @cached_property
    def drive(self) -> DriveMapping | None:
        """The mapped drive; None for the log of any other run, or where its mapping in the log is not readable."""
        try:
            return None if self.drive_files is None else parse_mapping(*self.drive_files, f"{self.path}: drive.toml")
        except MappingError:
            return None

    @property
    def end(self) -> Mapping[str, str]:
        """The run's outcome; empty in a cut log."""
        return self.metadata.get("emb.end", {})

    @property
    def exit_reason(self) -> str:
        """Reason for the run's end; unknown in a cut log."""
        return terminal.one_line(
            self.end.get("exit_reason", "unknown: the log ends before the run does"), LONGEST_REASON
        )

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic."""
        return {name: topic.messages for name, topic in self.topics.items()}

    @property
    def cycles(self) -> Table:
        """The control cycles, one column per field of CycleRecord."""
        self.require("/cycle", CycleRecord._fields)
        return self.tables["/cycle"]

    def require(self, topic: str, fields: Sequence[str]) -> None:
        """Refuse a log in which one of our topics is missing, or some of its fields are or mean something else."""
        what = {"/cycle": "the control cycles"}.get(topic, f"the messages of {topic}")
        if topic not in self.topics:
            raise LogError(f"{self.path}: {what} are missing{': ' + self.missing if self.missing else ''}")
        theirs = _kinds(self.topics[topic].factory)
        ours = _kinds(topics.message_class(topics.TOPICS[topic]))
        lost = [f"{name} ({ours[name]})" for name in fields if theirs.get(name) != ours[name]]
        if lost:
            raise LogError(f"{self.path}: {what} have other fields: expected {', '.join(lost)} too")

    def signals(self, message: str) -> Table:
        """The decoded signals of one DBC message, as columns."""
        try:
            return self.tables[f"/emb/{message}"]
        except KeyError:
            raise LogError(f"{self.path}: no decoded message is called {message}") from None

    @cached_property
    def conditions(self) -> Mapping[str, float]:
        """Mean temperature of the motor [degC] and supply voltage [V], by name; those that some frame has."""
        return {name: float(values.mean()) for name, values in self.measured_conditions.items()}

    @cached_property
    def measured_conditions(self) -> Mapping[str, NDArray[np.float64]]:
        """Values that :attr:`conditions` are the means of, in the order of their frames, by name."""
        found, topic = dict[str, NDArray[np.float64]](), "/emb/EMB_Conditions"
        for name, (signal, _, _) in CONDITIONS.items():
            values = np.asarray(self.tables[topic].get(signal, ()), np.float64) if topic in self.topics else np.empty(0)
            one = load_layout().optional["EMB_Conditions"].signal(signal)
            valid = values[(values >= one.minimum) & (values <= one.maximum)]  # this way round, NaN is none
            if valid.size:
                found[name] = valid
        drive = self.drive
        return found | ({} if drive is None or not drive.conditions else self._told_by(drive))

    def _told_by(self, drive: DriveMapping) -> dict[str, NDArray[np.float64]]:
        """Conditions by the frames on the bus of a mapped drive, by name, without implausible values."""
        found: dict[str, list[float]] = {}
        for identifier, data, *kind in self.rows("/drive/rx", "id", "data", "is_extended", "is_rtr", "is_error"):
            for name, value in conditions_in(drive, Frame(identifier, data, 0, *kind)).items():
                found.setdefault(name, []).append(value)
        return {name: np.array(values) for name, values in found.items()}

    @cached_property
    def wall_offset_ns(self) -> int:
        """Unix time minus the run's monotonic clock [ns]."""
        for publish_time, monotonic_ns in self.rows("/clock", "publish_time", "monotonic_ns"):
            return int(publish_time) - int(monotonic_ns)
        raise LogError(f"{self.path}: no reading of the clocks is left")

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """Every frame in the order in which it was recorded, on the run's monotonic clock; ``own`` if it was sent."""
        return tuple(f._replace(time_ns=f.time_ns - self.wall_offset_ns) for f in self.frames_by_unix_time())

    def frames_by_unix_time(self) -> Iterator[Frame]:
        """Every frame of a log of any length, as :attr:`frames` has it but with Unix time [ns]."""
        topics = {name: sent for name, sent in (("/can/rx", False), ("/can/tx", True)) if self._has(name, FRAME)}
        for part in self.batches(*topics):
            rows: list[tuple[int, Frame]] = []
            for topic, sent in topics.items():
                columns = (part[topic][name].tolist() for name in ("order", *FRAME))
                for order, identifier, data, when, extended, remote, error, dropped in zip(*columns, strict=True):
                    rows.append((order, Frame(identifier, data, when, extended, remote, error, sent, dropped)))
            yield from (frame for _, frame in sorted(rows))

    @cached_property
    def events(self) -> tuple[Event, ...]:
        """The safety events."""
        rows = self.rows("/safety", "publish_time", "code", "text")
        return tuple(Event(when, terminal.one_line(code), terminal.one_line(text)) for when, code, text in rows)

    @cached_property
    def bench(self) -> Bench:
        """The bench that the run was made on."""
        try:
            return _bench(self._text("bench.toml"))
        except BenchFileError as err:
            raise LogError(f"{self.path}: the bench file inside the log is refused: {err}") from err

    @cached_property
    def layout(self) -> Layout:
        """The CAN layout of the run; LogError if the log's messages are not those of this version."""
        layout = load_layout()
        if not _definitions(self._text("emb.dbc")) <= _definitions(layout.text):
            raise LogError(f"{self.path}: its DBC is not that of this version: read it with the version that wrote it")
        return layout

    @property
    def truth(self) -> BrakeParameters | None:
        """The true parameters of a simulated brake; None for a real one."""
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
        """Name of the plant that was simulated; None for a real bench, and for a log that does not name it."""
        return self.metadata.get("emb.truth", {}).get("plant")

    def _text(self, name: str) -> str:
        if name not in self.attachments:
            raise LogError(f"{self.path}: the log carries no {name}")
        if (size := len(self.attachments[name])) > LARGEST_TEXT:
            raise LogError(f"{self.path}: {name} inside the log has {size} bytes, expected at most {LARGEST_TEXT}")
        try:
            return self.attachments[name].decode()
        except UnicodeDecodeError as err:
            raise LogError(f"{self.path}: {name} inside the log is not UTF-8 text") from err


Found = TypeVar("Found")


def once(read: Callable[[RunLog], Found]) -> Callable[[RunLog], Found]:
    """A function of a log that is called once for each opened log; its result must not be changed."""
    results: WeakKeyDictionary[RunLog, Found] = WeakKeyDictionary()

    @wraps(read)
    def found(log: RunLog) -> Found:
        if log not in results:
            results[log] = read(log)
        return results[log]

    return found


def read_log(path: str | Path) -> RunLog:
    """Read a log, or the readable part of one.

    Raises:
        LogError: the file is empty, not MCAP or not a log of ours, or has no readable message.
        UsageError: it cannot be read.
    """
    path = Path(path)
    places, counts, spans = list[_Place](), Counter[int](), list[tuple[int, int]]()
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            contents = McapFile(path, file, size)
            for at, length, chunk in contents.chunks():
                places.append(_Place(at, length, len(chunk.at), frozenset(chunk.headers["channel"].tolist())))
                if len(chunk.at):
                    counts += Counter(dict(enumerate(np.bincount(chunk.headers["channel"]).tolist())))
                    spans.append((int(chunk.headers["publish"].min()), int(chunk.headers["publish"].max())))
    except OSError as err:
        raise UsageError(f"{path}: cannot read the log: {err.strerror}") from err
    if not counts:
        why = "; ".join(contents.missing) or "it holds none"
        raise LogError(f"{path}: not one message is left in this log: {why}")
    topics = _topics(path, contents, counts)
    missing, dropped = [*contents.missing], contents.metadata.get("emb.end", {}).get("dropped_records", "0")
    if dropped != "0":
        missing.append(f"{dropped} records were dropped while recording")
    return RunLog(
        path=path,
        complete=not missing,
        missing=terminal.one_line("; ".join(missing)),
        metadata=contents.metadata,
        attachments=contents.attachments,
        size=size,
        span=(min(first for first, _ in spans), max(last for _, last in spans)),
        chunks=Chunks(path, places),
        topics=topics,
    )


def require_driven(log: RunLog) -> None:
    """Refuse the log of a run that only listened."""
    if log.run.get("purpose") == RunType.LISTEN_ONLY:
        raise UsageError(f"{log.path}: nothing was driven in this log, its run only listened (--read-only)")


def end_detail(end: Mapping[str, str]) -> str:
    """Detail of a run's end beside its reason: that of the loop, else its cause, and the stop reason of the node."""
    node = end.get("node_stop_reason", "NONE")
    stopped = "" if node in ("NONE", "NEVER_COMMANDED") else f"stop reason of the node: {node}"
    cause = FAULTS[Fault[end["exit_reason"]]].cause if end.get("exit_reason") in Fault.__members__ else ""
    return "; ".join(filter(None, (end.get("detail") or cause, stopped)))


def _topics(path: Path, contents: McapFile, counts: Mapping[int, int]) -> dict[str, _Topic]:
    """Find how to decode each channel; one that cannot be decoded is named as missing."""
    topics: dict[str, _Topic] = {}
    for number in sorted(contents.channels.keys() | counts.keys()):
        count = counts.get(number, 0)
        channel = contents.channels.get(number)
        schema = contents.schemas.get(channel.schema_id) if channel else None
        if channel is None or schema is None:
            contents.name_missing(f"{count} messages of a topic whose description is lost")
        elif channel.topic in topics:
            contents.name_missing(f"{count} messages of a second channel of {channel.topic}")
        elif (channel.message_encoding, schema.encoding) != ("protobuf", "protobuf"):
            contents.name_missing(f"{count} messages of {channel.topic}, which are not protobuf")
        else:
            try:
                units = channel.metadata.get("units", "{}")
                topics[channel.topic] = _Topic(number, count, message_class(schema.name, schema.data), units)
            except UNREADABLE as err:
                contents.name_missing(f"{count} messages of {channel.topic}, not readable ({message_of(err)})")
    if not topics:
        raise LogError(f"{path}: nothing in this log can be decoded: {'; '.join(contents.missing)}")
    return topics


@lru_cache(maxsize=64)
def _kinds(factory: Any) -> dict[str, str]:
    """Type of each field's column, in words."""
    words = {"float64": "a real number", "int64": "a whole number", "bool": "yes or no"}
    return {column.name: words.get(column.kind, column.kind) for column in describe(factory)}


def _times(publish: NDArray[np.uint64], log: NDArray[np.uint64]) -> dict[str, NDArray[Any]]:
    """The times of messages; raises OverflowError for one beyond int64."""
    if max(publish.max(initial=0), log.max(initial=0)) >= 1 << 63:
        raise OverflowError("a time beyond 63 bits")
    return {"publish_time": publish.astype(np.int64), "log_time": log.astype(np.int64)}


@lru_cache(maxsize=8)
def _bench(text: str) -> Bench:
    """Many logs have one bench."""
    return parse_bench(text, "bench.toml", analysis=True)


def _definitions(dbc: str) -> set[str]:
    """Lines of a DBC without its comments."""
    return {line for line in dbc.splitlines() if not line.startswith("CM_")}
