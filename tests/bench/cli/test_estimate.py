from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs.log import read_log
from emb_runtime.config.bench import PARAMETER_NAMES, Bench

from tests.bench.conftest import Log, Replay  # isort: skip
from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.bench.experiment.test_experiment import Lose  # isort: skip
from tests.conftest import FunctionActor, Simulate  # isort: skip


@pytest.fixture
def replay(capsys: pytest.CaptureFixture[str]) -> Replay:
    """With two local searches unless more are asked for: most brakes here need one."""
    return Replay(capsys, ("estimate", "--starts", "2"))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    run = simulate(square, options="plant=exact,f_v=3e-5,T_c=1.2e-2,seed=5")
    return write_log(tmp_path_factory.mktemp("estimate") / "run.mcap", run)


def test_a_run_on_the_simulated_bus_gives_back_the_brake_that_was_simulated(path: Path, replay: Replay) -> None:
    got = replay.document(path, "--starts", "8")
    assert (got["model"], got["model_fits"], got["warnings"], got["identified"]) == ("exact", True, [], True)
    assert list(got["parameters"]) == list(PARAMETER_NAMES)
    assert got["parameters"]["f_v"]["true"] == 3e-5
    for found in got["parameters"].values():
        assert abs(found["value"] / found["true"] - 1.0) < 4.0 * found["deviation_between_runs"] < 0.05
        low, high = found["interval_95"]
        assert high - low == pytest.approx(2.0 * 1.959964 * found["deviation"] * found["value"])
        assert 0.5 < found["sandwich"] / found["cramer_rao"] < 2.0
        assert not found["at_bound"]
    assert len(got["starts"]) == 8
    assert np.diag(got["correlation"]["matrix"]).tolist() == [1.0] * 4
    low, high = got["misfit"]["expected"]
    assert low < got["misfit"]["chi2_per_freedom"] < high


def test_a_model_that_does_not_fit_says_what_it_may_lack(log: Log, replay: Replay) -> None:
    gentle = FunctionActor(lambda *sample: 0.8 * square(*sample))  # no angle below contact, which would tell the offset
    path = log("offset.mcap", "plant=offset", actor=gentle)
    misfit = replay.document(path, "--model", "exact", "--systematic", "none")["misfit"]
    first = misfit["cause"]["suspect"]
    assert (first["name"] in ("contact", "offset"), first["value"] > 0.0) == (True, True)
    along = replay.document(path, "--model", "exact")
    assert along["model_fits"]
    for one in along["parameters"].values():
        assert abs(one["value"] - one["true"]) < 4.0 * one["deviation_between_runs"] * one["value"]
    found = replay.document(path, "--model", "exact", "--nuisance", "offset")["parameters"]["offset"]
    assert abs(found["value"] - 0.2) < 4.0 * found["deviation"]
    assert (found["unit"], found["deviation_relative"], "true" in found) == ("rad", False, False)
    assert replay.document(path)["model"] == "offset"


def test_two_logs_of_one_brake_tell_more_than_one(path: Path, log: Log, replay: Replay) -> None:
    options = "plant=exact,f_v=3e-5,T_c=1.2e-2,seed=6"
    other = log("other.mcap", options)
    ideal = ("--nuisance", "x1_0", "--systematic", "none")
    alone = [replay.document(one, *ideal)["parameters"] for one in (path, other)]
    both = replay.document(path, other, *ideal, "--starts", "2")
    assert list(both["parameters"])[4:] == ["x1_0[0]", "x1_0[1]"]
    assert both["model_fits"]
    assert len(both["starts"]) == 2
    for name in PARAMETER_NAMES:
        information = sum(found[name]["cramer_rao"] ** -2 for found in alone)
        assert both["parameters"][name]["cramer_rao"] == pytest.approx(information**-0.5, rel=0.05)


def test_repeatability_is_the_scatter_of_further_runs_and_less_than_the_total(path: Path, replay: Replay) -> None:
    """By noise alone, so with systematic errors excluded it is all of the Cramér-Rao bound."""
    got = replay.document(path, "--starts", "1")["parameters"]
    ideal = replay.document(path, "--starts", "1", "--systematic", "none")["parameters"]
    for name, found in got.items():
        total = 0.5 * (found["interval_95"][1] - found["interval_95"][0])
        assert 0.0 < found["repeatability"] < 1.96 * found["cramer_rao"] * found["value"] <= total
        bound = 1.96 * ideal[name]["cramer_rao"] * ideal[name]["value"]
        assert ideal[name]["repeatability"] == pytest.approx(bound, rel=1e-4)


def test_lost_samples_are_said_first_and_left_out(
    tmp_path: Path, simulate: Simulate, bench: Bench, replay: Replay
) -> None:
    run = simulate(square, options="plant=exact,seed=7", on_receive=Lose(120, 125, 300))
    path = write_log(tmp_path / "lossy.mcap", run)
    got = replay.document(path)
    assert got["warnings"][0].startswith("3 samples were lost")
    # Parameters, systematic errors with the true start, and the currents of the periods whose reports were lost.
    assert got["misfit"]["freedom"] == 2 * 497 - 4 - 5 - 3
    assert got["model_fits"]
    record = read_experiment(read_log(path))
    assert np.isnan(record.samples).all(axis=1).sum() == 3
    assert record.measured.sum() == 497


def test_a_gap_that_hides_what_acted_is_said(tmp_path: Path, simulate: Simulate, replay: Replay) -> None:
    run = simulate(square, options="plant=exact,seed=7", on_receive=Lose(120, 121, 122, 300))
    path = write_log(tmp_path / "gap.mcap", run)
    got = replay.document(path)
    assert got["model_fits"]
    assert (len(got["caveats"]), len(got["warnings"])) == (2, 1)  # of single periods, and of gaps
    assumed = replay.document(path, "--method", "windows", "--window", "0.04")["warnings"]
    assert "4 periods" in assumed[1]
    assert len(replay.document(path, "--method", "rls")["warnings"]) == 1


def test_a_prior_is_named_and_counts(path: Path, replay: Replay) -> None:
    free, held = replay.document(path), replay.document(path, "--prior", "pm50")
    assert (free["prior"], held["prior"]) == (None, "pm50")
    for name, found in free["parameters"].items():
        shift = abs(held["parameters"][name]["value"] - found["value"]) / found["value"]
        assert 0.0 < shift < 0.1 * found["deviation"]


def test_strict_fails_where_the_model_does_not_fit_or_something_is_not_identified(path: Path, replay: Replay) -> None:
    replay.text(path, "--strict")
    for arguments in (("--model", "lag"), ("--nuisance", "J")):
        replay.text(path, "--strict", "--starts", "1", *arguments, code=1)


def test_profiles_come_when_asked_for(path: Path, replay: Replay) -> None:
    got = replay.document(path, "--profile", "--starts", "1")
    assert [(p["label"], p["doubt"]) for p in got["profiles"]] == [(name, None) for name in PARAMETER_NAMES]
    for found, profile in zip(got["parameters"].values(), got["profiles"], strict=True):
        (low, high), (first, last) = found["interval_95"], profile["interval_95"]
        assert low <= first < last <= high  # it allows for suspects that were not noticed, too
    ideal = replay.document(path, "--profile", "--starts", "1", "--systematic", "none")
    for found, profile in zip(ideal["parameters"].values(), ideal["profiles"], strict=True):
        assert found["interval_95"] == profile["interval_95"]


def test_without_scipy_and_numba_the_other_commands_work_and_this_one_says_what_to_install(path: Path) -> None:
    """As on the bench computer; and a report without matplotlib."""
    report = ["report", str(path), "-o", str(path.with_suffix(".html"))]
    for missing, command in ((("scipy", "numba"), ["estimate", str(path)]), (("matplotlib",), report)):
        code = (
            "import sys\n"
            f"sys.modules |= dict.fromkeys({missing})\n"
            "from emb_bench.cli.replay import main\n"
            f"assert main(['info', {str(path)!r}]) == 0\n"
            f"sys.exit(main({command}))"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert "'.[bench]'" in done.stderr
