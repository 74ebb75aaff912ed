"""A whole run over python-can's ``udp_multicast`` on the loopback: node, loop and watchdog are processes, in slow time.

A backend that gives a sender its own frames back; in a kernel of its own, for it knows one port for all groups.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from emb_bench.logs.log import read_log
from emb_runtime.config.bench import load_bench
from tests.hil.faults import NETWORK

pytestmark = pytest.mark.timeout(1200)  # far beyond what a busy computer needs

PLAY = """
python=$1; actor=$2; bus=udp_multicast:239.74.163.2
ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo || exit 1
"$python" -m emb_bench.cli.node --iface $bus --json > node.json &
node=$!
"$python" -m emb_runtime.cli.main --iface $bus --policy "$actor" --yes --json --log run.mcap > run.json
echo $? > run.exit
kill $node; wait $node
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the play left what it said."""
    folder = tmp_path_factory.mktemp("multicast")
    (folder / "play.sh").write_text(PLAY)
    emb_hil = [sys.executable, "-m", "emb_bench.hil.cli", "--uml", "--slow", "1000", "--root", "--timeout", "1000"]
    command = [*emb_hil, "--", "sh", "-c", f"cd {folder}; sh play.sh {sys.executable} {NETWORK}"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert (folder / "run.exit").exists(), done.stderr[-4000:]
    return folder


def said(folder: Path, who: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / f"{who}.json").read_text())
    return document


def test_every_sample_is_answered_and_every_command_obeyed(folder: Path) -> None:
    run, node = said(folder, "run"), said(folder, "node")
    assert (folder / "run.exit").read_text() == "0\n"
    assert (run["result"], run["answered"], run["missed"], run["not_obeyed"]) == ("done", 500, 0, 0)
    assert (node["obeyed"], node["rejected"]) == (500, 0)
    assert run["watchdog"]["tripped"] == ""
    limits = load_bench().limits
    assert limits.angle[0] <= node["angle_min"] <= node["angle_max"] <= limits.angle[1]
    assert node["top_speed"] <= limits.velocity


def test_what_the_bus_gives_back_is_nobody_else_s(folder: Path) -> None:
    """Each command is in the log once, as sent; a second commander would have ended the run."""
    run, log = said(folder, "run"), read_log(folder / "run.mcap")
    assert log.complete
    commands = [frame for frame in log.frames if frame.identifier == 0x080]
    assert len(commands) == run["confirmed"]
    assert all(frame.own for frame in commands)
    assert (run["rejected"], run["rejections"]) == (0, {})
