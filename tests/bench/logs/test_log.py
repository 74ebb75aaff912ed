"""A log gives back what the run pushed, column by column, and says what it lacks."""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs.can_files import McapReader
from emb_bench.logs.log import end_detail, read_log
from emb_bench.logs.mcap_file import message_class, message_columns
from emb_runtime.can.messages import load_layout
from emb_runtime.errors import LogError, UsageError
from emb_runtime.log.recorder import Recorder
from emb_runtime.log.ring_buffer import Attachment, EventRecord, LogHeader
from emb_runtime.records import CycleRecord
from tests.bench.conftest import STEPS
from tests.bench.simulated_logs import WALL, write_log
from tests.conftest import SimRun
from tests.corrupt import rewritten


def test_a_finished_log_gives_back_what_the_run_pushed(path: Path, run: SimRun) -> None:
    log = read_log(path)
    assert (log.complete, log.missing) == (True, "")
    assert log.frames == tuple(sorted(run.journal.frames, key=lambda frame: frame.time_ns))
    columns = [log.cycles[name].tolist() for name in CycleRecord._fields]
    for got, expected in zip(zip(*columns, strict=True), run.journal.cycles, strict=True):
        np.testing.assert_array_equal(got, expected)
    assert [(e.time_ns - WALL, e.code, e.text) for e in log.events] == run.journal.events
    assert log.wall_offset_ns == WALL
    assert log.exit_reason == "DONE"
    assert log.run["iface"] == "sim"
    assert log.counts["/cycle"] == len(run.journal.cycles)


def test_a_log_replays_alone(path: Path, run: SimRun) -> None:
    log = read_log(path)
    assert log.truth is not None
    assert log.truth._asdict() | {"seed": 7, "plant": "exact"} == run.transport.truth
    assert log.true_plant == "exact"
    assert log.bench.brake == log.truth._replace(f_v=log.bench.brake.f_v)
    assert log.layout.text == load_layout().text
    assert read_log(write_log(path, run, metadata={})).truth is None
    commented = load_layout().text.replace('CM_ "Electro', 'CM_ "An electro')
    assert commented != load_layout().text
    assert read_log(write_log(path, run, dbc=commented)).layout is load_layout()


@pytest.mark.parametrize(
    ("metadata", "driven"),
    [
        ({"emb.run": {"iface": "can0"}}, ""),
        ({"emb.run": {}}, ""),
        ({}, ""),
        ({"emb.run": {"iface": "can0"}, "emb.truth": {"f_v": "2e-5"}}, "a simulated brake"),
        ({"emb.run": {"iface": "sim:f_v=3e-5"}}, "a simulated brake"),
        ({"emb.run": {"iface": "map:odrive.toml@sim-odrive"}, "emb.truth": {}}, "a simulated brake"),
        ({"emb.run": {"iface": "vcan0"}}, "a node on a virtual bus (vcan0)"),
        ({"emb.run": {"iface": "vxcan1"}}, "a node on a virtual bus (vxcan1)"),
        ({"emb.run": {"iface": "vcan0"}, "emb.drive": {"bus": "can0"}}, ""),  # the bus between gateway and host
        ({"emb.run": {"iface": "can1"}, "emb.drive": {"bus": "vcan1"}}, "a node on a virtual bus (vcan1)"),
        ({"emb.run": {"iface": "vcan0"}, "emb.drive": {"bus": ""}}, "a node on a virtual bus (vcan0)"),
        ({"emb.run": {"iface": "vcan\u202e\x1b" + 99 * "0"}}, f"(vcan\\u202e\\x1b{34 * '0'} … (105 characters))"),
    ],
)
def test_a_log_says_whether_a_real_machine_was_driven_as_far_as_it_knows(
    path: Path, metadata: dict[str, dict[str, str]], driven: str
) -> None:
    log = replace(read_log(path), metadata=metadata)
    assert log.simulated.endswith(driven)
    assert bool(log.simulated) == bool(driven)


def test_decoded_signals_are_those_of_the_frames(path: Path, run: SimRun) -> None:
    layout = load_layout()
    sent = [layout.decode_command(frame) for frame in run.journal.frames if frame.own]
    commands = read_log(path).signals("EMB_Command")
    assert commands["Current"].tolist() == [command.current for command in sent]
    assert commands["Answers"].tolist() == [command.answers for command in sent]
    with pytest.raises(LogError, match="EMB_Nothing"):
        read_log(path).signals("EMB_Nothing")


def test_a_finished_log_without_its_first_chunk_is_read_with_the_descriptions_at_its_end(path: Path) -> None:
    data = path.read_bytes()
    at = data.index(b"zstd") + 40  # inside the first chunk, which describes the topics
    path.write_bytes(data[:at] + b"\x00\x00\x00" + data[at + 3 :])
    log = read_log(path)
    assert not log.complete
    assert len(log.cycles["step"]) == STEPS + 1


def test_a_cut_log_without_its_first_chunk_is_refused(path: Path) -> None:
    data = path.read_bytes()
    at = data.index(b"zstd") + 40
    path.write_bytes(data[:at] + b"\x00\x00\x00" + data[at + 3 : len(data) // 2])
    with pytest.raises(LogError, match="not one message is left"):
        read_log(path)


READERS: tuple[Callable[[Path], object], ...] = (read_log, McapReader)


@pytest.mark.parametrize("read", READERS)
def test_what_is_no_log_or_cannot_be_opened_is_refused_in_one_line(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    path = tmp_path / "x.mcap"
    for content, reason in (
        (b"", "empty"),
        (b"hello", "not an MCAP"),
        (b"\x89MCAP0\r\n", "not one message"),
        (b"\x7fELF" * 99, "not an MCAP"),
    ):
        path.write_bytes(content)
        with pytest.raises(LogError, match=reason) as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert caught.value.exit_code == 6
        assert list(tmp_path.iterdir()) == [path]
    for name, reason in (("absent.mcap", "No such file"), (".", "directory")):
        with pytest.raises(UsageError, match=reason):
            read(tmp_path / name)


@pytest.mark.parametrize("read", READERS)
def test_a_log_of_another_program_is_refused(tmp_path: Path, read: Callable[[Path], object]) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="somebody")
        schema = writer.register_schema("std_msgs/String", "ros2msg", b"string data")
        writer.add_message(writer.register_channel("/chatter", "cdr", schema), 1, b"\x00", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(LogError, match="an MCAP file, but not a log of emb-run"):
        read(path)
    assert list(tmp_path.iterdir()) == [path]


def test_a_log_that_another_program_has_copied_is_read_as_ours(path: Path) -> None:
    whole = read_log(path)
    angles = whole.cycles["angle"].tolist()
    rewritten(path, library="mcap go/v1.7.0")
    found = read_log(path)
    assert found.complete
    assert found.exit_reason == whole.exit_reason == "DONE"
    assert found.counts == {topic: count for topic, count in whole.counts.items() if count}
    assert found.cycles["angle"].tolist() == angles
    with McapReader(path) as frames:
        assert len([*frames]) == whole.counts["/can/rx"] + whole.counts["/can/tx"]


@pytest.mark.parametrize("seed", range(4))
def test_messages_of_equal_log_time_may_come_in_any_order(path: Path, seed: int) -> None:
    """MCAP leaves their order open: by channel, against it, at random."""
    own = read_experiment(read_log(path))
    rng = random.Random(seed)
    orders: tuple[Callable[[str], float], ...] = (
        lambda topic: topic == "/cycle",
        lambda topic: topic != "/cycle",
        lambda topic: topic != "/can/rx",
        lambda _topic: rng.random(),
    )
    rewritten(path, among_equals=orders[seed])
    found = read_experiment(read_log(path))
    np.testing.assert_array_equal(found.currents, own.currents)
    np.testing.assert_array_equal(found.samples, own.samples)
    assert (found.angle, found.slack, found.quality.lacks) == (own.angle, own.slack, own.quality.lacks)


@pytest.mark.parametrize(
    ("options", "form"),
    [
        ({"compression": CompressionType.LZ4}, "chunks compressed with lz4 are left out: mcap compress"),
        (
            {"use_chunking": False},
            "messages outside of chunks, where they have no checksum, are left out: mcap compress",
        ),
    ],
)
def test_a_form_of_mcap_that_is_not_read_is_named_once_and_is_no_damage(
    path: Path, options: dict[str, Any], form: str
) -> None:
    rewritten(path, **options)
    with pytest.raises(LogError) as refused:
        read_log(path)
    assert str(refused.value).count(form) == 1
    assert "damaged" not in str(refused.value)


def test_dropped_records_make_a_log_incomplete(tmp_path: Path) -> None:
    recorder = Recorder.start(tmp_path / "run.mcap", LogHeader(0, 0, True, load_layout().text, {}), slots=4)
    os.kill(recorder.pid, signal.SIGSTOP)
    for k in range(9):
        recorder.push(EventRecord(k, "X", ""))
    os.kill(recorder.pid, signal.SIGCONT)
    recorder.finish({"exit_reason": "DONE"})
    log = read_log(tmp_path / "run.mcap")
    assert (log.complete, log.missing) == (False, "5 records were dropped while recording")
    assert len(log.events) == 4


def test_what_a_log_should_carry_and_does_not_is_said(tmp_path: Path, run: SimRun) -> None:
    nan = dict.fromkeys(["J", "gamma", "k_m", "k_1", "T_c", "f_v"], "nan")
    rows: tuple[tuple[dict[str, Any], str, str], ...] = (
        ({"attachments": []}, "bench", "carries no bench.toml"),
        ({"attachments": [Attachment("bench.toml", "", b"xx")]}, "bench", "not valid TOML"),
        ({"attachments": [Attachment("bench.toml", "", b"\xff")]}, "bench", "not UTF-8"),
        ({"metadata": {"emb.truth": {"f_v": "1"}}}, "truth", "true parameters"),
        ({"dbc": load_layout().text.replace("[-6|6]", "[-5|5]")}, "layout", "its DBC is not that of this version"),
        ({"metadata": {"emb.truth": nan}}, "truth", "not positive"),
    )
    for changes, part, reason in rows:
        log = read_log(write_log(tmp_path / "x.mcap", run, **changes))
        with pytest.raises(LogError, match=reason):
            getattr(log, part)


@pytest.mark.parametrize(
    ("end", "told"),
    [
        ({"exit_reason": "INTERRUPTED", "detail": ""}, "stopped by the operator"),
        (
            {"exit_reason": "NODE_STOPPED", "detail": "x", "node_stop_reason": "LIMIT"},
            "x; stop reason of the node: LIMIT",
        ),
        ({"exit_reason": "DONE", "detail": "", "node_stop_reason": "NONE"}, ""),
        ({}, ""),
    ],
)
def test_the_end_of_a_run_is_explained_by_its_detail_or_the_cause(end: dict[str, str], told: str) -> None:
    assert end_detail(end) == told


KINDS = {
    "real": "double",
    "whole": "int64",
    "natural": "uint64",
    "small": "uint32",
    "flag": "bool",
    "text": "string",
    "data": "bytes",
    "kind": "enum",
    **{f"far{n}": "int64" for n in range(8)},
}


def all_kinds() -> Any:
    """The class of a message with a field of each kind."""
    file = FileDescriptorProto(name="all.proto", package="test", syntax="proto3")
    message, enum = file.message_type.add(name="All"), file.enum_type.add(name="Kind")
    enum.value.add(name="A", number=0)
    enum.value.add(name="B", number=1)
    for number, (name, kind) in enumerate(KINDS.items(), 1):
        of = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
        message.field.add(name=name, number=number, type=of, type_name=".test.Kind" if kind == "enum" else None)
    return message_class("test.All", FileDescriptorSet(file=[file]).SerializeToString())


ALL = all_kinds()
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "real": st.floats(),
    "whole": st.integers(-(2**63), 2**63 - 1),
    "natural": st.integers(0, 2**63 - 1),
    "small": st.integers(0, 2**32 - 1),
    "flag": st.booleans(),
    "text": st.text(max_size=200),
    "data": st.binary(max_size=200),
    "kind": st.integers(-(2**31), 2**31 - 1),
    "far7": st.integers(-300, 300),
}
MESSAGES = st.lists(st.fixed_dictionaries({}, optional=VALUES), max_size=12)
DEFAULTS = {"real": 0.0, "flag": False, "text": "", "data": b""}  # 0 for the others
TYPES = {"real": np.float64, "flag": np.bool_, "text": np.object_, "data": np.object_}  # int64 for the others


@settings(deadline=None, max_examples=100)
@given(MESSAGES)
def test_columns_hold_what_was_written_and_zero_where_nothing_was(messages: list[dict[str, Any]]) -> None:
    found = message_columns(ALL, [ALL(**message).SerializeToString() for message in messages])
    assert set(found) == set(KINDS)
    for name, column in found.items():
        assert column.dtype == TYPES.get(name, np.int64)
        expected = [message.get(name, DEFAULTS.get(name, 0)) for message in messages]
        np.testing.assert_array_equal(column, np.array(expected, column.dtype), err_msg=name)


@settings(deadline=None, max_examples=200)
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=4))
def test_any_bytes_are_columns_of_one_row_each_or_refused(payloads: list[bytes]) -> None:
    with suppress(DecodeError, OverflowError):
        found = message_columns(ALL, payloads)
        assert {column.shape for column in found.values()} == {(len(payloads),)}


def test_a_message_that_was_cut_takes_nothing_of_the_next() -> None:
    values = {"whole": 3, "natural": 4, "small": 5, "flag": True, "text": "eleven", "data": b"12", "kind": 1}
    payload = ALL(real=2.0, **values, **{f"far{n}": n + 1 for n in range(8)}).SerializeToString()
    for length in range(len(payload)):
        try:
            last = ALL.FromString(payload[:length])
        except DecodeError:
            with pytest.raises(DecodeError):
                message_columns(ALL, [payload, payload[:length], payload])
        else:
            found = message_columns(ALL, [payload, payload[:length], payload])
            assert {name: column[1] for name, column in found.items()} == {name: getattr(last, name) for name in KINDS}


def test_a_number_beyond_63_bits_is_refused() -> None:
    with pytest.raises(OverflowError):
        message_columns(ALL, [ALL(natural=2**63).SerializeToString()])
