"""Damaged, foreign and contradictory logs: salvaged or refused in one line, and no wrong number without a warning."""

from __future__ import annotations

import json
import math
import resource
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.cli.replay import main
from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs.info import info_document
from emb_bench.logs.log import RunLog, read_log
from emb_bench.logs.mcap_file import MAGIC
from emb_runtime.errors import LogError
from emb_runtime.records import CycleRecord

from tests.bench.damaged import (  # isort: skip
    ATTACHMENT,
    CHUNK,
    DATA_END,
    FOOTER,
    METADATA,
    Read,
    chunk,
    judge,
    read,
    read_or_refuse,
    record,
    records,
    rewritten,
    spliced,
    with_field,
    without,
)
from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import FIXTURE_KEPT, SimRun, Simulate  # isort: skip

STEPS = 20
OPCODES = (ATTACHMENT, METADATA, CHUNK)
FIXTURE = settings(max_examples=60, suppress_health_check=FIXTURE_KEPT)


@pytest.fixture(scope="module")
def run(simulate: Simulate) -> SimRun:
    return simulate(square, steps=STEPS, options="plant=exact,seed=3")


@pytest.fixture(scope="module")
def undamaged(tmp_path_factory: pytest.TempPathFactory, run: SimRun) -> Path:
    return write_log(tmp_path_factory.mktemp("undamaged") / "run.mcap", run, steps=STEPS, flush_every=15)


@pytest.fixture(scope="module")
def whole(undamaged: Path) -> Read:
    found = read(undamaged)
    assert found is not None
    assert not found.said
    return found


@pytest.fixture
def path(tmp_path: Path, undamaged: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copy(undamaged, tmp_path))


@FIXTURE
@given(st.data())
def test_flipped_bytes_give_no_number_without_a_warning(path: Path, whole: Read, data: st.DataObject) -> None:
    true = path.read_bytes()
    damaged = bytearray(true)
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    other = path.with_name("damaged.mcap")
    other.write_bytes(damaged)
    found = judge(other, whole)
    assert found is None or found.said or bytes(damaged) == true


@FIXTURE
@given(st.integers(0, 40_000), st.integers(0, 3000), st.binary(max_size=50))
def test_bytes_that_are_gone_or_came_in_give_no_number_without_a_warning(
    path: Path, whole: Read, at: int, gone: int, new: bytes
) -> None:
    data = path.read_bytes()
    damaged = path.with_name("damaged.mcap")
    damaged.write_bytes(data[:at] + new + data[at + gone :])
    read_or_refuse(damaged)
    found = judge(damaged, whole)
    assert found is None or found.said or damaged.read_bytes() == data or at >= len(data)


def test_a_length_or_a_field_of_a_chunk_that_lies_costs_what_follows_and_that_is_said(path: Path, whole: Read) -> None:
    true = path.read_bytes()
    places = {opcode: [begin for kind, begin, _ in records(true) if kind == opcode][-1] for opcode in OPCODES}
    lies = [
        (begin + 1, struct.pack("<Q", length))
        for begin in places.values()
        for length in (2**63, 2**64 - 1, 2**40, 2**31, 0, 3)
    ]
    lies += [(places[CHUNK] + 9 + offset, b"\xf0\xff\xff\xff") for offset in range(0, 60, 4)]
    for at, lie in lies:
        path.write_bytes(true[:at] + lie + true[at + len(lie) :])
        found = judge(path, whole)
        assert found is None or found.said, (at, lie)


def test_a_chunk_that_unpacks_to_gigabytes_is_left_out_in_little_memory(path: Path, whole: Read) -> None:
    piece, packer = bytes(1 << 20), zstandard.ZstdCompressor().compressobj()
    bomb = b"".join(packer.compress(piece) for _ in range(2048)) + packer.flush()
    honest = zstandard.ZstdCompressor().compressobj(size=256 << 20)
    told = b"".join(honest.compress(piece) for _ in range(256)) + honest.flush()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    clean = path.read_bytes()
    for packed, size, words in (
        *(
            (packed, size, "it claims to unpack from")
            for packed, size in ((bomb, 2 << 30), (bomb, 2**63), (told, 256 << 20))
        ),
        (bomb, 1000, "is damaged"),
        (told, 1000, "its frame claims to unpack to"),
    ):
        path.write_bytes(clean)
        spliced(path, record(CHUNK, chunk(b"", size=size, packed=packed)))
        found = judge(path, whole)
        assert found is not None
        assert found.said
        assert "the chunk at byte" in found.log.missing
        assert words in found.log.missing
        assert found.numbers == whole.numbers
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 128 * 1024  # KiB


def test_a_huge_record_that_is_really_there_is_passed_over_in_little_memory(path: Path, whole: Read) -> None:
    data = path.read_bytes()
    at = next(begin for kind, begin, _ in records(data) if kind == CHUNK)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with path.open("wb") as file:  # a hole in the file, which takes no space on the disk
        file.write(data[:at] + struct.pack("<BQ", ATTACHMENT, 400 << 20))
        file.seek(400 << 20, 1)
        file.write(data[at:])
    found = judge(path, whole)
    assert found is not None
    assert "more than any of ours" in found.log.missing
    assert found.numbers == whole.numbers
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 128 * 1024


def test_a_malformed_record_is_left_out_and_the_rest_is_right(path: Path, whole: Read) -> None:
    true, crc = path.read_bytes(), zlib.crc32
    for extra in (
        record(CHUNK, chunk(b"", compression=b"lz4")),
        record(CHUNK, chunk(b"\x05" + struct.pack("<Q", 10) + bytes(10))),
        record(CHUNK, chunk(b"\x05" + struct.pack("<Q", 2**63) + bytes(30))),
        record(CHUNK, chunk(b"\x40" + struct.pack("<Q", 0) + b"\x40\x00")),
        record(CHUNK, chunk(b"\x04" + struct.pack("<Q", 2) + b"\x00\x01")),
        record(5, bytes(40)),
        record(0x40, b"x"),
        record(METADATA, b"\xff\xff\xff\xff"),
        record(ATTACHMENT, bytes(30) + struct.pack("<I", crc(bytes(30)))),
        record(ATTACHMENT, b"\xff" * 40 + struct.pack("<I", crc(b"\xff" * 40))),
        record(ATTACHMENT, b"\xff" * 3),
    ):
        path.write_bytes(true)
        spliced(path, extra)
        found = judge(path, whole)
        assert found is not None, extra
        assert found.numbers == whole.numbers, extra
        assert found.said or extra[0] == ATTACHMENT  # one that is whole, under another name


def test_records_after_version_two_of_the_format_are_passed_over_in_silence(path: Path, whole: Read) -> None:
    spliced(path, record(0x90, b"anything"))
    found = judge(path, whole)
    assert found is not None
    assert not found.said


def test_a_field_that_a_later_version_adds_changes_nothing(path: Path, whole: Read) -> None:
    true = path.read_bytes()
    for topic in ("", "/cycle", "/can/rx", "/can/tx", "/clock", "/safety"):
        path.write_bytes(true)
        rewritten(path, with_field(topic, "novelty", "int64"), values=lambda _t, n, row: {**row, "novelty": n})
        found = judge(path, whole)
        assert found is not None, topic
        assert not found.said, topic


def test_a_field_that_is_missing_is_named(path: Path) -> None:
    true = path.read_bytes()
    rows: list[tuple[str, str, Callable[[RunLog], object]]] = [
        *(("/cycle", name, read_experiment) for name in CycleRecord._fields),
        *(("/can/rx", name, read_experiment) for name in ("id", "data", "is_extended")),
        *((topic, name, lambda log: log.frames) for topic, name in (("/can/tx", "data"), ("/clock", "monotonic_ns"))),
        ("/safety", "code", info_document),
    ]
    for topic, name, asked in rows:
        path.write_bytes(true)
        rewritten(path, without(topic, name))
        with pytest.raises(LogError, match=f"have other fields: expected {name} "):
            asked(read_log(path))


@pytest.mark.parametrize("kind", ["string", "bytes", "double", "bool", "int64"])
def test_a_field_of_another_kind_is_refused_unless_it_means_the_same(path: Path, whole: Read, kind: str) -> None:
    types: dict[str, Callable[[Any], Any]] = {
        "string": str,
        "bytes": lambda v: str(v).encode(),
        "double": float,
        "bool": bool,
        "int64": int,
    }
    of_data = dict.fromkeys(("double", "int64", "bool"), len) | {"bytes": bytes, "string": lambda v: v.hex()}
    true = path.read_bytes()
    for topic, name in (("/cycle", "step"), ("/cycle", "angle"), ("/can/rx", "id"), ("/can/rx", "is_rtr"), DATA):
        change = (of_data if name == "data" else types)[kind]
        path.write_bytes(true)
        rewritten(path, with_field(topic, name, kind), values=partial(_changed, topic, name, change))
        found = judge(path, whole)
        assert found is None or not found.said, (topic, name)


DATA = "/can/tx", "data"


def _changed(
    topic: str, name: str, change: Callable[[Any], Any], where: str, _n: int, row: dict[str, Any]
) -> dict[str, Any]:
    return {**row, name: change(row[name])} if where == topic else row


def test_two_runs_in_one_log_are_refused(path: Path) -> None:
    rewritten(path, runs=2)
    with pytest.raises(LogError, match="this is not one run"):
        read_experiment(read_log(path))


def test_of_two_logs_one_after_the_other_in_a_file_the_first_is_read_and_that_is_said(path: Path, whole: Read) -> None:
    path.write_bytes(path.read_bytes() * 2)
    found = judge(path, whole)
    assert found is not None
    assert found.said
    assert found.numbers == whole.numbers


def test_a_log_without_a_message_is_refused(path: Path) -> None:
    data = path.read_bytes()
    head = next(begin for kind, begin, _ in records(data) if kind == CHUNK)
    path.write_bytes(data[:head] + record(DATA_END, bytes(4)) + record(FOOTER, bytes(20)) + MAGIC)
    with pytest.raises(LogError, match="not one message is left in this log: it holds none"):
        read_log(path)


STAMPS: tuple[Callable[[int], int], ...] = (
    lambda t: 0,
    lambda t: 2**64 - 1,
    lambda t: 2**63 - 1,
    lambda t: t - 10**9 * (t // 10**6 % 3),
    lambda t: t // 10**7 * 10**7,
    lambda t: t + 2**61,
)


def _stamped(topic: str, stamp: Callable[[int], int], where: str, _n: int, time_ns: int) -> int:
    return stamp(time_ns) if where == topic else time_ns


def test_times_that_no_run_has_give_no_wrong_number(path: Path, whole: Read) -> None:
    true = path.read_bytes()
    for topic in ("/can/rx", "/can/tx", "/cycle", "/clock"):
        for stamp in STAMPS:
            path.write_bytes(true)
            rewritten(path, stamps=partial(_stamped, topic, stamp))
            judge(path, whole)


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e308])
@pytest.mark.parametrize("name", ["angle", "velocity", "applied_current", "sent_current"])
def test_a_sample_that_is_no_measurement_counts_as_lost_and_that_is_said(
    path: Path, whole: Read, name: str, value: float
) -> None:
    rewritten(path, values=lambda topic, n, row: {**row, name: value} if (topic, n % 5) == ("/cycle", 3) else row)
    if name == "sent_current":  # what acted is what the node reports
        found = read(path)
        assert found is not None
        assert found.numbers[:-1] == whole.numbers[:-1]
    else:
        found = judge(path, whole)
        assert found is not None
        assert (int((~found.experiment.measured).sum()), found.said) == (4, True)


@pytest.mark.parametrize("name", ["step", "receive_time_ns", "state"])
def test_a_huge_number_in_a_control_cycle_takes_no_memory_and_gives_no_wrong_number(
    path: Path, whole: Read, run: SimRun, name: str
) -> None:
    first = next(n for n, cycle in enumerate(run.journal.cycles) if cycle.step == 0)
    true = path.read_bytes()
    for value in (2**63 - 1, -(2**63), 2**40, 501, 10**7, -5):
        for which in (0, 7, STEPS):
            number = value if name != "state" else max(-(2**31), min(value, 2**31 - 1))
            path.write_bytes(true)
            rewritten(path, values=partial(_in_cycle, first + which, name, number))
            found = read(path)
            if found is not None and not found.said:
                assert found.numbers[:-1] == whole.numbers[:-1]


def _in_cycle(number: int, name: str, value: object, topic: str, n: int, row: dict[str, Any]) -> dict[str, Any]:
    return {**row, name: value} if (topic, n) == ("/cycle", number) else row


@pytest.mark.parametrize(("name", "value"), [("angle", math.nan), ("device_time_ns", 10**15)])
@pytest.mark.parametrize("count", [1, 4, 10**6])
def test_an_experiment_that_begins_without_a_measurement_gives_no_number_without_a_warning(
    path: Path, run: SimRun, monkeypatch: pytest.MonkeyPatch, name: str, value: float, count: int
) -> None:
    monkeypatch.setattr("emb_bench.logs.log.BATCH", 1)
    first = next(n for n, cycle in enumerate(run.journal.cycles) if cycle.step == 0)

    def values(topic: str, n: int, row: dict[str, Any]) -> dict[str, Any]:
        return {**row, name: value} if topic == "/cycle" and first <= n < first + count else row

    rewritten(path, values=values, chunk_size=500)
    found = read(path)
    assert found is None or found.said


@pytest.mark.parametrize("steps", ["9" * 15, "9" * 5000, "-3", "", "20.0", "0"])
def test_a_planned_length_that_is_none_is_not_believed(tmp_path: Path, run: SimRun, steps: str) -> None:
    found = read(write_log(tmp_path / "x.mcap", run, metadata={"emb.run": {"steps": steps}, "emb.truth": {}}))
    assert found is None or found.said


@pytest.mark.parametrize("command", ["fim", "info"])
def test_the_commands_say_one_line_and_an_exit_code_for_every_damage(
    path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    data = path.read_bytes()
    damaged = [data[:size] for size in range(0, len(data), len(data) // 25)]
    damaged += [data[:at] + b"\xff\x00\xfe" + data[at + 3 :] for at in range(0, len(data), len(data) // 25)]
    codes = set()
    for content in [*damaged, b"", MAGIC, b"x", data + b"x", bytes(100)]:
        path.write_bytes(content)
        code = main([command, str(path), "--json"])
        out, err = capsys.readouterr()
        codes.add(code)
        assert code in (0, 6)
        assert (err.count("\n"), bool(out)) == ((0, True) if code == 0 else (1, False))
        if code == 0:
            said = json.loads(out)
            assert said["complete"] is False
            assert said.get("missing") or said.get("warnings")
    assert codes == {0, 6}
