"""A log as a file of python-can, and in the formats to which python-can converts it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import can
import can.logconvert
import pytest

from emb_bench.logs.can_files import McapReader
from emb_bench.logs.log import read_log
from emb_runtime.log.ring_buffer import FrameRecord
from emb_runtime.records import Frame

from tests.bench.conftest import STEPS  # isort: skip
from tests.bench.simulated_logs import WALL, write_log  # isort: skip
from tests.conftest import SimRun  # isort: skip

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
def run(run: SimRun) -> SimRun:
    last = max(frame.time_ns for frame in run.journal.frames)
    for frame in (  # what a run on a real bus also sees
        Frame(0x1ABCDEF, b"\x01\x02", last + 1_000_000, extended=True),
        Frame(0x321, bytes(3), last + 2_000_000, remote=True),
        Frame(0x88, bytes(8), last + 3_000_000, error=True),
        Frame(0x7FF, b"", last + 4_000_000),
    ):
        run.journal.push(FrameRecord(frame))
    return run


def test_a_log_can_be_read_twice_and_a_cut_one_as_far_as_it_goes(
    path: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with McapReader(path) as reader:
        whole = facts(reader)
        assert facts(reader) == whole
        assert (reader.missing, caplog.text) == ("", "")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with McapReader(cut) as reader:
        part = facts(reader)
        assert 0 < len(part) < len(whole)
        assert part == whole[: len(part)]
    assert f"{cut}: the file is cut at byte" in caplog.text


def test_the_base_install_is_enough_and_the_parsers_do_not_load_python_can(path: Path) -> None:
    code = """
import sys
for extra in ("scipy", "numba", "matplotlib", "pyarrow", "asammdf", "pandas", "torch", "ray"):
    sys.modules[extra] = None
import emb_bench.cli.replay
emb_bench.cli.replay.parser()
assert "can" not in sys.modules
import can
with can.LogReader(sys.argv[1]) as reader:
    assert sum(1 for _ in reader) == int(sys.argv[2])
"""
    with McapReader(path) as reader:
        count = len(list(reader))
    subprocess.run([sys.executable, "-c", code, path, str(count)], check=True, timeout=120)


@pytest.mark.parametrize("form", ["blf", "asc", "log", "mf4"])
def test_can_logconvert_writes_every_frame_of_a_log(
    run: SimRun, tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    metadata = {"emb.run": {"steps": str(STEPS), "iface": "sim:plant=exact,seed=29"}}
    path, out = write_log(tmp_path / "run.mcap", run, metadata=metadata), tmp_path / f"out.{form}"
    monkeypatch.setattr(sys, "argv", ["can_logconvert", str(path), str(out)])
    can.logconvert.main()
    frames = read_log(path).frames
    with can.LogReader(out) if form != "asc" else can.ASCReader(out, relative_timestamp=False) as reader:
        messages = list(reader)
    assert len(messages) == len(frames)
    # The seed is no channel: Vector's formats have the first, which python-can counts as 0, and candump the name.
    channels = {message.channel for message in messages if not message.is_error_frame}
    assert channels == {"sim" if form == "log" else 0}
    first = messages[0].timestamp - (frames[0].time_ns + WALL) / 1e9
    for message, frame in zip(messages, frames, strict=True):
        assert message.is_error_frame == frame.error
        late = message.timestamp - (frame.time_ns + WALL) / 1e9
        assert abs(late - (first if form == "asc" else 0.0)) < 2e-6  # it shortens ASC's date
        if frame.error:
            continue
        assert message.arbitration_id == frame.identifier
        assert message.is_extended_id == frame.extended
        assert message.is_remote_frame == frame.remote
        assert message.is_rx != frame.own
        assert message.dlc == len(frame.data) or (frame.remote and form == "log")  # candump's R has no length
        if not frame.remote:
            assert bytes(message.data) == frame.data
