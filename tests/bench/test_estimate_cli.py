from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.estimate.records import record_of
from emb_bench.experiment import read_experiment
from emb_bench.log import read_log
from emb_bench.replay import main
from emb_runtime.bench import PARAMETER_NAMES, Bench

from tests.bench.logs import square, write_log  # isort: skip
from tests.bench.test_experiment import Lose  # isort: skip
from tests.conftest import Simulate  # isort: skip


@pytest.fixture
def path(tmp_path: Path, simulate: Simulate) -> Path:
    return write_log(tmp_path / "run.mcap", simulate(square, options="plant=exact,f_v=3e-5,T_c=1.2e-2,seed=5"))


def say(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["estimate", *map(str, arguments)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return out


def document(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> dict[str, Any]:
    parsed: dict[str, Any] = json.loads(say(capsys, *arguments, "--json"))
    return parsed


def complaint(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main(["estimate", *map(str, arguments)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err


def test_a_run_on_the_simulated_bus_gives_back_the_brake_that_was_simulated(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    got = document(capsys, path)
    assert (got["model"], got["model_fits"], got["warnings"], got["told"]) == ("exact", True, [], True)
    assert list(got["parameters"]) == list(PARAMETER_NAMES)
    assert got["parameters"]["f_v"]["true"] == 3e-5
    for found in got["parameters"].values():
        assert abs(found["value"] / found["true"] - 1.0) < 4.0 * found["deviation"] < 0.02
        low, high = found["interval_95"]
        assert high - low == pytest.approx(2.0 * 1.959964 * found["deviation"] * found["value"])
        assert 0.5 < found["sandwich"] / found["cramer_rao"] < 2.0
        assert not found["at_bound"]
    assert len(got["starts"]) == 8
    assert np.diag(got["correlation"]["matrix"]).tolist() == [1.0] * 4
    low, high = got["misfit"]["expected"]
    assert low < got["misfit"]["chi2_per_freedom"] < high


def test_the_verdict_on_the_model_comes_before_any_number(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = say(capsys, path).splitlines()
    assert good[0].startswith("the model 'exact' may be the right one")
    assert not any("WARNING" in line for line in good)
    rows = {line.split()[0]: line for line in good if line.startswith(PARAMETER_NAMES)}
    assert list(rows) == list(PARAMETER_NAMES)
    assert all("identified; " in row and "simulated" in row for row in rows.values())
    bad = say(capsys, path, "--model", "lag")
    assert bad.startswith("WARNING: THE MODEL 'lag' DOES NOT FIT")
    assert bad.index("the residuals are too large") < bad.index("parameter ")
    assert document(capsys, path, "--model", "lag")["model_fits"] is False


def test_a_model_that_does_not_fit_says_what_it_may_lack(
    tmp_path: Path, simulate: Simulate, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_log(tmp_path / "offset.mcap", simulate(square, options="plant=offset"))
    text = say(capsys, path, "--model", "exact")
    assert "the residuals look like, each to first order: contact +0." in text
    mended = document(capsys, path, "--model", "exact", "--nuisance", "offset")
    assert mended["model_fits"]
    found = mended["parameters"]["offset"]
    assert abs(found["value"] - 0.2) < 4.0 * found["deviation"]
    assert (found["unit"], found["deviation_relative"], "true" in found) == ("rad", False, False)
    assert document(capsys, path)["model"] == "offset"


def test_two_logs_of_one_brake_tell_more_than_one(
    tmp_path: Path, path: Path, simulate: Simulate, capsys: pytest.CaptureFixture[str]
) -> None:
    options = "plant=exact,f_v=3e-5,T_c=1.2e-2,seed=6"
    other = write_log(tmp_path / "other.mcap", simulate(square, options=options))
    one = document(capsys, path, "--nuisance", "x1_0")
    both = document(capsys, path, other, "--nuisance", "x1_0", "--starts", "2")
    assert list(both["parameters"])[4:] == ["x1_0[0]", "x1_0[1]"]
    assert both["model_fits"]
    assert len(both["starts"]) == 2
    for name in PARAMETER_NAMES:
        gain = one["parameters"][name]["cramer_rao"] / both["parameters"][name]["cramer_rao"]
        assert gain == pytest.approx(2**0.5, rel=0.05)
    assert "x1_0[1]" in say(capsys, path, other, "--nuisance", "x1_0", "--starts", "1")


def test_what_is_not_identified_has_no_interval_and_is_named_with_its_combination(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Torques and inertia scale together."""
    text = say(capsys, path, "--nuisance", "J", "--starts", "2")
    assert text.count("NOT identified") == 5
    assert "flat: +0.447 k_m +0.447 k_1 +0.447 T_c +0.447 f_v +0.447 J leaves no trace in the data" in text
    got = document(capsys, path, "--nuisance", "J", "--starts", "2")
    assert not got["told"]
    assert all(found["interval_95"] == [None, None] for found in got["parameters"].values())


def test_lost_samples_are_said_first_and_left_out(
    tmp_path: Path, simulate: Simulate, bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    run = simulate(square, options="plant=exact,seed=7", on_receive=Lose(120, 125, 300))
    path = write_log(tmp_path / "lossy.mcap", run)
    text = say(capsys, path)
    assert text.startswith("WARNING: 3 samples were lost")
    assert "497 of 500 samples" in text
    got = document(capsys, path)
    assert got["misfit"]["freedom"] == 2 * 497 - 4
    assert got["model_fits"]
    record = record_of("x", read_experiment(read_log(path)), bench, bench.plant("exact"))
    assert np.isnan(record.samples).all(axis=1).sum() == 3
    assert record.measured.sum() == 497


def test_a_gap_that_hides_what_acted_is_said(
    tmp_path: Path, simulate: Simulate, capsys: pytest.CaptureFixture[str]
) -> None:
    run = simulate(square, options="plant=exact,seed=7", on_receive=Lose(120, 121, 122, 300))
    path = write_log(tmp_path / "gap.mcap", run)
    warnings = document(capsys, path)["warnings"]
    assert len(warnings) == 2
    assert warnings[1].startswith("2 periods lie between lost samples: what acted in them is assumed")


def test_a_prior_is_named_and_counts(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "prior        the ranges 'pm50'" in say(capsys, path, "--prior", "pm50", "--starts", "1")
    free, held = document(capsys, path), document(capsys, path, "--prior", "pm50")
    assert (free["prior"], held["prior"]) == (None, "pm50")
    for name, found in free["parameters"].items():
        shift = abs(held["parameters"][name]["value"] - found["value"]) / found["value"]
        assert 0.0 < shift < 0.1 * found["deviation"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--params", "mass"], "'mass' is no parameter"),
        (["--params", ""], "at least one parameter"),
        (["--nuisance", "cubic"], "'cubic' is not estimated"),
        (["--starts", "0"], "--starts: expected a number from 1, got 0"),
        (["--seed", "-1"], "--seed: expected a number from 0, got -1"),
        (["--model", "rubber"], "no plant is called 'rubber'"),
        (["--prior", "none"], "no set of ranges is called 'none'"),
        (["--model", "euler", "--nuisance", "delay"], "a delay is estimated with"),
    ],
)
def test_a_wrong_argument_is_one_line(
    path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert message in complaint(capsys, path, *arguments)


def test_logs_of_different_brakes_need_a_model_that_is_said(
    tmp_path: Path, path: Path, simulate: Simulate, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_log(tmp_path / "other.mcap", simulate(square, options="plant=stribeck"))
    assert "(exact, stribeck): say which model to use" in complaint(capsys, path, other)
    assert "DOES NOT FIT" in say(capsys, path, other, "--model", "exact", "--starts", "1")


def test_without_scipy_and_numba_the_other_commands_work_and_this_one_says_what_to_install(path: Path) -> None:
    """As on the bench computer."""
    code = (
        "import sys\n"
        "sys.modules['scipy'] = sys.modules['numba'] = None\n"
        "from emb_bench.replay import main\n"
        f"assert main(['info', {str(path)!r}]) == 0\n"
        f"sys.exit(main(['estimate', {str(path)!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr == "emb-replay: emb-replay estimate needs scipy and numba: install emb-excite[bench]\n"
