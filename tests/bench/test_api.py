"""The Python API gives what the commands print, on the same log."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from numpy.testing import assert_array_equal

from emb_bench import api
from emb_bench.cli import replay
from emb_runtime.cli import main as emb_run
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.errors import UsageError


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("api") / "run.mcap"
    api.simulate(path, plant="exact", parameters={"f_v": 3e-5}, seed=2)
    return path


def printed(capsys: pytest.CaptureFixture[str], exit_code: int) -> Any:
    assert exit_code == 0
    return json.loads(capsys.readouterr().out)


def test_a_simulated_run_is_that_of_emb_run(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "run.mcap"
    found = printed(capsys, emb_run.main(["--iface", "sim:plant=exact,f_v=3e-5,seed=2", "--log", str(other), "--json"]))
    run = api.open_run(log)
    assert (run.exit_reason, found["result"]) == ("DONE", "done")
    assert run.truth is not None
    assert run.truth.f_v == 3e-5
    sent = "sent_current"  # NaN where none was sent
    assert_array_equal(run.cycles[sent], api.open_run(other).cycles[sent])


def test_nothing_that_is_handed_on_says_where_its_user_keeps_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "Müller's own"
    (folder / "runs").mkdir(parents=True)
    (folder / "my.toml").write_text(shipped_bench_text(), encoding="utf-8")
    typed = ["--iface", "sim:seed=2", f"--bench={folder}/my.toml", "--log", f"{folder}/runs/a.mcap", "--serial", "8/15"]
    monkeypatch.setattr("sys.argv", [f"{folder}/bin/emb-run", *typed])
    assert emb_run.main() == 0
    api.simulate(folder / "runs" / "b.mcap")
    monkeypatch.chdir(folder)
    api.report("runs/a.mcap", "page.html")
    assert replay.main(["export", "runs/a.mcap", "-o", "a.parquet"]) == 0
    assert replay.main(["campaign", "runs", "-o", "rows.parquet", "--jobs", "1"]) == 0
    capsys.readouterr()
    assert replay.main(["info", "runs/a.mcap", "--json"]) == 0
    said = [str(api.open_run(log).metadata) for log in sorted(Path("runs").glob("*.mcap"))]
    assert "emb-run --iface sim:seed=2 --bench=my.toml --log a.mcap --serial 8/15" in said[0]
    assert "emb-run --iface sim:plant=exact,seed=1 --log b.mcap" in said[1]
    tables = [pq.read_table(name) for name in ("a.parquet", "rows.parquet")]
    said += [f"{table.schema.metadata}{table.to_pylist()[0]}" for table in tables]
    said += [Path("page.html").read_text(encoding="utf-8"), capsys.readouterr().out]
    assert [text for text in said if "own/" in text or str(tmp_path) in text] == []


def test_a_log_s_bench_is_replaced_by_one_of_the_same_sample_time_only(log: Path, tmp_path: Path) -> None:
    text = api.open_run(log).bench.text
    same, slower = tmp_path / "same.toml", tmp_path / "slower.toml"
    same.write_text(text.replace("[noise]", "[noise]\n", 1), encoding="utf-8")
    slower.write_text(text.replace("sample_time = 1.0e-3", "sample_time = 1.1e-3"), encoding="utf-8")
    run = api.open_run(log)
    assert api.fisher_information(run, bench=same).fisher("physical").matrix.tolist() == (
        api.fisher_information(run).fisher("physical").matrix.tolist()
    )
    with pytest.raises(UsageError, match="at least one run"):
        api.estimate([])
    with pytest.raises(UsageError, match="sample time"):
        api.fisher_information(run, bench=slower)


def test_a_topic_is_the_table_that_emb_replay_export_writes(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "estimate.parquet"
    assert replay.main(["export", str(log), "--topic", "/estimate", "-o", str(path)]) == 0
    found = api.topic(api.open_run(log), "/estimate")
    assert found.equals(pq.read_table(path), check_metadata=True)
    assert found.schema.field("f_v").metadata == {b"unit": "N·m·s/rad".encode()}
    with pytest.raises(UsageError, match="/nothing"):
        api.topic(api.open_run(log), "/nothing")


def test_a_run_is_drawn_on_axes_of_the_caller(log: Path) -> None:
    run, axes = api.open_run(log), Figure().subplots(5, sharex=True)
    api.draw(run, axes)
    assert_array_equal(axes[0].lines[0].get_ydata(), run.cycles["angle"])
    with pytest.raises(UsageError, match="5 axes"):
        api.draw(run, axes[:4])


def test_the_interval_of_an_information_is_that_of_fim(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = printed(capsys, replay.main(["fim", str(log), "--json"]))["estimate"]
    interval = api.interval(api.fisher_information(log))
    assert dict(zip(interval.names, interval.between_runs.tolist(), strict=True)) == found["between_runs"]
    assert (interval.of_comparison, interval.of_repeatability) == (found["T"], found["I"])
