from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.conftest import Replay  # isort: skip
from tests.bench.simulated_logs import square, write_log  # isort: skip
from tests.bench.experiment.test_experiment import Lose  # isort: skip
from tests.conftest import Simulate  # isort: skip


@pytest.fixture
def replay(capsys: pytest.CaptureFixture[str]) -> Replay:
    """With two local searches unless more are asked for: most brakes here need one."""
    return Replay(capsys, ("estimate", "--starts", "2"))


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, simulate: Simulate) -> Path:
    run = simulate(square, options="plant=exact,f_v=3e-5,T_c=1.2e-2,seed=5")
    return write_log(tmp_path_factory.mktemp("estimate") / "run.mcap", run)


def test_a_gap_that_hides_what_acted_is_said(tmp_path: Path, simulate: Simulate, replay: Replay) -> None:
    run = simulate(square, options="plant=exact,seed=7", on_receive=Lose(120, 121, 122, 300))
    path = write_log(tmp_path / "gap.mcap", run)
    got = replay.document(path)
    assert got["model_fits"]
    assert (len(got["caveats"]), len(got["warnings"])) == (2, 1)  # of single periods, and of gaps
    assert f"WARNING: {got['warnings'][0]}"[:60] in replay.text(path)
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
