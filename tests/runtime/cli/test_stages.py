"""emb-run before it arms: its stages, the question, the watchdog, and what is kept of all that."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import pytest

from emb_bench.logs.log import read_log
from emb_bench.sim.node import BrakeNode
from emb_runtime.can.messages import Layout
from emb_runtime.cli.session import Bus
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.records import Frame
from emb_runtime.safety.heartbeat import Unwatched
from emb_runtime.safety.watchdog import WatchdogHandle, WatchdogResult
from tests.actors import constant_actor
from tests.runtime.operating import Edited, EmbRun, Keyboard, Sim

pytestmark = pytest.mark.usefixtures("handlers")

ANGLE = 0x100


# --- stages ---------------------------------------------------------------------------------------------------------


def test_read_only_logs_all_sends_nothing_and_says_what_is_on_the_bus(
    emb_run: EmbRun, tmp_path: Path, sim: Sim
) -> None:
    summary = emb_run.document("--log", str(tmp_path), "--read-only", "--duration", "0.7")
    assert (summary["result"], summary["stage"], summary["limit"], summary["steps"]) == ("done", "read-only", 0.0, 0)
    frames = summary["heard"]["frames"]
    assert frames["EMB_Status"] == 7
    assert frames["EMB_Angle"] == pytest.approx(700, abs=1)
    assert frames["EMB_Velocity"] == pytest.approx(700, abs=1)
    assert summary["heard"]["rates"]["EMB_Velocity"] == pytest.approx(1000.0)
    assert summary["heard"]["status"]["stop_reason"] == "NEVER_COMMANDED"
    assert summary["heard"]["scatter"]["velocity"] == pytest.approx(1.0, rel=0.2)
    assert sim.sent == []
    (path,) = tmp_path.glob("run-*-read.mcap")
    log = read_log(path)
    assert log.complete
    assert len(log.frames) == sum(frames.values())
    assert [event.code for event in log.events] == ["SILENT"]
    assert (log.run["purpose"], log.run["stage"], log.end["exit_reason"]) == ("reading", "read-only", "DONE")
    assert "a run could begin" in emb_run.text("--read-only", "--duration", "0.7")


def test_read_only_needs_no_policy_and_refuses_one_that_was_named_and_does_not_fit(
    emb_run: EmbRun, bench: Bench, tmp_path: Path, sim: Sim
) -> None:
    heard = emb_run.document("--read-only", "--duration", "0.5")
    assert (heard["result"], heard["exit_code"]) == ("done", 0)
    assert "policy.onnx" not in emb_run.log().attachments
    weak = tmp_path / "weak.onnx"
    weak.write_bytes(constant_actor(replace(bench, limits=replace(bench.limits, current=3.0)), 2.0))
    emb_run.refused("limits.current is 6.0 A", "--policy", str(weak), "--read-only", code=5)
    assert sim.sent == []


def test_read_only_of_a_node_that_is_not_ready_ends_with_its_fault(emb_run: EmbRun, sim: Sim) -> None:
    sim.angle = 30.0
    said = emb_run.text("--read-only", code=3)
    assert said.startswith("a run could NOT begin (NODE_NOT_READY): pre-flight, node state: at 2")
    log = emb_run.log()
    assert [event.code for event in log.events] == ["SILENT", "NODE_NOT_READY"]
    assert sim.sent == []


def test_read_only_of_a_bus_that_loses_many_samples_is_a_failed_check_and_its_log_says_so(
    emb_run: EmbRun, sim: Sim, layout: Layout
) -> None:
    sim.change = lambda frame: (
        None if frame.identifier == ANGLE and layout.decode_angle(frame).counter in (3, 4, 5, 10, 11, 12) else frame
    )
    said = emb_run.text("--read-only", code=1)
    assert said.startswith("a run could NOT begin (REFUSED): pre-flight, samples: 300, ")
    end = emb_run.log().end
    lines = {line["what"]: line for line in json.loads(end["preflight"])}
    assert end["exit_reason"] == "REFUSED"
    assert lines["samples"]["verdict"] == "refused"
    assert lines["node"]["verdict"] == "ok"


@pytest.mark.parametrize(("trouble", "result", "exit_code"), [("stop", "done", 0), ("bus", "BUS_LOST", 4)])
def test_read_only_that_is_ended_keeps_what_it_has_heard(
    emb_run: EmbRun, sim: Sim, trouble: str, result: str, exit_code: int
) -> None:
    def end(_node: BrakeNode) -> None:
        if trouble == "bus":
            raise BusError("sim: the interface is down")
        signal.raise_signal(signal.SIGTERM)

    sim.when(lambda node: node.samples == 300, end)
    summary = emb_run.document("--read-only", code=exit_code)
    assert (summary["result"], summary["heard"]["pairs"]) == (result, pytest.approx(300, abs=1))
    log = emb_run.log()
    assert log.complete
    assert log.end["exit_reason"].lower() == result.lower()
    assert json.loads(log.end["heard"]) == summary["heard"]


@pytest.mark.parametrize(("stage", "limit"), [(["--zero"], 0.0), (["--limit", "1.5"], 1.5), ([], 6.0)])
def test_nothing_beyond_the_stage_s_limit_leaves(emb_run: EmbRun, sim: Sim, stage: list[str], limit: float) -> None:
    summary = emb_run.document(*stage)
    assert (summary["limit"], summary["top_current"]) == (limit, pytest.approx(limit))
    log = emb_run.log()
    assert max(abs(c) for c in log.signals("EMB_Command")["Current"]) == pytest.approx(limit)
    assert max(abs(c) for c in sim.currents) <= limit
    assert log.run["limit"] == repr(limit)
    assert log.run["stage"] == {0.0: "zero", 1.5: "limited", 6.0: "full"}[limit]
    if limit == 0.0:  # nothing moves, and all goes through the whole chain
        assert (summary["answered"], summary["confirmed"], summary["clipped"]) == (500, 503, 500)
        assert (sim.node.obeyed, sim.node.angle_range) == (500, (0.0, 0.0))


# --- asking ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("answer", "exit_code"), [("y\n", 0), ("Yes\n", 0), ("n\n", 3), ("\n", 3), ("\x04", 3)])
def test_with_confirm_only_a_yes_arms(
    emb_run: EmbRun, tmp_path: Path, sim: Sim, keyboard: Keyboard, answer: str, exit_code: int
) -> None:
    keyboard(answer)
    emb_run.text("--log", str(tmp_path), "--confirm", code=exit_code)
    assert bool(sim.sent) is (exit_code == 0)
    assert len(list(tmp_path.glob("*.mcap"))) == (1 if exit_code == 0 else 0)


def test_what_was_typed_before_the_question_is_no_answer(emb_run: EmbRun, sim: Sim, keyboard: Keyboard) -> None:
    keyboard("y\ny\n", before=True)
    keyboard("n\n")
    emb_run.text("--confirm", code=3)
    assert sim.sent == []


def test_ctrl_c_at_the_prompt_ends_cleanly_and_nothing_was_sent(
    emb_run: EmbRun, tmp_path: Path, sim: Sim, keyboard: Keyboard, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyboard("")
    monkeypatch.setattr("emb_runtime.cli.main.time.sleep", lambda _: signal.raise_signal(signal.SIGINT))
    logs = tmp_path / "logs"
    out, err = emb_run.streams("--log", str(logs), "--confirm", "--json", code=3)
    assert json.loads(out)["result"] == "INTERRUPTED"
    assert "PRE-FLIGHT" in err  # who is asked must see what about
    assert "Traceback" not in err
    assert sim.sent == []
    assert not logs.exists()


def test_a_real_bus_asks_the_terminal_unless_told_not_to(
    emb_run: EmbRun, tmp_path: Path, sim: Sim, keyboard: Keyboard, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyboard("n\n")
    emb_run.text()  # on the simulated one nobody is asked
    sim.sent.clear()
    monkeypatch.setattr(Bus, "in_process", False)
    emb_run.text("--log", str(tmp_path / "asked.mcap"), "--no-watchdog", code=3)
    assert sim.sent == []
    emb_run.text("--log", str(tmp_path / "asked.mcap"), "--no-watchdog", "--yes")


# --- the watchdog ---------------------------------------------------------------------------------------------------


class RecordedPulse(Unwatched):
    """A pulse that keeps what it is told."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []

    def arm(self, now_ns: int) -> None:
        self.told.append("arm")

    def disarm(self) -> None:
        self.told.append("disarm")

    def publish(self, counter: int, answers: int) -> None:
        self.told.append("publish")


class FakeWatchdog:
    """Stands in for the process, which only a bus of several processes can have."""

    pid = 4711
    realtime: ClassVar = {"scheduler": "FIFO 90"}

    def __init__(self) -> None:
        self.pulse = RecordedPulse()
        self.finished = 0

    def finish(self) -> WatchdogResult:
        self.finished += 1
        return WatchdogResult(tripped="stalled", frames=3, realtime=self.realtime)


@pytest.fixture
def watchdog(monkeypatch: pytest.MonkeyPatch) -> FakeWatchdog:
    fake = FakeWatchdog()
    monkeypatch.setattr(Bus, "in_process", False)
    monkeypatch.setattr(WatchdogHandle, "start", lambda *_, **__: fake)
    return fake


def test_loop_and_guard_are_watched_and_what_became_of_it_is_told(
    emb_run: EmbRun, sim: Sim, watchdog: FakeWatchdog
) -> None:
    summary = emb_run.document()
    told = watchdog.pulse.told
    assert (told[0], told[-1], told.count("publish"), watchdog.finished) == ("arm", "disarm", 503, 1)
    assert (summary["watchdog"]["tripped"], summary["watchdog"]["frames"]) == ("stalled", 3)
    assert {line["what"]: line["verdict"] for line in summary["preflight"]}["watchdog"] == "ok"
    end = emb_run.log().end
    assert (end["watchdog_tripped"], end["watchdog_rt_scheduler"]) == ("stalled", "FIFO 90")


def test_the_watchdog_ends_with_a_run_that_is_refused(emb_run: EmbRun, sim: Sim, watchdog: FakeWatchdog) -> None:
    sim.angle = 20.0
    emb_run.text(code=3)
    assert watchdog.finished == 1
    assert sim.sent == []


def test_a_bus_that_no_watchdog_can_be_on_says_how_to_do_without_one(
    emb_run: EmbRun, sim: Sim, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Bus, "in_process", False)  # the real one refuses a simulated bus
    emb_run.refused("--no-watchdog", code=4)
    assert sim.sent == []


def test_a_run_without_watchdog_on_a_bus_that_could_have_one_is_a_warning(
    emb_run: EmbRun, tmp_path: Path, sim: Sim, watchdog: FakeWatchdog
) -> None:
    summary = emb_run.document("--log", str(tmp_path), "--no-watchdog")
    assert summary["watchdog"] is None
    assert {line["what"]: line["verdict"] for line in summary["preflight"]}["watchdog"] == "warning"
    assert watchdog.finished == 0


# --- what is kept ---------------------------------------------------------------------------------------------------


def test_the_pre_flight_and_what_was_counted_are_in_the_log_and_the_document(emb_run: EmbRun, sim: Sim) -> None:
    to_damage = {50, 90}

    def damage(frame: Frame) -> Frame:
        if sim.node.obeyed not in to_damage or frame.identifier != ANGLE:
            return frame
        to_damage.remove(sim.node.obeyed)
        return frame._replace(data=bytes([frame.data[0] ^ 1]) + frame.data[1:])

    sim.change = damage
    summary = emb_run.document()
    log = emb_run.log()
    assert set(log.metadata["emb.preflight"]) == {line["what"] for line in summary["preflight"]}
    assert log.metadata["emb.preflight"]["node state"].startswith("ok: IDLE")
    assert sum(summary["rejections"]["EMB_Angle"].values()) == 2
    assert json.loads(log.end["rejections"]) == summary["rejections"]
    for name in ("not_taken", "confirmed", "bus_errors", "left"):
        assert log.end[name] == str(summary[name])
    assert json.loads(log.end["bus_error_classes"]) == summary["bus_error_classes"] == {}


def test_time_outs_longer_than_the_shipped_ones_are_for_where_there_is_no_brake(
    emb_run: EmbRun, sim: Sim, edited: Edited
) -> None:
    patient = edited("heartbeat    = 0.005", "heartbeat    = 0.5")
    emb_run.document("--bench", patient, "--long-timeouts")
