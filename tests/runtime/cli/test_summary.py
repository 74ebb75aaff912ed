"""What is said of a run afterwards, in words and in the log."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from emb_runtime.can.messages import StopReason
from emb_runtime.cli.documents import RunResult, refusal, trailer
from emb_runtime.cli.options import parser, prepare
from emb_runtime.cli.plan import Plan
from emb_runtime.cli.preflight import Check, RefusedError
from emb_runtime.cli.summary import brief, run_text
from emb_runtime.config.bench import Bench
from emb_runtime.control.memory import RunCounters
from emb_runtime.control.result import Outcome
from emb_runtime.errors import EXIT_OUTSIDE, BusError, UsageError
from emb_runtime.log.recorder import RecorderResult
from emb_runtime.records import NodeState, RunType, SensorSample
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.safety.watchdog import WatchdogResult
from tests.actors import contract_for


@pytest.fixture
def plan(bench: Bench) -> Plan:
    plan = prepare(parser().parse_args(["--iface", "can0"]))
    assert plan.experiment is not None
    policy: Any = SimpleNamespace(contract=contract_for(bench, 300.0, kind="speed"), sha256="0123456789abcdef")
    return replace(plan, bench=bench, experiment=replace(plan.experiment, policy=policy))


@pytest.fixture
def outcome() -> Outcome:
    return Outcome(
        fault=None,
        detail="",
        counters=RunCounters(
            pairs=501, answered=490, unanswered=10, not_taken=2, left=3, confirmed=493, top_current=5.5
        ),
        end=SensorSample(0, 0.01, 0.5, 0, 0, 0.0, 15, NodeState.ACTIVE),
        last=SensorSample(1, 0.02, 0.5, 0, 0, 0.0, 15, NodeState.IDLE),
        home=True,
        node_at_rest=True,
        node_stop_reason=StopReason.DISABLED,
        duration_ns=500_000_000,
        rejections={},
        bus_errors={},
    )


@pytest.fixture
def ran(plan: Plan, outcome: Outcome) -> RunResult:
    log = RecorderResult(Path("run.mcap"), 3787, 150_000, 0, True, "")
    return RunResult(plan, RunType.EXPERIMENT, 500, (), outcome, log, None, {})


@pytest.fixture
def told(ran: RunResult) -> Any:
    """The document of a run that was a little other."""

    def make(run_type: RunType = RunType.EXPERIMENT, **changes: Any) -> dict[str, Any]:
        of_run = {name: changes.pop(name) for name in ("watchdog", "realtime", "log") if name in changes}
        return replace(ran, run_type=run_type, outcome=replace(ran.outcome, **changes), **of_run).document()

    return make


def test_every_count_and_every_trouble_has_its_words_and_an_undisturbed_run_few(told: Any) -> None:
    lost = RecorderResult(Path("run.mcap"), 5, 100, 1, False, "disk full")
    tripped = WatchdogResult(tripped="stalled", frames=3, error="queue full")
    rows: tuple[tuple[dict[str, Any], str], ...] = (
        ({}, "490 of 500"),
        ({}, "10 without a command"),
        ({}, "  policy     speed, sha256 0123456789ab\n"),
        ({}, "run.mcap (3787 messages, 146 KiB)"),
        ({"bus_errors": {"no acknowledgement": 3, "bus error": 1}}, "no acknowledgement (3), bus error (1)"),
        ({"rejections": {"EMB_Angle": {"CRC": 2}}}, "EMB_Angle: CRC (2)"),
        ({"watchdog": tripped}, "stalled, 3 stop frames: queue full"),
        ({"realtime": {"scheduler": "not obtained: no", "timer_slack": "1 ns"}}, "NOT OBTAINED: scheduler;"),
        ({"log": lost}, "INCOMPLETE: disk full"),
        ({"node_stop_reason": StopReason.LIMIT}, "LIMIT"),
        ({"node_stop_reason": None}, "stop reason not reported"),
        ({"unexplained": (3.6, math.inf)}, "no verdict"),
        (
            {"estimate": (0.02, 23.0, 0.01, 2e-5, 0.006, 6.6, 0.003, 6e-6), "model_fits": False},
            "THE MODEL DOES NOT FIT",
        ),
        ({"unexplained": (3.6, 28.4)}, "unexplained velocity 4 rad/s, limit 28 rad/s"),
        ({"response": "0.1 samples late"}, "  response   0.1 samples late\n"),
        ({"response": ""}, "  response   NOT PROVEN: too little motion, so the speed stayed low\n"),
    )
    for changes, part in rows:
        changes |= {"counters": RunCounters(pairs=1, answered=490, unanswered=10, bus_errors=4)}
        assert part in run_text(told(**changes), details=True), part
    said = run_text(told(counters=RunCounters(pairs=501, answered=500, confirmed=503), watchdog=WatchdogResult()))
    assert len(said.splitlines()) <= 14
    assert "watchdog" not in said


def test_an_estimate_at_the_border_of_the_ranges_or_beyond_is_said_first_and_with_strict_no_success(
    ran: RunResult,
) -> None:
    for k_1, outside in ((23.0, False), (11.0, True), (34.56, True), (34.5, False)):
        estimate = (0.02, k_1, 0.01, 2e-5, 1e-5, 0.0004, 1e-5, 1e-7)
        for strict in (False, True):
            known = replace(ran, plan=replace(ran.plan, strict=strict), outcome=replace(ran.outcome, estimate=estimate))
            said = known.document()
            assert list(said["outside"]) == (["k_1"] if outside else [])
            assert said["exit_code"] == (EXIT_OUTSIDE if outside and strict else 0)
            first, second, *_ = run_text(said).splitlines()
            assert ("OUTSIDE" in first, "the limits were not guaranteed" in second) == (outside, outside)
            stopped = replace(known, outcome=replace(known.outcome, fault=Fault.INTERRUPTED))
            assert stopped.document()["exit_code"] == 3


def test_an_estimate_of_a_run_that_ended_before_its_response_was_proven_says_nothing_of_the_ranges(told: Any) -> None:
    estimate = (0.02, 11.0, 0.01, 2e-5, 1e-5, 0.0004, 1e-5, 1e-7)
    assert not told(fault=Fault.RESPONSE_LATE, estimate=estimate)["outside"]
    assert list(told(fault=Fault.INTERRUPTED, estimate=estimate, response="on time")["outside"]) == ["k_1"]


def test_every_fault_is_told_with_its_cause_its_detail_and_what_to_do(told: Any) -> None:
    for fault in Fault:
        said = run_text(told(fault=fault, detail="because", home=False)).splitlines()
        assert said[0] == f"STOPPED ({fault.name}): {FAULTS[fault].cause}: because"
        assert said[1] == f"  → {FAULTS[fault].advice}"
        assert brief(told(fault=fault, detail="because")) == f"{fault.name}: because, run.mcap"


def test_the_ways_home_are_told_with_the_experiment(told: Any) -> None:
    way = told(RunType.HOMING)
    gone = refusal(RefusedError("nobody there", 4, (), Fault.NO_NODE), "can0")
    said = run_text(told() | {"homing": {"before": way, "after": gone}})
    assert "way home   before the experiment: done: 490 of 500 answered, home, run.mcap" in said
    assert "way home   after the experiment: NO_NODE: nobody there" in said
    assert "policy" not in run_text(told(RunType.HOMING))  # it does not move the brake then
    assert run_text(told(RunType.HOMING, fault=Fault.NOT_HOME)).startswith("STOPPED on the way home (NOT_HOME)")


@pytest.mark.parametrize(
    ("err", "result", "exit_code"),
    [
        (RefusedError("x", 3, (Check("node", "a", "b"),), Fault.NODE_NOT_READY), "NODE_NOT_READY", 3),
        (RefusedError("x", 2), "REFUSED", 2),
        (BusError("x"), "BUS_LOST", 4),
        (UsageError("x"), "REFUSED", 2),
    ],
)
def test_what_ended_before_anything_was_sent_has_a_document_too(
    err: RefusedError | BusError | UsageError, result: str, exit_code: int
) -> None:
    found = refusal(err, "can0")
    assert (found["result"], found["exit_code"], found["log"], found["detail"]) == (result, exit_code, None, "x")
    assert brief(found) == f"{result}: x"
    assert len(found["preflight"]) == (result == "NODE_NOT_READY")


def test_the_log_s_last_record_has_all_of_it_as_text(outcome: Outcome) -> None:
    changed = replace(outcome, rejections={"pair": {"why": 1}}, bus_errors={"bus error": 2})
    end = trailer(changed, {"scheduler": "FIFO 80"}, WatchdogResult(realtime={"scheduler": "FIFO 90"}))
    assert all(isinstance(value, str) for value in end.values())
    assert (end["exit_reason"], end["answered"], end["home"], end["left"]) == ("DONE", "490", "True", "3")
    assert (end["duration_s"], end["end_angle"], end["last_angle"], end["node_state"]) == (
        "0.5",
        "0.01",
        "0.02",
        "IDLE",
    )
    assert {name for name, value in changed.document().items() if value is not None} <= set(end)
    assert "goal_s" not in end
    assert json.loads(end["rejections"]) == {"pair": {"why": 1}}
    assert json.loads(end["bus_error_classes"]) == {"bus error": 2}
    assert (end["rt_scheduler"], end["watchdog_rt_scheduler"], end["watchdog_tripped"]) == ("FIFO 80", "FIFO 90", "")


def test_a_loop_that_gave_no_outcome_is_an_internal_error_in_the_log() -> None:
    end = trailer(None, {}, WatchdogResult(tripped="gone"))
    assert (end["exit_reason"], end["watchdog_tripped"]) == ("INTERNAL", "gone")


def test_the_last_estimate_is_told_with_its_interval_and_unit(ran: RunResult) -> None:
    known = replace(ran.outcome, estimate=(0.02, 0.05, 0.01, 2e-5, 1e-5, 0.0004, 1e-5, 1e-7), goal_ns=94_000_000)
    said = replace(ran, outcome=known).document()
    halves = {"repeatability": pytest.approx(1.96e-7, rel=1e-4), "total": pytest.approx(4.38e-7, rel=1e-2)}
    assert said["estimate"]["f_v"] == {"value": 2e-5, "deviation": 1e-7, **halves, "unit": "N·m·s/rad"}
    lines = run_text(said).splitlines()
    assert lines[0].endswith(" samples answered, precise after 0.094 s, then home")
    assert said["goal_s"] == pytest.approx(0.094)
    for line in (
        "k_1 = 0.05000 ± 0.00078 N/rad repeatability ± 1.6 %",
        "f_v = (2.000 ± 0.020) × 10⁻⁵ N·m·s/rad repeatability ± 0.98 %",
        "total about 2 to 2.5 %, as J is known to 1 %",
    ):
        assert line in [" ".join(said.split()) for said in lines]
    assert trailer(known, {})["goal_reached"] == "True"


def test_a_motion_that_was_judged_is_in_document_and_log_and_one_that_was_not_is_in_neither(
    told: Any, outcome: Outcome
) -> None:
    rows: tuple[tuple[dict[str, Any], bool], ...] = (
        ({}, False),
        ({"unexplained": (3.6, math.inf)}, False),
        ({"unexplained": (3.6, 28.4)}, True),
    )
    for changes, judged in rows:
        found, end = told(**changes), trailer(replace(outcome, **changes), {})
        numbers = (3.6, 28.4) if judged else (None, None)
        assert (found["unexplained"], found["unexplained_allowed"]) == numbers
        assert ("unexplained" in end) is judged
        assert not judged or (float(end["unexplained"]), float(end["unexplained_allowed"])) == numbers
        assert "motion" not in run_text(told(run_type=RunType.HOMING, **changes))


def test_a_motion_without_an_explanation_leads_to_what_to_check(ran: RunResult, told: Any) -> None:
    changed = replace(ran, outcome=replace(ran.outcome, fault=Fault.MOTION_UNEXPLAINED, detail="60 rad/s"))
    assert changed.exit_code == 8
    said = run_text(told(fault=Fault.MOTION_UNEXPLAINED, detail="60 rad/s"))
    for word in ("MOTION_UNEXPLAINED", "60 rad/s", "zero", "scale", "current", "friction"):
        assert word in said
