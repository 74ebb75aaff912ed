"""A run of emb-run whose shield learns, from the bench file to the log, its summary and its report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from emb_bench.logs.estimates import last_learnt, learnt_by_step
from emb_bench.logs.log import read_log
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text
from emb_runtime.errors import BenchFileError, LogError
from tests.bench.conftest import Log, Replay
from tests.bench.damaged import rewritten, without


@pytest.fixture
def bench_file(tmp_path: Path) -> Path:
    path = tmp_path / "learning.toml"
    keys = "learn = true\nmodel_error = 5.0\n"
    path.write_text(shipped_bench_text().replace("[shield]", f"[shield]\n{keys}#"), encoding="utf-8")
    return path


@pytest.fixture
def learnt_log(tmp_path: Path, bench_file: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    path = tmp_path / "run.mcap"
    run = ["--iface", "sim:plant=exact,k_m=0.025", "--bench", str(bench_file), "--log", str(path)]
    assert emb_run([*run, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    low, high = said["learnt"]["k_m"]
    assert 0.9 < low < 0.025 / 2.17e-2 < high < 1.4
    (line,) = [line for line in said["preflight"] if line["what"] == "learning"]
    assert "model flow, model error 5 rad/s²" in line["found"]
    assert "an observer" in line["expected"]
    return path


def test_every_cycle_s_set_is_in_the_log_and_holds_the_true_brake(learnt_log: Path, replay: Replay) -> None:
    log = read_log(learnt_log)
    assert list(learnt_by_step(log)) == list(range(500))
    numbers = np.array([*learnt_by_step(log).values()])
    assert numbers.shape == (500, 13)
    truth = np.array([0.025 / 2.17e-2, 1.0, 1.0, 1.0])
    assert (numbers[:, 0:8:2] <= truth).all()
    assert (truth <= numbers[:, 1:8:2]).all()
    assert last_learnt(log) == {n: [*numbers[-1, 2 * i : 2 * i + 2]] for i, n in enumerate(PARAMETER_NAMES)}
    assert {key: log.run[key] for key in ("model", "model_error", "current_error")} == {
        "model": "flow",
        "model_error": "5.0",
        "current_error": "0.001",
    }
    assert json.loads(log.end["learnt"])["k_m"] == pytest.approx(numbers[-1, :2], abs=0.1)
    assert replay.document("rerun", learnt_log)["reproduced"]
    assert replay.document("info", learnt_log)["learnt"] == last_learnt(log)
    assert "learnt       k_m " in replay.text("info", learnt_log)


def test_a_report_shows_the_set_that_is_left(learnt_log: Path, tmp_path: Path, replay: Replay) -> None:
    page = tmp_path / "page.html"
    replay.text("report", learnt_log, "--output", page)
    text = page.read_text(encoding="utf-8")
    assert "What the shield learnt" in text
    low, high = last_learnt(read_log(learnt_log))["k_m"]
    assert f"<dt>k_m</dt><dd>{low:.4f} to {high:.4f} of nominal</dd>" in text
    assert "model error 5.0 rad/s²" in text


def test_a_log_without_a_bound_that_was_learnt_is_refused(learnt_log: Path) -> None:
    rewritten(learnt_log, without("/learnt", "k_m_low"))
    for asked in (learnt_by_step, last_learnt):
        with pytest.raises(LogError, match="expected k_m_low"):
            asked(read_log(learnt_log))


def test_a_log_of_a_shield_that_learns_nothing_has_no_such_topic(log: Log, replay: Replay) -> None:
    path = log("plain.mcap")
    found = read_log(path)
    assert learnt_by_step(found) == {}
    assert last_learnt(found) == {}
    assert "learnt" not in replay.document("info", path)


def test_a_bench_that_does_not_grant_what_learning_needs_is_refused(
    bench_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = bench_file.read_text(encoding="utf-8").replace("frame_age     = [0, 0]", "frame_age     = [0, 1]")
    bench_file.write_text(text, encoding="utf-8")
    log = tmp_path / "run.mcap"
    assert emb_run(["--iface", "sim", "--bench", str(bench_file), "--log", str(log)]) == BenchFileError.exit_code
    assert "shield.learn: expected shield.frame_age = [0, 0]" in capsys.readouterr().err
    assert not log.exists()
