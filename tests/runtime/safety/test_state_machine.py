"""The state machine: every pair of state and event, against the picture drawn by hand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.errors import EXIT_BUS, EXIT_DONE, EXIT_SAFETY_STOP, EXIT_UNEXPLAINED
from emb_runtime.records import RunState
from emb_runtime.safety.state_machine import (
    FAULTS,
    Event,
    Fault,
    Run,
    StateMachine,
    StopError,
    may_enable,
    may_send,
    next_run,
)

MS = 1_000_000
LATCHED = [fault for fault, info in FAULTS.items() if info.latched]
SOFT = [fault for fault, info in FAULTS.items() if not info.latched]

# "=" is the same state, "-" is impossible.
# state:   PREPARED NODE_READY BEGIN  BEGIN_HOMING FINISHED STOPPED FAULT    SOFT
PICTURE = """
INIT       SILENT   -          -      -            -        -       OVER     =
SILENT     -        ARMED      -      -            -        -       OVER     =
ARMED      -        -          ACTIVE HOMING       -        -       STOPPING =
ACTIVE     -        -          -      -            STOPPING -       STOPPING =
HOMING     -        -          -      -            STOPPING -       STOPPING =
STOPPING   -        -          -      -            -        OVER    =        =
OVER       -        -          -      -            -        -       =        =
"""


@pytest.mark.parametrize("row", PICTURE.strip().splitlines())
def test_every_transition_is_the_one_in_the_picture(row: str) -> None:
    name, *targets = row.split()
    run = Run(RunState[name], since_ns=100 * MS)
    for event, target in zip([*Event, Fault.INTERRUPTED, Fault.BUS_ERRORS], targets, strict=True):
        if target == "-":
            with pytest.raises(ValueError, match=f"{event.name} cannot happen in {name}"):
                next_run(run, event, 101 * MS)
            continue
        after = next_run(run, event, 101 * MS)
        assert after.state is (run.state if target == "=" else RunState[target])
        assert after.since_ns == (100 * MS if target == "=" else 101 * MS)


def test_a_run_begins_in_init_at_time_0_and_without_a_fault() -> None:
    assert Run() == (RunState.INIT, 0, None)


def test_an_error_that_stops_a_run_carries_its_fault_and_the_detail() -> None:
    error = StopError(Fault.NOT_OBEYED, "for 40 periods")
    assert (error.fault, error.detail, str(error)) == (Fault.NOT_OBEYED, "for 40 periods", "NOT_OBEYED")
    assert StopError(Fault.INTERNAL).detail == ""


@given(st.lists(st.tuples(st.sampled_from([*Event, *Fault]), st.integers(0, 10**10)), max_size=60))
def test_whatever_happens_a_fault_stays_and_only_stopping_follows_what_may_have_sent(
    events: list[tuple[Event | Fault, int]],
) -> None:
    run, now_ns = Run(), 0
    for event, waited_ns in events:
        now_ns += waited_ns
        try:
            after = next_run(run, event, now_ns)
        except ValueError:
            continue
        assert run.fault is None or after.fault is run.fault
        assert not may_send(after.state) or after.fault is None or after.state is RunState.STOPPING
        if may_send(run.state) and after.state is not run.state:
            assert after.state in (RunState.STOPPING, RunState.OVER)
            assert after.state is RunState.STOPPING or run.state is RunState.STOPPING
        if run.state is RunState.OVER:
            assert after.state is RunState.OVER
        run = after


def test_nothing_leaves_before_the_experiment_and_no_current_after_it() -> None:
    assert [s for s in RunState if may_send(s)] == [RunState.ACTIVE, RunState.STOPPING, RunState.HOMING]
    assert [s for s in RunState if may_enable(s)] == [RunState.ACTIVE, RunState.HOMING]


def test_every_fault_tells_cause_advice_and_exit_code() -> None:
    assert set(FAULTS) == set(Fault)
    assert {info.exit_code for info in FAULTS.values() if info.latched} == {
        EXIT_SAFETY_STOP,
        EXIT_BUS,
        EXIT_UNEXPLAINED,
    }
    assert {info.exit_code for info in FAULTS.values() if not info.latched} == {EXIT_DONE}
    for info in FAULTS.values():
        assert info.cause
        assert info.advice


def test_the_codes_of_soft_faults_are_apart_from_those_that_latch() -> None:
    assert max(LATCHED) < 100 < min(SOFT)


def test_the_manual_has_every_fault_with_its_code_and_its_exit_code() -> None:
    manual = (Path(__file__).parents[3] / "docs" / "reference" / "fault-codes.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (\w+) \| .* \| (\d*) ?\|$", manual, re.MULTILINE)
    expected = [(str(int(f)), f.name, str(FAULTS[f].exit_code) if FAULTS[f].latched else "") for f in Fault]
    assert rows == expected


# --- What is told of each change, and which error ends a run ----------------------------------------------------------


@pytest.fixture
def events() -> list[tuple[int, str, str]]:
    return []


@pytest.fixture
def machine(events: list[tuple[int, str, str]]) -> StateMachine:
    """A state machine that waits for the node since 1 ms."""
    machine = StateMachine(lambda *event: events.append(event))
    machine.handle_event(Event.PREPARED, MS)
    return machine


def begun(machine: StateMachine) -> StateMachine:
    """The same in ACTIVE since 2 ms."""
    for event in (Event.NODE_READY, Event.BEGIN):
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


def test_the_first_fault_that_latches_is_the_run_s_and_it_is_recorded_when_it_is_asked_for(
    machine: StateMachine, events: list[tuple[int, str, str]]
) -> None:
    begun(machine)
    machine.latch(Fault.INTERRUPTED, 3 * MS)
    assert (machine.run.state, events[3:]) == (RunState.STOPPING, [])
    machine.explain(Fault.INTERRUPTED, "")
    machine.latch(Fault.BUS_LOST, 4 * MS)
    machine.explain(Fault.BUS_LOST, "vcan0")
    machine.handle_event(Event.STOPPED, 5 * MS)
    assert events[3:] == [
        (3 * MS, "INTERRUPTED", FAULTS[Fault.INTERRUPTED].cause),
        (3 * MS, "STOPPING", "after INTERRUPTED"),
        (4 * MS, "BUS_LOST", f"{FAULTS[Fault.BUS_LOST].cause}: vcan0"),
        (5 * MS, "OVER", "after STOPPED"),
    ]
    assert machine.run == Run(RunState.OVER, 5 * MS, Fault.INTERRUPTED)
