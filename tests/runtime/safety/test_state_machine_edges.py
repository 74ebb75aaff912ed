"""The state machine's times and its first state, to the nanosecond."""

from __future__ import annotations

from dataclasses import replace

import pytest

from emb_runtime.config.bench import load_bench
from emb_runtime.records import RunState
from emb_runtime.safety.state_machine import (
    FAULTS,
    Event,
    Fault,
    Run,
    StateMachine,
    StopError,
    Timeouts,
    step,
    timeouts,
)

MS = 1_000_000
TIMES = Timeouts(period_ns=MS, start_ns=5_000 * MS, soft_missed=5, stop_missed=20)


def test_a_run_begins_in_init_at_time_0_unheard_and_without_a_fault() -> None:
    assert Run() == (RunState.INIT, 0, 0, False, None)


def test_a_time_in_seconds_is_rounded_to_nanoseconds() -> None:
    bench = load_bench()
    assert 2.01 * 1e9 < 2_010_000_000
    assert timeouts(replace(bench, watch=replace(bench.watch, start_timeout=2.01))).start_ns == 2_010_000_000


@pytest.mark.parametrize("state", [s for s in RunState if s is not RunState.SILENT])
def test_the_time_to_show_itself_counts_while_the_run_waits_for_the_node_only(state: RunState) -> None:
    now_ns = 100_000 * MS
    run = Run(state, since_ns=0, heard_ns=now_ns)
    assert step(TIMES, run, Event.TIME, now_ns) == run


def test_what_was_told_as_late_stays_so_until_a_pair_comes() -> None:
    run = Run(RunState.ACTIVE, heard_ns=100 * MS, late=True)
    assert step(TIMES, run, Event.TIME, 100 * MS).late
    assert not step(TIMES, run, Event.PAIR, 101 * MS).late


def test_an_error_that_stops_a_run_carries_its_fault_and_the_detail() -> None:
    error = StopError(Fault.NOT_OBEYED, "for 40 periods")
    assert (error.fault, error.detail, str(error)) == (Fault.NOT_OBEYED, "for 40 periods", "NOT_OBEYED")
    assert StopError(Fault.INTERNAL).detail == ""


@pytest.fixture
def events() -> list[tuple[int, str, str]]:
    return []


@pytest.fixture
def machine(events: list[tuple[int, str, str]]) -> StateMachine:
    """A state machine that waits for the node since 1 ms."""
    machine = StateMachine(TIMES, lambda *event: events.append(event))
    machine.handle_event(Event.PREPARED, MS)
    return machine


def begun(machine: StateMachine) -> StateMachine:
    """The same in ACTIVE, with a pair at 2 ms."""
    for event in (Event.NODE_READY, Event.BEGIN, Event.PAIR):
        machine.handle_event(event, 2 * MS)
    return machine


def test_every_change_of_state_is_recorded_once_with_its_time_and_event(
    machine: StateMachine, events: list[tuple[int, str, str]]
) -> None:
    begun(machine).handle_event(Event.FINISHED, 3 * MS)
    assert machine.run.state is RunState.STOPPING
    assert events == [
        (MS, "SILENT", "after PREPARED"),
        (2 * MS, "ARMED", "after NODE_READY"),
        (2 * MS, "ACTIVE", "after BEGIN"),
        (3 * MS, "STOPPING", "after FINISHED"),
    ]


def test_a_node_that_does_not_come_in_time_fails_the_run_with_the_time_it_had(machine: StateMachine) -> None:
    machine.handle_event(Event.TIME, 5_001 * MS - 1)
    with pytest.raises(StopError) as caught:
        machine.handle_event(Event.TIME, 5_001 * MS)
    assert (caught.value.fault, caught.value.detail) == (Fault.NO_NODE, "within 5 s")
    assert machine.run.state is RunState.SILENT  # until the error is handled


def test_missed_periods_are_reported_once_and_then_fail_the_run_with_their_number(
    machine: StateMachine, events: list[tuple[int, str, str]]
) -> None:
    begun(machine)
    for late_ns in (7 * MS + MS // 2, 9 * MS):
        machine.handle_event(Event.TIME, late_ns)
    cause = FAULTS[Fault.SENSOR_LATE].cause
    assert events[3:] == [(7 * MS + MS // 2, "SENSOR_LATE", f"{cause}: 5 so far")]
    with pytest.raises(StopError) as caught:
        machine.handle_event(Event.TIME, 22 * MS + MS // 2)
    assert (caught.value.fault, caught.value.detail) == (Fault.SENSOR_LOST, "20 periods without a valid pair")


def test_a_fault_that_latches_is_recorded_with_its_cause_and_the_state_after_it(
    machine: StateMachine, events: list[tuple[int, str, str]]
) -> None:
    begun(machine)
    machine.fail(Fault.INTERRUPTED, "", 3 * MS)
    machine.fail(Fault.BUS_LOST, "vcan0", 4 * MS)
    machine.handle_event(Event.STOPPED, 5 * MS)
    assert events[3:] == [
        (3 * MS, "INTERRUPTED", FAULTS[Fault.INTERRUPTED].cause),
        (3 * MS, "STOPPING", "after INTERRUPTED"),
        (4 * MS, "BUS_LOST", f"{FAULTS[Fault.BUS_LOST].cause}: vcan0"),
        (5 * MS, "OVER", "after STOPPED"),
    ]
    assert machine.run == Run(RunState.OVER, 5 * MS, 2 * MS, False, Fault.INTERRUPTED)
