from __future__ import annotations

from pathlib import Path

from emb_bench.analysis.study import Study, StudyOptions, make_study
from emb_bench.config.bench import Bench
from emb_bench.estimate.records import EstimationProblem
from emb_bench.logs.log import read_log
from emb_bench.report.estimate import text
from emb_bench.report.sentences import apart

from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip


def study_of_two(bench: Bench, folder: Path, simulate: Simulate, second: str) -> Study:
    logs = [
        read_log(write_log(folder / f"{i}.mcap", simulate(square, options=options)))
        for i, options in enumerate(("plant=exact,seed=1", second))
    ]
    return make_study(bench, logs, StudyOptions(EstimationProblem(), starts=2, model="exact"))


def test_two_brakes_in_one_call_are_said_to_fit_each_alone(bench: Bench, tmp_path: Path, simulate: Simulate) -> None:
    study = study_of_two(bench, tmp_path, simulate, "plant=exact,seed=2,k_m=0.0225")
    assert study.apart[0].name == "k_m"
    assert " ".join(apart(study).split()) in " ".join(text(study).split())


def test_one_brake_in_two_runs_and_one_that_the_model_does_not_know_are_not(
    bench: Bench, tmp_path: Path, simulate: Simulate
) -> None:
    for second in ("plant=exact,seed=2", "plant=stribeck,seed=2"):
        assert study_of_two(bench, tmp_path, simulate, second).apart == ()
