"""Tables and pictures of a log, read back by the libraries whose formats they are."""

from __future__ import annotations

import csv
import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest

from emb_bench.cli.replay import main
from emb_bench.experiment.from_log import read_experiment
from emb_bench.export.mjcf import mjcf
from emb_bench.export.picture import broken, draw_run
from emb_bench.logs.log import RunLog, read_log
from emb_runtime.config.bench import load_bench
from emb_runtime.log.ring_buffer import EventRecord
from emb_runtime.records import CycleRecord, RunState

from tests.bench.conftest import STEPS, Replay  # isort: skip
from tests.bench.simulated_logs import WALL, square, write_log  # isort: skip
from tests.conftest import SimRun, Simulate  # isort: skip


def export(*arguments: str | Path) -> int:
    return main(["export", *map(str, arguments)])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_csv_of_the_cycles_has_every_field_with_its_unit(path: Path, run: SimRun, tmp_path: Path) -> None:
    out = tmp_path / "run.csv"
    assert export(path, "-o", out) == 0
    rows = rows_of(out)
    titles = list(rows[0])
    assert [title.split(" [")[0] for title in titles] == ["time", "unix_time", *CycleRecord._fields]
    assert {"time [s]", "angle [rad]", "velocity [rad/s]", "sent_current [A]", "receive_time_ns [ns]"} <= set(titles)
    assert len(rows) == len(run.journal.cycles)
    start = min(event[0] for event in run.journal.events)  # before the first frame
    for row, cycle in zip(rows, run.journal.cycles, strict=True):
        assert int(row["unix_time [ns]"]) == WALL + cycle.receive_time_ns
        assert float(row["time [s]"]) == pytest.approx((cycle.receive_time_ns - start) * 1e-9, abs=1e-9)
        assert row["state"] == RunState(cycle.state).name
        assert int(row["step"]) == cycle.step
        for title, value in (("angle [rad]", cycle.angle), ("policy_current [A]", cycle.policy_current)):
            assert (math.isnan(value) and row[title] == "") or float(row[title]) == value


def test_any_topic_can_be_a_table(path: Path, run: SimRun, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    assert export(path, "-o", out, "--topic", "/can/tx") == 0
    sent = [frame for frame in run.journal.frames if frame.own]
    rows = rows_of(out)
    assert [bytes.fromhex(row["data"]) for row in rows] == [frame.data for frame in sent]
    assert [row["is_extended"] for row in rows] == ["false"] * len(sent)
    for topic, count in read_log(path).counts.items():
        out = tmp_path / f"{topic.replace('/', '_')}.csv"
        assert export(path, "-o", out, "--topic", topic) == 0
        assert len(rows_of(out)) == count


FORMULAS = ("=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(1)", "\t=1", "\r=1", "\n1", " =1", "＝1")
PLAIN = ("a = b", "1 - 2", "", "it's", "'=1", "# 5")


def test_no_text_of_a_log_is_a_formula_in_a_spreadsheet(simulate: Simulate, tmp_path: Path) -> None:
    run, texts = simulate(square, options="plant=exact"), [*FORMULAS, *PLAIN]
    when = run.journal.events[-1].time_ns
    run.journal.records += [EventRecord(when, text, text) for text in texts]
    path = write_log(tmp_path / "=1.mcap", run)
    assert export(path, "-o", tmp_path / "events.csv", "--topic", "/safety") == 0
    assert [row["text"] for row in rows_of(tmp_path / "events.csv")][-len(texts) :] == [
        *(f"'{text}" for text in FORMULAS),
        *PLAIN,
    ]
    folder = tmp_path / "-logs"
    folder.mkdir()
    shutil.copy(path, folder / "@1.mcap")
    (folder / "+2.mcap").write_text("none")
    assert main(["campaign", str(folder), "-o", str(tmp_path / "rows.csv"), "--method", "none", "--jobs", "1"]) == 1
    rows = rows_of(tmp_path / "rows.csv")
    assert [row["log"] for row in rows] == ["'+2.mcap", "'@1.mcap"]
    assert float(rows[1]["angle_min"]) < 0.0  # a number stays one


def test_parquet_has_the_same_numbers_and_units_and_says_what_is_missing(
    path: Path, tmp_path: Path, replay: Replay
) -> None:
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.parquet"
    cut.write_bytes(path.read_bytes()[:-5])
    log = read_log(cut)
    document = replay.document("export", cut, "-o", out)
    assert document["holds"] == f"{log.counts['/cycle']} rows of /cycle"
    assert document["missing"] == log.missing
    table = pq.read_table(out)
    assert table.column_names == ["time", "unix_time", *CycleRecord._fields]
    for name in ("angle", "velocity", "sent_current", "policy_current", "step", "send_time_ns"):
        np.testing.assert_array_equal(table[name].to_numpy(), log.cycles[name])
    assert table["unix_time"].cast("int64").to_pylist() == log.cycles["publish_time"].tolist()
    assert table["state"].to_pylist() == [RunState(state).name for state in log.cycles["state"].tolist()]
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema if field.metadata}
    assert units["angle"] == "rad"
    assert units["velocity"] == "rad/s"
    assert units["send_time_ns"] == "ns"
    about = table.schema.metadata
    assert about[b"emb.complete"] == b"false"
    assert about[b"emb.missing"].decode() == log.missing
    assert json.loads(about[b"emb.run"])["iface"] == "sim"


def test_a_value_that_does_not_exist_is_null_in_parquet(simulate: Simulate, tmp_path: Path) -> None:
    run = simulate(square, steps=STEPS)
    records = run.journal.records
    records[:] = [r._replace(policy_current=math.nan) if isinstance(r, CycleRecord) else r for r in records]
    source = write_log(tmp_path / "nan.mcap", run, steps=STEPS)
    assert export(source, "-o", tmp_path / "out.parquet") == 0
    assert pq.read_table(tmp_path / "out.parquet")["policy_current"].null_count == len(run.journal.cycles)


def test_a_picture_says_what_is_in_it(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("matplotlib").rcParams, "svg.fonttype", "none")  # text stays text
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(path.read_bytes()[:-5])
    for ending, magic in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        draw_run(read_log(cut), tmp_path / f"out.{ending}")
        assert (tmp_path / f"out.{ending}").read_bytes().startswith(magic)
    text = (tmp_path / "out.svg").read_text(encoding="utf-8")
    for word in ("angle [rad]", "velocity [rad/s]", "current [A]", "requested", "applied", "returning", "run stopping"):
        assert f">{word}<" in text
    assert "cut.mcap" in text
    assert "the log is NOT complete" in text


def test_mujoco_moves_the_exported_brake_as_the_log_has_it(simulate: Simulate, tmp_path: Path) -> None:
    path = write_log(tmp_path / "long.mcap", simulate(square, steps=300), steps=300)
    out, record = tmp_path / "brake.xml", read_experiment(read_log(path))
    assert export(path, "-o", out, "--theta", "f_v=3e-5") == 0
    assert mujoco.MjModel.from_xml_path(str(out)).joint("motor").damping[0] == 3e-5
    assert export(path, "-o", tmp_path / "true.xml", "--theta", "true") == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "true.xml"))
    data, steps = mujoco.MjData(model), round(1e-3 / model.opt.timestep)
    for current, (angle, velocity) in zip(record.currents, record.samples, strict=True):
        data.ctrl[0] = current
        mujoco.mj_step(model, data, steps)
        assert data.qpos[0] == pytest.approx(angle, abs=0.02)
        assert data.qvel[0] == pytest.approx(velocity, abs=5.0)
    assert record.samples[:, 0].max() > 5.0  # it has moved


def test_the_clamp_of_an_exported_brake_pushes_only_in_contact() -> None:
    brake = load_bench().brake
    model = mujoco.MjModel.from_xml_string(mjcf(load_bench(), brake))
    data = mujoco.MjData(model)
    for angle in (-5.0, 20.0, 90.0):
        data.qpos[0] = angle
        mujoco.mj_forward(model, data)
        assert data.qfrc_passive[0] == pytest.approx(-brake.gamma * brake.k_1 * max(angle, 0.0), rel=1e-12)


def test_no_line_is_drawn_through_periods_that_were_missed() -> None:
    values, missed = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0, 2, 0, 1])
    np.testing.assert_array_equal(broken(values, missed), [1.0, np.nan, 2.0, 3.0, np.nan, 4.0])


def test_a_missing_extra_is_named(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, replay: Replay) -> None:
    for name, module in (("out.csv", "pyarrow"), ("out.png", "matplotlib")):
        with monkeypatch.context() as missing:
            missing.setitem(sys.modules, module, None)
            said = replay.refused("export", path, "-o", tmp_path / name)
        assert f"needs {module}: " in said
        assert "pip install -c constraints.txt -e '.[bench]'" in said
        assert not (tmp_path / name).exists()


def test_a_picture_needs_control_cycles(tmp_path: Path, run: SimRun, replay: Replay) -> None:
    run.journal.records[:] = [r for r in run.journal.records if not isinstance(r, CycleRecord)]
    source = write_log(tmp_path / "none.mcap", run, steps=STEPS)
    said = replay.refused("export", source, "-o", tmp_path / "out.png", code=6)
    assert "not one control cycle is in this log" in said


def test_a_long_log_is_written_batch_by_batch(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert export(path, "-o", tmp_path / "1.csv") == 0
    batches: list[int] = []
    plain = RunLog.batches

    def counted(self: RunLog, wanted: Any) -> Any:
        for batch in plain(self, wanted):
            batches.append(len(batch))
            yield batch

    monkeypatch.setattr("emb_bench.logs.log.BATCH", 1)  # as if each chunk were as much as one may hold
    monkeypatch.setattr(RunLog, "batches", counted)
    assert export(path, "-o", tmp_path / "2.csv") == 0
    assert len(batches) > 3
    assert (tmp_path / "2.csv").read_bytes() == (tmp_path / "1.csv").read_bytes()
    log = read_log(path)
    for n, (topic, count) in enumerate(log.counts.items()):  # the first batches have nothing of some topics
        assert export(path, "-o", tmp_path / f"{n}.parquet", "--topic", topic) == 0
        table = pq.read_table(tmp_path / f"{n}.parquet")
        assert table.num_rows == count
        for name in ("data", "text", "message"):
            if name in table.column_names:
                assert table[name].to_pylist() == log.tables[topic][name].tolist()
