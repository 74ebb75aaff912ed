"""Acceptance criteria: what is read of the file, and when each is passed, failed or not decided."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import pytest

from emb_bench.analysis.drift import Earlier
from emb_bench.analysis.options import EstimateOptions
from emb_bench.analysis.stages import make_study
from emb_bench.analysis.study import Result, Study
from emb_bench.cli.replay import main
from emb_bench.config.bench import load_bench
from emb_bench.experiment.experiment import Experiment
from emb_bench.logs.log import read_log
from emb_bench.report.acceptance import accept, read_criteria
from emb_bench.report.estimate import study_document
from emb_runtime.errors import UsageError

from tests.bench.conftest import Replay  # isort: skip
from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.conftest import Simulate  # isort: skip
from tests.benches import SENSOR_BENCH


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    folder = tmp_path_factory.mktemp("acceptance")
    write_log(folder / "good.mcap", simulate(square, options="plant=exact,f_v=3e-5,seed=5"))
    write_log(folder / "other.mcap", simulate(square, options="plant=stribeck,seed=4"))

    def fails(angle: float, velocity: float, step: float) -> float:
        return math.nan if step >= 120 else square(angle, velocity, step)

    write_log(folder / "aborted.mcap", simulate(fails, options="plant=exact,seed=5"))
    return folder


def study_of(path: Path, model: str | None = None, last: Any = None) -> Study:
    options = EstimateOptions(starts=1, model=model)
    return make_study(SENSOR_BENCH, [read_log(path)], options, last=last)


@pytest.fixture(scope="module")
def study(folder: Path) -> Study:
    return study_of(folder / "good.mcap")


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "criteria.toml"
    path.write_text(f"[acceptance]\n{text}\n", encoding="utf-8")
    return path


def results(tmp_path: Path, text: str, study: Study) -> dict[str, Result]:
    found = accept(read_criteria(written(tmp_path, text)), "criteria.toml", study, [])
    assert all(bool(one.why) == (one.result is not Result.PASS) for one in found.results)
    return {one.name: one.result for one in found.results}


def test_an_interval_passes_inside_fails_outside_and_decides_nothing_across_a_limit(
    tmp_path: Path, study: Study
) -> None:
    low, high = next(c.interval for c in study.conclusions if c.label == "f_v")
    width = high - low
    limits = {
        (low - width, high + width): Result.PASS,
        (low - 2 * width, low - width): Result.FAIL,
        (high + width, high + 2 * width): Result.FAIL,
        (low + 0.1 * width, high + width): Result.CANNOT_TELL,
        (low + 0.1 * width, high - 0.1 * width): Result.CANNOT_TELL,
    }
    for (a, b), expected in limits.items():
        assert results(tmp_path, f"parameters.f_v.interval = [{a!r}, {b!r}]", study)["f_v"] is expected


def test_a_relative_tolerance_is_of_nominal_or_of_its_reference(tmp_path: Path, study: Study) -> None:
    assert load_bench().brake.f_v == pytest.approx(2.16e-5)  # the brake has 3e-5, 39 % more
    for relative, expected in ((0.5, Result.PASS), (0.3, Result.FAIL)):
        assert results(tmp_path, f"parameters.f_v.relative = {relative}", study)["f_v"] is expected
    assert results(tmp_path, "parameters.f_v = {relative = 0.05, reference = 3e-5}", study)["f_v"] is Result.PASS


def test_drift_is_judged_against_an_earlier_estimate_and_not_without_one(
    tmp_path: Path, folder: Path, study: Study
) -> None:
    last = msgspec.convert(study_document(study), Earlier)
    k_1 = last.parameters["k_1"]
    moved = {**last.parameters, "k_1": msgspec.structs.replace(k_1, value=0.9 * k_1.value)}
    changed = msgspec.structs.replace(last, parameters=moved)
    for earlier, expected in ((last, Result.PASS), (changed, Result.FAIL)):
        now = study_of(folder / "good.mcap", last=earlier)
        assert results(tmp_path, "drift.k_1 = 0.01", now)["drift of k_1"] is expected
    doubted = msgspec.structs.replace(changed, model_fits=False)
    now = study_of(folder / "good.mcap", last=doubted)
    doubtful = results(tmp_path, "drift.k_1 = 0.01", now)
    assert doubtful["drift of k_1"] is Result.CANNOT_TELL
    assert results(tmp_path, "drift.k_1 = 0.01", study)["drift of k_1"] is Result.CANNOT_TELL


def test_a_budget_is_counted_per_run_and_open_where_nothing_was_measured(
    tmp_path: Path, folder: Path, study: Study
) -> None:
    text = "budgets = {missed = 0.0, lost = 0.001}"
    lost = results(tmp_path, text, with_run(study, experiment=without_a_sample(study)))
    assert (lost["missed periods"], lost["lost samples"]) == (Result.PASS, Result.FAIL)
    nothing = replace(study.logs[0], topics={})
    unknown = results(tmp_path, text, with_run(study, log=nothing, experiment=None))
    assert (unknown["missed periods"], unknown["lost samples"]) == (Result.CANNOT_TELL, Result.CANNOT_TELL)


def with_run(study: Study, **changes: Any) -> Study:
    """The study, of a run that is another in some respects."""
    return replace(study, runs=(replace(study.runs[0], **changes),))


def without_a_sample(study: Study) -> Experiment:
    x = study.runs[0].experiment
    assert x is not None
    samples = x.samples.copy()
    samples[7] = math.nan
    return replace(x, samples=samples)


def test_nothing_rests_on_a_model_that_does_not_fit_and_a_misfit_fails(tmp_path: Path, folder: Path) -> None:
    wrong = study_of(folder / "other.mcap", model="exact")
    found = results(tmp_path, "parameters.k_m.relative = 0.9", wrong)
    assert found == {"run completed": Result.PASS, "model fit": Result.FAIL, "k_m": Result.CANNOT_TELL}
    allowed = results(tmp_path, "model_fit = false", wrong)
    assert allowed == {"run completed": Result.PASS}
    none = replace(with_run(wrong, experiment=None, why_not="no experiment"), joint=None, conclusions=())
    assert set(results(tmp_path, "parameters.k_m.relative = 0.9", none).values()) == {Result.PASS, Result.CANNOT_TELL}


def test_a_stopped_run_or_a_log_that_is_not_whole_fails_whatever_the_model_says(tmp_path: Path, study: Study) -> None:
    log = study.logs[0]
    for other in (
        replace(log, metadata={**log.metadata, "emb.end": {"exit_reason": "SENSOR_LOST"}}),
        replace(log, complete=False, missing="cut"),
    ):
        assert results(tmp_path, "", with_run(study, log=other))["run completed"] is Result.FAIL
    left_out = accept(read_criteria(written(tmp_path, "")), "criteria.toml", study, ["x.mcap: left out: no log"])
    assert left_out.result is Result.FAIL


def test_a_wrong_file_is_refused_by_its_key(tmp_path: Path) -> None:
    for text, key in {
        "parameters.mass.relative = 0.1": "acceptance.parameters",
        "parameters.k_m = {}": "acceptance.parameters.k_m",
        "parameters.k_m = {relative = 0.1, interval = [0, 1]}": "acceptance.parameters.k_m",
        "parameters.k_m.relative = -0.1": "acceptance.parameters.k_m.relative",
        "parameters.delay.relative = 0.1": "acceptance.parameters.delay",
        "parameters.k_m = {interval = [0, 1], reference = 2}": "acceptance.parameters.k_m.reference",
        "parameters.k_m.interval = [2, 1]": "acceptance.parameters.k_m.interval",
        "drift.mass = 0.1": "acceptance.drift",
        "drift.k_m = 0": "acceptance.drift.k_m",
        "budgets.missed = 2": "acceptance.budgets.missed",
        "budgets.late = 0.1": "acceptance.budgets.late",
        "model_fit = 1": "acceptance.model_fit",
        "modelfit = true": "acceptance.modelfit",
        "x = [": "TOML",
    }.items():
        with pytest.raises(UsageError, match="--acceptance") as caught:
            read_criteria(written(tmp_path, text))
        assert key in str(caught.value)


SIMULATED = "SIMULATED: the values are of a simulated brake, not of a real machine."


def test_the_command_says_the_result_first_and_has_an_exit_code_for_each(
    tmp_path: Path, folder: Path, replay: Replay
) -> None:
    page = tmp_path / "page.html"

    def said(log: str, text: str, code: int, *more: str) -> str:
        file = written(tmp_path, text)
        arguments = ["report", str(folder / log), "-o", str(page), "--starts", "1", "--acceptance", str(file), *more]
        assert main(arguments) == code
        return json.dumps(json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))["acceptance"])

    assert '"result": "pass"' in said("good.mcap", "parameters.f_v.relative = 0.5", 0, "--strict")
    assert f'class="banner care" role="alert">{SIMULATED} ACCEPTED: all 3 criteria passed' in page.read_text(
        encoding="utf-8"
    )
    junit = ("--junit", str(tmp_path / "cases.xml"))
    assert '"result": "fail"' in said("good.mcap", "parameters.f_v.relative = 0.1", 1, "--strict", *junit)
    assert f'class="banner bad" role="alert">{SIMULATED} NOT ACCEPTED: 1 of 3' in page.read_text(encoding="utf-8")
    assert '"result": "cannot tell"' in said("good.mcap", "drift.k_m = 0.1", 7, "--strict")
    assert f'class="banner care" role="alert">{SIMULATED} CANNOT TELL: 1 of 3' in page.read_text(encoding="utf-8")
    assert "criteria not decided: drift of k_m" in page.read_text(encoding="utf-8")
    said("aborted.mcap", "model_fit = false", 1, "--strict")
    assert f'class="banner bad" role="alert">{SIMULATED} NOT ACCEPTED. STOPPED: ' in page.read_text(encoding="utf-8")
    assert str(page) in replay.refused("report", folder / "good.mcap", "-o", page, "--acceptance", page)
    suite = ElementTree.parse(tmp_path / "cases.xml").getroot()  # our own
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("3", "1", "0")
    assert [case.get("name") for case in suite if case.find("failure") is not None] == ["f_v"]
