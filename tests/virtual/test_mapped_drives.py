"""Whole runs on mapped drives on a vcan0: loop, watchdog, software node and drive are processes, in slow time."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from emb_bench.logs.log import read_log
from emb_runtime.config.bench import parse_bench
from tests.actors import constant_actor
from tests.drives import EXAMPLES, SHIPPED
from tests.runtime.drives.mapped import late_bench

pytestmark = pytest.mark.timeout(1200)  # far beyond what a busy computer needs

PLAY = """
name=$1; drive=$2; examples=$3; python=$4; shift 4
"$python" -m emb_bench.cli.node --iface vcan0 --drive "$drive" --json > "$name.node" &
node=$!
"$python" -m emb_runtime.cli.main --iface "map:$examples/$drive.toml@vcan0" --bench "$drive.bench.toml" \
  --policy "$drive.onnx" --serial simulated --yes --json --log "$name.mcap" "$@" > "$name.json"
echo $? > "$name.exit"
kill $node; wait $node
"""
PLAYS = {**{drive: (drive, ()) for drive in SHIPPED}, "zero": ("odrive", ("--zero",))}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all plays left what they said, from one boot."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "play.sh").write_text(PLAY)
    for drive in SHIPPED:
        text = late_bench(polled=drive == "mit")
        (folder / f"{drive}.bench.toml").write_text(text)
        (folder / f"{drive}.onnx").write_bytes(constant_actor(parse_bench(text, "bench.toml"), 6.0))
    lines = [
        " ".join(["sh play.sh", name, drive, str(EXAMPLES), sys.executable, *more])
        for name, (drive, more) in PLAYS.items()
    ]
    emb_hil = [sys.executable, "-m", "emb_bench.hil.cli", "--uml", "--slow", "1000", "--root", "--timeout", "1000"]
    command = [*emb_hil, "--", "sh", "-c", f"cd {folder}; {'; '.join(lines)}; true"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


def said(folder: Path, play: str, kind: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / f"{play}.{kind}").read_text())
    return document


@pytest.mark.parametrize("play", PLAYS)
def test_every_sample_is_answered_and_the_drive_is_let_go(folder: Path, play: str) -> None:
    run, node = said(folder, play, "json"), said(folder, play, "node")
    assert (folder / f"{play}.exit").read_text() == "0\n"
    assert (run["result"], run["answered"], run["not_obeyed"], run["log_complete"]) == ("done", 500, 0, True)
    assert (run["watchdog"]["tripped"], run["drive"]["drive_frames_refused"]) == ("", "0")
    assert not node["armed"]
    limits = parse_bench((folder / f"{PLAYS[play][0]}.bench.toml").read_text(), "bench.toml").limits
    assert limits.angle[0] <= node["angle_min"] <= node["angle_max"] <= limits.angle[1]
    assert node["top_speed"] <= limits.velocity


def test_with_zero_the_drive_s_own_time_out_is_proved_and_nothing_moves(folder: Path) -> None:
    end = read_log(folder / "zero.mcap").metadata["emb.end"]
    assert end["drive_time_out"].startswith("let go within 0.01")
    assert end["drive_too_late"] == ""
    assert said(folder, "zero", "node")["top_speed"] == 0.0
