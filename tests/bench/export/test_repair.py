"""Repaired logs, seen by a reader that is not ours, and by ours."""

from __future__ import annotations

import hashlib
import tracemalloc
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import Writer

from emb_bench.cli.replay import main
from emb_bench.export.repair import repair
from emb_bench.logs.log import read_log
from emb_runtime.errors import LogError

from tests.bench.conftest import Replay  # isort: skip
from tests.conftest import FIXTURE_KEPT  # isort: skip


class Seen(NamedTuple):
    """What the plain reader of the mcap package says of a finished file."""

    messages: list[tuple[str, Message]]
    channels: dict[str, tuple[dict[str, str], str, bytes]]
    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    chunks: list[int]


def seen(path: Path) -> Seen:
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        messages = [(channel.topic, message) for _, channel, message in reader.iter_messages(log_time_order=False)]
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(messages)
        schemas = summary.schemas
        return Seen(
            messages,
            {
                c.topic: (c.metadata, schemas[c.schema_id].name, schemas[c.schema_id].data)
                for c in summary.channels.values()
            },
            {m.name: m.metadata for m in reader.iter_metadata()},
            {a.name: a.data for a in reader.iter_attachments()},
            [index.chunk_start_offset for index in summary.chunk_indexes],
        )


def facts(messages: list[tuple[str, Message]]) -> list[tuple[Any, ...]]:
    return [(topic, m.log_time, m.publish_time, m.sequence, m.data) for topic, m in messages]


def test_a_cut_log_is_repaired_to_its_last_whole_chunk(path: Path, tmp_path: Path) -> None:
    whole = seen(path)
    cut, fixed = tmp_path / "cut.mcap", tmp_path / "fixed.mcap"
    content = path.read_bytes()[: whole.chunks[-1] + 100]
    cut.write_bytes(content)
    assert main(["repair", str(cut), "-o", str(fixed)]) == 0
    got = seen(fixed)
    assert 100 < len(got.messages) < len(whole.messages)
    assert facts(got.messages) == facts(whole.messages)[: len(got.messages)]
    assert got.channels == whole.channels
    assert got.attachments == whole.attachments
    said = got.metadata.pop("emb.repair")
    assert got.metadata == {name: whole.metadata[name] for name in got.metadata}
    assert "emb.run" in got.metadata
    assert said["missing"].startswith(f"the file is cut at byte {len(content)}")
    assert said["source_sha256"] == hashlib.sha256(content).hexdigest()


@settings(max_examples=20, suppress_health_check=FIXTURE_KEPT)
@given(where=st.floats(0.0, 1.0, exclude_max=True))
def test_a_log_cut_anywhere_is_refused_or_repaired_to_what_reading_finds(
    path: Path, tmp_path: Path, where: float
) -> None:
    content = path.read_bytes()
    cut, fixed = tmp_path / "cut.mcap", tmp_path / "fixed.mcap"
    cut.write_bytes(content[: int(where * len(content))])
    fixed.unlink(missing_ok=True)
    try:
        repair(cut, fixed)
    except LogError:
        assert not fixed.exists()
        with pytest.raises(LogError):
            read_log(cut)
    else:
        counts = read_log(cut).counts
        assert {topic: count for topic, count in read_log(fixed).counts.items() if count} == {
            topic: count for topic, count in counts.items() if count
        }
        assert sum(counts.values()) == len(seen(fixed).messages)
        assert read_log(cut).missing in read_log(fixed).missing


@settings(max_examples=20, suppress_health_check=FIXTURE_KEPT)
@given(where=st.floats(0.0, 1.0, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_costs_at_most_a_neighbourhood_and_is_told(
    path: Path, tmp_path: Path, where: float, bit: int
) -> None:
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 1 << bit
    damaged, fixed = tmp_path / "damaged.mcap", tmp_path / "fixed.mcap"
    damaged.write_bytes(content)
    fixed.unlink(missing_ok=True)
    try:
        found = repair(damaged, fixed)
    except LogError:
        assert int(where * len(content)) < 100  # the magic bytes or the header: not a log of ours any more
        return
    assert found is not None  # each byte is under a checksum
    original = facts(seen(path).messages)
    kept = facts(seen(fixed).messages)
    assert set(kept) <= set(original)  # nothing is invented
    assert not read_log(fixed).complete


def test_repairing_takes_memory_for_a_chunk_not_for_the_file(tmp_path: Path) -> None:
    cut, fixed = tmp_path / "cut.mcap", tmp_path / "fixed.mcap"
    random = np.random.default_rng(1)
    with cut.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 18)
        writer.start(library="emb-excite/0")
        schema = writer.register_schema("emb.Noise", "protobuf", b"")
        channel = writer.register_channel("/noise", "protobuf", schema)
        for n in range(400):
            writer.add_message(channel, n, random.bytes(1 << 16), n)
    tracemalloc.start()
    try:
        repair(cut, fixed)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert fixed.stat().st_size > 24 << 20
    assert peak < 6 << 20


def test_a_repaired_log_that_is_cut_in_its_turn_keeps_both_stories(path: Path, tmp_path: Path) -> None:
    whole = seen(path)
    first, fixed, second, again = (tmp_path / name for name in ("1.mcap", "2.mcap", "3.mcap", "4.mcap"))
    first.write_bytes(path.read_bytes()[: whole.chunks[-1] + 100])
    repair(first, fixed)
    second.write_bytes(fixed.read_bytes()[:-3])
    repair(second, again)
    missing = read_log(again).missing
    assert f"cut at byte {first.stat().st_size}" in missing
    assert f"cut at byte {second.stat().st_size}" in missing
    assert repair(again, tmp_path / "5.mcap") is None  # there is nothing left to repair


def test_a_log_that_is_whole_is_left_alone(path: Path, tmp_path: Path, replay: Replay) -> None:
    out = tmp_path / "fixed.mcap"
    assert "nothing to repair" in replay.text("repair", path, "-o", out)
    assert not out.exists()
    expected = {"log": str(path), "written": None, "missing": "", "messages": None}
    assert replay.document("repair", path, "-o", out) == expected
