"""The whole chain on a real SocketCAN bus: emb-node and emb-run as two processes, judged from outside.

One kernel is booted for all scenarios. A shared host can steal seconds at any moment: so that kernel lives slowly, the
bench file waits longer. What is asserted is what was said and logged; exact times are the matter of ``--iface sim``.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from emb_bench.cli.replay import main as replay
from emb_bench.logs.log import RunLog, read_log
from emb_runtime.config.bench import Bench, parse_bench, shipped_bench_text
from tests.actors import constant_actor
from tests.independent import DATABASE, protected

from .conftest import EMB_HIL

DRIVER = Path(__file__).with_name("driver.py")
COMMAND, ANGLE, VELOCITY, STATUS = 0x80, 0x100, 0x101, 0x102
WATCHDOG_MS = 400
SLOW = "1000"
"""Times that the kernel is slower: two milliseconds in there are two seconds of a computer that stands still."""

PATIENCE = {
    "soft_missed  = 5": "soft_missed  = 100",
    "stop_missed  = 20": "stop_missed  = 400",
    "rejected     = 5": "rejected     = 50",
    "start_timeout = 5.0": "start_timeout = 60.0",
    "heartbeat    = 0.005": "heartbeat    = 0.2",
    "watchdog         = 0.010": f"watchdog         = {WATCHDOG_MS / 1000}",
}


def patient_text(horizon: int = 500) -> str:
    text = shipped_bench_text().replace("horizon     = 500", f"horizon     = {horizon}")
    for old, new in PATIENCE.items():
        assert old in text
        text = text.replace(old, new)
    return text


@dataclass
class Scenario:
    """What a scenario left behind."""

    report: dict[str, Any]
    log_path: Path

    @property
    def frames(self) -> list[tuple[int, int, bytes]]:
        return [(t, i, bytes.fromhex(d)) for t, i, d in self.report["frames"]]

    @property
    def summary(self) -> dict[str, Any]:
        return dict(json.loads(self.report["run"]["out"]))

    def log(self) -> RunLog:
        return read_log(self.log_path)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scenario]:
    """All scenarios, played once."""
    folder = tmp_path_factory.mktemp("chain")
    bench = folder / "bench.toml"
    bench.write_text(patient_text())
    long_text = patient_text(horizon=4000)
    long_bench = folder / "long.toml"
    long_bench.write_text(long_text)
    actors = {
        "long": constant_actor(parse_bench(long_text, "long"), 2.0),
        "giant": constant_actor(parse_bench(patient_text(), "t"), 3.0, 1e9),
    }
    for name, data in actors.items():
        (folder / f"{name}.onnx").write_bytes(data)

    def scenario(name: str, **changes: Any) -> dict[str, Any]:
        on = changes.pop("bench", bench)
        node = ["-m", "emb_bench.cli.node", "--iface", "vcan0", "--bench", str(on), "--json", "--theta", "f_v=3e-5"]
        node += changes.pop("node_arguments", [])
        run = ["-m", "emb_runtime.cli.main", "--iface", "vcan0", "--bench", str(on), "--json", "--long-timeouts"]
        log = f"/dev/shm/{folder.name}-{name}.mcap"
        run += ["--log", log, *changes.pop("arguments", [])]
        plain = {"name": name, "log": log, "node": [sys.executable, *node], "run": [sys.executable, *run]}
        return {**plain, "kill": None, "linger": 0.3, **changes}

    def killed(by: str, after: int = 150, recorder: bool = False) -> dict[str, Any]:
        return {"after": after, "signal": by, "recorder": recorder}

    long = {"bench": long_bench, "arguments": ["--policy", str(folder / "long.onnx")]}
    plan = [
        scenario("normal"),
        scenario("killed", **long, kill=killed("SIGKILL", 400), linger=1.5),
        # The node leaves the recorder its share of this kernel's only processor here.
        scenario(
            "all_killed",
            **long,
            kill=killed("SIGKILL", 700, recorder=True),
            linger=0.5,
            node_arguments=["--no-rt"],
        ),
        scenario("interrupted", **long, kill=killed("SIGINT")),
        scenario("giant", arguments=["--policy", str(folder / "giant.onnx")]),
    ]
    (folder / "plan.json").write_text(json.dumps(plan))
    _play(folder)

    def get(name: str) -> Scenario:
        report = json.loads((folder / f"{name}.json").read_text())
        assert "error" not in report, report
        assert report["dropped"] == 0, "the kernel had no room for all frames: nothing can be judged"
        return Scenario(report, folder / f"{name}.mcap")

    return get


def _play(folder: Path) -> None:
    import subprocess

    driver = [sys.executable, str(DRIVER), str(folder / "plan.json"), str(folder)]
    command = [*EMB_HIL, "--slow", SLOW, "--timeout", "460", "--", *driver]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"the scenarios were not played (exit {done.returncode}):\n{done.stderr[-3000:]}"


ALL = ["normal", "killed", "all_killed", "interrupted", "giant"]


@pytest.mark.timeout(480)
@pytest.mark.parametrize("name", ALL)
def test_every_command_on_the_bus_is_legal(played: Callable[[str], Scenario], name: str) -> None:
    """±6 A, a valid CRC (AUTOSAR's own code), the next counter, and an answer to a sample that was on the bus."""
    message = DATABASE.get_message_by_frame_id(COMMAND)
    newest = None
    counters = []
    for _, identifier, data in played(name).frames:
        if identifier == ANGLE:
            newest = data[1] & 0x0F
        if identifier != COMMAND:
            continue
        values = message.decode(data, decode_choices=False)
        assert abs(values["Current"]) <= 6.0
        assert values["Enable"] == 1 or values["Current"] == 0.0
        assert data == protected(COMMAND, data[1:])
        assert newest is not None
        counters.append(values["Counter"])
    assert counters, "no command was sent"
    assert counters == [n % 15 for n in range(len(counters))]


@pytest.mark.parametrize("name", ALL)
def test_the_brake_passed_no_limit(played: Callable[[str], Scenario], name: str) -> None:
    node = json.loads(played(name).report["node"]["out"])
    assert node["angle_min"] >= -10.0
    assert node["angle_max"] <= 100.0
    assert node["top_speed"] <= 500.0


def test_every_sensor_pair_is_answered_once_or_counted(played: Callable[[str], Scenario]) -> None:
    scenario = played("normal")
    summary = scenario.summary
    assert scenario.report["run"]["exit"] == 0, scenario.report["run"]
    assert summary["result"] == "done"
    assert summary["pairs"] == summary["answered"] + summary["unanswered"] + 1
    assert summary["answered"] > 0
    # From the frames alone: each enabled command names a pair that was on the bus before it, and none is named twice.
    message = DATABASE.get_message_by_frame_id(COMMAND)
    pairs: list[int] = []  # the counter of each
    answered: list[int] = []
    for _, identifier, data in scenario.frames:
        if identifier == VELOCITY:
            pairs.append(data[1] & 0x0F)
        elif identifier == COMMAND and (values := message.decode(data))["Enable"]:
            age = (pairs[-1] - values["Answers"]) % 15
            answered.append(len(pairs) - 1 - age)
    assert len(set(answered)) == len(answered) == summary["answered"]
    assert answered == sorted(answered)
    assert answered[-1] - answered[0] < summary["pairs"] + summary["missed"]
    # Both ends account for the same commands; only across periods that the node skipped can the runtime not know.
    obeyed = json.loads(scenario.report["node"]["out"])["obeyed"]
    assert 0 <= summary["answered"] - summary["not_obeyed"] - obeyed <= summary["missed"]


def test_the_log_holds_every_frame_that_was_on_the_bus(played: Callable[[str], Scenario]) -> None:
    scenario = played("normal")
    log = scenario.log()
    assert log.complete
    assert scenario.summary["log_dropped"] == 0
    logged = [(f.identifier, f.data) for f in log.frames]
    on_bus = [(i, d) for _, i, d in scenario.frames]
    start = first_index(on_bus, logged[:40])
    assert on_bus[start : start + len(logged)] == logged
    # Nothing that belongs to the run lies outside: all commands are in it.
    assert sum(i == COMMAND for i, _ in logged) == sum(i == COMMAND for i, _ in on_bus)


def first_index(sequence: list[Any], part: list[Any]) -> int:
    for start in range(len(sequence) - len(part) + 1):
        if sequence[start : start + len(part)] == part:
            return start
    raise AssertionError("the beginning of the log was never on the bus")


def test_the_log_is_evaluated_to_fisher_information_and_run_again(
    played: Callable[[str], Scenario], capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(["fim", str(played("normal").log_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["physical"]["log_det"] > 60.0
    assert all(0.0 < v < 0.1 for v in report["physical"]["cramer_rao"].values())
    assert replay(["rerun", str(played("normal").log_path)]) == 0


@pytest.mark.parametrize("name", ["killed", "all_killed"])
def test_after_kill_9_the_node_begins_its_stop_within_its_watchdog_and_two_periods(
    played: Callable[[str], Scenario], name: str
) -> None:
    scenario = played(name)
    assert scenario.report["run"]["exit"] == -9
    frames = scenario.frames
    enabled = DATABASE.get_message_by_frame_id(COMMAND)
    last = max(n for n, (_, i, data) in enumerate(frames) if i == COMMAND and enabled.decode(data)["Enable"])
    # The watchdog process speaks where it lives; where it was killed as well, the node's own must do.
    assert sum(i == COMMAND for _, i, _ in frames[last + 1 :]) == (3 if name == "killed" else 0)
    answered_ms = max(device_time_ms(frames[: last + 1]))
    samples = samples_after(frames, last)
    stopping = [n for n, (_, state) in enumerate(samples) if state == 2]
    assert stopping, "the node never began its stop"
    # The stop begins between two samples of the node; a computer that stood still may have hidden some of them.
    before_ms = samples[stopping[0] - 1][0] if stopping[0] else answered_ms
    assert before_ms - answered_ms <= WATCHDOG_MS + 2
    if name == "all_killed":
        assert samples[stopping[0]][0] - answered_ms >= WATCHDOG_MS


def device_time_ms(frames: list[tuple[int, int, bytes]]) -> list[float]:
    message = DATABASE.get_message_by_frame_id(ANGLE)
    times: list[float] = []
    wraps = 0.0
    for _, identifier, data in frames:
        if identifier == ANGLE:
            stamp = message.decode(data)["DeviceTime"] * 1e3 + wraps
            if times and stamp < times[-1]:
                stamp, wraps = stamp + 4194.304, wraps + 4194.304
            times.append(stamp)
    return times


def samples_after(frames: list[tuple[int, int, bytes]], start: int) -> list[tuple[float, int]]:
    """(device time in ms, node state) of every sample after a position."""
    velocity = DATABASE.get_message_by_frame_id(VELOCITY)
    times = device_time_ms(frames)
    states = [velocity.decode(d, decode_choices=False)["NodeState"] for _, i, d in frames if i == VELOCITY]
    already = sum(i == VELOCITY for _, i, _ in frames[: start + 1])
    return list(zip(times, states, strict=False))[already:]


def test_after_kill_9_the_recorder_finishes_the_log_and_it_can_be_evaluated(
    played: Callable[[str], Scenario], capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = played("killed")
    log = scenario.log()
    sent = sum(i == COMMAND and bool(data[4] & 1) for _, i, data in scenario.frames)
    assert abs(int((log.signals("EMB_Command")["Enable"] == 1).sum()) - sent) <= 2
    assert replay(["fim", str(scenario.log_path)]) == 0
    assert "died" in capsys.readouterr().out


def test_after_kill_9_of_the_recorder_and_the_watchdog_too_the_cut_log_says_what_is_missing(
    played: Callable[[str], Scenario], capsys: pytest.CaptureFixture[str]
) -> None:
    """How much is lost is tested where the recorder has a processor of its own: here it has what the loop leaves."""
    scenario = played("all_killed")
    assert len(scenario.report["killed"]) == 2, "recorder and watchdog"
    log = scenario.log()
    assert not log.complete
    assert "cut" in log.missing or "closed" in log.missing
    assert {f.identifier for f in log.frames} <= {COMMAND, ANGLE, VELOCITY, STATUS}
    code = replay(["fim", str(scenario.log_path)])
    out, err = capsys.readouterr()
    assert (code == 0 and log.missing.split(";")[0] in out) or (code == 6 and err.count("\n") == 1)


def test_ctrl_c_ends_with_stop_frames(played: Callable[[str], Scenario]) -> None:
    scenario = played("interrupted")
    assert scenario.report["run"]["exit"] == 3
    assert scenario.summary["result"] == "INTERRUPTED"
    assert_stop_frames(scenario)


def test_a_policy_gone_mad_is_stopped(played: Callable[[str], Scenario]) -> None:
    scenario = played("giant")
    assert scenario.report["run"]["exit"] == 3
    assert scenario.summary["result"] == "POLICY_BEYOND_CONTRACT"
    assert "Traceback" not in scenario.report["run"]["err"]
    assert_stop_frames(scenario)


def assert_stop_frames(scenario: Scenario) -> None:
    message = DATABASE.get_message_by_frame_id(COMMAND)
    enables = [message.decode(d, decode_choices=False)["Enable"] for _, i, d in scenario.frames if i == COMMAND]
    assert enables[-3:] == [0, 0, 0]
    assert set(enables[:-3]) == {1}


def test_what_was_timed_where_time_runs_slowly_is_not_judged(
    played: Callable[[str], Scenario], capsys: pytest.CaptureFixture[str]
) -> None:
    assert replay(["timing", str(played("normal").log_path)]) == 2
    assert f"not judged: time ran {SLOW} times slower than the computer's" in capsys.readouterr().out


def test_the_direction_of_every_logged_frame_is_right(played: Callable[[str], Scenario], bench: Bench) -> None:
    log = played("normal").log()
    assert len(log.tables["/can/tx"]["id"]) == sum(f.identifier == COMMAND for f in log.frames)
    assert set(log.tables["/can/tx"]["id"]) == {COMMAND}
    assert set(log.tables["/can/rx"]["id"]) == {ANGLE, VELOCITY, STATUS}
    assert bench.contract_hash == log.bench.contract_hash


def test_consecutive_device_times_in_the_log_advance(played: Callable[[str], Scenario]) -> None:
    times = played("normal").log().cycles["device_time_ns"]
    assert all(int(b) > int(a) for a, b in pairwise(times))
