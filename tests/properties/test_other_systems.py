"""What works without Linux: everything but a bus. The system that is run on plays one that has less."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from emb_bench.logs.log import read_log

ROOT = Path(__file__).parents[2]
SYSTEMS = ["darwin", "win32"]
pytestmark = pytest.mark.slow  # those systems themselves are played at night, too


def run(system: str, *command: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "tests.other_system", system, *map(str, command)]
    return subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False, timeout=300)


def done(system: str, *command: object) -> str:
    ended = run(system, *command)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


@pytest.mark.parametrize("system", SYSTEMS)
def test_every_module_can_be_imported(system: str) -> None:
    done(system, "import")


def test_a_simulated_run_is_the_same_and_its_log_is_evaluated(tmp_path: Path) -> None:
    system = "win32"  # the other one has more
    here, there = tmp_path / "here.mcap", tmp_path / "there.mcap"
    done(system, "emb-run", "--iface", "sim", "--log", there)
    code = "import sys; from emb_runtime.system.entry import emb_run; sys.exit(emb_run())"
    subprocess.run([sys.executable, "-c", code, "--iface", "sim", "--log", here], check=True, capture_output=True)
    ours, theirs = read_log(here), read_log(there)
    assert theirs.complete
    assert len(theirs.frames) > 1500
    assert [f.data for f in theirs.frames] == [f.data for f in ours.frames]
    assert "answered" in done(system, "emb-replay", "info", there)
    done(system, "emb-replay", "fim", there)
    estimate = json.loads(done(system, "emb-replay", "estimate", there, "--json", "--starts", "1"))
    assert estimate["model_fits"] is True
    done(system, "emb-replay", "report", there, "-o", tmp_path / "report.html")
    done(system, "emb-replay", "campaign", there, "-o", tmp_path / "rows.parquet", "--jobs", "1")
    assert len(pq.read_table(tmp_path / "rows.parquet")) == 1


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["emb-run", "--iface", "can0"], "--iface can0: a bus needs Linux"),
        (["emb-run", "--iface", "sim", "--live"], "--live: needs Linux"),
        (["emb-hil", "--", "true"], "emb-hil: needs Linux"),
    ],
)
def test_what_needs_linux_says_so_in_one_line(system: str, command: list[str], said: str, tmp_path: Path) -> None:
    log = ["--log", tmp_path / "run.mcap"] if command[0] == "emb-run" else []
    ended = run(system, *command[:1], *log, *command[1:])
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert said in ended.stderr
