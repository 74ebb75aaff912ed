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
from emb_runtime.safety.end_stop import released_speed
from tests.actors import constant_actor
from tests.drives import EXAMPLES, SHIPPED
from tests.runtime.drives.mapped import late_bench

pytestmark = pytest.mark.timeout(1200)  # far beyond what a busy computer needs

PLAY = """
name=$1; drive=$2; fault=$3; examples=$4; python=$5; shift 5
"$python" -m emb_bench.cli.node --iface vcan0 --drive "$drive" --json > "$name.node" 2> /dev/null &
node=$!
"$python" -m emb_runtime.cli.main --iface "map:$examples/$drive.toml@vcan0" --bench "$drive.bench.toml" \
  --policy "$drive.onnx" --serial simulated --yes --json --log "$name.mcap" "$@" > "$name.json" &
run=$!
[ "$fault" = none ] || "$python" breaks.py "$fault" $run "$examples/$drive"
wait $run
echo $? > "$name.exit"
kill $node; wait $node
ip link set vcan0 up
"""
BREAKS = """
import os, signal, socket, struct, subprocess, sys, time, tomllib
import cantools
fault, run, drive = sys.argv[1], int(sys.argv[2]), sys.argv[3]
with open(f"{drive}.toml", "rb") as file:
    command = tomllib.load(file)["can"]["signals"]["command"]
name, signal_name = command["signal"].split(".")
message = cantools.database.load_file(f"{drive}.dbc").get_message_by_name(name)
bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
bus.bind(("vcan0",))
commands = 0
while commands < 60:  # currents that are none of 0 A
    identifier, length, data = struct.unpack("<IB3x8s", bus.recv(16))
    if identifier & socket.CAN_EFF_MASK == message.frame_id:
        commands += abs(message.decode(data[:length])[signal_name]) > 0.01 * command["range"][1]
def children(pid):
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        return [int(child) for child in file.read().split()]
def is_node(pid):
    with open(f"/proc/{pid}/cmdline") as file:
        return "node_process" in file.read()
if fault == "down":
    subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
else:
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(98))  # a host dies at once: none sees another go
    below = sorted(children(run), key=is_node, reverse=True)
    for pid in [*below, run] if fault == "host" else below[:1]:
        os.kill(pid, signal.SIGKILL)
time.sleep(0.5)  # the brake comes to rest
"""
WHOLE = {**{drive: (drive, "none", ()) for drive in SHIPPED}, "zero": ("odrive", "none", ("--zero",))}
BROKEN = {f"{drive}-{fault}": (drive, fault, ()) for drive in SHIPPED for fault in ("host", "node", "down")}
"""What breaks in a run: all processes of this computer killed, the software node alone, the interface down."""
PLAYS = {**WHOLE, **BROKEN}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where all plays left what they said, from one boot."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "play.sh").write_text(PLAY)
    (folder / "breaks.py").write_text(BREAKS)
    for drive in SHIPPED:
        text = late_bench(polled=drive == "mit")
        (folder / f"{drive}.bench.toml").write_text(text)
        (folder / f"{drive}.onnx").write_bytes(constant_actor(parse_bench(text, "bench.toml"), 6.0))
    lines = [
        " ".join(["sh play.sh", name, drive, fault, str(EXAMPLES), sys.executable, *more])
        for name, (drive, fault, more) in PLAYS.items()
    ]
    emb_hil = [sys.executable, "-m", "emb_bench.hil.cli", "--uml", "--slow", "1000", "--root", "--timeout", "1000"]
    command = [*emb_hil, "--", "sh", "-c", f"cd {folder}; {'; '.join(lines)}; true"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder


def said(folder: Path, play: str, kind: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / f"{play}.{kind}").read_text())
    return document


@pytest.mark.parametrize("play", WHOLE)
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


@pytest.mark.parametrize("drive", SHIPPED)
@pytest.mark.parametrize("killed", ["host", "node"])
def test_whoever_is_killed_the_drive_lets_go_by_its_own_time_out_below_the_speed_that_was_stated(
    folder: Path, drive: str, killed: str
) -> None:
    node = said(folder, f"{drive}-{killed}", "node")
    bench = parse_bench((folder / f"{drive}.bench.toml").read_text(), "bench.toml")
    assert not node["armed"]
    assert bench.limits.angle[0] <= node["angle_min"] <= node["angle_max"] <= bench.limits.angle[1]
    assert 300.0 < node["top_speed"] <= released_speed(bench, 0.010)


@pytest.mark.parametrize("drive", SHIPPED)
def test_a_loop_without_its_node_or_its_interface_ends_with_exit_4_and_says_so(folder: Path, drive: str) -> None:
    for fault, why in (("node", "the drive's node has ended"), ("down", "vcan0")):
        play = f"{drive}-{fault}"
        assert (folder / f"{play}.exit").read_text() == "4\n"
        run = said(folder, play, "json")
        assert run["result"] == "BUS_LOST"
        assert why in run["detail"]
    assert (folder / f"{drive}-host.exit").read_text() == "137\n"
    assert not (folder / f"{drive}-host.json").read_text()
