from __future__ import annotations

import io
import json
import math
import os
import resource
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from msgspec import to_builtins

from emb_runtime.can.messages import load_layout
from emb_runtime.errors import BusError, LogError
from emb_runtime.log import recorder_process
from emb_runtime.log.recorder import Recorder
from emb_runtime.log.ring_buffer import Attachment, ClockRecord, EventRecord, FrameRecord, LogHeader, Ring, pack
from emb_runtime.records import CycleRecord, Frame, NodeState, Reason, RunState

from tests.bench.processes import wait_until_gone  # isort: skip

LAYOUT = load_layout()
WALL = 1_700_000_000_000_000_000
START = 5_000_000_000
HEADER = LogHeader(
    start_ns=START,
    wall_offset_ns=WALL,
    simulated=True,
    dbc=LAYOUT.text,
    messages=LAYOUT.all_messages,
    metadata={"emb.run": {"iface": "sim", "argv": "emb-run --iface sim"}, "emb.truth": {"f_v": "2e-5"}},
    attachments=(Attachment("policy.onnx", "application/octet-stream", bytes(range(256)) * 400),),
)


def cycle(step: int, time_ns: int, **changes: Any) -> CycleRecord:
    record = CycleRecord(
        step, RunState.ACTIVE, Reason.NONE, step % 15, step % 15, 0, NodeState.ACTIVE,
        0.25, -3.5, 0.0, 1.0, 1.0, 1.0, step * 1_000_000, *[time_ns] * 4,
    )  # fmt: skip
    return record._replace(**changes)


def decode(path: Path) -> dict[str, list[tuple[Any, Any]]]:
    """The messages by topic as (mcap message, protobuf message), with nothing but what the file says of itself."""
    topics: dict[str, list[tuple[Any, Any]]] = defaultdict(list)
    classes: dict[int, Any] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            if schema.id not in classes:
                pool = descriptor_pool.DescriptorPool()
                for proto in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(proto)
                classes[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            topics[channel.topic].append((message, classes[schema.id].FromString(message.data)))
    return topics


def summary(path: Path) -> tuple[Any, dict[str, dict[str, str]], dict[str, bytes]]:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
        return reader.get_summary(), metadata, {a.name: a.data for a in reader.iter_attachments()}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with a bit of everything."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    recorder = Recorder.start(path, HEADER)
    for k in range(20):
        now = START + k * 1_000_000
        recorder.push(FrameRecord(LAYOUT.encode_angle(k % 15, 0.5, k * 1_000_000)._replace(time_ns=now, dropped=2)))
        recorder.push(FrameRecord(LAYOUT.encode_velocity(k % 15, -3.5, 0.0, NodeState.IDLE, 15)._replace(time_ns=now)))
        command = LAYOUT.encode_command(k % 15, k % 15, 1.5, True)
        recorder.push(FrameRecord(command._replace(time_ns=now + 1000, own=True)))
        recorder.push(cycle(k, now + 2000))
    recorder.push(FrameRecord(Frame(0x100, b"\x00damage", START + 30_000_000)))
    recorder.push(FrameRecord(Frame(0x20, b"", START + 31_000_000, error=True)))
    recorder.push(cycle(20, START + 32_000_000, policy_current=math.nan, state=RunState.STOPPING))
    recorder.push(EventRecord(START + 33_000_000, "SENSOR_LATE", "5 periods ohne Δ"))
    recorder.push(ClockRecord(START + 35_000_000, WALL + START + 35_000_000 + 7))
    result = recorder.finish({"exit_reason": "done"})
    assert (result.complete, result.error, result.dropped, result.bytes) == (True, "", 0, path.stat().st_size)
    assert result.messages == sum(summary(path)[0].statistics.channel_message_counts.values())
    return path


def test_the_loss_of_the_drive_s_bus_costs_its_frames_and_not_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    waiting = [Frame(9, b"drive", START)]

    opened: list[str] = []

    class Bus:
        def __init__(self, iface: str, _clock: object) -> None:
            opened.append(iface)

        def receive(self, _deadline_ns: int) -> Frame | None:
            if not waiting:
                raise BusError("can0 is down")
            return waiting.pop()

    monkeypatch.setattr(recorder_process, "SocketCan", Bus)
    path, ring = tmp_path / "run.mcap", Ring.create(16)
    header = to_builtins(replace(HEADER, drive_bus="can0"), str_keys=True)
    recording = recorder_process.begin_recording(ring, {"path": str(path), "parent": 0, "header": header})
    commands = iter((None, None, {"exit_reason": "BUS_LOST"}))

    def listen(_wait: float) -> dict[str, str] | None:
        ring.push(*pack(EventRecord(START, "X", "")))
        return next(commands)

    monkeypatch.setattr(recording, "_listen", listen)
    answer = recording.run()
    assert opened == ["can0"]
    assert (answer["error"], answer["lost"]) == ("", 0)
    topics = decode(path)
    assert (len(topics["/drive/rx"]), len(topics["/safety"])) == (1, 3)
    assert summary(path)[1]["emb.end"] == {
        "exit_reason": "BUS_LOST", "dropped_records": "0", "drive_bus_error": "can0 is down", "undecoded_frames": "0",
    }  # fmt: skip


def overwritten(path: Path) -> None:
    with path.open("r+b") as file:
        file.seek(2000)
        file.write(b"somebody else")


def appended(path: Path) -> None:
    with path.open("ab") as file:
        file.write(bytes(1 << 20))


def replaced(path: Path) -> None:
    path.unlink()
    path.write_bytes(b"another file")


def turned_into_a_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def turned_into_a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


MEDDLING: dict[str, Callable[[Path], None]] = {
    "removed": Path.unlink,
    "replaced": replaced,
    "emptied": lambda path: os.truncate(path, 0),
    "cut": lambda path: os.truncate(path, path.stat().st_size - 100),
    "grown by far more than can be read": lambda path: os.truncate(path, 1 << 40),
    "overwritten": overwritten,
    "appended to": appended,
    "a pipe": turned_into_a_pipe,
    "a folder": turned_into_a_folder,
}


@pytest.mark.parametrize("what", MEDDLING)
def test_a_log_that_was_meddled_with_while_it_was_written_is_not_complete(what: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder.start(path, HEADER)
    recorder.push(cycle(0, START + 1000))
    MEDDLING[what](path)
    result = recorder.finish({"exit_reason": "done"})
    assert not result.complete
    assert result.error == "it was removed, replaced or changed while it was written: run again, and leave it alone"


def test_a_log_that_was_moved_to_another_disk_and_back_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder.start(path, HEADER)
    (tmp_path / "other.mcap").hardlink_to(path)
    path.unlink()
    (tmp_path / "other.mcap").rename(path)
    assert recorder.finish({"exit_reason": "done"}).complete


class ZstdError(Exception):
    """As zstandard raises, which is no OSError."""


@pytest.mark.parametrize("kind", [OSError, ZstdError, MemoryError, ValueError, UnicodeError, KeyError, RecursionError])
def test_whatever_writing_raises_the_run_is_told(kind: type[Exception], tmp_path: Path) -> None:
    def fail(*_: object, **__: object) -> None:
        raise kind("planted")

    header = to_builtins(HEADER, str_keys=True)
    for place in ("add_message", "flush", "finish", "add_metadata"):
        ring = Ring.create(16)
        recording = recorder_process.begin_recording(
            ring, {"path": str(tmp_path / f"{place}.mcap"), "parent": 0, "header": header}
        )
        ring.push(*pack(EventRecord(START, "X", "")))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Writer, place, fail)
            answer = recording.finish({"exit_reason": "done"})
        assert answer["error"] == f"writing failed: {kind.__name__}: {kind('planted')}", place


def test_what_the_first_chunk_raises_is_told_before_the_run_and_no_file_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZstdError("planted")

    monkeypatch.setattr(recorder_process.LogWriter, "flush", fail)
    header = to_builtins(HEADER, str_keys=True)
    with pytest.raises(LogError, match="ZstdError: planted; the file was begun, and is removed"):
        recorder_process.begin_recording(
            Ring.create(16), {"path": str(tmp_path / "run.mcap"), "parent": 0, "header": header}
        )
    assert list(tmp_path.iterdir()) == []


def test_a_text_that_is_no_unicode_is_written_with_escape_sequences(tmp_path: Path) -> None:
    name, half = os.fsdecode(b"r\xfcn"), "a\ud800"
    recorder = Recorder.start(tmp_path / f"{name}.mcap", replace(HEADER, metadata={"emb.run": {"operator": half}}))
    recorder.push(EventRecord(START, "X", half))
    result = recorder.finish({"exit_reason": half})
    assert (result.complete, result.error) == (True, "")
    _, metadata, _ = summary(result.path)
    assert (metadata["emb.run"]["operator"], metadata["emb.end"]["exit_reason"]) == ("a\\ud800", "a\\ud800")
    assert decode(result.path)["/safety"][0][1].text == "a\\ud800"


def test_a_plain_reader_finds_every_record_with_the_descriptors_in_the_file(log: Path) -> None:
    topics = decode(log)
    counts = {name: len(messages) for name, messages in topics.items()}
    assert counts == {
        "/clock": 2, "/can/rx": 42, "/can/tx": 20, "/cycle": 21, "/safety": 1,
        "/emb/EMB_Angle": 20, "/emb/EMB_Velocity": 20, "/emb/EMB_Command": 20,
    }  # fmt: skip
    frame = topics["/can/rx"][0][1]
    assert (frame.id, frame.dlc, frame.dropped, frame.is_extended, frame.is_rtr) == (256, 8, 2, False, False)
    assert frame.data == LAYOUT.encode_angle(0, 0.5, 0).data
    assert topics["/can/rx"][-1][1].is_error
    angle, velocity, command = (topics[f"/emb/EMB_{name}"][7][1] for name in ("Angle", "Velocity", "Command"))
    assert (angle.Counter, angle.Angle, angle.DeviceTime) == (7, pytest.approx(0.5), pytest.approx(0.007))
    assert (velocity.Velocity, velocity.CommandCounter) == (pytest.approx(-3.5), 15)
    assert (command.Answers, command.Current, command.Enable) == (7, pytest.approx(1.5), 1)
    event, clock = topics["/safety"][0][1], topics["/clock"][1][1]
    assert (event.code, event.text) == ("SENSOR_LATE", "5 periods ohne Δ")
    assert clock.wall_ns - clock.monotonic_ns == WALL + 7


def test_every_field_of_a_cycle_record_is_in_the_file(log: Path) -> None:
    messages = [message for _, message in decode(log)["/cycle"]]
    for k, message in enumerate(messages[:-1]):
        expected = cycle(k, START + k * 1_000_000 + 2000)
        assert [getattr(message, name) for name in CycleRecord._fields] == [float(v) for v in expected]
    assert math.isnan(messages[-1].policy_current)


def test_zeros_are_on_the_wire_and_states_are_enums(log: Path) -> None:
    message = decode(log)["/cycle"][0][1]
    assert message.HasField("step")
    assert message.HasField("applied_current")
    names = {f.name: {v.name: v.number for v in f.enum_type.values} for f in message.DESCRIPTOR.fields if f.enum_type}
    assert names["state"] == {state.name: state.value for state in RunState}
    assert names["node_state"] == {state.name: state.value for state in NodeState}
    velocity = decode(log)["/emb/EMB_Velocity"][0][1].DESCRIPTOR
    states = velocity.fields_by_name["NodeState"].enum_type
    assert {v.name: v.number for v in states.values} == {state.name: state.value for state in NodeState}
    assert velocity.fields_by_name["CommandCounter"].enum_type is None


def test_units_travel_in_the_channel_metadata(log: Path) -> None:
    channels = {c.topic: c.metadata for c in summary(log)[0].channels.values()}
    assert json.loads(channels["/cycle"]["units"])["sent_current"] == "A"
    assert json.loads(channels["/emb/EMB_Velocity"]["units"]) == {"Velocity": "rad/s", "AppliedCurrent": "A"}
    assert channels["/can/rx"]["dropped"] == "frames that the kernel has dropped on this socket so far"
    assert channels["/clock"]["description"].startswith("Both clocks read at once: ")


def test_metadata_and_attachments_make_the_file_replay_alone(log: Path) -> None:
    _, metadata, attachments = summary(log)
    assert metadata["emb.run"]["argv"] == "emb-run --iface sim"
    assert metadata["emb.truth"] == {"f_v": "2e-5"}
    assert metadata["emb.end"] == {"exit_reason": "done", "dropped_records": "0", "undecoded_frames": "2"}
    assert attachments == {"emb.dbc": LAYOUT.text.encode(), "policy.onnx": bytes(range(256)) * 400}


def test_published_is_when_it_happened_and_logged_follows_simulated_time(log: Path) -> None:
    topics = decode(log)
    published = [m.publish_time for m, _ in topics["/can/tx"]]
    assert published == [WALL + START + k * 1_000_000 + 1000 for k in range(20)]
    with log.open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)
    assert times[-1] == WALL + START + 35_000_000


def test_in_real_time_logged_is_when_it_was_written_on_the_same_epoch(tmp_path: Path) -> None:
    offset = time.time_ns() - time.monotonic_ns()
    start = time.monotonic_ns()
    recorder = Recorder.start(tmp_path / "a.mcap", LogHeader(start, offset, False, LAYOUT.text, {}))
    for _ in range(10):
        recorder.push(EventRecord(time.monotonic_ns(), "X", ""))
        time.sleep(0.002)
    recorder.finish({})
    end = time.monotonic_ns()
    for message, _ in decode(tmp_path / "a.mcap")["/safety"]:
        assert start + offset < message.publish_time <= message.log_time < end + offset


def test_the_topic_of_a_drive_s_bus_is_described_in_the_first_chunk_too() -> None:
    output, found = io.BytesIO(), list[str]()
    recorder_process.LogWriter(output, replace(HEADER, drive_bus="can0"))
    output.seek(0)
    with pytest.raises(EndOfFile):
        found.extend(record.topic for record in StreamReader(output).records if isinstance(record, Channel))
    assert "/drive/rx" in found
    assert "/estimate" not in found


def test_the_first_chunk_is_on_disk_before_the_run_begins_and_what_is_recorded_follows(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder.start(path, HEADER)
    with path.open("rb") as file:
        records: list[str] = []
        with pytest.raises(EndOfFile):
            records.extend(type(record).__name__ for record in StreamReader(file).records)
    assert {"Metadata", "Attachment", "Schema", "Channel", "Message"} <= set(records)
    before = path.stat().st_size
    recorder.push(EventRecord(START, "X", ""))
    deadline = time.monotonic() + 20
    while path.stat().st_size == before:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    recorder.finish({})


def test_a_ring_that_overflows_is_counted_and_told(tmp_path: Path) -> None:
    recorder = Recorder.start(tmp_path / "run.mcap", HEADER, slots=8)
    os.kill(recorder.pid, signal.SIGSTOP)
    for _ in range(11):
        recorder.push(EventRecord(START, "X", ""))
    os.kill(recorder.pid, signal.SIGCONT)
    result = recorder.finish({})
    assert (result.dropped, result.complete) == (3, False)
    assert result.error == "3 records did not fit into the ring"
    assert len(decode(result.path)["/safety"]) == 8
    assert summary(result.path)[1]["emb.end"]["dropped_records"] == "3"


@pytest.mark.parametrize(
    ("name", "reason"),
    [("nowhere/run.mcap", "No such file or directory"), (".", "exists"), ("taken.mcap", "never overwritten")],
)
def test_a_path_that_cannot_be_written_is_refused_before_the_run(tmp_path: Path, name: str, reason: str) -> None:
    (tmp_path / "taken.mcap").write_bytes(b"precious")
    with pytest.raises(LogError, match=reason) as caught:
        Recorder.start(tmp_path / name, HEADER)
    assert "\n" not in str(caught.value)
    assert (tmp_path / "taken.mcap").read_bytes() == b"precious"


def test_a_recorder_that_does_not_start_does_not_hang_the_runtime(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sleeper = tmp_path / "python"
    sleeper.write_text("#!/bin/sh\nexec sleep 60\n")
    sleeper.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(sleeper))
    with pytest.raises(LogError, match=r"did not answer within 0\.2 s"):
        Recorder.start(tmp_path / "run.mcap", HEADER, timeout=0.2)


class Waiting:
    """Recorder process that tells how long it was waited for."""

    waited = 0.0

    def tell(self, trailer: object) -> None: ...

    def read_answer(self, timeout: float) -> dict[str, Any]:
        self.waited = timeout
        return {}

    def join(self) -> None: ...


def test_a_day_of_listening_is_waited_for_while_it_is_read_back(tmp_path: Path) -> None:
    path, process = tmp_path / "run.mcap", Waiting()
    path.touch()
    os.truncate(path, 25_000_000_000)
    Recorder(path, Ring.create(8), cast(Any, process)).finish({})
    assert process.waited >= 25_000_000_000 / 100e6  # of a slow disk


def test_a_recorder_that_cannot_be_started_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "absent"))
    with pytest.raises(LogError, match="No such file"):
        Recorder.start(tmp_path / "run.mcap", HEADER)


def test_a_disk_that_is_full_before_the_run_is_told_and_no_piece_of_a_file_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    limited = tmp_path / "python"
    limited.write_text(f'#!/bin/sh\nulimit -f 8\nexec {sys.executable} "$@"\n')
    limited.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(limited))
    large = Attachment("policy.onnx", "", os.urandom(1 << 20))
    header = LogHeader(START, WALL, True, load_layout().text, {}, attachments=(large,))
    with pytest.raises(LogError, match="cannot record: File too large; the file was begun, and is removed"):
        Recorder.start(tmp_path / "run.mcap", header)
    assert not (tmp_path / "run.mcap").exists()
    assert capfd.readouterr().err == ""


def test_a_full_disk_does_not_disturb_the_run_and_is_told_at_its_end(tmp_path: Path) -> None:
    recorder = Recorder.start(tmp_path / "run.mcap", HEADER, slots=1 << 14)
    size = recorder.path.stat().st_size
    resource.prlimit(recorder.pid, resource.RLIMIT_FSIZE, (size + 1000, size + 1000))
    for k in range(3000):
        recorder.push(EventRecord(START + k, "X", f"{k}: {os.urandom(40).hex()}"))
    result = recorder.finish({"exit_reason": "done"})
    assert not result.complete
    assert result.error.startswith("writing failed: ")
    assert result.dropped > 0


def test_a_recorder_that_is_killed_does_not_disturb_the_run_and_is_told_at_its_end(tmp_path: Path) -> None:
    recorder = Recorder.start(tmp_path / "run.mcap", HEADER, slots=8)
    os.kill(recorder.pid, signal.SIGKILL)
    for _ in range(10):
        recorder.push(EventRecord(START, "X", ""))
    result = recorder.finish({"exit_reason": "done"})
    assert (result.complete, result.messages) == (False, 0)
    assert result.error == "the recorder process died (signal 9)"
    assert result.dropped >= 2


RUNTIME = """
import os, sys, time
from emb_runtime.can.messages import load_layout
from emb_runtime.log.recorder import Recorder
from emb_runtime.log.ring_buffer import EventRecord, LogHeader
recorder = Recorder.start(sys.argv[1], LogHeader(0, 0, True, load_layout().text, {"emb.run": {"iface": "x"}}))
if "fork" in sys.argv and os.fork() == 0:
    time.sleep(60)  # a sibling that holds every inherited pipe open
for k in range(500):
    recorder.push(EventRecord(k, "X", str(k)))
print(recorder.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.parametrize("mode", ["plain", "fork"])
def test_the_file_is_finished_when_the_runtime_is_killed(tmp_path: Path, mode: str) -> None:
    path = tmp_path / "run.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", RUNTIME, str(path), mode], stdout=subprocess.PIPE, start_new_session=True
    ) as runtime:
        assert runtime.stdout is not None
        pid = int(runtime.stdout.readline())
        os.kill(runtime.pid, signal.SIGKILL)
        runtime.wait()
        wait_until_gone(pid)
        if mode == "fork":
            os.killpg(runtime.pid, signal.SIGKILL)
    assert [m.text for _, m in decode(path)["/safety"]] == [str(k) for k in range(500)]
    assert summary(path)[1]["emb.end"]["exit_reason"] == "the runtime process died"


def test_the_recorder_leaves_signals_to_the_runtime(tmp_path: Path) -> None:
    recorder = Recorder.start(tmp_path / "run.mcap", HEADER)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(recorder.pid, number)
    recorder.push(EventRecord(START, "X", ""))
    result = recorder.finish({"exit_reason": "stopped by the operator"})
    assert result.complete
    assert len(decode(result.path)["/safety"]) == 1
