"""A log that asks for more than it is: memory has a bound, and time grows with the size of the file and no faster."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from emb_bench.cli.replay import main
from emb_bench.logs.log import LARGEST_TEXT, read_log
from emb_bench.logs.mcap_file import LARGEST, MOST_CARRIED, MOST_DESCRIBED, SMALL
from emb_runtime.errors import LogError
from tests.bench.simulated_logs import square, write_log
from tests.conftest import Simulate
from tests.corrupt import attachment, chunk, counted, file_of, metadata, records_of

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
