"""The faults that are played against emb-run and emb-node, and the judgement of what was on the bus.

Judged by cantools and AUTOSAR's own CRC from the frames on the node's bus: nothing of the project's reads them here.
Time is bus time: the node's device time, and the kernel's stamps.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from emb_bench.logs.log import read_log
from emb_runtime.errors import LogError
from tests.independent import DATABASE, MESSAGES, protected

ROOT = Path(__file__).parents[2]
COMMAND, ANGLE, VELOCITY, STATUS = 0x80, 0x100, 0x101, 0x102
IDLE, ACTIVE, STOPPING = 0, 1, 2
NO_COMMAND = 15
GARBAGE = "ff" * 8


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
    lie: dict[str, Any] = field(default_factory=dict)
    """Fields of :class:`tests.lying.node.Lie`: the node is that one, and not emb-node."""

    def plan(self, run_arguments: Sequence[str], node_arguments: Sequence[str]) -> dict[str, Any]:
        """What the driver is told."""
        log = self.log or f"/dev/shm/{self.name}.mcap"
        return {
            **asdict(self),
            "node": ["--iface", self.node_bus, "--json", *node_arguments],
            "run": ["--iface", self.run_bus, "--json", "--yes", "--log", log, *run_arguments],
            "log": log,
        }


def _signal(to: str, name: str, after: int = 0, pause: float = 0.0) -> dict[str, Any]:
    return {"do": "signal", "to": to, "signal": name, "after": after, "pause": pause}


def _lying(name: str, what: str, *results: str, **lie: Any) -> Play:
    """A node that lies: its own account of its stop is one of its lies, so that is not judged."""
    return Play(name, what, results, (3,), node_lost=True, lie={"begin": 0.15, **lie})


CONTRADICT, OUTSIDE, POLARITY = "SENSORS_CONTRADICT", "MOTION_OUTSIDE_SET", "WRONG_POLARITY"
REJECTED = "FRAMES_REJECTED"
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
        (_signal("watchdog", "SIGSTOP", WHEN), _signal("run", "SIGKILL"), _signal("watchdog", "SIGKILL")),
        may_lose=IN_HAND,
    ),
    Play(
        "loop_and_recorder_killed", "kill -9 of loop and recorder", (), (-9,),
        (_signal("recorder", "SIGKILL", LATE), _signal("run", "SIGKILL")), may_lose=HALF_A_SECOND,
    ),
    Play(
        "recorder_killed", "kill -9 of the recorder", ("done",), (6,), (_signal("recorder", "SIGKILL", LATE),),
        stops=False, may_lose=HALF_A_SECOND,
    ),
    Play(
        "recorder_stopped", "SIGSTOP of the recorder for 0.2 s", ("done",), (0,),
        (_signal("recorder", "SIGSTOP", WHEN), _signal("recorder", "SIGCONT", pause=0.2)), stops=False,
    ),
    Play(
        # While the kernel takes it down, at its priority, the loop has no processor in QEMU.
        "watchdog_killed", "kill -9 of the watchdog", ("WATCHDOG_LOST", "NODE_STOPPED"), (3,),
        (_signal("watchdog", "SIGKILL", WHEN),),
    ),
    Play(
        "watchdog_stopped", "SIGSTOP of the watchdog", ("WATCHDOG_LOST",), (3,),
        (_signal("watchdog", "SIGSTOP", WHEN), _signal("watchdog", "SIGCONT", pause=0.3)),
    ),
    Play(
        "node_killed", "kill -9 of the node, which then returns", ("SENSOR_LOST", "WATCHDOG_TRIPPED"), (3,),
        # Taking the node down, at its priority, takes longer in QEMU than the loop may stand still.
        (_signal("node", "SIGKILL", WHEN), {"do": "restart_node", "pause": 0.2}), node_lost=True,
    ),
    Play(
        "node_stopped", "SIGSTOP of the node for 0.2 s", ("SENSOR_LOST", "NODE_STOPPED"), (3,),
        (_signal("node", "SIGSTOP", WHEN), _signal("node", "SIGCONT", pause=0.2)), node_lost=True,
    ),
    Play(
        "loss", "5 % of all frames lost", ("done",), (0,),
        ({"do": "impair", "interface": "vcan0", "by": {"loss": 0.05}, "after": 50},), stops=False,
    ),
    Play(
        "silence", "all frames lost for 50 ms", STOPPED, (3,),
        (
            {"do": "impair", "interface": "vcan0", "by": {"loss": 1.0}, "after": WHEN},
            {"do": "heal", "interface": "vcan0", "pause": 0.05},
        ),
        node_lost=True,
    ),
    Play(
        # Node and loop need six tenths of a period of the processor in QEMU; twice this still fits beside them.
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
    ),
    Play(
        "reordered", "every fourth frame overtakes", ("done", "FRAMES_REJECTED", *STOPPED), (0, 3),
        ({"do": "impair", "interface": "vcan0", "by": {"delay": 0.0003, "reorder": 0.25}, "after": WHEN},),
        stops=False,
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
        "babbling_stranger", "a stranger sends without a pause for 50 ms", ("done", *STOPPED), (0, 3),
        ({"do": "babble", "identifier": 0x7FF, "data": GARBAGE, "seconds": 0.05, "after": WHEN},), stops=False,
    ),
    Play(
        "babbling_impostor", "false velocity frames without a pause for 50 ms",
        ("FRAMES_REJECTED", "WATCHDOG_TRIPPED"), (3,),
        ({"do": "babble", "identifier": VELOCITY, "data": GARBAGE, "seconds": 0.05, "after": WHEN},),
    ),
    Play(
        "foreign_commander", "a stranger's valid command of 3 A", ("FOREIGN_COMMAND",), (3,),
        ({"do": "command", "after": WHEN},),
    ),
    Play(
        "link_down", "the interface down for 50 ms", ("BUS_LOST",), (4,),
        (
            {"do": "link", "interface": "vcan0", "up": False, "after": WHEN},
            {"do": "link", "interface": "vcan0", "up": True, "pause": 0.05},
        ),
        node_lost=True,
    ),
    Play(
        "no_room", "commands wait 5 ms on their way out, two at most", STOPPED, (3,),
        ({"do": "impair", "interface": "can0", "by": {"delay": 0.005, "limit": 2}, "after": WHEN},),
        node_bus="can1", run_bus="can0",
    ),
    Play(
        "bus_off", "the controller goes bus-off", ("BUS_LOST",), (4,), ({"do": "bus_off", "off": True, "after": WHEN},),
    ),
    Play(
        "disk_full", "the disk fills up in mid-run", ("done",), (6,),
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
    _lying("lie_drift_30", "its angle drifts by 30 rad/s", CONTRADICT, drift=30.0),
    _lying("lie_drift_45", "its angle drifts by 45 rad/s", CONTRADICT, drift=45.0),
    _lying("lie_offset", "its velocity is 40 rad/s too high", CONTRADICT, OUTSIDE, offset=40.0),
    _lying("lie_scale", "angle and velocity are said a third as large", OUTSIDE, scale=0.33, begin=0.0),
    _lying("lie_motor", "the motor turns the other way", POLARITY, motor=-1, begin=0.0),
    _lying("lie_sensors", "both sensors count the other way", POLARITY, sensors=-1, begin=0.0),
    _lying("lie_clock_jump", "its clock jumps by 0.5 s", "DEVICE_TIME", CONTRADICT, clock_jump=0.5),
    _lying(
        "lie_hidden_jump", "its clock jumps by 13 ms, its angle by -5 rad", "DEVICE_TIME", CONTRADICT,
        clock_jump=0.013, clock_jump_angle=-5.0,
    ),
    _lying("lie_clock_fast", "its clock is 1 % fast", "DEVICE_TIME", CONTRADICT, clock=1.01, begin=0.0),
    _lying("lie_clock_slow", "its clock is 5 % slow", "DEVICE_TIME", CONTRADICT, REJECTED, clock=0.95, begin=0.0),
    _lying("lie_jumps", "every other angle is 5 rad off", "FRAMES_REJECTED", jump=5.0, duty=0.5),
    _lying("lie_crc", "the CRC of every other velocity frame is wrong", "FRAMES_REJECTED", crc=True, duty=0.5),
    _lying("lie_deaf", "half of the commands are not obeyed", "NOT_OBEYED", deaf=True, duty=0.5),
    _lying("lie_deaf_30", "30 % of the commands are not obeyed", "NOT_OBEYED", "INCOMPLETE", deaf=True, duty=0.3),
    _lying("lie_braking", "it brakes with 20 A every other period", "CURRENT_MISMATCH", current=20.0, duty=0.5),
    _lying("lie_idle", "it says IDLE every tenth period", "NODE_CHANGED", idle=True, duty=0.1),
    _lying("lie_identity", "its status is of another bench", "NODE_CHANGED", identity=1),
)  # fmt: skip


NETWORK = Path(__file__).with_name("network.onnx")
"""An actor without an estimator: emb-train --preset single-viscous --seed 0 --steps 4000000, exported. QEMU's processor
does an instruction in a nanosecond; node, loop, watchdog and recorder share it, and the estimator of the shipped actor
would not be ready within the period."""


def perform(
    plays: Iterable[Play], folder: Path, hil: Sequence[str], *, node: Sequence[str] = (), run: Sequence[str] = ()
) -> None:
    """Play them in one boot of a kernel; the reports come into ``folder``.

    Args:
        plays: what to play.
        folder: made here; the working directory inside.
        hil: the command that has the kernel, up to and with its ``--``.
        node: further arguments of emb-node.
        run: further arguments of emb-run.
    """
    folder.mkdir(parents=True, exist_ok=True)
    plan = folder / "plan.json"
    plan.write_text(json.dumps([play.plan(run, node) for play in plays]))
    command = [*hil, sys.executable, "-c", _DRIVE, str(ROOT), str(plan), str(folder)]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, cwd=folder)
    if done.returncode != 0:
        raise RuntimeError(f"the plays were not played (exit {done.returncode}):\n{done.stdout}\n{done.stderr[-4000:]}")


_DRIVE = "import sys; sys.path.insert(0, sys.argv.pop(1)); from tests.hil.fault_driver import main; main()"


class Sampled(NamedTuple):
    """A sensor pair on the bus."""

    at: int  # Its place among the frames
    time_ns: int  # The kernel's stamp
    device_ms: float
    counter: int
    state: int
    obeyed: int  # Counter of the command obeyed in the period before
    angle: float
    velocity: float


@dataclass(frozen=True)
class Seen:
    """What a play left behind."""

    play: Play
    report: dict[str, Any]
    log: Path
    frames: list[tuple[int, int, bytes]] = field(repr=False)  # On the node's bus
    run_frames: list[tuple[int, int, bytes]] = field(repr=False)  # On the run's bus, which may be another

    @property
    def summary(self) -> dict[str, Any]:
        """What emb-run said."""
        said: dict[str, Any] = json.loads(self.report["run"]["out"] or "{}")
        return said

    def commands(self) -> list[tuple[int, dict[str, Any]]]:
        """Place and content of every command on the run's bus."""
        message = DATABASE.get_message_by_frame_id(COMMAND)
        return [
            (n, message.decode(data, decode_choices=False))
            for n, (_, identifier, data) in enumerate(self.run_frames)
            if identifier == COMMAND
        ]

    def samples(self) -> list[Sampled]:
        """Every whole pair of the node on the bus, in order; frames that nobody sent so are left out."""
        angle, velocity = (DATABASE.get_message_by_frame_id(n) for n in (ANGLE, VELOCITY))
        found: list[Sampled] = []
        last: dict[str, Any] | None = None
        for n, (time_ns, identifier, data) in enumerate(self.frames):
            if identifier == ANGLE and _genuine(identifier, data):
                last = angle.decode(data, decode_choices=False)
            elif identifier == VELOCITY and _genuine(identifier, data) and last is not None:
                said = velocity.decode(data, decode_choices=False)
                if said["Counter"] != last["Counter"]:
                    continue
                wraps = found[-1].device_ms - found[-1].device_ms % 4194.304 if found else 0.0
                device_ms = last["DeviceTime"] * 1e3 + wraps
                if found and device_ms < found[-1].device_ms - 2000.0:
                    device_ms += 4194.304
                found.append(
                    Sampled(
                        n, time_ns, device_ms, said["Counter"], said["NodeState"], said["CommandCounter"],
                        last["Angle"], said["Velocity"],
                    )
                )  # fmt: skip
        return found


def _genuine(identifier: int, data: bytes) -> bool:
    return len(data) == MESSAGES[identifier].length and data == protected(identifier, data[1:])


def seen(play: Play, folder: Path) -> Seen:
    """What a play left behind in the folder."""
    report = json.loads((folder / f"{play.name}.json").read_text())
    frames, run_frames = (
        [(t, i, bytes.fromhex(d)) for t, i, d in kept]
        for kept in (report["frames"], report.get("run_frames", report["frames"]))
    )
    return Seen(play, report, folder / f"{play.name}.mcap", frames, run_frames)


@dataclass(frozen=True)
class Verdict:
    """What came of a play."""

    wrong: tuple[str, ...]  # What must not be
    result: str
    stop_ms: float | None
    """From the last period that obeyed a command to the node's safe stop, device time; None if there was no stop."""
    reaction_ms: float | None
    """From the fault to the first sample that reports the stop, bus time; of a lying node to the stop itself."""
    angle: tuple[float, float]  # True angle, lowest and highest [rad]; NaN of a node that was killed
    top_speed: float  # True [rad/s]
    frames_lost: int | None
    """Frames of the node and of ours on the bus up to the last current that the log has not; None without a log."""


def judge(it: Seen, watchdog_ms: float = 10.0) -> Verdict:
    """Judge a play.

    Args:
        it: what was seen.
        watchdog_ms: the node's own time-out.
    """
    wrong = [it.report["error"]] if "error" in it.report else []
    if it.report["dropped"]:
        wrong.append(f"the kernel dropped {it.report['dropped']} frames: nothing can be judged")
    if it.report["run"]["forced"]:
        wrong.append("the run did not end by itself")
    if "Traceback" in it.report["run"]["err"]:
        wrong.append("a traceback")
    result = it.summary.get("result", "")
    if it.report["run"]["exit"] not in it.play.exits:
        wrong.append(f"exit {it.report['run']['exit']}: {it.report['run']['err'].strip()}")
    if it.play.results and result not in it.play.results:
        wrong.append(f"it said {result}: {it.summary.get('detail')}")
    wrong += illegal(it)
    stop_ms, stop = safe_stop(it.samples())
    if it.play.stops and not it.play.node_lost:
        if stop is None or stop_ms is None:
            wrong.append("the node never began its stop")
        elif stop_ms > watchdog_ms + 2.0:
            wrong.append(f"the stop began after {stop_ms:.1f} ms")
    struck = [time_ns for _, time_ns in it.report["done"]][:1]
    told = [json.loads(node["out"]) for node in it.report["nodes"] if node["out"].startswith("{")]
    low = min((node["angle_min"] for node in told), default=float("nan"))
    high = max((node["angle_max"] for node in told), default=float("nan"))
    speed = max((node["top_speed"] for node in told), default=float("nan"))
    reaction_ms = (stop.time_ns - struck[0]) * 1e-6 if stop is not None and struck and it.play.stops else None
    if it.play.lie:
        reaction_ms = next((node["detected_ms"] for node in told), None)
    if low < -10.0 or high > 100.0 or speed > 500.0:
        wrong.append(f"limits passed: {low:.2f} to {high:.2f} rad, {speed:.1f} rad/s")
    return Verdict(
        wrong=tuple(wrong),
        result=result or f"killed ({it.report['run']['exit']})",
        stop_ms=stop_ms,
        reaction_ms=reaction_ms,
        angle=(low, high),
        top_speed=speed,
        frames_lost=lost(it),
    )


def illegal(it: Seen) -> list[str]:
    """What is wrong with the commands on the bus: range, enable, CRC, counter, and the sample that is answered."""
    found = []
    newest = {n: data[1] & 0x0F for n, (_, i, data) in enumerate(it.run_frames) if i == ANGLE and len(data) == 8}
    answered: set[int] = set()
    foreign = it.play.name in ("foreign_commander", "duplicates")
    lossy = any(action["do"] in ("impair", "link") for action in it.play.actions)
    held_up = any(action.get("by", {}).get("delay", 0.0) > 0.002 for action in it.play.actions)  # after the guard
    expected = None
    for n, values in it.commands():
        data = it.run_frames[n][2]
        if abs(values["Current"]) > 6.0 or (values["Enable"] == 0 and values["Current"] != 0.0):
            found.append(f"command {values} is beyond the guard's contract")
        if data != protected(COMMAND, data[1:]):
            found.append(f"command {data.hex()} has a wrong CRC")
        if not (foreign or lossy) and expected not in (None, values["Counter"]):
            found.append(f"command counter {values['Counter']}, expected {expected}")
        expected = (values["Counter"] + 1) % 15
        before = [at for at in newest if at < n][-3:]
        source = [at for at in before if newest[at] == values["Answers"]]
        if values["Enable"] and not foreign:
            if not (source or held_up):
                found.append(f"command {values} answers no sample of the last three periods")
            elif source and source[-1] in answered and not held_up:
                found.append(f"command {values} answers a sample again")
            answered.update(source[-1:])
    return found


def safe_stop(samples: list[Sampled]) -> tuple[float | None, Sampled | None]:
    """Device time from the last period that obeyed a command to the node's stop [ms]; the sample that reports it."""
    stop = next((s for s in samples if s.state == STOPPING), None)
    if stop is None:
        return None, None
    obeyed = [s.device_ms for s in samples if s.obeyed != NO_COMMAND and s.at < stop.at]
    return (stop.device_ms - obeyed[-1] if obeyed else None), stop


def lost(it: Seen) -> int | None:
    """Frames between the log's first and the last current commanded that the log has not."""
    if not it.log.exists():
        return None
    try:
        logged = [(f.identifier, f.data) for f in read_log(it.log).frames]
    except LogError:
        return None
    on_bus = [(i, d) for _, i, d in it.run_frames if i in (COMMAND, ANGLE, VELOCITY, STATUS)]
    last = max((n for n, (i, data) in enumerate(on_bus) if i == COMMAND and data[4] & 1), default=-1)
    if not logged or last < 0:
        return None
    begin = next((n for n in range(len(on_bus)) if on_bus[n : n + 10] == logged[:10]), 0)
    have = list(logged)
    missing = 0
    for frame in on_bus[begin : last + 1]:
        if frame in have:
            have.remove(frame)
        else:
            missing += 1
    return missing
