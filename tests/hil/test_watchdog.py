"""The watchdog on a real SocketCAN bus: loops that are stopped, killed and hung, and what the node makes of it.

One kernel is booted for all scenarios. A shared host can steal seconds at any moment: so that kernel lives slowly, and
the heartbeat is longer.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from emb_runtime.config.bench import parse_bench, shipped_bench_text
from tests.actors import constant_actor
from tests.independent import DATABASE

from .conftest import EMB_HIL, SLOWLY

ROOT = Path(__file__).parents[2]
COMMAND, VELOCITY = 0x80, 0x101
STOPPING = 2
HEARTBEAT = 0.15

PATIENCE = {
    "horizon": "4000",
    "soft_missed": "100",
    "stop_missed": "400",
    "rejected": "50",
    "start_timeout": "60.0",
    "heartbeat": str(HEARTBEAT),
    "watchdog": "0.5",  # the node's own comes after this watchdog's
}

HUNG = ["hung", "robbed of the lock"]
STOPPED_FOR = ["stopped", "killed", *HUNG]
LOST = ["watchdog stopped", "watchdog killed"]


def patient_text() -> str:
    text = shipped_bench_text()
    for name, value in PATIENCE.items():
        text, found = re.subn(rf"(?m)^({name} *= )\S+", rf"\g<1>{value}", text)
        assert found == 1, name
    return text


class Scenario:
    """What a scenario left behind."""

    def __init__(self, report: dict[str, Any]) -> None:
        self.report = report
        self.commands: list[tuple[int, dict[str, Any]]] = []
        """Time [ns] and signals of every command."""
        self.states: list[tuple[int, int]] = []
        """Time [ns] and node state of every velocity frame."""
        for time_ns, identifier, data in report["frames"]:
            if identifier in (COMMAND, VELOCITY):
                values = DATABASE.decode_message(identifier, bytes.fromhex(data), decode_choices=False)
                if identifier == COMMAND:
                    self.commands.append((time_ns, values))
                else:
                    self.states.append((time_ns, values["NodeState"]))

    @property
    def summary(self) -> dict[str, Any]:
        return dict(json.loads(self.report["run"]["out"]))

    @property
    def node(self) -> dict[str, Any]:
        return dict(json.loads(self.report["node"]["out"]))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Scenario]:
    """All scenarios, played once."""
    folder = tmp_path_factory.mktemp("watchdog")
    bench, actor = folder / "bench.toml", folder / "actor.onnx"
    bench.write_text(patient_text())
    actor.write_bytes(constant_actor(parse_bench(patient_text(), "t"), 2.0))
    arguments = ["--iface", "vcan0", "--bench", str(bench), "--json"]
    node = [sys.executable, "-m", "emb_bench.cli.node", *arguments, "--theta", "f_v=3e-5"]

    def scenario(name: str, do: str, program: tuple[str, ...] = ("emb_runtime.cli.main",)) -> dict[str, Any]:
        log = f"/dev/shm/{folder.name}-{name}.mcap"
        run = [sys.executable, "-m", *program, *arguments, "--long-timeouts", "--policy", str(actor), "--log", log]
        return {"name": name, "do": do, "log": log, "node": node, "run": run}

    plan = [
        scenario("stopped", "stop"),
        scenario("killed", "kill"),
        *(scenario(how, "wait", ("tests.hil.failing_run", how)) for how in HUNG),
        scenario("watchdog stopped", "stop watchdog"),
        scenario("watchdog killed", "kill watchdog"),
    ]
    (folder / "plan.json").write_text(json.dumps(plan))
    driver = [sys.executable, "-m", "tests.hil.watchdog_driver", str(folder / "plan.json"), str(folder)]
    done = subprocess.run(
        [*EMB_HIL, *SLOWLY, "--timeout", "540", "--", *driver],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, f"the scenarios were not played (exit {done.returncode}):\n{done.stderr[-3000:]}"

    def get(name: str) -> Scenario:
        report = json.loads((folder / f"{name}.json").read_text())
        assert "error" not in report, report["error"] + str(report["run"]) + str(report["node"])
        assert report["dropped"] == 0, "the kernel had no room for all frames: nothing can be judged"
        return Scenario(report)

    return get


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", [*STOPPED_FOR, *LOST])
def test_three_stop_frames_continue_the_count_and_nothing_enabled_follows(
    played: Callable[[str], Scenario], name: str
) -> None:
    commands = [values for _, values in played(name).commands]
    assert [values["Counter"] for values in commands] == [n % 15 for n in range(len(commands))]
    assert [values["Enable"] for values in commands] == [1] * (len(commands) - 3) + [0] * 3
    assert [values["Current"] for values in commands[-3:]] == [0.0] * 3


@pytest.mark.parametrize("name", STOPPED_FOR)
def test_the_stop_frames_come_while_the_loop_cannot_send_them(played: Callable[[str], Scenario], name: str) -> None:
    scenario = played(name)
    stops = [time_ns for time_ns, values in scenario.commands if not values["Enable"]]
    assert stops[-1] < scenario.report["resumed_ns"]
    last_enabled = max(time_ns for time_ns, values in scenario.commands if values["Enable"])
    if name != "killed":  # a process that has ended is noticed at once
        assert stops[0] - last_enabled >= 0.9 * HEARTBEAT * 1e9


@pytest.mark.parametrize("name", STOPPED_FOR)
def test_the_node_obeys_the_watchdog_s_stop_frame_and_is_not_left_to_its_own_watchdog(
    played: Callable[[str], Scenario], name: str
) -> None:
    scenario = played(name)
    assert scenario.node["stop_reason"] == "DISABLED"
    first_stop = min(time_ns for time_ns, values in scenario.commands if not values["Enable"])
    # A busy computer may have hidden the whole stop between two samples.
    assert all(time_ns > first_stop for time_ns, state in scenario.states if state == STOPPING)


def test_a_loop_that_goes_on_says_that_its_watchdog_has_tripped(played: Callable[[str], Scenario]) -> None:
    scenario = played("stopped")
    assert scenario.report["run"]["exit"] == 3
    assert scenario.summary["result"] == "WATCHDOG_TRIPPED"
    watchdog = scenario.summary["watchdog"]
    assert (watchdog["tripped"], watchdog["frames"], watchdog["error"]) == ("stalled", 3, "")
    assert watchdog["silence_ns"] >= HEARTBEAT * 1e9
    assert scenario.summary["log_complete"]


@pytest.mark.parametrize("name", LOST)
def test_a_loop_stops_by_itself_when_its_watchdog_gives_no_sign_of_life(
    played: Callable[[str], Scenario], name: str
) -> None:
    scenario = played(name)
    assert scenario.report["run"]["exit"] == 3
    assert scenario.summary["result"] == "WATCHDOG_LOST"
    assert scenario.summary["log_complete"]


@pytest.mark.parametrize("name", [*STOPPED_FOR, *LOST])
def test_no_watchdog_outlives_its_run(played: Callable[[str], Scenario], name: str) -> None:
    assert played(name).report["watchdog ended"]


@pytest.fixture(scope="module")
def unguarded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    command = [*EMB_HIL, *SLOWLY, "--timeout", "300", "--", sys.executable, "-m", "tests.hil.unguarded_loop"]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(json.loads(done.stdout))


def test_after_the_trip_the_kernel_refuses_what_the_loop_sends_even_without_a_guard(unguarded: dict[str, Any]) -> None:
    assert unguarded["before"] == ""
    assert "vcan0" in unguarded["after"]
    decoded = [DATABASE.decode_message(i, bytes.fromhex(d), decode_choices=False) for i, d in unguarded["frames"][:-1]]
    assert [(values["Counter"], values["Enable"]) for values in decoded] == [(0, 1), (1, 0), (2, 0), (3, 0)]
    assert (unguarded["result"]["tripped"], unguarded["result"]["frames"]) == ("stalled", 3)
    assert unguarded["result"]["error"] == ""


def test_after_the_trip_the_loop_still_hears_its_bus(unguarded: dict[str, Any]) -> None:
    assert unguarded["heard"] == [COMMAND, COMMAND, COMMAND, COMMAND, 0x123]


def test_where_there_is_real_time_the_watchdog_stands_above_the_loop(unguarded: dict[str, Any]) -> None:
    assert unguarded["result"]["realtime"]["scheduler"] == "FIFO 90"
