"""Logs of any length, record for record as the recorder writes them, only many records at a time."""

from __future__ import annotations

import base64
import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from emb_bench.brake.motion import no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.logs.log import read_log
from emb_bench.logs.mcap_file import MAGIC
from emb_bench.sim.open_loop import held, march, trajectory
from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, protect
from emb_runtime.can.messages import Layout, Message
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.log import mcap_schema
from emb_runtime.log.recorder_process import LogWriter
from emb_runtime.records import CycleRecord, NodeState, RunState

BEFORE = 60  # Samples before the experiment
CHUNK = 250  # Periods in a chunk: the recorder closes one every quarter of a second
TOGETHER = 10  # Chunks that are made together
START, WALL = 10**13, 1_700_000_000 * 10**9  # Monotonic time of the first sample, and what to add for Unix time [ns]

CRC = np.frombuffer(b"".join(protect(0, bytes([value]))[:1] for value in range(256)), np.uint8)
"""The CRC of each single byte."""

Octets = NDArray[np.uint8]
Columns = dict[str, NDArray[Any]]


class Ragged(NamedTuple):
    """Rows of bytes of different lengths: those of ``octets`` where ``used``."""

    octets: Octets
    used: NDArray[np.bool_]

    @property
    def length(self) -> NDArray[np.int64]:
        """Length of each row."""
        return np.asarray(self.used.sum(axis=1), np.int64)


def side_by_side(parts: list[Ragged]) -> Ragged:
    """Rows whose bytes follow each other."""
    return Ragged(np.concatenate([p.octets for p in parts], axis=1), np.concatenate([p.used for p in parts], axis=1))


def fixed(values: NDArray[Any]) -> Ragged:
    """Numbers, or records of numbers, as they are in memory."""
    octets = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
    return Ragged(octets, np.ones(octets.shape, np.bool_))


def varint(values: NDArray[Any]) -> Ragged:
    """Numbers as protobuf writes them."""
    if 0 <= values.min() <= values.max() < 0x80:
        return fixed(values.astype(np.uint8))
    words = values.astype(np.int64).view(np.uint64)[:, None] >> np.arange(0, 70, 7).clip(max=63).astype(np.uint64)
    words[:, 9] &= np.uint64(1)
    more = np.concatenate([words[:, 1:] != 0, np.zeros((len(words), 1), np.bool_)], axis=1)
    octets: Octets = np.bitwise_or(more.astype(np.uint64) << np.uint64(7), words & np.uint64(0x7F)).astype(np.uint8)
    return Ragged(octets, np.concatenate([np.ones((len(words), 1), np.bool_), more[:, :-1]], axis=1))


def constant(octets: bytes, rows: int) -> Ragged:
    """Returns the same bytes in each row."""
    return fixed(np.tile(np.frombuffer(octets, np.uint8), (rows, 1)))


def message(topic: mcap_schema.Topic, columns: Columns, channel: int, times: NDArray[np.int64], first: int) -> Ragged:
    """A topic's message records, one per row.

    Args:
        topic: name and fields.
        columns: the fields.
        channel: its number in the log.
        times: when each happened, Unix [ns].
        first: sequence number of the first one.
    """
    rows, parts = len(times), []
    for number, field in enumerate(topic.fields, 1):
        values = columns[field.name]
        wire = {"double": 1, "bytes": 2}.get(field.type, 0)
        tag = number << 3 | wire
        parts.append(constant(bytes([tag]) if tag < 0x80 else bytes([tag & 0x7F | 0x80, tag >> 7]), rows))
        if wire == 1:
            parts.append(fixed(values.astype("<f8")))
        elif wire == 2:
            parts += [constant(bytes([values.shape[1]]), rows), fixed(values)]
        else:
            parts.append(varint(values))
    body = side_by_side(parts)
    head = np.zeros(
        rows, np.dtype([("op", "u1"), ("n", "<u8"), ("c", "<u2"), ("s", "<u4"), ("l", "<u8"), ("p", "<u8")])
    )
    head["op"], head["n"], head["c"] = 5, body.length + 22, channel
    head["s"], head["l"], head["p"] = np.arange(first, first + rows), times, times
    return side_by_side([fixed(head), body])


def payload(m: Message, columns: Columns) -> Octets:
    """Frames of a message with their CRC, shape (n, length); ``columns`` becomes their values after rounding."""
    rows = len(columns["Counter"])
    word = np.zeros(rows, np.uint64)
    for signal in m.signals[1:]:
        raw = np.rint((columns[signal.name] - signal.offset) / signal.factor).astype(np.int64)
        assert (raw >= signal.raw_minimum).all(), (signal.name, raw.min())
        assert (raw <= signal.raw_maximum).all(), (signal.name, raw.max())
        columns[signal.name] = raw * signal.factor + signal.offset
        word |= (raw & signal.mask).astype(np.uint64) << np.uint64(signal.shift)
    octets = word.astype("<u8").view(np.uint8).reshape(rows, 8)[:, : m.length].copy()
    crc = np.full(rows, m.crc_start, np.uint8)
    for k in range(1, m.length):
        crc = CRC[crc ^ octets[:, k]]
    octets[:, 0] = columns["CRC"] = crc
    return octets


def excitation(k: NDArray[np.int64]) -> NDArray[np.float64]:
    """Current in each period [A]: the brake stays applied and moves all the time."""
    wave = np.where(k // 25 % 2 == 0, 0.7, -0.7) + 0.3 * np.sin(2.0 * np.pi * 0.0037 * k)
    result: NDArray[np.float64] = (1.3 + wave) * np.minimum(1.0, k / 400.0)
    return result


class Writer:
    """Writes a long log, chunk after chunk."""

    def __init__(self, path: Path, periods: int, bench: Bench, layout: Layout) -> None:
        self._bench, self._layout = bench, layout
        truth = {**{name: repr(value) for name, value in bench.brake._asdict().items()}, "plant": "exact"}
        text = base64.b64encode(shipped_bench_text().encode()).decode()
        head = io.BytesIO()
        LogWriter(
            head,
            {
                "start_ns": START - 10**6,
                "wall_offset_ns": WALL,
                "dbc": layout.text,
                "metadata": {"emb.run": {"steps": str(periods), "iface": "sim"}, "emb.truth": truth},
                "estimates": [],
                "attachments": [["bench.toml", "application/toml", text]],
            },
        )
        path.write_bytes(head.getvalue())
        self._channels = {name: topic.channel for name, topic in read_log(path).topics.items()}
        names = {
            m.name: mcap_schema.message_topic(m.name, m.identifier, self._fields(m)) for m in layout.messages.values()
        }
        self._topics = {topic.name: topic for topic in (*names.values(), *mcap_schema.FIXED_TOPICS)}
        self._periods, self._begun = periods, 0
        self._x, (self._chosen, self._s) = rest(), no_sensitivity(())
        self._rng = np.random.default_rng(1)
        with path.open("ab") as file:
            self._crc = zlib.crc32(head.getvalue())
            for chunk in self._chunks():
                self._put(file, chunk)
            self._end(file)

    @staticmethod
    def _fields(m: Message) -> list[mcap_schema.Field]:
        return [
            mcap_schema.Field(s.name, "int64" if isinstance(s.factor, int) else "double", s.unit) for s in m.signals
        ]

    def _chunks(self) -> Iterator[bytes]:
        last = 0.0
        for begin in range(-BEFORE, self._periods + 1, TOGETHER * CHUNK):
            k = np.arange(begin, min(begin + TOGETHER * CHUNK, self._periods + 1))
            step = self._layout.command.signal("Current").factor
            command = np.rint(np.where((k >= 0) & (k < self._periods), excitation(k), 0.0) / step) * step
            acted = np.concatenate([[last], command[:-1]])  # in the period that ends at each sample
            last = float(command[-1])
            plant, t_s = self._bench.plant("exact"), self._bench.timing.sample_time
            brake, loop = self._bench.brake, compiled(march)
            x, _ = trajectory(loop, plant.mechanics, brake, held(acted, t_s), self._chosen, self._x, self._s)
            self._x = x[-1]
            noise = self._rng.standard_normal((len(k), 2)) * [self._bench.noise.angle, self._bench.noise.velocity]
            octets, used = self._rows(k, x[1:, :2] + noise, acted, command)
            for row in range(0, len(k), CHUNK):
                yield octets[row : row + CHUNK][used[row : row + CHUNK]].tobytes()

    def _rows(
        self, k: NDArray[np.int64], seen: NDArray[Any], acted: NDArray[np.float64], command: NDArray[np.float64]
    ) -> Ragged:
        layout, counter, count = self._layout, (k + BEFORE) % COUNTER_MODULUS, len(k)
        device = (k + BEFORE) * self._bench.timing.sample_time_ns
        when = START + device
        asked, obeyed = (k >= 0) & (k < self._periods), k >= 1
        node = np.where(obeyed, NodeState.ACTIVE, NodeState.IDLE)
        named = np.where(obeyed, (counter - 1) % COUNTER_MODULUS, NO_COUNTER)
        wrapped = device % layout.device_time_period_ns * 1e-9
        angle: Columns = {"Counter": counter, "Angle": seen[:, 0], "DeviceTime": wrapped}
        velocity: Columns = {"Counter": counter, "NodeState": node, "Velocity": seen[:, 1]}
        velocity |= {"AppliedCurrent": acted, "CommandCounter": named}
        told: Columns = {"Counter": counter, "Answers": counter, "Current": command, "Enable": asked.astype(np.int64)}
        parts = []
        frames = (("/can/rx", layout.angle, angle, 10), ("/can/rx", layout.velocity, velocity, 20))
        for topic, m, columns, late in (*frames, ("/can/tx", layout.command, told, 60)):
            data, times = payload(m, columns), WALL + when + late
            zero = np.zeros(count, np.int64)
            frame: Columns = dict.fromkeys(("is_rtr", "is_extended", "is_error", "dropped"), zero)
            frame |= {"id": zero + m.identifier, "dlc": zero + m.length, "data": data}
            parts += [self._of(topic, frame, times), self._of(f"/emb/{m.name}", columns, times)]
        cycle: Columns = dict.fromkeys(CycleRecord._fields, np.zeros(count, np.int64))
        cycle |= {"step": np.where(k >= 0, k, -1), "state": np.where(k >= 0, RunState.ACTIVE, RunState.ARMED)}
        cycle |= {"counter": counter, "command_counter": np.where(asked, counter, NO_COUNTER), "node_state": node}
        cycle |= {"angle": angle["Angle"], "velocity": velocity["Velocity"], "applied_current": acted}
        cycle |= dict.fromkeys(("policy_current", "clipped_current", "sent_current"), command)
        cycle |= {"device_time_ns": device, "receive_time_ns": when + 20, "wake_time_ns": when + 30}
        cycle |= {"decide_time_ns": when + 50, "send_time_ns": when + 60 + self._rng.integers(0, 9000, count)}
        parts.append(self._of("/cycle", cycle, WALL + when + 20))
        self._begun += count
        return side_by_side(parts)

    def _of(self, topic: str, columns: Columns, times: NDArray[np.int64]) -> Ragged:
        return message(self._topics[topic], columns, self._channels[topic], times, self._begun)

    def _put(self, file: BinaryIO, data: bytes) -> None:
        packed = zstandard.compress(data)
        head = struct.pack("<QQQI", 0, 0, len(data), zlib.crc32(data)) + struct.pack("<I", 4) + b"zstd"
        self._record(file, 6, head + struct.pack("<Q", len(packed)) + packed)

    def _end(self, file: BinaryIO) -> None:
        name, text = b"emb.end", struct.pack("<I", 11) + b"exit_reason" + struct.pack("<I", 4) + b"DONE"
        self._record(file, 12, struct.pack("<I", len(name)) + name + struct.pack("<I", len(text)) + text)
        self._record(file, 15, struct.pack("<I", self._crc))
        self._record(file, 2, bytes(20))
        file.write(MAGIC)

    def _record(self, file: BinaryIO, opcode: int, body: bytes) -> None:
        data = struct.pack("<BQ", opcode, len(body)) + body
        self._crc = zlib.crc32(data, self._crc)
        file.write(data)
