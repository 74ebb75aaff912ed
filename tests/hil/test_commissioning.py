"""A commissioning on a vcan0, from a terminal: node, loop and watchdog are processes, in slow time.

What a person at a bench goes through: no node yet; a step that is interrupted, one that is not agreed to, another bench
identity of the node before the last step; and each time the same command again. Then the same brake behind a drive
with a protocol of its own.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.logs.log import read_log
from emb_runtime.config.bench import load_bench
from tests.bench.commission.test_commissioning import TRUTH, mapping_for, sheet
from tests.drives import EXAMPLES
from tests.hil.plays import ROOT, SLOWLY

SENDING = ("2-zero", "3-current", "4-first-move", "5-free-stroke", "6-small", "7-medium", "8-large", "9-full")
"""Steps that send something."""
SCENES = ("nobody", "interrupted", "refused", "agreed", "finished", "no_gateway", "mapped", "mapped_finished")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]  # far beyond what a busy computer needs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the play left what it did."""
    folder = tmp_path_factory.mktemp("commission")
    measured = f'{sheet().text}\n[sensors]\nvelocity = "sensor"\n'
    (folder / "sheet.toml").write_text(measured.replace("[0, 3]", "[0, 0]"))

    def call(iface: str, bench: str, into: str, *more: str) -> list[str]:
        return [str(folder / into), "--iface", iface, "--bench", str(folder / bench), "--no-rt", *more]

    run = call("vcan0", "sheet.toml", "brake")
    (folder / "late.toml").write_text(measured.replace("[0, 3]", "[0, 1]"))
    mapping = str(mapping_for(folder, "odrive"))
    mapped = call("vcan0", "late.toml", "mapped", "--drive", f"{mapping}@vcan1")
    brake = {**TRUTH, "angle_noise": sheet().noise.angle, "velocity_noise": sheet().noise.velocity}
    theta = ",".join(f"{name}={value}" for name, value in brake.items())
    working, found = (
        ["emb_bench.cli.node", "--iface", "vcan0", "--json", "--brake", theta, "--bench", str(folder / "brake" / name)]
        for name in ("working.toml", "bench.toml")
    )
    drive = ["simulated_drives", "--iface", "vcan1", "--brake", theta, "--bench", str(folder / "late.toml")]
    drive += ["--drive", "odrive"]
    buses = ["--drive", "vcan1", "--node", "vcan0", "--serial", "simulated", "--yes", "--json"]
    gateways = [
        ["emb_runtime.cli.gateway", mapping, *buses, "--bench", str(folder / "mapped" / name)]
        for name in ("working.toml", "bench.toml")
    ]
    scenes = [
        {"name": "nobody", "node": None, "run": run},
        # What is typed beyond the first answer answers no other question; Ctrl-C comes in the middle of the third run.
        {"name": "interrupted", "node": working, "run": run, "answers": ["y\ny\ny\n"], "interrupt": 3},
        {"name": "refused", "node": None, "run": run, "answers": ["n\n"]},
        {"name": "agreed", "node": None, "run": run},
        {"name": "finished", "node": found, "run": run},
        {"name": "no_gateway", "node": drive, "run": mapped},
        {"name": "mapped", "node": None, "gateway": gateways[0], "run": mapped},
        {"name": "mapped_finished", "node": None, "gateway": gateways[1], "run": mapped},
    ]
    (folder / "scenes.json").write_text(json.dumps(scenes))
    emb_hil = ["timeout", "1000", sys.executable, "-m", "emb_bench.hil.cli", *SLOWLY]
    driver = [sys.executable, "-m", "tests.hil.terminal", str(folder / "scenes.json"), str(folder)]
    command = [*emb_hil, "--", "env", f"PYTHONPATH={ROOT}:{EXAMPLES}", *driver]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


@pytest.fixture(scope="module")
def played(folder: Path) -> dict[str, Any]:
    """What was printed, asked and sent, by scene."""
    document: dict[str, Any] = json.loads((folder / "played.json").read_text())
    return document


def steps_begun(scene: dict[str, Any]) -> list[str]:
    return re.findall(r"^(\d-[a-z-]+): ", scene["out"].replace("\r", ""), re.MULTILINE)


def test_each_scene_ends_as_it_should_and_the_last_one_with_a_bench_file(played: dict[str, Any]) -> None:
    codes = {"nobody": 4, "finished": 0, "no_gateway": 4, "mapped_finished": 0}
    for name in SCENES:
        assert played[name]["exit"] == codes.get(name, 3), (name, played[name]["out"][-1000:])
    assert "NO_NODE" in played["nobody"]["out"]
    assert "4-first-move was not completed: INTERRUPTED" in played["interrupted"]["out"]
    assert "stopped by the operator before anything was sent" in played["refused"]["out"]
    assert "another bench file" in played["agreed"]["out"]
    assert "done: 9 steps, 1 new runs" in played["finished"]["out"]
    assert "another bench file" in played["mapped"]["out"]
    assert "done: 9 steps, 1 new runs" in played["mapped_finished"]["out"]
    assert played["gateway"]["drive_time_out"].startswith("disarmed within 0.01")
    for name in SCENES:
        assert "Traceback" not in played[name]["out"]


def test_each_step_is_done_once_and_one_that_was_interrupted_again(played: dict[str, Any]) -> None:
    assert steps_begun(played["nobody"]) == ["1-listen"]
    assert steps_begun(played["interrupted"]) == ["1-listen", *SENDING[:3]]
    assert steps_begun(played["refused"]) == ["4-first-move"]
    assert steps_begun(played["agreed"]) == list(SENDING[2:])
    assert steps_begun(played["finished"]) == ["9-full"]
    assert steps_begun(played["mapped"]) == ["1-listen", *SENDING]
    assert steps_begun(played["mapped_finished"]) == ["9-full"]


def test_nothing_leaves_before_its_step_was_agreed_to(played: dict[str, Any]) -> None:
    for name, runs in zip(SCENES, (0, 3, 1, 5, 1, 0, 7, 1), strict=True):
        scene = played[name]
        assert len(scene["questions"]) == runs
        ends = [0]
        for at_question, at_answer in scene["questions"]:
            assert at_question == at_answer  # while nobody answers
            ends.append(at_question)
        assert ends[1:2] in ([], [0])  # and before the first question
        assert ends == sorted(ends)
    assert played["nobody"]["sent"] == played["refused"]["sent"] == 0


@pytest.mark.parametrize("brake", ["brake", "mapped"])
def test_the_brake_stayed_within_the_limits_and_its_parameters_within_the_ranges_written(
    folder: Path, played: dict[str, Any], brake: str
) -> None:
    limits = sheet().limits
    *nodes, drive = played["nodes"]
    for node in nodes if brake == "brake" else [drive]:
        assert limits.angle[0] <= node["angle_min"] <= node["angle_max"] <= limits.angle[1]
        assert node["top_speed"] <= limits.velocity
    assert [node["rejected"] for node in nodes] == [0, 0]
    assert not drive["armed"]
    bench = load_bench(folder / brake / "bench.toml")
    box = bench.range_set(bench.shield.ranges)
    for name, value in TRUTH.items():
        assert getattr(box.low, name) <= value <= getattr(box.high, name), name
    for step in SENDING:
        paths = [folder / brake / f"{step}{attempt}.mcap" for attempt in ("-attempt2", "")]
        log = read_log(next(path for path in paths if path.exists()))
        assert log.exit_reason == "DONE"
        currents = np.asarray(log.cycles["sent_current"])
        assert np.nanmax(np.abs(currents)) <= float(log.run["limit"]) + 1e-9
