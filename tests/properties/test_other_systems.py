"""What works without Linux: everything but a bus. The system that is run on plays one that has less."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from emb_bench.logs.log import read_log
from emb_runtime.config.bench import parse_bench, shipped_bench_text
from tests.actors import constant_actor
from tests.bench.linear_machine import MAP, Machine, record
from tests.drives import EXAMPLES
from tests.runtime.drives.mapped import late_bench

ROOT = Path(__file__).parents[2]
SYSTEMS = ["darwin", "win32"]
pytestmark = pytest.mark.slow  # those systems themselves are played at night, too


def run(system: str, *command: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "tests.other_system", system, *map(str, command)]
    environment = {**os.environ, "PYTHONPATH": str(EXAMPLES)}  # which registers sim-drive
    return subprocess.run(line, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=300)


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


def test_a_recording_of_another_machine_is_imported_and_evaluated(tmp_path: Path) -> None:
    system, log = "win32", tmp_path / "servo.mcap"  # the other one has more
    rows = zip(*(column.tolist() for column in record(Machine(), 2.0)), strict=True)
    (tmp_path / "servo.csv").write_text("t,x,F\n" + "".join(f"{t!r},{x!r},{f!r}\n" for t, x, f in rows))
    (tmp_path / "servo.toml").write_text(MAP.replace("window = 0.5", "window = 0.05"))
    done(system, "emb-replay", "import", tmp_path / "servo.csv", "--map", tmp_path / "servo.toml", "-o", log)
    estimate = json.loads(done(system, "emb-replay", "estimate", log, "--json", "--starts", "1"))
    assert estimate["theta"]["J"] > 0.0
    done(system, "emb-replay", "report", log, "-o", tmp_path / "report.html", "--starts", "1")


def test_a_simulated_drive_is_run_through_its_mapping_and_a_real_one_needs_linux(tmp_path: Path) -> None:
    bench = tmp_path / "late.toml"
    bench.write_text(late_bench())
    iface = f"map:{EXAMPLES / 'odrive.toml'}@sim-drive:odrive"
    policy = tmp_path / "constant.onnx"
    policy.write_bytes(constant_actor(parse_bench(late_bench(), "late.toml"), 6.0))
    arguments = ["--bench", bench, "--policy", policy, "--log", tmp_path / "run.mcap"]
    assert json.loads(done("win32", "emb-run", "--iface", iface, *arguments, "--json"))["answered"] == 500
    buses = ["--drive", "can0", "--node", "vcan0", "--serial", "7", "--yes"]
    ended = run("win32", "emb-gateway", EXAMPLES / "odrive.toml", "--bench", bench, *buses)
    assert ended.returncode == 2
    assert "a bus needs Linux" in ended.stderr


def test_a_commissioning_goes_from_step_to_step(tmp_path: Path) -> None:
    """Up to the one that contradicts this data sheet: the brake is not as late as it may be."""
    sheet, folder = tmp_path / "sheet.toml", tmp_path / "brake"
    sheet.write_text(shipped_bench_text())
    ended = run("win32", "emb-commission", folder, "--iface", "sim:plant=late", "--bench", sheet)
    assert ended.returncode == 3, ended.stderr
    assert "commands act 1 samples late" in ended.stderr.splitlines()[-1]
    assert {path.name for path in folder.glob("*.mcap")} == {"1-listen.mcap", "2-zero.mcap", "3-current.mcap"}


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


def test_an_excitation_is_designed_learned_and_exported(tmp_path: Path) -> None:
    system = "win32"  # the other one has more
    bench = tmp_path / "short.toml"
    bench.write_text(shipped_bench_text().replace("horizon     = 500", "horizon     = 50"), encoding="utf-8")
    fixed = ["--bench", bench, "--starts", "1", "--params", "k_m,T_c", "--model", "euler"]
    done(system, "emb-design", *fixed, "-o", tmp_path / "design.csv")
    done(system, "emb-train", "ppo", "single-viscous", "--bench", bench, "--steps", "1", "--out", tmp_path / "run")
    done(system, "emb-export", tmp_path / "run", "--out", tmp_path / "actor.onnx")
    assert (tmp_path / "actor.onnx").stat().st_size > 1000
