"""The faults that are played against emb-run and emb-node on a real bus: one table.

Played inside the kernel by :mod:`tests.hil.stage`, judged outside by :mod:`tests.hil.judge`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from emb_runtime.config.bench import load_bench, parse_bench
from tests.actors import constant_actor
from tests.drives import EXAMPLES, SHIPPED, late_bench

ROOT = Path(__file__).parents[2]
COMMAND, VELOCITY = 0x80, 0x101
GARBAGE = "ff" * 8
SLOWLY = ("--uml", "--slow", "1000", "--root")
"""Two milliseconds of such a kernel are two seconds of a computer that stands still: no load of the host is seen."""


@dataclass(frozen=True)
class Play:
    """One fault, and what may come of it."""

    name: str
    what: str  # In words, for the table
    results: tuple[str, ...]  # What emb-run may say: ``done`` or a fault; empty if it is killed
    exits: tuple[int, ...]
    actions: tuple[dict[str, Any], ...] = ()
    before: tuple[dict[str, Any], ...] = ()  # Done before anything is started
    node_bus: str = "vcan0"
    run_bus: str = "vcan0"
    log: str = ""  # Where the log goes, if not into the ordinary memory
    linger: float = 0.8  # How long the bus is watched after the run's end [s]
    node_lost: bool = False  # The fault takes the node away, so its stop cannot be seen
    may_lose: int = 0
    """Frames that the log may lack: what the loop had in hand when it was killed, or what a killed recorder had."""
    stops: bool = True  # The fault must end in the node's safe stop before the experiment's own end
    stop_frames: int | None = 3  # Last commands on the bus, all disabled; None if some may be lost or are a stranger's
    policy: str = ""  # How it fails: "giant" asks for too much, others are of :mod:`tests.hil.failing_policy`
    drive: str = ""  # Simulated drive in place of the node, behind its mapping
    options: tuple[str, ...] = ()  # Further ones of emb-run

    def plan(self, folder: Path) -> dict[str, Any]:
        """What the stage is told; benches and actors are in the folder."""
        log = self.log or f"/dev/shm/{self.name}.mcap"
        run = ["--iface", self.run_bus, "--json", "--yes", "--log", log, *self.options]
        node = ["--iface", self.node_bus]
        gateway: list[str] = []
        if self.drive:
            kind, mapping = "polled" if self.drive == "mit" else "late", f"{EXAMPLES / self.drive}.toml"
            bench = ["--bench", str(folder / f"{kind}.toml")]
            run += ["--drive", f"{mapping}@{self.node_bus}", *bench, "--policy", str(folder / f"{kind}.onnx")]
            node += ["--drive", self.drive]
            gateway = [mapping, "--drive", self.node_bus, "--node", self.run_bus, "--serial", "simulated", *bench]
            gateway += ["--yes", "--json"]
        else:
            node.append("--json")
        if self.policy:
            run += ["--policy", str(folder / ("giant.onnx" if self.policy == "giant" else "constant.onnx"))]
        return {**asdict(self), "node": node, "gateway": gateway, "run": run, "log": log}


def _signal(to: str, name: str, after: int = 0, pause: float = 0.0, stops: int = 0) -> dict[str, Any]:
    """Waits for commands, then for stop frames, then for a time, and signals."""
    return {"do": "signal", "to": to, "signal": name, "after": after, "pause": pause, "stops": stops}


def _mapped(name: str, what: str, drive: str, results: tuple[str, ...], code: int, *actions: Any, **more: Any) -> Play:
    return Play(
        f"mapped_{name}", what, results, (code,), actions, drive=drive, stops=False, stop_frames=None,
        may_lose=10**6, run_bus="vcan1", **more,
    )  # fmt: skip


WHEN = 150  # Commands after which a fault strikes: the brake is fast and far out
LATE = 400  # The same, for what needs some of the log to be on disk
IN_HAND = 3  # Frames that wait for the next record
HALF_A_SECOND = 2000  # Frames of a bus of four per period
JOINED = ({"do": "corrupt", "identifier": VELOCITY},)
STOPPED = ("NODE_STOPPED", "NOT_OBEYED", "SENSOR_LOST")

PLAYS = (
    Play("normal", "nothing", ("done",), (0,), stops=False),
    Play("interrupted", "Ctrl-C", ("INTERRUPTED",), (3,), (_signal("run", "SIGINT", WHEN),)),
    Play(
        "loop_killed", "kill -9 of the loop", (), (-9,), (_signal("run", "SIGKILL", WHEN),), may_lose=IN_HAND,
    ),
    Play(
        "loop_stopped", "SIGSTOP of the loop, SIGCONT after 0.3 s", ("WATCHDOG_TRIPPED",), (3,),
        (_signal("run", "SIGSTOP", WHEN), _signal("run", "SIGCONT", pause=0.3)),
    ),
    Play(
        "loop_and_watchdog_killed", "kill -9 of loop and watchdog", (), (-9,),
        ({"do": "kill", "roles": ("watchdog", "run"), "after": WHEN},),
        may_lose=IN_HAND, stop_frames=0,
    ),
    Play(
        "loop_and_recorder_killed", "kill -9 of loop and recorder", (), (-9,),
        (_signal("recorder", "SIGKILL", LATE), _signal("run", "SIGKILL")), may_lose=HALF_A_SECOND,
    ),
    Play(
        "recorder_killed", "kill -9 of the recorder", ("LOG_INCOMPLETE",), (6,),
        (_signal("recorder", "SIGKILL", LATE),),
        stops=False, may_lose=HALF_A_SECOND,
    ),
    Play(
        "recorder_stopped", "SIGSTOP of the recorder for 0.2 s", ("done",), (0,),
        (_signal("recorder", "SIGSTOP", WHEN), _signal("recorder", "SIGCONT", pause=0.2)), stops=False,
    ),
    Play(
        "watchdog_killed", "kill -9 of the watchdog", ("WATCHDOG_LOST",), (3,),
        (_signal("watchdog", "SIGKILL", WHEN),),
    ),
    Play(
        "watchdog_stopped", "SIGSTOP of the watchdog", ("WATCHDOG_LOST",), (3,),
        (_signal("watchdog", "SIGSTOP", WHEN), _signal("watchdog", "SIGCONT", pause=0.3)),
    ),
    Play(
        "node_killed", "kill -9 of the node, which then returns", ("SENSOR_LOST",), (3,),
        (_signal("node", "SIGKILL", WHEN), {"do": "restart_node", "pause": 0.2}), node_lost=True,
    ),
    Play(
        "node_stopped", "SIGSTOP of the node for 0.2 s", ("SENSOR_LOST", "NODE_STOPPED"), (3,),
        (_signal("node", "SIGSTOP", WHEN), _signal("node", "SIGCONT", pause=0.2)), node_lost=True,
    ),
    Play(
        "loss", "5 % of all frames lost", ("done",), (0,),
        ({"do": "impair", "interface": "vcan0", "by": {"loss": 0.05}, "after": 50},), stops=False, stop_frames=None,
    ),
    Play(
        "silence", "all frames lost for 50 ms", STOPPED, (3,),
        (
            {"do": "impair", "interface": "vcan0", "by": {"loss": 1.0}, "after": WHEN},
            {"do": "clear_netem", "interface": "vcan0", "pause": 0.05},
        ),
        node_lost=True, stop_frames=None,
    ),
    Play(
        "delay", "all frames delayed by 0.1 ms", ("done",), (0,),
        ({"do": "impair", "interface": "vcan0", "by": {"delay": 0.0001}, "after": WHEN},), stops=False,
    ),
    Play(
        "late", "all frames delayed by 2 ms", STOPPED, (3,),
        ({"do": "impair", "interface": "vcan0", "by": {"delay": 0.002}, "after": WHEN},),
    ),
    Play(
        "duplicates", "10 % of all frames twice", ("done", "FRAMES_REJECTED", "FOREIGN_COMMAND"), (0, 3),
        ({"do": "impair", "interface": "vcan0", "by": {"duplicate": 0.1}, "after": WHEN},), stops=False,
        stop_frames=None,
    ),
    Play(
        "reordered", "every fourth frame overtakes", ("done", "FRAMES_REJECTED", *STOPPED), (0, 3),
        ({"do": "impair", "interface": "vcan0", "by": {"delay": 0.0003, "reorder": 0.25}, "after": WHEN},),
        stops=False, stop_frames=None,
    ),
    Play(
        "corrupted_sensor", "a bit of every velocity frame turned over", ("FRAMES_REJECTED",), (3,),
        ({"do": "corrupt", "identifier": VELOCITY, "xor": "0000010000000000", "after": WHEN},), JOINED, "vcan1",
    ),
    Play(
        "corrupted_command", "a bit of every command turned over", STOPPED, (3,),
        ({"do": "corrupt", "identifier": COMMAND, "xor": "0000010000000000", "after": WHEN},), JOINED, "vcan1",
    ),
    Play(
        "babbling_stranger", "a stranger sends without a pause for 50 ms", ("done",), (0,),
        ({"do": "babble", "identifier": 0x7FF, "data": GARBAGE, "seconds": 0.05, "after": WHEN},), stops=False,
    ),
    Play(
        "babbling_impostor", "false velocity frames without a pause for 50 ms",
        ("FRAMES_REJECTED",), (3,),
        ({"do": "babble", "identifier": VELOCITY, "data": GARBAGE, "seconds": 0.05, "after": WHEN},),
    ),
    Play(
        "foreign_commander", "a stranger's valid command of 3 A", ("FOREIGN_COMMAND",), (3,),
        ({"do": "command", "after": WHEN},), stop_frames=None,
    ),
    Play(
        "link_down", "the interface down for 50 ms", ("BUS_LOST",), (4,),
        (
            {"do": "link", "interface": "vcan0", "up": False, "after": WHEN},
            {"do": "link", "interface": "vcan0", "up": True, "pause": 0.05},
        ),
        node_lost=True, stop_frames=None,
    ),
    Play(
        "no_room", "frames wait 5 ms on their way out, two at most", STOPPED, (3,),
        ({"do": "impair", "interface": "vcan0", "by": {"delay": 0.005, "limit": 2}, "after": WHEN},),
        node_lost=True, stop_frames=None,
    ),
    Play(
        "bus_off", "the controller goes bus-off", ("BUS_LOST",), (4,), ({"do": "bus_off", "off": True, "after": WHEN},),
    ),
    Play(
        "disk_full", "the disk fills up in mid-run", ("LOG_INCOMPLETE",), (6,),
        ({"do": "fill", "where": "/run/small", "after": WHEN},),
        before=({"do": "small_disk", "where": "/run/small", "size": 16 << 20},), log="/run/small/disk_full.mcap",
        stops=False,
    ),
    Play(
        "clock_forward", "the time of day steps by 10 s", ("done",), (0,),
        ({"do": "step_clock", "seconds": 10.0, "after": WHEN},), stops=False,
    ),
    Play(
        "clock_back", "the time of day steps back by 10 s", ("done",), (0,),
        ({"do": "step_clock", "seconds": -10.0, "after": WHEN},), stops=False,
    ),
    Play(
        "loop_hung", "the policy does not come back, then kill -9", (), (-9,),
        (_signal("run", "SIGKILL", WHEN, stops=3, pause=0.3),), may_lose=IN_HAND, policy="hung",
    ),
    Play(
        "loop_robbed", "another thread of the loop keeps Python's lock, then kill -9", (), (-9,),
        (_signal("run", "SIGKILL", WHEN, stops=3),), may_lose=IN_HAND, policy="robbed of the lock",
    ),
    Play("giant", "a policy gone mad", ("POLICY_BEYOND_CONTRACT",), (3,), policy="giant", stops=False),
    *(_mapped(drive, "nothing", drive, ("done",), 0) for drive in SHIPPED),
    _mapped("zero", "nothing, with --zero", "odrive", ("done",), 0, options=("--zero",)),
    *(
        _mapped(
            f"{drive}_host", "kill -9 of all processes of the run", drive, (), -9,
            {"do": "kill", "roles": ("gateway", "watchdog", "recorder", "run"), "after": 60},
        )
        for drive in SHIPPED
    ),
    _mapped(
        "left", "kill -9 of run, watchdog and recorder, not of the gateway", "odrive", (), -9,
        {"do": "kill", "roles": ("watchdog", "recorder", "run"), "after": 60}, linger=2.5,
    ),
    _mapped(
        "gateway", "kill -9 of the gateway", "odrive", ("SENSOR_LOST",), 3, _signal("gateway", "SIGKILL", 60),
        linger=0.5,
    ),
    _mapped(
        "down", "the drive's interface down", "odrive", ("SENSOR_LOST",), 3,
        {"do": "link", "interface": "vcan0", "up": False, "after": 60}, linger=0.5,
    ),
)  # fmt: skip


def perform(plays: Iterable[Play], folder: Path, kernel: Sequence[str] = SLOWLY) -> None:
    """Play them in one boot of a kernel; the reports come into ``folder``, which is made here.

    Raises:
        RuntimeError: they were not played; the message says why.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for kind in ("late", "polled"):
        text = late_bench(polled=kind == "polled")
        (folder / f"{kind}.toml").write_text(text)
        (folder / f"{kind}.onnx").write_bytes(constant_actor(parse_bench(text, kind), 6.0))
    (folder / "constant.onnx").write_bytes(constant_actor(load_bench(), 2.0))
    (folder / "giant.onnx").write_bytes(constant_actor(load_bench(), 3.0, 1e9))
    plan = folder / "plan.json"
    plan.write_text(json.dumps([play.plan(folder) for play in plays]))
    hil = ["timeout", "3000", sys.executable, "-m", "emb_bench.hil.cli", *kernel, "--"]
    command = [*hil, sys.executable, "-m", "tests.hil.stage", str(plan), str(folder)]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(EXAMPLES), "EMB_CORE": "python"},
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode != 0:
        raise RuntimeError(f"the plays were not played (exit {done.returncode}):\n{done.stdout}\n{done.stderr[-4000:]}")
