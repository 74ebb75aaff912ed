"""The judgement of what was on the bus in a play, by cantools and AUTOSAR's own CRC, not by the project's code.

Time is bus time: the node's device time, and the kernel's stamps.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from emb_bench.logs.log import read_log
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import LogError
from emb_runtime.safety.end_stop import released_speed
from tests.independent import DATABASE, MESSAGES, protected
from tests.scenarios.injections import ANGLE, COMMAND, STATUS, VELOCITY
from tests.scenarios.table import Scenario

STOPPING = 2
NO_COMMAND = 15
WATCHDOG_MS = 10.0  # The shipped bench's node.watchdog
DRIVE_TIME_OUT = 0.010  # [s]


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

    play: Scenario
    report: dict[str, Any]
    log: Path
    frames: list[tuple[int, int, bytes]] = field(repr=False)  # On the node's bus
    run_frames: list[tuple[int, int, bytes]] = field(repr=False)  # On the run's bus, which may be another

    @property
    def summary(self) -> dict[str, Any]:
        """What emb-run said."""
        said: dict[str, Any] = json.loads(self.report["run"]["out"] or "{}")
        return said

    @property
    def told(self) -> list[dict[str, Any]]:
        """What the nodes that were not killed said at their end."""
        return [json.loads(node["out"]) for node in self.report["nodes"] if node["out"].startswith("{")]

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


def seen(play: Scenario, folder: Path) -> Seen:
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
    stop_ms: float | None
    """From the last period that obeyed a command to the node's safe stop, device time; None if there was no stop."""
    frames_lost: int | None
    """Frames of the node and of ours on the bus up to the last current that the log has not; None without a log."""


def judge(it: Seen) -> Verdict:
    """Judge a play."""
    wrong = [*_ended_wrongly(it, it.summary.get("result", "")), *illegal(it), *stop_frames(it)]
    stop_ms = safe_stop(it.samples())
    if it.play.stops and not it.play.node_lost:
        if stop_ms is None:
            wrong.append("the node never began its stop")
        elif stop_ms > WATCHDOG_MS + 2.0:
            wrong.append(f"the stop began after {stop_ms:.1f} ms")
    highest = 500.0
    if it.play.drive and it.play.actions:  # nothing brakes a drive that has let go
        highest = released_speed(load_bench(it.log.parent / "late.toml"), DRIVE_TIME_OUT)
    for node in it.told:
        low, high, speed = node["angle_min"], node["angle_max"], node["top_speed"]
        if low < -10.0 or high > 100.0 or speed > highest:
            wrong.append(f"limits passed: {low:.2f} to {high:.2f} rad, {speed:.1f} rad/s")
    return Verdict(tuple(wrong), stop_ms, lost(it))


def _ended_wrongly(it: Seen, result: str) -> list[str]:
    """What is wrong with how the play went and how the programs ended."""
    report, play = it.report, it.play
    complaints = {
        report.get("error", ""): "error" in report,
        f"the kernel dropped {report['dropped']} frames: nothing can be judged": report["dropped"],
        "the run did not end by itself": report["run"]["forced"],
        "a traceback": "Traceback" in report["run"]["err"],
        f"exit {report['run']['exit']}: {report['run']['err'].strip()}": report["run"]["exit"] not in play.exits,
        f"it said {result}: {it.summary.get('detail')}": play.results and result not in play.results,
        f"processes outlive the run: {report['left']}": report["left"],
        "the fault did not strike": play.name in STRUCK and not STRUCK[play.name](it),
        "the drive is still armed": any(node.get("armed") for node in it.told),
    }
    return [what for what, wrong in complaints.items() if wrong]


def illegal(it: Seen) -> list[str]:
    """What is wrong with the commands on the bus: range, enable, CRC, counter, and the sample that is answered."""
    found = []
    newest = {n: data[1] & 0x0F for n, (_, i, data) in enumerate(it.run_frames) if i == ANGLE and len(data) == 8}
    answered: set[int] = set()
    foreign = it.play.name in ("foreign_commander", "duplicates")
    lossy = any(action["do"] in ("impair", "link") for action in it.play.actions or ())
    held_up = any(action.get("by", {}).get("delay", 0.0) > 0.002 for action in it.play.actions or ())  # after the guard
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


def stop_frames(it: Seen) -> list[str]:
    """What is wrong with the last commands: so many that disable, and before them all enabled."""
    count = it.play.stop_frames
    if count is None:
        return []
    enables = [values["Enable"] for _, values in it.commands()]
    expected = [1] * (len(enables) - count) + [0] * count
    return [] if enables and enables == expected else [f"expected {count} stop frames at the end, got {enables[-10:]}"]


def _out_of_order(it: Seen) -> bool:
    pairs = [(i, data[1] & 0x0F) for _, i, data in it.frames if i in (ANGLE, VELOCITY)]
    return any(i == VELOCITY and before != (ANGLE, counter) for before, (i, counter) in pairwise(pairs))


def _answers_take(it: Seen, least_ns: int) -> bool:
    """Returns True if from the fault on no command came sooner after its velocity frame."""
    begin, last, delays = it.report["done"][0][1], 0, []
    for time_ns, identifier, _ in it.frames:
        if identifier == VELOCITY:
            last = time_ns
        elif identifier == COMMAND and last > begin + 10_000_000:
            delays.append(time_ns - last)
    return len(delays) > 100 and min(delays) >= least_ns


STRUCK: dict[str, Callable[[Seen], bool]] = {
    "loss": lambda it: sum(b.device_ms - a.device_ms > 1.5 for a, b in pairwise(it.samples())) > 5,
    "delay": lambda it: _answers_take(it, 90_000),
    "duplicates": lambda it: sum(a[1:] == b[1:] for a, b in pairwise(it.frames)) > 5,
    "reordered": _out_of_order,
    "babbling_stranger": lambda it: sum(identifier == 0x7FF for _, identifier, _ in it.frames) > 300,
    "clock_forward": lambda it: max(b[0] - a[0] for a, b in pairwise(it.frames)) > 9e9,
    "clock_back": lambda it: min(b[0] - a[0] for a, b in pairwise(it.frames)) < -9e9,
}
"""That the fault was on the bus, of plays that may end as if there had been none."""


def safe_stop(samples: list[Sampled]) -> float | None:
    """Device time from the last period that obeyed a command to the node's stop [ms]; None without either."""
    stop = next((s for s in samples if s.state == STOPPING), None)
    obeyed = [s.device_ms for s in samples if stop is not None and s.obeyed != NO_COMMAND and s.at < stop.at]
    return stop.device_ms - obeyed[-1] if stop is not None and obeyed else None


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
