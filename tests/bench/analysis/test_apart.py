from __future__ import annotations

from pathlib import Path

from emb_bench.analysis.study import StudyOptions, make_study
from emb_bench.estimate.records import EstimationProblem
from emb_bench.logs.log import read_log
from emb_bench.report.estimate import document, text
from emb_runtime.config.bench import Bench

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip


def said(bench: Bench, folder: Path, simulate: Simulate, second: str) -> tuple[list[str], str]:
    logs = [
        read_log(write_log(folder / f"{i}.mcap", simulate(square, options=options)))
        for i, options in enumerate(("plant=exact,seed=1", second))
    ]
    study = make_study(bench, logs, StudyOptions(EstimationProblem(), starts=2, model="exact"))
    return [one["name"] for one in document(study)["apart"]], " ".join(text(study).split())


def test_two_brakes_in_one_call_are_said_to_fit_each_alone(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    names, words = said(bench, tmp_path, simulate, "plant=exact,seed=2,k_m=0.0225")
    assert names[0] == "k_m"
    assert "each log fits alone, but not with the others" in words
    assert "take each log's own values" in words
    assert "find the plant" not in words


def test_one_brake_in_two_runs_is_not(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    names, words = said(bench, tmp_path, simulate, "plant=exact,seed=2")
    assert names == []
    assert "each log fits alone" not in words


def test_a_brake_that_the_model_does_not_know_is_no_second_brake(
    bench: Bench, tmp_path: Path, simulate: Simulate
) -> None:
    assert said(bench, tmp_path, simulate, "plant=stribeck,seed=2")[0] == []
