"""Broken files: what is corrupted and how, what a reader may make of it, and the bounds that every command keeps.

Bench files, policies, contracts and logs, each drawn from a seed. Some are damaged blindly (:func:`corrupt`); most keep
their outer form, checksums included, so that the damage reaches what lies inside. :func:`damages` is the table of what
may happen to a log, with the ways in which reading it may end.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from os import _exit
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import zstandard
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorSet
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer
from onnx import helper

from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.information.evaluation import Evaluation, Question, evaluate
from emb_bench.logs.info import info_document
from emb_bench.logs.log import RunLog, read_log
from emb_bench.logs.mcap_file import MAGIC, message_class
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench, shipped_bench_text
from emb_runtime.errors import EmbError, LogError
from emb_runtime.policy.contract import CONTRACT_KEY
from emb_runtime.policy.onnx_file import FIXED
from emb_runtime.records import CycleRecord
from tests.actors import constant_actor

BENCH = load_bench()
ACTORS = constant_actor, partial(constant_actor, current=300.0, kind="speed")  # One of each kind


# Bounds -----------------------------------------------------------------------------------------------------------

LONGEST = 5.0  # Time that a command may take with a file that it refuses, or that has little in it [s]
MOST_MEMORY = 512 << 20  # Memory of its largest process [bytes]
MOST_GROWTH = 128 << 20  # By which reading a damaged log may increase the memory of this process [bytes]
FORBIDDEN = re.compile(r"Traceback|Error\(|error in the program|\x1b")  # In what a command says

COMPLETE, IN_PART, REFUSED = "complete, right", "in part, said so", "refused"
OUTCOMES = COMPLETE, IN_PART, REFUSED
NOT_SILENT = IN_PART, REFUSED  # No number without a warning

RUN = ("emb-run", "--yes", "--log", "OUT.mcap", "--duration", "0.02")
LOG_COMMANDS = (
    ("emb-replay", "info", "FILE"),
    ("emb-replay", "fim", "FILE"),
    ("emb-replay", "timing", "FILE"),
    ("emb-replay", "estimate", "FILE", "--params", "f_v"),
    ("emb-replay", "export", "FILE", "-o", "OUT.csv"),
    ("emb-replay", "rerun", "FILE"),
)


# Bytes ------------------------------------------------------------------------------------------------------------


def corrupt(dice: random.Random, data: bytes) -> bytes:
    """Some bytes changed, removed, doubled or put elsewhere; or the end cut off."""
    made = bytearray(data)
    for _ in range(dice.choice((1, 1, 2, 5, 50))):
        at, length = dice.randrange(len(made) + 1), dice.choice((1, 2, 4, 8, 100, 5000))
        piece = bytes(made[at : at + length])
        match dice.randrange(6):
            case 0:
                made[at : at + length] = dice.randbytes(len(piece))
            case 1:
                del made[at : at + length]
            case 2:
                made[at:at] = piece * dice.choice((1, 2, 20))
            case 3:
                made[at : at + 8] = struct.pack("<Q", dice.choice(NUMBERS))
            case 4:
                to = dice.randrange(len(made) + 1)
                made[to:to] = piece
            case 5 if dice.randrange(4) == 0:
                del made[at:]
    return bytes(made)


def flipped(dice: random.Random, data: bytes) -> bytes:
    """One to four bytes changed."""
    made = bytearray(data)
    for _ in range(dice.randint(1, 4)):
        made[dice.randrange(len(data))] ^= dice.randint(1, 255)
    return bytes(made)


# Records of a log -------------------------------------------------------------------------------------------------


def records(data: bytes) -> list[tuple[int, int, int]]:
    """Opcode, begin and end of each record of a file."""
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((opcode, at, at + 9 + length))
        at += 9 + length
    return found


def records_of(log: bytes) -> list[tuple[int, bytes]]:
    """Opcode and body of each record of a whole log."""
    return [(opcode, log[begin + 9 : end]) for opcode, begin, end in records(log)]


def file_of(parts: Sequence[tuple[int, bytes]]) -> bytes:
    """A log of such records; the checksum over its data is left out."""
    return MAGIC + b"".join(record(opcode, body) for opcode, body in parts) + MAGIC


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def chunk(data: bytes, *, size: int | None = None, packed: bytes | None = None, compression: bytes = b"zstd") -> bytes:
    """The body of a chunk; it may claim another size than it has, or hold other bytes."""
    packed = zstandard.compress(data) if packed is None else packed
    claimed = len(data) if size is None else size, zlib.crc32(data)
    name = struct.pack("<I", len(compression)) + compression
    return struct.pack("<QQQI", 0, 2**63, *claimed) + name + struct.pack("<Q", len(packed)) + packed


def content_of(body: bytes) -> bytes:
    """What is in a chunk."""
    return zstandard.ZstdDecompressor().decompress(body[44:], max_output_size=1 << 26)


def counted(text: str) -> bytes:
    """A text with its length in front."""
    data = text.encode("utf-8", "replace")
    return struct.pack("<I", len(data)) + data


def metadata(name: str, entries: dict[str, str]) -> bytes:
    """The body of a metadata record."""
    pairs = b"".join(counted(key) + counted(value) for key, value in entries.items())
    return counted(name) + struct.pack("<I", len(pairs)) + pairs


def attachment(name: str, data: bytes) -> bytes:
    """The body of an attachment's record."""
    body = struct.pack("<QQ", 0, 0) + counted(name) + counted("") + struct.pack("<Q", len(data)) + data
    return body + struct.pack("<I", zlib.crc32(body))


END = record(Opcode.DATA_END, bytes(4)) + record(Opcode.FOOTER, bytes(20)) + MAGIC
"""Of a file without a checksum over its data."""


def begin_of(data: bytes, opcode: int) -> int:
    """Place of the first record of a kind."""
    return next(begin for kind, begin, _ in records(data) if kind == opcode)


def spliced(data: bytes, extra: bytes) -> bytes:
    """A log with records before its first chunk."""
    at, end = begin_of(data, Opcode.CHUNK), begin_of(data, Opcode.DATA_END)
    return data[:at] + extra + data[at:end] + END


# Logs written anew ------------------------------------------------------------------------------------------------

Change = Callable[[str, DescriptorProto], None]
"""Changes the message of a topic."""


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


# Hostile files ----------------------------------------------------------------------------------------------------


class Hostile(NamedTuple):
    """A file and the command that is given it."""

    kind: str
    ending: str
    content: bytes
    command: tuple[str, ...]  # Program and arguments; FILE is the file, OUT a name beside it


JUNK: tuple[Any, ...] = (
    *(None, True, "", "x\ny", "\u202e", "\x1b]52;c;AAAA\x07", "a" * 100_000),
    *(-1, 0, 0.5, 10**400, 1e308, -1e308, 5e-324),
    *([], [[]], {}, {"a": {}}, [0] * 10_000, 2**63, 2**64, "9" * 5000, "NaN"),
)
NUMBERS = (0, 1, 2, 3, 127, 128, 255, 256, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)


def bench_file(dice: random.Random) -> Hostile:
    """A bench file."""
    lines = shipped_bench_text().split("\n")
    for _ in range(dice.choice((1, 1, 2, 5))):
        at = dice.randrange(len(lines))
        key, equal, value = lines[at].partition("=")
        size = dice.choice((3, 1000, 20_000, 70_000))
        values = ["nan", "inf", "1e308", "-1", "[]", "{}", '""', "[[1]]", "0x" + "f" * size, "1" * size, "[" * size]
        values += ['"' + "x" * size + '"', '"\\u202e\\u001b"', "1979-05-27", "true"]
        values += ["[1e-30, 1e30]", "0.0001", "5e-324"]
        values += ["{a=" * (size // 3), '"""' + "\\\n" * (size // 2) + '"""', "1_" * size + "1"]
        changed = [f"{key}{equal} {dice.choice(values)}", "[" + "a." * size + "a]", "a." * size + "a = 1", ""]
        changed += ["#" * size, lines[at] + "\n" + lines[at], f"['{'k' * size}']\nx = 1", "[[plants.x]]"]
        changed += [value, "\ufeff", "\x00", "\x1b[2J"]
        lines[at] = dice.choice((changed[0], dice.choice(changed)))
    text = "\n".join(lines).encode()
    if dice.randrange(6) == 0:
        text = corrupt(dice, text)
    return Hostile("bench file", ".toml", text, (*RUN, "--bench", "FILE"))


def policy_bytes(dice: random.Random) -> bytes:
    """A policy whose graph was changed."""
    model = onnx.load_from_string(dice.choice(ACTORS)(BENCH))
    graph = model.graph
    for _ in range(dice.choice((1, 1, 2, 4))):
        match dice.randrange(8):
            case 0:
                tensor = dice.choice(graph.initializer)
                tensor.dims[:] = [dice.choice((0, 1, 3, 1000, 2**31, 2**62, -1)) for _ in range(dice.randrange(4))]
            case 1:
                dice.choice(graph.node).op_type = dice.choice(
                    (*FIXED, "Loop", "If", "RandomNormal", "x" * 10_000, "\x1b")
                )
            case 2:
                node = dice.choice(graph.node)
                names = [name for each in graph.node for name in (*each.input, *each.output)] + ["", "nobody"]
                node.input[:] = [dice.choice(names) for _ in range(dice.choice((0, 1, 2, 3, 2000)))]
            case 3:
                name = dice.choice(("axis", "axes", "perm", "to", "keepdims", "equation", "k", "allowzero"))
                value = dice.choice((-1, 0, 1, 7, 2**40, [0, 1], [2**62], [-5] * 100, "ij,jk->ik", "a" * 500, 0.5))
                dice.choice(graph.node).attribute.append(helper.make_attribute(name, value))
            case 4:
                size = [dice.choice((1, 3, 1000, 10**6, 2**40)) for _ in range(dice.choice((1, 2, 3)))]
                graph.initializer.append(onnx.numpy_helper.from_array(np.array(size), "drawn"))
                operator = dice.choice(("Expand", "Tile", "Pad", "Reshape", "ConstantOfShape"))
                inputs = ["drawn"] if operator == "ConstantOfShape" else ["inputs", "drawn"]
                graph.node.insert(0, helper.make_node(operator, inputs, ["made"]))
                graph.node.append(
                    helper.make_node(dice.choice(("MatMul", "Exp", "Softmax")), ["made", "made"][:1], ["out"])
                )
            case 5:
                count = dice.choice((10, 300, 3000))
                graph.node.extend(
                    helper.make_node("Mul", [f"c{n}" if n else "inputs"] * 2, [f"c{n + 1}"]) for n in range(count)
                )
            case 6:
                tensor = dice.choice(graph.initializer)
                tensor.raw_data = corrupt(dice, tensor.raw_data or b"\0" * 8)
            case 7:
                port = dice.choice((*graph.input, *graph.output))
                port.type.tensor_type.shape.dim.add().dim_value = dice.choice((0, 1, 2**62))
    return bytes(model.SerializeToString())


def policy(dice: random.Random) -> Hostile:
    """A policy."""
    data = corrupt(dice, constant_actor(BENCH)) if dice.randrange(5) == 0 else policy_bytes(dice)
    return Hostile("policy", ".onnx", data, (*RUN, "--policy", "FILE"))


def contract(dice: random.Random) -> Hostile:
    """A policy whose contract was changed."""
    model = onnx.load_from_string(dice.choice(ACTORS)(BENCH))
    (entry,) = model.metadata_props
    text = entry.value
    if dice.randrange(4):
        record = json.loads(text)
        for _ in range(dice.choice((1, 1, 3))):
            _spoil(dice, record)
        text = json.dumps(record)
    else:
        text = corrupt(dice, text.encode()).decode("utf-8", "replace")
    helper.set_model_props(model, {CONTRACT_KEY: text})
    return Hostile("contract", ".onnx", model.SerializeToString(), (*RUN, "--policy", "FILE"))


def _spoil(dice: random.Random, record: Any) -> None:
    """Put junk in some place of a document."""
    while True:
        keys = list(record) if isinstance(record, dict) else list(range(len(record)))
        if not keys:
            return
        key = dice.choice(keys)
        if isinstance(record[key], dict | list) and record[key] and dice.randrange(4):
            record = record[key]
            continue
        record[key] = dice.choice(JUNK)
        return


def bomb(dice: random.Random) -> bytes:
    """What a chunk may unpack to that is small when packed, and much work."""
    size = dice.choice((1 << 12, 1 << 16, 1 << 20, 1 << 23, 1 << 26))
    message = struct.pack("<BQHIQQ", 5, 22, dice.choice((1, 5, 9)), 0, 1, 1)
    patterns = [b"\0", b"\x05", b"\x05\x05\x05\x05" + b"\0" * 8, b"\x80" + b"\0" * 8, b"\x03" + b"\0" * 8]
    pattern = dice.choice([*patterns, message, b"\xff" * 9])
    return (pattern * (size // len(pattern) + 1))[: size // len(pattern) * len(pattern)]


def log_bytes(dice: random.Random, honest: bytes) -> bytes:
    """A log that was changed."""
    parts = records_of(honest)
    which = dice.randrange(10)
    if which == 0:
        return corrupt(dice, honest)
    for _ in range(dice.choice((1, 1, 2, 3))):
        at = dice.choice([k for k, (opcode, _) in enumerate(parts) if opcode == Opcode.CHUNK])
        _, body = parts[dice.randrange(1, len(parts))]
        match which:
            case 1 | 2:  # the content of a chunk, with its checksum
                parts[at] = (Opcode.CHUNK, chunk(corrupt(dice, content_of(parts[at][1]))))
            case 3:
                parts[at] = (Opcode.CHUNK, chunk(content_of(parts[at][1]), size=dice.choice(NUMBERS)))
            case 4 | 5:
                parts[at:at] = [(Opcode.CHUNK, chunk(bomb(dice)))] * dice.choice((1, 5, 50))
            case 6:
                kinds = (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.SCHEMA, Opcode.CHANNEL)
                parts.insert(at, (dice.choice(kinds), corrupt(dice, body)))
            case 7:
                name = dice.choice(("emb.run", "emb.end", "emb.truth", "\x1b[31m", "x" * 10_000))
                key = dice.choice(("steps", "purpose", "iface", "bench_name", "f_v", "missing", "tool", "\u202e"))
                parts.insert(
                    -1 if dice.randrange(2) else at, (Opcode.METADATA, metadata(name, {key: str(dice.choice(JUNK))}))
                )
            case 8:
                whole = attachment(dice.choice(("bench.toml", "emb.dbc", "policy.onnx")), _inside(dice))
                parts = [r for r in parts if not (r[0] == Opcode.ATTACHMENT and r[1][16:40] == whole[16:40])]
                parts.insert(1, (Opcode.ATTACHMENT, whole))
            case 9:
                eight = b"\0" * 8
                filler = dice.choice((b"\x70" + eight, b"\x09" + eight, _LURE, b"\x0c" + struct.pack("<Q", 8) + eight))
                where = dice.choice((20, 300_000))
                return honest[:where] + filler * (dice.choice((1000, 300_000)) // len(filler)) + honest[where:]
    return file_of(parts)


_LURE = b"\x06" + struct.pack("<QQQQI", 300_000, 0, 0, 300_000, 7) + b"\x04\0\0\0zstd" + struct.pack("<Q", 299_000)
"""What looks like the begin of a chunk."""


def _inside(dice: random.Random) -> bytes:
    """What an attachment may hold."""
    dbc = (Path(__file__).parents[1] / "runtime/emb_runtime/can/emb.dbc").read_bytes()
    many = b"BO_ 1 x: 8 y\n" * 4000
    kinds = lambda: corrupt(dice, dbc), lambda: bench_file(dice).content, lambda: policy_bytes(dice), lambda: many
    return dice.choice(kinds)()


def log(dice: random.Random, honest: bytes) -> Hostile:
    """A log."""
    return Hostile("log", ".mcap", log_bytes(dice, honest), dice.choice(LOG_COMMANDS))


def draw(seed: int, honest_log: bytes) -> Hostile:
    """A hostile file of some kind."""
    dice = random.Random(seed)
    kinds: tuple[Callable[[random.Random], Hostile], ...]
    kinds = bench_file, policy, contract, partial(log, honest=honest_log)
    return dice.choices(kinds, (3, 4, 3, 10))[0](dice)


# Damaged logs -----------------------------------------------------------------------------------------------------


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


def read(path: Path) -> Read | str:
    """All that the commands compute of a log, or the one line with which it is refused."""
    try:
        log = read_log(path)
        assert log.complete == (not log.missing)
        for part in ("frames", "cycles", "events", "truth"):
            with contextlib.suppress(LogError):
                getattr(log, part)
        experiment = read_experiment(log)
        bench = log.bench
        plant, question = bench.plant("exact"), Question(PARAMETER_NAMES)
        (evaluation,) = evaluate(log, experiment, bench, [plant], question, "nominal", bench.brake)
        return Read(log, experiment, evaluation, info_document(log))
    except EmbError as err:
        refused = str(err)
    assert refused
    assert "\n" not in refused
    return refused


def judge(path: Path, whole: Read) -> tuple[str, Read | str]:
    """How reading ends: no wrong number without a warning, and none with one that is not what it says."""
    found = read(path)
    if isinstance(found, str):
        return REFUSED, found
    if not found.said:
        assert found.numbers == whole.numbers
    count, measured = found.experiment.periods, found.experiment.measured
    assert count <= whole.experiment.periods
    np.testing.assert_array_equal(found.experiment.samples[measured], whole.experiment.samples[:count][measured])
    np.testing.assert_array_equal(found.experiment.currents[measured], whole.experiment.currents[:count][measured])
    return IN_PART if found.said else COMPLETE, found


def outcome(damage: Damage, change: Callable[[Path], object], path: Path, data: bytes, whole: Read) -> str:
    """How reading a log with one change ends, as the damage's row allows; raises AssertionError if otherwise."""
    path.write_bytes(data)
    change(path)
    ends, found = judge(path, whole)
    with path.open("rb") as file:
        as_it_was = file.read(len(data)) == data  # Bytes behind its end are no part of it
    assert ends in damage.allowed or as_it_was, (damage.what, change, ends, found)
    said = found.log.missing if isinstance(found, Read) else found
    assert damage.words in said, (damage.what, change, said)
    if damage.equal:
        assert isinstance(found, Read)
        assert found.numbers == whole.numbers, (damage.what, change)
    return ends


class Damage(NamedTuple):
    """One kind of damage to a log, done in many places."""

    what: str
    changes: Sequence[Callable[[Path], object]]  # Each done to the file, which is whole before
    allowed: tuple[str, ...] = NOT_SILENT
    equal: bool = False  # What is read has the numbers of the whole log
    words: str = ""  # In what is said to be missing, or why the log is refused


def put(content: bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(content)


def damages(data: bytes, dice: random.Random) -> Iterator[Damage]:
    """Everything that may happen to a whole log."""
    first, *_, (_, begin, end) = (r for r in records(data) if r[0] == Opcode.CHUNK)
    topics = ("/cycle", "/can/rx", "/can/tx", "/clock", "/safety")
    fields = [*(("/cycle", name) for name in CycleRecord._fields), ("/can/rx", "id"), ("/can/rx", "data")]
    cut = "the file is cut at byte"
    yield Damage("cut in the last chunk", [put(data[:at]) for at in range(begin, end)], words=cut)
    cuts = [*range(1, begin, 499), *range(end, len(data), 211)]
    yield Damage("cut elsewhere", [put(data[:at]) for at in cuts])
    yield Damage("one to four flipped bytes", [put(flipped(dice, data)) for _ in range(300)])
    yield Damage("bytes gone, doubled or put elsewhere", [put(corrupt(dice, data)) for _ in range(100)])
    yield Damage("a length or a field of a record lies", list(map(put, _lies(data))))
    for what, bombs, words in _bombs():
        yield Damage(what, [put(spliced(data, bomb)) for bomb in bombs], (IN_PART,), True, words)
    huge = [partial(_hole, data=data)]
    yield Damage("a huge record that is really there", huge, (IN_PART,), True, "more than any of ours")
    malformed = [put(spliced(data, each)) for each in MALFORMED]
    yield Damage("a malformed record", malformed, (IN_PART,), True, "left out")
    missing = [partial(rewritten, change=without(*field)) for field in fields]
    yield Damage("wrong schema: a field is missing", missing, (REFUSED,), words="have other fields: expected ")
    retyped = [_retyped(*field, "string") for field in fields]
    retyped += [_retyped(*field, kind) for field in SOME_FIELDS for kind in KINDS]
    yield Damage("wrong schema: a field of another kind", retyped, (COMPLETE, REFUSED))
    stamped = [_stamped(topic, stamp) for topic in topics for stamp in STAMPS]
    yield Damage("times that no run has", stamped, OUTCOMES)
    yield Damage("empty", [put(b"")], (REFUSED,), words="the file is empty")
    yield Damage("of another format", [put(b"x"), put(bytes(1000))], (REFUSED,), words="not an MCAP file")
    yield Damage("without a record", [put(MAGIC), put(MAGIC * 2)], (REFUSED,), words=cut)
    yield Damage("without a message", [put(data[: first[1]] + END)], (REFUSED,), words="it holds none")
    counted_on = partial(rewritten, values=lambda _topic, n, row: {**row, "novelty": n + 1})
    later = [partial(counted_on, change=with_field(topic, "novelty", "int64")) for topic in topics]
    new = put(spliced(data, record(0x90, b"anything")))
    yield Damage("of a later version: more fields, other records", [*later, new], (COMPLETE,), True)
    yield Damage("two logs one after the other", [put(data * 2)], (IN_PART,), True, "the end of the file is not that")
    yield Damage("of another program", [partial(rewritten, library="other")], (COMPLETE,), True)
    yield Damage("two runs in one", [partial(rewritten, runs=2)], (REFUSED,), words="this is not one run")


def _lies(data: bytes) -> Iterator[bytes]:
    """Lengths of the last record of three kinds, and fields of the last chunk."""
    places = {kind: begin for kind, begin, _ in records(data)}
    lies = [
        (places[kind] + 1, struct.pack("<Q", length))
        for kind in (Opcode.ATTACHMENT, Opcode.METADATA, Opcode.CHUNK)
        for length in (2**63, 2**64 - 1, 2**40, 2**31, 0, 3)
    ]
    lies += [(places[Opcode.CHUNK] + 9 + offset, b"\xf0\xff\xff\xff") for offset in range(0, 60, 4)]
    return (data[:at] + lie + data[at + len(lie) :] for at, lie in lies)


def _bombs() -> Iterator[tuple[str, list[bytes], str]]:
    """Chunks that are small when packed: what they claim to be, themselves, and what is said of them."""
    piece, packer = bytes(1 << 20), zstandard.ZstdCompressor().compressobj()
    untold = b"".join(packer.compress(piece) for _ in range(2048)) + packer.flush()
    honest = zstandard.ZstdCompressor().compressobj(size=256 << 20)
    told = b"".join(honest.compress(piece) for _ in range(256)) + honest.flush()
    for what, claims, words in (
        ("that claims too much", [(untold, 2 << 30), (untold, 2**63), (told, 256 << 20)], "it claims to unpack from"),
        ("that claims too little", [(untold, 1000)], "the chunk at byte"),
        ("with another size than its frame", [(told, 1000)], "its frame claims to unpack to"),
    ):
        bombs = [record(Opcode.CHUNK, chunk(b"", size=size, packed=packed)) for packed, size in claims]
        yield f"a chunk of gigabytes {what}", bombs, words


def _hole(path: Path, data: bytes) -> None:
    """An attachment of 400 MiB that takes no space on the disk."""
    at = begin_of(data, Opcode.CHUNK)
    with path.open("wb") as file:
        file.write(data[:at] + struct.pack("<BQ", Opcode.ATTACHMENT, 400 << 20))
        file.seek(400 << 20, 1)
        file.write(data[at:])


MALFORMED = (
    record(Opcode.CHUNK, chunk(b"", compression=b"lz4")),
    record(Opcode.CHUNK, chunk(b"\x05" + struct.pack("<Q", 10) + bytes(10))),
    record(Opcode.CHUNK, chunk(b"\x05" + struct.pack("<Q", 2**63) + bytes(30))),
    record(Opcode.CHUNK, chunk(b"\x40" + struct.pack("<Q", 0) + b"\x40\x00")),
    record(Opcode.CHUNK, chunk(b"\x04" + struct.pack("<Q", 2) + b"\x00\x01")),
    record(Opcode.MESSAGE, bytes(40)),
    record(0x40, b"x"),
    record(Opcode.METADATA, b"\xff\xff\xff\xff"),
    record(Opcode.ATTACHMENT, bytes(30) + struct.pack("<I", zlib.crc32(bytes(30)))),  # whole, under another name
    record(Opcode.ATTACHMENT, b"\xff" * 40 + struct.pack("<I", zlib.crc32(b"\xff" * 40))),
    record(Opcode.ATTACHMENT, b"\xff" * 3),
)
SOME_FIELDS = ("/cycle", "step"), ("/cycle", "angle"), ("/can/rx", "id"), ("/can/rx", "is_rtr"), ("/can/tx", "data")
KINDS: dict[str, Callable[[Any], Any]] = {
    "string": lambda v: v.hex() if isinstance(v, bytes) else str(v),
    "bytes": lambda v: v if isinstance(v, bytes) else str(v).encode(),
    "double": lambda v: float(len(v) if isinstance(v, bytes) else v),
    "bool": bool,
    "int64": lambda v: int(len(v) if isinstance(v, bytes) else v),
}
"""Kinds of a field, and a value as that kind."""
STAMPS: tuple[Callable[[int], int], ...] = (
    lambda t: 0,
    lambda t: 2**64 - 1,
    lambda t: 2**63 - 1,
    lambda t: t - 10**9 * (t // 10**6 % 3),
    lambda t: t // 10**7 * 10**7,
    lambda t: t + 2**61,
)


def _retyped(topic: str, name: str, kind: str) -> Callable[[Path], object]:
    def values(where: str, _n: int, row: dict[str, Any]) -> dict[str, Any]:
        return {**row, name: KINDS[kind](row[name])} if where == topic else row

    return partial(rewritten, change=with_field(topic, name, kind), values=values)


def _stamped(topic: str, stamp: Callable[[int], int]) -> Callable[[Path], object]:
    return partial(rewritten, stamps=lambda where, _n, time_ns: stamp(time_ns) if where == topic else time_ns)


# Commands ---------------------------------------------------------------------------------------------------------


class Judged(NamedTuple):
    """Outcome of a command."""

    code: int
    cpu: float  # Processor time of all its processes [s]
    memory: int  # Of its largest process [bytes]
    said: str

    @property
    def fault(self) -> str:
        """Reason why this must not be; empty if all is well."""
        if self.code < 0:
            return f"ended by signal {-self.code}"
        if found := FORBIDDEN.search(self.said):
            return f"said {found.group()!r}"
        if self.cpu > LONGEST:
            return f"took {self.cpu:.1f} s of processor time"
        if self.memory > MOST_MEMORY:
            return f"took {self.memory >> 20} MiB"
        return ""


def command(hostile: Hostile, folder: Path, longest: float = 60.0) -> Judged:
    """Run the command on the file, in a process forked from this one with its imports, for ``longest`` seconds."""
    from emb_bench.cli.replay import main as replay
    from emb_runtime.cli.main import main as run

    path = folder / f"hostile{hostile.ending}"
    path.write_bytes(hostile.content)
    for made in folder.glob("out*"):
        shutil.rmtree(made) if made.is_dir() else made.unlink()
    arguments = [a.replace("FILE", str(path)).replace("OUT", str(folder / "out")) for a in hostile.command[1:]]
    program: Callable[[list[str]], int] = {"emb-run": run, "emb-replay": replay}[hostile.command[0]]
    with tempfile.TemporaryFile() as said:
        pid = os.fork()  # a Process of multiprocessing that another call has waited for would keep its descriptors
        if pid == 0:
            _become(program, arguments, said.fileno())
        code, usage = _wait(pid, longest)
        said.seek(0)
        text = said.read(1 << 20).decode("utf-8", "replace")
    return Judged(code, usage.ru_utime + usage.ru_stime, usage.ru_maxrss << 10, text)


def _become(program: Callable[[list[str]], int], arguments: list[str], output: int) -> None:
    code = 111
    try:
        for descriptor in (1, 2):
            os.dup2(output, descriptor)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        try:
            code = program(arguments)
        except SystemExit as err:
            code = int(err.code or 0)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        _exit(code)


def _wait(pid: int, longest: float) -> tuple[int, resource.struct_rusage]:
    ended = time.monotonic() + longest
    while True:
        found, status, usage = os.wait4(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), usage
        if time.monotonic() > ended:
            os.kill(pid, signal.SIGKILL)
            _, status, usage = os.wait4(pid, 0)
            return os.waitstatus_to_exitcode(status), usage
        time.sleep(0.002)
