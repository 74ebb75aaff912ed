"""Logs made damaged, foreign or contradictory, and what the commands make of one."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorSet
from mcap.reader import NonSeekingReader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.information.evaluation import Evaluation, Question, evaluate
from emb_bench.logs.info import info_document
from emb_bench.logs.log import RunLog, read_log
from emb_bench.logs.mcap_file import MAGIC, message_class
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import EmbError, LogError

Change = Callable[[str, DescriptorProto], None]
"""Changes the message of a topic."""
CHUNK, ATTACHMENT, METADATA, DATA_END, FOOTER = 6, 9, 12, 15, 2


@dataclass(frozen=True)
class Read:
    """What one file gave."""

    log: RunLog
    experiment: Experiment
    evaluation: Evaluation
    info: dict[str, Any]

    @property
    def said(self) -> bool:
        """Whether it was said that something is missing."""
        return bool(not self.log.complete or self.log.missing or self.experiment.quality.lacks)

    @property
    def numbers(self) -> list[Any]:
        """Everything that is computed."""
        e = self.evaluation
        info = {k: v for k, v in self.info.items() if k in ("cycles", "largest", "sensor_to_command")}
        return [e.histories["physical"].tolist(), e.histories["weighted"].tolist(), e.fit, e.experiment.x0(), info]


def read_or_refuse(path: Path) -> RunLog | None:
    """The two ways in which reading may end: a log, whose parts are read or refused, or None."""
    try:
        log = read_log(path)
    except LogError:
        return None
    for part in ("frames", "cycles", "events", "truth"):
        with contextlib.suppress(LogError):
            getattr(log, part)
    assert log.complete == (not log.missing)
    return log


def read(path: Path) -> Read | None:
    """All that the commands compute of a log; None if it is refused in one line."""
    try:
        log = read_log(path)
        experiment = read_experiment(log)
        bench = log.bench
        plant, question = bench.plant("exact"), Question(PARAMETER_NAMES)
        (evaluation,) = evaluate(log, experiment, bench, [plant], question, "nominal", bench.brake)
        return Read(log, experiment, evaluation, info_document(log))
    except EmbError as err:
        refused = str(err)
    assert refused
    assert "\n" not in refused
    return None


def judge(path: Path, whole: Read) -> Read | None:
    """No wrong number without a warning, and none with one that is not what it says."""
    found = read(path)
    if found is None:
        return None
    if not found.said:
        assert found.numbers == whole.numbers
    count, measured = found.experiment.periods, found.experiment.measured
    assert count <= whole.experiment.periods
    np.testing.assert_array_equal(found.experiment.samples[measured], whole.experiment.samples[:count][measured])
    np.testing.assert_array_equal(found.experiment.currents[measured], whole.experiment.currents[:count][measured])
    return found


def records(data: bytes) -> list[tuple[int, int, int]]:
    """Opcode, begin and end of each record of a file."""
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((opcode, at, at + 9 + length))
        at += 9 + length
    return found


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(
    data: bytes,
    *,
    size: int | None = None,
    crc: int | None = None,
    packed: bytes | None = None,
    compression: bytes = b"zstd",
) -> bytes:
    """The body of a chunk; it may claim another size or checksum than it has, or hold other bytes."""
    packed = zstandard.compress(data) if packed is None else packed
    claimed = len(data) if size is None else size, zlib.crc32(data) if crc is None else crc
    name = struct.pack("<I", len(compression)) + compression
    return struct.pack("<QQQI", 0, 2**63, *claimed) + name + struct.pack("<Q", len(packed)) + packed


def spliced(path: Path, extra: bytes, opcode: int = CHUNK) -> None:
    """Put records into a file before the first one of a kind; the checksum over all data is removed."""
    data = path.read_bytes()
    at = next(begin for kind, begin, _ in records(data) if kind == opcode)
    end = next(begin for kind, begin, _ in records(data) if kind == DATA_END)
    path.write_bytes(data[:at] + extra + data[at:end] + record(DATA_END, bytes(4)) + record(FOOTER, bytes(20)) + MAGIC)


def rewritten(
    path: Path,
    change: Change = lambda _topic, _message: None,
    *,
    values: Callable[[str, int, dict[str, Any]], dict[str, Any]] = lambda _topic, _n, row: row,
    stamps: Callable[[str, int, int], int] = lambda _topic, _n, time_ns: time_ns,
    runs: int = 1,
    chunk_size: int = 1 << 20,
    library: str = "emb-excite/0.1.0",
    among_equals: Callable[[str], float] = lambda _topic: 0.0,
    **options: Any,
) -> None:
    """Write a log anew with the plain MCAP library: other fields, values or times, or the whole of it again.

    Messages of equal ``log_time`` are put in the order ``among_equals`` of their topics, and ``options`` are the
    library's.
    """
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        rows = sorted(reader.iter_messages(), key=lambda row: (row[2].log_time, among_equals(row[1].topic)))
    with path.open("rb") as file:
        metadata = list(NonSeekingReader(file).iter_metadata())
    with path.open("rb") as file:
        attachments = list(NonSeekingReader(file).iter_attachments())
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=chunk_size, enable_data_crcs=True, **options)
        writer.start(profile="", library=library)
        for entry in metadata:
            writer.add_metadata(entry.name, entry.metadata)
        for a in attachments:
            writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        channels: dict[str, int] = {}
        counts: dict[str, int] = {}
        for described, channel, message in rows * runs:
            assert described is not None
            name, payload = channel.topic, message.data
            files = FileDescriptorSet.FromString(described.data)
            change(name, next(m for m in files.file[0].message_type if described.name == f"emb.{m.name}"))
            data = files.SerializeToString()
            if name not in channels:
                number = writer.register_schema(described.name, SchemaEncoding.Protobuf, data)
                channels[name] = writer.register_channel(name, MessageEncoding.Protobuf, number)
            n = counts[name] = counts.get(name, -1) + 1
            old = message_class(described.name, described.data).FromString(payload)
            row = values(name, n, {f.name: getattr(old, f.name) for f in old.DESCRIPTOR.fields})
            new = message_class(described.name, data)
            payload = new(**{k: v for k, v in row.items() if k in new.DESCRIPTOR.fields_by_name}).SerializeToString()
            publish = stamps(name, n, message.publish_time)
            writer.add_message(channels[name], message.log_time, payload, publish, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]


def without(topic: str, *names: str) -> Change:
    def change(name: str, message: DescriptorProto) -> None:
        if name == topic:
            _set_fields(message, [field for field in message.field if field.name not in names])

    return change


def with_field(topic: str, name: str, kind: str) -> Change:
    """A field more, or one of another kind."""

    def change(of: str, message: DescriptorProto) -> None:
        if of == topic:
            number = next((field.number for field in message.field if field.name == name), 99)
            field = FieldDescriptorProto(name=name, number=number, label=FieldDescriptorProto.LABEL_OPTIONAL)
            field.type = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
            _set_fields(message, [*(field for field in message.field if field.name != name), field])

    return change


def _set_fields(message: DescriptorProto, fields: Sequence[FieldDescriptorProto]) -> None:
    """Replace the fields, without presence: each has a oneof for it."""
    kept = DescriptorProto(name=message.name, field=fields)
    for field in kept.field:
        field.ClearField("proto3_optional")
        field.ClearField("oneof_index")
    message.CopyFrom(kept)
