"""MCAP as a format of python-can, and frames in the formats that python-can itself reads back."""

from __future__ import annotations

import gzip
import math
import resource
import subprocess
import sys
import time
from collections.abc import Iterable
from datetime import datetime
from fractions import Fraction
from pathlib import Path

import can
import can.logconvert
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from emb_bench.cli.replay import main
from emb_bench.export.repair import repair
from emb_bench.logs.can_files import McapReader, McapWriter
from emb_bench.logs.log import read_log
from emb_runtime.errors import FrameError, LogError, UsageError
from emb_runtime.records import Frame

from tests.bench.simulated_logs import WALL, square, write_log  # isort: skip
from tests.conftest import FIXTURE_KEPT, SimRun, Simulate  # isort: skip

STEPS = 40
FIELDS = (
    "timestamp",
    "arbitration_id",
    "is_extended_id",
    "is_remote_frame",
    "is_error_frame",
    "is_rx",
    "dlc",
    "data",
    "channel",
)


def facts(messages: Iterable[can.Message], fields: tuple[str, ...] = FIELDS) -> list[tuple[object, ...]]:
    return [tuple(getattr(message, name) for name in fields) for message in messages]


@pytest.fixture
def run(simulate: Simulate) -> SimRun:
    run = simulate(square, steps=STEPS)
    last = max(frame.time_ns for frame in run.journal.frames)
    run.journal.frames += [  # what a run on a real bus also sees
        Frame(0x1ABCDEF, b"\x01\x02", last + 1_000_000, extended=True),
        Frame(0x321, bytes(3), last + 2_000_000, remote=True),
        Frame(0x88, bytes(8), last + 3_000_000, error=True),
        Frame(0x7FF, b"", last + 4_000_000),
    ]
    return run


@pytest.fixture
def path(tmp_path: Path, run: SimRun) -> Path:
    return write_log(tmp_path / "run.mcap", run, steps=STEPS)


def test_python_can_reads_our_log_by_its_ending(path: Path) -> None:
    reader = can.LogReader(path)
    assert isinstance(reader, McapReader)
    with reader:
        messages = list(reader)
    frames = read_log(path).frames
    assert len(messages) == len(frames)
    for message, frame in zip(messages, frames, strict=True):
        assert message.timestamp == (frame.time_ns + WALL) / 10**9
        assert message.arbitration_id == frame.identifier
        assert message.is_extended_id == frame.extended
        assert message.is_remote_frame == frame.remote
        assert message.is_error_frame == frame.error
        assert message.is_rx != frame.own
        assert message.dlc == len(frame.data)
        assert bytes(message.data) == (b"" if frame.remote else frame.data)
        assert message.channel == "sim"
    assert {message.is_rx for message in messages} == {True, False}


def test_a_log_can_be_read_twice_and_a_cut_one_as_far_as_it_goes(
    path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with McapReader(path) as reader:
        whole = facts(reader)
        assert facts(reader) == whole
        assert (reader.missing, caplog.text) == ((), "")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with McapReader(cut) as reader:
        part = facts(reader)
        assert 0 < len(part) < len(whole)
        assert part == whole[: len(part)]
        assert len(reader.missing) == 1
        assert f"{cut}: the file is cut at byte" in caplog.text
    fixed = tmp_path / "fixed.mcap"
    repair(cut, fixed)
    with McapReader(fixed) as reader:
        assert facts(reader) == part
        assert "this log was repaired" in reader.missing[0]


MESSAGES = st.builds(
    can.Message,
    timestamp=st.floats(0.0, 4e9),
    arbitration_id=st.integers(0, 0x7FF),
    is_extended_id=st.booleans(),
    is_error_frame=st.booleans(),
    is_rx=st.booleans(),
    channel=st.none() | st.integers(0, 3) | st.sampled_from(["can0", "vcan1"]),
    data=st.binary(max_size=8),
)


@settings(max_examples=15, suppress_health_check=FIXTURE_KEPT)
@given(messages=st.lists(MESSAGES, max_size=12))
def test_what_is_written_is_read_back(tmp_path: Path, messages: list[can.Message]) -> None:
    path = tmp_path / "x.mcap"
    path.unlink(missing_ok=True)
    with can.Logger(path) as logger:
        assert isinstance(logger, McapWriter)
        for message in messages:
            logger(message)
    with can.LogReader(path) as reader:
        got = list(reader)
    assert facts(got, FIELDS[1:]) == facts(messages, FIELDS[1:])
    for ours, theirs in zip(got, messages, strict=True):
        assert abs(ours.timestamp - theirs.timestamp) <= 1e-9
    with path.open("rb") as file:  # by a reader that is not ours
        found = list(make_reader(file, validate_crcs=True).iter_messages(log_time_order=False))
    assert [channel.topic for _, channel, _ in found] == ["/can/rx" if m.is_rx else "/can/tx" for m in messages]
    assert {schema.name for schema, _, _ in found if schema} <= {"emb.CanFrame"}
    assert [m.log_time for _, _, m in found] == [round(Fraction(m.timestamp) * 10**9) for m in messages]


def test_a_remote_frame_keeps_its_length(tmp_path: Path) -> None:
    message = can.Message(timestamp=5.0, arbitration_id=7, is_extended_id=False, is_remote_frame=True, dlc=6)
    with can.Logger(tmp_path / "x.mcap") as logger:
        logger(message)
    with can.LogReader(tmp_path / "x.mcap") as reader:
        assert facts(reader) == facts([message])


def test_frames_without_a_run_are_refused_as_a_log_of_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.mcap"
    with can.Logger(path) as logger:
        logger(can.Message(timestamp=5.0, arbitration_id=7, data=b"\x01"))
    with pytest.raises(LogError, match="an MCAP file, but not a log of emb-run"):
        read_log(path)
    assert main(["info", str(path)]) == 6
    assert capsys.readouterr().err == f"emb-replay: {path}: an MCAP file, but not a log of emb-run\n"
    assert main(["export", str(path), "--to", "log", "-o", str(tmp_path / "x.log")]) == 0  # frames are frames
    assert "#01 R" in (tmp_path / "x.log").read_text()


def test_can_fd_and_impossible_times_are_refused(tmp_path: Path) -> None:
    with McapWriter(tmp_path / "x.mcap") as writer:
        with pytest.raises(FrameError, match="expected a classical CAN frame, got CAN FD"):
            writer(can.Message(timestamp=1.0, is_fd=True, data=bytes(12)))
        for bad in (math.nan, math.inf, -1.0, 1e10):
            with pytest.raises(FrameError, match="expected a time in seconds since 1970"):
                writer(can.Message(timestamp=bad))
        writer(can.Message(timestamp=1.0))
    with can.LogReader(tmp_path / "x.mcap") as reader:
        assert len(list(reader)) == 1


def test_a_frame_reaches_the_file_though_no_other_follows(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    writer = McapWriter(path, flush_every=0.01)
    writer(can.Message(timestamp=1.0, arbitration_id=3))
    deadline = time.monotonic() + 20.0
    found: list[can.Message] = []
    while not found and time.monotonic() < deadline:
        time.sleep(0.01)
        if path.stat().st_size:  # its first flush may take its time
            with McapReader(path) as reader:
                found = list(reader)
    assert [message.arbitration_id for message in found] == [3]
    assert reader.missing  # what is not finished says so
    writer.stop()
    writer.stop()
    with McapReader(path) as reader:
        assert len(list(reader)) == 1
        assert reader.missing == ()


def test_a_file_that_exists_is_neither_overwritten_nor_appended_to(path: Path, tmp_path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(UsageError, match="exists, and logs are never overwritten"):
        can.Logger(path)
    with pytest.raises(UsageError, match="cannot be appended to"):
        can.Logger(tmp_path / "new.mcap", append=True)
    with pytest.raises(UsageError, match="cannot write"):
        can.Logger(tmp_path / "nowhere" / "new.mcap")
    assert path.read_bytes() == before


def keep_writing(writer: McapWriter) -> None:
    for _ in range(1000):
        writer(can.Message(timestamp=1.0, arbitration_id=3))
        time.sleep(0.02)


def test_a_file_that_cannot_grow_is_said_at_the_next_frame_and_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    writer = McapWriter(path, flush_every=0.01)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2048, limits[1]))  # a full disk, for this process
    try:
        with pytest.raises(UsageError, match="cannot write: File too large"):
            keep_writing(writer)
        with pytest.raises(UsageError, match="cannot write: File too large"):
            writer.stop()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    with McapReader(path) as reader:
        assert all(message.arbitration_id == 3 for message in reader)
        assert reader.missing


def test_the_base_install_is_enough_and_the_parsers_do_not_load_python_can(path: Path) -> None:
    code = """
import sys
for extra in ("scipy", "numba", "matplotlib", "pyarrow", "asammdf", "pandas", "torch", "ray"):
    sys.modules[extra] = None
import emb_bench.cli.replay
emb_bench.cli.replay.parser()
assert "can" not in sys.modules
import can
with can.LogReader(sys.argv[1]) as reader, can.Logger(sys.argv[2]) as logger:
    for message in reader:
        logger(message)
"""
    out = path.with_name("out.mcap")
    subprocess.run([sys.executable, "-c", code, path, out], check=True, timeout=120)
    with McapReader(path) as reader, McapReader(out) as converted:
        assert facts(converted) == facts(reader)


def test_logconvert_speaks_mcap_both_ways(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asc, back, again = tmp_path / "a.asc", tmp_path / "b.mcap", tmp_path / "c.log"
    for source, target in ((path, asc), (asc, back), (path, again)):
        monkeypatch.setattr(sys, "argv", ["can_logconvert", str(source), str(target)])
        can.logconvert.main()
    with McapReader(path) as reader:
        original = list(reader)
    with McapReader(back) as reader:
        converted = list(reader)
    # ASC knows neither the bus's name nor what an error frame holds.
    kept = ("arbitration_id", "is_extended_id", "is_remote_frame", "is_error_frame", "is_rx", "dlc", "data")
    good = [message for message in original if not message.is_error_frame]
    assert facts((m for m in converted if not m.is_error_frame), kept) == facts(good, kept)
    assert sum(message.is_error_frame for message in converted) == 1
    assert len(again.read_text().splitlines()) == len(original)


@pytest.mark.parametrize("form", ["asc", "blf"])
def test_the_channel_of_a_converted_log_is_the_first_whatever_the_seed(
    run: SimRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    metadata = {"emb.run": {"iface": "sim:plant=exact,seed=29"}}
    path, out = write_log(tmp_path / "run.mcap", run, metadata=metadata), tmp_path / f"out.{form}"
    monkeypatch.setattr(sys, "argv", ["can_logconvert", str(path), str(out)])
    can.logconvert.main()
    with can.LogReader(out) as reader:  # python-can counts from 0
        assert {message.channel for message in reader} == {0}


@pytest.mark.parametrize("form", ["blf", "asc", "log"])
def test_frames_are_exported_as_python_can_reads_them_back(
    path: Path, tmp_path: Path, form: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / f"out.{form}"
    assert main(["export", str(path), "--to", form, "-o", str(out)]) == 0
    frames = read_log(path).frames
    assert capsys.readouterr().out == f"{out}: {len(frames)} frames\n"
    with can.LogReader(out) if form != "asc" else can.ASCReader(out, relative_timestamp=False) as reader:
        messages = list(reader)
    assert len(messages) == len(frames)
    for message, frame in zip(messages, frames, strict=True):
        assert message.is_error_frame == frame.error
        # ASC's date has milliseconds, and candump's times microseconds.
        assert abs(message.timestamp - (frame.time_ns + WALL) / 1e9) < {"blf": 2e-6, "asc": 1.1e-3, "log": 2e-6}[form]
        if frame.error:
            continue
        assert message.arbitration_id == frame.identifier
        assert message.is_extended_id == frame.extended
        assert message.is_remote_frame == frame.remote
        assert message.is_rx != frame.own
        assert message.dlc == len(frame.data) or (frame.remote and form == "log")  # candump's R has no length
        if not frame.remote:
            assert bytes(message.data) == frame.data


@pytest.mark.parametrize("form", ["blf", "asc", "log"])
def test_an_export_has_the_date_of_the_log_and_no_time_before_its_first(tmp_path: Path, form: str) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / f"out.{form}"
    begin = 1_700_000_000.038  # python-can writes these milliseconds as .38
    with can.Logger(path) as logger:
        for late in (0.0, 0.5, -0.02):  # kernel's stamps need not go forward
            logger(can.Message(timestamp=begin + late, arbitration_id=7, data=b"\x01"))
    assert main(["export", str(path), "--to", form, "-o", str(out)]) == 0
    with can.LogReader(out) if form != "asc" else can.ASCReader(out, relative_timestamp=False) as reader:
        times = [message.timestamp - begin for message in reader]
    assert times == pytest.approx([0.0, 0.5, 0.0], abs=1.1e-3)
    if form == "asc":
        date, _, _, trigger, *_ = out.read_text().splitlines()
        assert date.removeprefix("date ") == trigger.removeprefix("Begin Triggerblock ")
        assert datetime.fromtimestamp(begin).strftime("%a %b %d %H:%M:%S.038 %Y") in date


def test_python_cans_own_compression_is_refused_by_python_can(path: Path, tmp_path: Path) -> None:
    packed = tmp_path / "run.mcap.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    with pytest.raises(ValueError, match="No read support"):
        can.LogReader(packed)
