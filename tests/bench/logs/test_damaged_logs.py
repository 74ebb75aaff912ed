"""Damaged, foreign and boundless logs: salvaged or refused in one line, in little memory, no number wrong unsaid."""

from __future__ import annotations

import json
import math
import random
import resource
import shutil
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode

from emb_bench.cli.replay import main
from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs.info import info_document
from emb_bench.logs.log import LARGEST_TEXT, RunLog, read_log
from emb_bench.logs.mcap_file import LARGEST, MAGIC, MOST_CARRIED, MOST_DESCRIBED, SMALL
from emb_runtime.errors import LogError
from emb_runtime.records import CycleRecord
from tests.bench.simulated_logs import square, write_log
from tests.conftest import SimRun, Simulate
from tests.corrupt import (
    IN_PART,
    MOST_GROWTH,
    Read,
    attachment,
    chunk,
    counted,
    damages,
    file_of,
    judge,
    metadata,
    outcome,
    read,
    records_of,
    rewritten,
    without,
)

STEPS = 20
MOST_PLAYED = 60  # Changes of each kind of damage; tests/searches/broken_files.py plays all


@pytest.fixture(scope="module")
def run(simulate: Simulate) -> SimRun:
    return simulate(square, steps=STEPS, options="plant=exact,seed=3")


@pytest.fixture(scope="module")
def undamaged(tmp_path_factory: pytest.TempPathFactory, run: SimRun) -> Path:
    return write_log(tmp_path_factory.mktemp("undamaged") / "run.mcap", run, steps=STEPS, flush_every=15)


@pytest.fixture(scope="module")
def whole(undamaged: Path) -> Read:
    found = read(undamaged)
    assert isinstance(found, Read)
    assert not found.said
    return found


@pytest.fixture
def path(tmp_path: Path, undamaged: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copy(undamaged, tmp_path))


def test_reading_ends_for_each_damage_as_its_row_allows_and_in_little_memory(path: Path, whole: Read) -> None:
    data = path.read_bytes()
    for damage in damages(data, random.Random(1)):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        for change in damage.changes[:: max(1, len(damage.changes) // MOST_PLAYED)]:
            outcome(damage, change, path, data, whole)
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        assert grown << 10 < MOST_GROWTH, damage.what


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


@pytest.mark.parametrize("value", [math.nan, math.inf, -1e308])
@pytest.mark.parametrize("name", ["angle", "velocity", "applied_current", "sent_current"])
def test_a_sample_that_is_no_measurement_counts_as_lost_and_that_is_said(
    path: Path, whole: Read, name: str, value: float
) -> None:
    rewritten(path, values=lambda topic, n, row: {**row, name: value} if (topic, n % 5) == ("/cycle", 3) else row)
    if name == "sent_current":  # what acted is what the node reports
        found = read(path)
        assert isinstance(found, Read)
        assert found.numbers[:-1] == whole.numbers[:-1]
    else:
        ends, found = judge(path, whole)
        assert isinstance(found, Read)
        assert (int((~found.experiment.measured).sum()), ends) == (4, IN_PART)


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
            if isinstance(found, Read) and not found.said:
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
    assert isinstance(found, str) or found.said


@pytest.mark.parametrize("steps", ["9" * 15, "9" * 5000, "-3", "", "20.0", "0"])
def test_a_planned_length_that_is_none_is_not_believed(tmp_path: Path, run: SimRun, steps: str) -> None:
    found = read(write_log(tmp_path / "x.mcap", run, metadata={"emb.run": {"steps": steps}, "emb.truth": {}}))
    assert isinstance(found, str) or found.said


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


EMPTY = b"\x80" + bytes(8)  # A record of a kind that readers pass over, with nothing in it


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> list[tuple[int, bytes]]:
    run = simulate(square, steps=20, options="plant=exact,seed=3")
    return records_of(write_log(tmp_path_factory.mktemp("log") / "run.mcap", run, steps=20).read_bytes())


def changed(tmp_path: Path, honest: list[tuple[int, bytes]], *more: tuple[int, bytes]) -> Path:
    """A log with more records in front of its first chunk."""
    at = next(k for k, (opcode, _) in enumerate(honest) if opcode == Opcode.CHUNK)
    path = tmp_path / "changed.mcap"
    path.write_bytes(file_of([*honest[:at], *more, *honest[at:]]))
    return path


def test_a_chunk_of_records_that_are_no_messages_is_left_out(tmp_path: Path, honest: list[tuple[int, bytes]]) -> None:
    few = EMPTY * (SMALL // len(EMPTY))
    log = read_log(changed(tmp_path, honest, (Opcode.CHUNK, chunk(few))))
    assert f"more than {MOST_DESCRIBED} records in it are no messages" in log.missing


def test_a_log_that_carries_more_than_any_of_ours_is_refused(tmp_path: Path, honest: list[tuple[int, bytes]]) -> None:
    half = (Opcode.ATTACHMENT, attachment("x", bytes(LARGEST // 2)))
    with pytest.raises(LogError, match="expected at most 32 MiB of attachments and metadata"):
        read_log(changed(tmp_path, honest, *[half] * (2 * MOST_CARRIED // LARGEST)))
    topics = [
        (Opcode.SCHEMA, struct.pack("<H", n) + counted("x") + counted("") + counted(""))
        for n in range(1, MOST_DESCRIBED + 2)
    ]
    with pytest.raises(LogError, match="expected at most 500 schemas and channels"):
        read_log(changed(tmp_path, honest, *topics))


@pytest.mark.parametrize("name", ["bench.toml", "emb.dbc"])
def test_a_text_larger_than_any_of_ours_is_refused(tmp_path: Path, honest: list[tuple[int, bytes]], name: str) -> None:
    large = [r for r in honest if r[0] != Opcode.ATTACHMENT]
    log = read_log(changed(tmp_path, large, (Opcode.ATTACHMENT, attachment(name, b"#" * (LARGEST_TEXT + 1)))))
    with pytest.raises(LogError, match=f"{name} inside the log has 65537 bytes, expected at most 65536"):
        _ = log.bench if name == "bench.toml" else log.layout


def test_strings_of_a_log_reach_the_terminal_as_single_lines_without_control_characters(
    tmp_path: Path, honest: list[tuple[int, bytes]], capsys: pytest.CaptureFixture[str]
) -> None:
    wild = "\x1b]52;c;QUJD\x07\x9b2J\u202e\nexit   DONE"
    entries = {"exit_reason": wild, "detail": wild, wild: "x" * 1_000_000}
    rest = [r for r in honest if r[0] != Opcode.METADATA or b"emb.end" not in r[1]]
    more = [(Opcode.METADATA, metadata("emb.end", entries)), (Opcode.ATTACHMENT, attachment(wild, b""))]
    path = changed(tmp_path, rest, *more).rename(tmp_path / "\x1b[31m.mcap")
    shown = r"\x1b]52;c;QUJD\x07\x9b2J\u202e\nexit   DONE"
    for command in ("info", "fim"):
        assert main([command, str(path)]) == 0
        out, err = capsys.readouterr()
        assert shown in out
        assert (out + err).replace("\n", "").isprintable()
        assert max(map(len, out.split("\n"))) < 5000
    assert main(["info", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["metadata"]["emb.end"]["detail"], document["exit_reason"]) == (wild, shown)
