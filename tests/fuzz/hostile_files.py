"""Hostile files, made from honest ones: policies, contracts, bench files and logs; and what a command makes of one.

Each is drawn from a seed. Some are damaged blindly; most keep their outer form, checksums included, so that the damage
reaches what lies inside.
"""

from __future__ import annotations

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
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
import zstandard
from mcap.opcode import Opcode
from onnx import helper

from emb_bench.logs.mcap_file import MAGIC
from emb_runtime.config.bench import load_bench, shipped_bench_text
from emb_runtime.policy.contract import CONTRACT_KEY
from emb_runtime.policy.onnx_file import FIXED
from tests.actors import constant_actor
from tests.bench.damaged import chunk, record, records

LONGEST = 5.0  # Time that a command may take with a file that it refuses, or that has little in it [s]
MOST_MEMORY = 512 << 20  # Memory of its largest process [bytes]
TRACEBACK = re.compile(r"Traceback|Error\(|error in the program|\x1b")
BENCH = load_bench()
ACTORS = constant_actor, partial(constant_actor, current=300.0, kind="speed")  # One of each kind

JUNK: tuple[Any, ...] = (
    *(
        None,
        True,
        "",
        "x\ny",
        "\u202e",
        "\x1b]52;c;AAAA\x07",
        "a" * 100_000,
        -1,
        0,
        0.5,
        10**400,
        1e308,
        -1e308,
        5e-324,
    ),
    *([], [[]], {}, {"a": {}}, [0] * 10_000, 2**63, 2**64, "9" * 5000, "NaN"),
)
NUMBERS = (0, 1, 2, 3, 127, 128, 255, 256, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)


class Hostile(NamedTuple):
    """A file and the command that is given it."""

    kind: str
    ending: str
    content: bytes
    command: tuple[str, ...]  # Program and arguments; FILE is the file, OUT a name beside it


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
        if found := TRACEBACK.search(self.said):
            return f"said {found.group()!r}"
        if self.cpu > LONGEST:
            return f"took {self.cpu:.1f} s of processor time"
        if self.memory > MOST_MEMORY:
            return f"took {self.memory >> 20} MiB"
        return ""


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


def blind(dice: random.Random, data: bytes) -> bytes:
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


# Bench files ------------------------------------------------------------------------------------------------------


def bench_file(dice: random.Random) -> Hostile:
    """A bench file."""
    lines = shipped_bench_text().split("\n")
    for _ in range(dice.choice((1, 1, 2, 5))):
        at = dice.randrange(len(lines))
        key, equal, value = lines[at].partition("=")
        size = dice.choice((3, 1000, 20_000, 70_000))
        values = ["nan", "inf", "1e308", "-1", "[]", "{}", '""', "[[1]]", "0x" + "f" * size, "1" * size, "[" * size]
        values += [
            '"' + "x" * size + '"',
            '"\\u202e\\u001b"',
            "1979-05-27",
            "true",
            "[1e-30, 1e30]",
            "0.0001",
            "5e-324",
        ]
        values += ["{a=" * (size // 3), '"""' + "\\\n" * (size // 2) + '"""', "1_" * size + "1"]
        changed = [
            f"{key}{equal} {dice.choice(values)}",
            "[" + "a." * size + "a]",
            "a." * size + "a = 1",
            "",
            "#" * size,
        ]
        changed += [
            lines[at] + "\n" + lines[at],
            f"['{'k' * size}']\nx = 1",
            "[[plants.x]]",
            value,
            "\ufeff",
            "\x00",
            "\x1b[2J",
        ]
        lines[at] = dice.choice((changed[0], dice.choice(changed)))
    text = "\n".join(lines).encode()
    if dice.randrange(6) == 0:
        text = blind(dice, text)
    return Hostile("bench file", ".toml", text, (*RUN, "--bench", "FILE"))


# Policies ---------------------------------------------------------------------------------------------------------


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
                tensor.raw_data = blind(dice, tensor.raw_data or b"\0" * 8)
            case 7:
                port = dice.choice((*graph.input, *graph.output))
                port.type.tensor_type.shape.dim.add().dim_value = dice.choice((0, 1, 2**62))
    return bytes(model.SerializeToString())


def policy(dice: random.Random) -> Hostile:
    """A policy."""
    data = blind(dice, constant_actor(BENCH)) if dice.randrange(5) == 0 else policy_bytes(dice)
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
        text = blind(dice, text.encode()).decode("utf-8", "replace")
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


# Logs -------------------------------------------------------------------------------------------------------------


def records_of(log: bytes) -> list[tuple[int, bytes]]:
    """Opcode and body of each record of a whole log."""
    return [(opcode, log[begin + 9 : end]) for opcode, begin, end in records(log)]


def file_of(parts: Sequence[tuple[int, bytes]]) -> bytes:
    """A log of such records; the checksum over its data is left out."""
    return MAGIC + b"".join(record(opcode, body) for opcode, body in parts) + MAGIC


def content_of(body: bytes) -> bytes:
    """What is in a chunk."""
    return zstandard.ZstdDecompressor().decompress(body[44:], max_output_size=1 << 26)


def bomb(dice: random.Random) -> bytes:
    """What a chunk may unpack to that is small when packed, and much work."""
    size = dice.choice((1 << 12, 1 << 16, 1 << 20, 1 << 23, 1 << 26))
    message = struct.pack("<BQHIQQ", 5, 22, dice.choice((1, 5, 9)), 0, 1, 1)
    pattern = dice.choice(
        (
            b"\0",
            b"\x05",
            b"\x05\x05\x05\x05" + b"\0" * 8,
            b"\x80" + b"\0" * 8,
            b"\x03" + b"\0" * 8,
            message,
            b"\xff" * 9,
        )
    )
    return (pattern * (size // len(pattern) + 1))[: size // len(pattern) * len(pattern)]


def log_bytes(dice: random.Random, honest: bytes) -> bytes:
    """A log that was changed."""
    parts = records_of(honest)
    which = dice.randrange(10)
    if which == 0:
        return blind(dice, honest)
    for _ in range(dice.choice((1, 1, 2, 3))):
        at = dice.choice([k for k, (opcode, _) in enumerate(parts) if opcode == Opcode.CHUNK])
        _, body = parts[dice.randrange(1, len(parts))]
        match which:
            case 1 | 2:  # the content of a chunk, with its checksum
                parts[at] = (Opcode.CHUNK, chunk(blind(dice, content_of(parts[at][1]))))
            case 3:
                parts[at] = (Opcode.CHUNK, chunk(content_of(parts[at][1]), size=dice.choice(NUMBERS)))
            case 4 | 5:
                parts[at:at] = [(Opcode.CHUNK, chunk(bomb(dice)))] * dice.choice((1, 5, 50))
            case 6:
                kinds = (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.SCHEMA, Opcode.CHANNEL)
                parts.insert(at, (dice.choice(kinds), blind(dice, body)))
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
                filler = dice.choice(
                    (b"\x70" + b"\0" * 8, b"\x09" + b"\0" * 8, _LURE, b"\x0c" + struct.pack("<Q", 8) + b"\0" * 8)
                )
                where = dice.choice((20, 300_000))
                return honest[:where] + filler * (dice.choice((1000, 300_000)) // len(filler)) + honest[where:]
    return file_of(parts)


_LURE = b"\x06" + struct.pack("<QQQQI", 300_000, 0, 0, 300_000, 7) + b"\x04\0\0\0zstd" + struct.pack("<Q", 299_000)
"""What looks like the begin of a chunk."""


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


def _inside(dice: random.Random) -> bytes:
    """What an attachment may hold."""
    dbc = (Path(__file__).parents[2] / "runtime/emb_runtime/can/emb.dbc").read_bytes()
    return dice.choice(
        (
            lambda: blind(dice, dbc),
            lambda: bench_file(dice).content,
            lambda: policy_bytes(dice),
            lambda: b"BO_ 1 x: 8 y\n" * 4000,
        )
    )()


def log(dice: random.Random, honest: bytes) -> Hostile:
    """A log."""
    return Hostile("log", ".mcap", log_bytes(dice, honest), dice.choice(LOG_COMMANDS))


def draw(seed: int, honest_log: bytes) -> Hostile:
    """A hostile file of some kind."""
    dice = random.Random(seed)
    kinds: tuple[Callable[[random.Random], Hostile], ...] = (
        bench_file,
        policy,
        contract,
        lambda drawn: log(drawn, honest_log),
    )
    return dice.choices(kinds, (3, 4, 3, 10))[0](dice)


# Commands ---------------------------------------------------------------------------------------------------------


def judge(hostile: Hostile, folder: Path, longest: float = 60.0) -> Judged:
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
        pid = os.fork()
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
            import traceback

            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


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
