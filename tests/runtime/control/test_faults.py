"""Every fault in a whole run of the simulated loop; one for which no scenario is written fails here.

And a node that is not heard: before the run begins, and between two samples, to the nanosecond.
"""

from __future__ import annotations

import dataclasses
import re
from itertools import pairwise
from typing import Any

import pytest

from emb_bench.sim.transport import SimTransport, SteppedClock, open_sim
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Sensors
from emb_runtime.records import CurrentCommand, Frame, NodeState, RunState
from emb_runtime.safety.heartbeat import STOP_FRAMES
from emb_runtime.safety.state_machine import FAULTS, Fault

from tests.conftest import FunctionActor, SimRun, Simulate, make_loop  # isort: skip
from tests.benches import SENSOR_BENCH
from tests.scenarios.injections import ANGLE, STATUS, VELOCITY, Pulse, changing, dropping, saying
from tests.scenarios.table import IN_LOOP, loop_run

MS = 1_000_000


def test_a_node_that_sends_the_velocity_first_is_there_and_not_ready(simulate: Simulate) -> None:
    held: list[Frame] = []

    def swap(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        if frame is not None and frame.identifier == ANGLE:
            following = transport.receive(clock.now_ns())
            assert following is not None
            held.append(frame)
            return following
        if held and frame is not None:
            held.append(frame)
        return held.pop(0) if held else frame

    run = simulate(on_receive=swap)
    assert run.outcome.fault is Fault.NODE_NOT_READY
    assert "no velocity next after the angle with its counter" in run.outcome.detail
    assert run.sent == []


BY_FAULT = {scenario.fault: name for name, scenario in IN_LOOP.items()}


def test_every_fault_has_a_scenario() -> None:
    assert BY_FAULT.keys() == {None, *Fault}
    assert len(BY_FAULT) == len(IN_LOOP)  # a second one of a fault would not be played here


@pytest.mark.parametrize("fault", [f for f, info in FAULTS.items() if info.latched], ids=lambda fault: fault.name)
def test_every_fault_that_latches_ends_the_run_with_stop_frames_and_within_limits(
    fault: Fault, simulate: Simulate, layout: Layout
) -> None:
    run = loop_run(BY_FAULT[fault], simulate)
    assert run.outcome.fault is fault, run.outcome.detail
    assert fault.name in run.journal.codes
    assert run.journal.codes[-1] == "OVER"
    assert not run.outcome.home
    sent = commands(run, layout)
    assert all(abs(c.current) <= 6.0 for c in sent)
    armed = fault not in (Fault.NO_NODE, Fault.NODE_NOT_READY)
    assert (run.outcome.end is not None) == armed
    if not armed:
        assert sent == []
        return
    if fault is Fault.WATCHDOG_TRIPPED:  # the watchdog sends the stop frames, and this process is silent
        assert all(c.enable for c in sent)
    else:
        assert [(c.enable, c.current) for c in sent[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES
    if fault is not Fault.OUT_OF_LIMITS:  # that one is a brake for which nothing was promised
        assert_within_limits(run)
    if fault is not Fault.NOT_OBEYED:  # that node hears nothing, stop frames neither
        assert run.transport.node.state in (NodeState.STOPPING, NodeState.IDLE)
    assert FAULTS[fault].exit_code in (3, 4, 8)


@pytest.mark.parametrize("fault", [f for f, info in FAULTS.items() if not info.latched], ids=lambda fault: fault.name)
def test_every_soft_fault_is_told_and_ends_nothing_by_itself(fault: Fault, simulate: Simulate, layout: Layout) -> None:
    run = loop_run(BY_FAULT[fault], simulate)
    assert fault.name in run.journal.codes
    assert run.outcome.fault in (None, Fault.NODE_STOPPED)  # the node ends it where nobody may command it for long
    assert (run.outcome.fault is None) == (fault is not Fault.PERMISSION_LOST)
    sent = commands(run, layout)
    assert [(c.enable, c.current) for c in sent[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES
    assert_within_limits(run)


def test_a_command_without_room_is_lost_and_never_sent_later(simulate: Simulate, layout: Layout) -> None:
    run = loop_run("queue", simulate)
    assert (run.outcome.counters.not_taken, run.outcome.counters.unanswered) == (3, 3)
    assert run.journal.codes.count(Fault.SEND_QUEUE_FULL.name) == 3
    sent = commands(run, layout)
    answered = [c.answers for c in sent if c.enable]
    gaps = [(after - before) % 15 for before, after in pairwise(answered)]
    assert sorted(gaps) == [1] * (len(gaps) - 2) + [2, 3]
    assert run.transport.node.braked == 3
    assert run.outcome.home


def test_the_watchdog_is_armed_before_the_first_frame_and_released_after_the_last(simulate: Simulate) -> None:
    pulse = Pulse()
    sent: list[list[bool]] = []
    run = simulate(pulse=pulse, on_send=lambda _frame: sent.append(list(pulse.calls)))
    assert run.outcome.fault is None
    assert sent == [[True]] * len(sent)
    assert pulse.calls == [True, False]


def test_a_watchdog_that_trips_while_the_stop_frames_go_out_is_the_run_s_fault(simulate: Simulate) -> None:
    class Late(Pulse):
        """Trips once the stop frames are out."""

        @property
        def tripped(self) -> bool:
            return self.calls == [True, False]

    run = simulate(pulse=Late())
    assert run.outcome.fault is Fault.WATCHDOG_TRIPPED
    assert not run.outcome.home
    assert run.journal.codes[-3:] == ["STOPPING", "WATCHDOG_TRIPPED", "OVER"]


def assert_within_limits(run: SimRun) -> None:
    low, high = run.transport.node.angle_range
    assert -10.0 <= low <= high <= 100.0
    assert run.transport.node.top_speed <= 500.0


def commands(run: SimRun, layout: Layout) -> list[CurrentCommand]:
    return [layout.decode_command(frame) for frame in run.sent]


@pytest.mark.parametrize(
    ("state", "fault", "within"),
    [
        (NodeState.FAULT, Fault.NODE_STOPPED, 1),
        (NodeState.STOPPING, Fault.NODE_STOPPED, 1),
        (NodeState.IDLE, Fault.NODE_CHANGED, 101),
    ],
)
def test_a_status_that_contradicts_the_pairs_ends_the_run(
    simulate: Simulate, state: NodeState, fault: Fault, within: int
) -> None:
    said: list[int] = []

    def receive(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is None or frame.identifier != STATUS or transport.node.periods < 250:
            return frame
        said.append(transport.node.periods)
        return saying(NodeState=int(state))(frame)

    run = simulate(on_receive=receive)
    assert run.outcome.fault is fault, run.outcome.detail
    assert f"status is {state.name}" in run.outcome.detail
    assert run.journal.cycles[-1].step + run.journal.cycles[0].device_time_ns // 1_000_000 <= said[0] + within
    assert_within_limits(run)


@pytest.mark.parametrize(("state", "until"), [(NodeState.IDLE, 101), (NodeState.STOPPING, 1)])
def test_a_status_from_before_the_first_command_ends_no_run(simulate: Simulate, state: NodeState, until: int) -> None:
    late = changing(saying(NodeState=int(state)), STATUS, range(until + 1))
    assert simulate(on_receive=late).outcome.fault is None


def test_a_node_whose_status_says_fault_is_not_armed(simulate: Simulate) -> None:
    outcome = simulate(on_receive=changing(saying(NodeState=int(NodeState.FAULT)), STATUS)).outcome
    assert (outcome.fault, outcome.end) == (Fault.NODE_NOT_READY, None)
    assert outcome.detail == "its status is FAULT"


@pytest.mark.parametrize(
    ("plant", "named"),
    [
        ("observer", r"\[sensors\] velocity = \"observer\", observer_bandwidth = (14[5-9]0|15[0-2]0) at most$"),
        ("lag", r"\[shield\] current_lag = (0\.002)$"),
        ("late", r"\[shield\] frame_age = \[0, (2)\]$"),
    ],
)
def test_an_undeclared_response_ends_the_run_below_every_limit_and_with_the_named_value_the_next_run_is_done(
    plant: str, named: str, simulate: Simulate
) -> None:
    for seed in range(3):
        ran = simulate(options=f"plant={plant},seed={seed}", on_bench=SENSOR_BENCH)
        assert ran.outcome.fault is Fault.RESPONSE_LATE
        assert ran.outcome.response == ""
        assert max(abs(cycle.velocity) for cycle in ran.journal.cycles) < 250.0
        assert_within_limits(ran)
        found = re.search(named, ran.outcome.detail)
        assert found is not None, ran.outcome.detail
        bench, value = SENSOR_BENCH, float(found[1])
        keys: dict[str, dict[str, Any]] = {"lag": {"current_lag": value}, "late": {"frame_age": (0, int(value))}}
        shield = keys.get(plant, {})
        sensors = Sensors("observer", value) if plant == "observer" else bench.sensors
        declared = dataclasses.replace(bench, sensors=sensors, shield=bench.shield._replace(**shield))
        assert simulate(options=f"plant={plant},seed={seed}", on_bench=declared).outcome.fault is None


@pytest.mark.parametrize(
    ("plant", "declared"),
    [
        ("exact", {}),
        ("observer", {"sensors": Sensors("observer", 1480.0)}),
        ("lag", {"shield": SENSOR_BENCH.shield._replace(current_lag=0.002)}),
        ("late", {"shield": SENSOR_BENCH.shield._replace(frame_age=(0, 2))}),
        ("late", {"shield": SENSOR_BENCH.shield._replace(frame_age=(2, 2))}),  # the answer acts two periods later
    ],
)
def test_a_response_that_is_declared_is_proven_the_outcome_says_so_and_the_limits_hold(
    plant: str, declared: dict[str, Any], simulate: Simulate
) -> None:
    for current in (6.0, -6.0):
        ran = simulate(
            lambda *_, i=current: i, options=f"plant={plant}", on_bench=dataclasses.replace(SENSOR_BENCH, **declared)
        )
        assert ran.outcome.fault is None, ran.outcome.detail
        assert_within_limits(ran)
        assert current < 0.0 or re.fullmatch(
            r"the velocity follows the commands with a delay of -?\d\.\d ± \d\.\d samples, at most [\d.]+ are declared",
            ran.outcome.response,
        )


@pytest.mark.parametrize(
    ("frames", "fault", "detail"),
    [
        (0, Fault.NO_NODE, "within 2.01 s"),
        (1, Fault.NO_NODE, "within 2.01 s"),  # an angle alone is no sample
        (2, Fault.NODE_NOT_READY, "it has not sent its status, so nobody knows what it is"),
        (5, Fault.NODE_NOT_READY, "within 2.01 s"),  # two samples, and a status between
    ],
)
def test_a_node_that_is_not_ready_in_time_ends_the_run_before_anything_has_left(
    frames: int, fault: Fault, detail: str
) -> None:
    assert 2.01 * 1e9 < 2_010_000_000  # a time in seconds is rounded to nanoseconds
    bench = dataclasses.replace(SENSOR_BENCH, watch=dataclasses.replace(SENSOR_BENCH.watch, start_timeout=2.01))
    driven: dict[str, Any] = dict.fromkeys(("send", "receive", "now_ns", "push"))
    core = make_loop(bench, FunctionActor(lambda *_: 0.0), 200, **driven).core
    bus, clock = open_sim("", bench)
    begin_ns = clock.now_ns()
    core.begin(begin_ns)
    heard = [bus.receive(begin_ns + 3 * MS) for _ in range(frames)]
    core.process_frames([frame for frame in heard if frame is not None], clock.now_ns())
    core.timeout(begin_ns + 2_009_999_999)
    assert (core.state, core.fault) == (RunState.SILENT, None)
    core.timeout(begin_ns + 2_010_000_000)
    assert (core.state, core.fault) == (RunState.OVER, fault)
    assert core.outcome().detail == detail


@pytest.mark.parametrize(
    ("missed", "late", "fault"),
    [
        ((range(100, 104), range(105, 109)), 0, None),  # a sample between forgives
        ((range(100, 105), range(200, 204)), 1, None),
        ((range(100, 105), range(200, 206)), 2, None),
        ((range(100, 119),), 1, Fault.NODE_STOPPED),  # it has braked for too long
        ((range(100, 120),), 1, Fault.SENSOR_LOST),
    ],
)
def test_missed_periods_are_told_at_the_soft_limit_and_end_the_run_at_the_other(
    missed: tuple[range, ...], late: int, fault: Fault | None, simulate: Simulate
) -> None:
    """The limits are 5 and 20 periods of 1 ms."""
    lost = [period for periods in missed for period in periods]
    run = simulate(lambda *_: 1.0, on_receive=dropping(VELOCITY, lost), on_bench=SENSOR_BENCH)
    assert run.outcome.fault is fault
    told = [event for event in run.journal.events if event.code == "SENSOR_LATE"]
    assert [event.text for event in told] == [f"{FAULTS[Fault.SENSOR_LATE].cause}: 5 so far"] * late
    for event in told:
        last_ns = max(c.receive_time_ns for c in run.journal.cycles if c.receive_time_ns <= event.time_ns)
        assert event.time_ns == last_ns + 5 * MS + MS // 2  # the sample is half a period overdue
    if fault is Fault.SENSOR_LOST:
        assert run.outcome.detail == "20 periods without a valid pair"
