"""A node that is not heard: before the run begins, and between two samples, to the nanosecond."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from emb_bench.sim.transport import open_sim
from emb_runtime.records import RunState
from emb_runtime.safety.state_machine import FAULTS, Fault

from tests.conftest import FunctionActor, Simulate, make_loop  # isort: skip
from tests.benches import SENSOR_BENCH
from tests.scenarios.injections import VELOCITY, dropping

MS = 1_000_000


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
    bench = replace(SENSOR_BENCH, watch=replace(SENSOR_BENCH.watch, start_timeout=2.01))
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
