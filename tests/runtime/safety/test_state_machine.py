"""The state machine: every pair of state and event, against the picture drawn by hand, and its time-outs to the ns."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.config.bench import load_bench
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
    missed,
    step,
)

MS = 1_000_000
BENCH = load_bench()  # A period of 1 ms, 5 s to begin, 5 and 20 missed periods
LATCHED = [fault for fault, info in FAULTS.items() if info.latched]
SOFT = [fault for fault, info in FAULTS.items() if not info.latched]

# Nothing has waited for long; "=" is the same state, "-" is impossible.
# state:   PREPARED NODE_READY BEGIN  BEGIN_HOMING PAIR TIME FINISHED STOPPED FAULT    SOFT
PICTURE = """
INIT       SILENT   -          -      -            -    =    -        -       OVER     =
SILENT     -        ARMED      -      -            =    =    -        -       OVER     =
ARMED      -        -          ACTIVE HOMING       =    =    -        -       STOPPING =
ACTIVE     -        -          -      -            =    =    STOPPING -       STOPPING =
HOMING     -        -          -      -            =    =    STOPPING -       STOPPING =
STOPPING   -        -          -      -            =    =    -        OVER    =        =
OVER       -        -          -      -            -    =    -        -       =        =
"""


@pytest.mark.parametrize("row", PICTURE.strip().splitlines())
def test_every_transition_is_the_one_in_the_picture(row: str) -> None:
    name, *targets = row.split()
    run = Run(RunState[name], since_ns=100 * MS, last_pair_ns=100 * MS)
    for event, target in zip([*Event, Fault.INTERRUPTED, Fault.BUS_ERRORS], targets, strict=True):
        if target == "-":
            with pytest.raises(ValueError, match=f"{event.name} cannot happen in {name}"):
                step(BENCH, run, event, 101 * MS)
            continue
        after = step(BENCH, run, event, 101 * MS)
        assert after.state is (run.state if target == "=" else RunState[target])
        assert after.since_ns == (100 * MS if target == "=" else 101 * MS)


def test_a_run_begins_in_init_at_time_0_unheard_and_without_a_fault() -> None:
    assert Run() == (RunState.INIT, 0, 0, False, None)


def test_a_time_in_seconds_is_rounded_to_nanoseconds() -> None:
    assert 2.01 * 1e9 < 2_010_000_000
    bench = replace(BENCH, watch=replace(BENCH.watch, start_timeout=2.01))
    for now_ns, fault in ((2_009_999_999, None), (2_010_000_000, Fault.NO_NODE)):
        assert step(bench, Run(RunState.SILENT), Event.TIME, now_ns).fault is fault


@pytest.mark.parametrize("state", [s for s in RunState if s is not RunState.SILENT])
def test_the_time_to_show_itself_counts_while_the_run_waits_for_the_node_only(state: RunState) -> None:
    now_ns = 100_000 * MS
    run = Run(state, since_ns=0, last_pair_ns=now_ns)
    assert step(BENCH, run, Event.TIME, now_ns) == run


def test_an_error_that_stops_a_run_carries_its_fault_and_the_detail() -> None:
    error = StopError(Fault.NOT_OBEYED, "for 40 periods")
    assert (error.fault, error.detail, str(error)) == (Fault.NOT_OBEYED, "for 40 periods", "NOT_OBEYED")
    assert StopError(Fault.INTERNAL).detail == ""


@pytest.mark.parametrize("last_pair_ns", [0, 7 * MS])
def test_a_node_that_does_not_show_itself_in_time_ends_the_run_before_anything_has_left(last_pair_ns: int) -> None:
    run = Run(RunState.SILENT, since_ns=3, last_pair_ns=last_pair_ns)
    assert step(BENCH, run, Event.TIME, 2 + 5_000 * MS) == run
    over = step(BENCH, run, Event.TIME, 3 + 5_000 * MS)
    assert over.state is RunState.OVER
    assert over.fault is (Fault.NODE_NOT_READY if last_pair_ns else Fault.NO_NODE)


@pytest.mark.parametrize("state", [RunState.ARMED, RunState.ACTIVE, RunState.HOMING])
def test_missed_periods_are_told_at_the_soft_limit_and_stop_the_run_at_the_other(state: RunState) -> None:
    run = Run(state, since_ns=0, last_pair_ns=100 * MS)
    soft, stop = 105 * MS + MS // 2, 120 * MS + MS // 2
    assert step(BENCH, run, Event.TIME, soft - 1) == run
    late = step(BENCH, run, Event.TIME, soft)
    assert late == run._replace(late=True)
    assert step(BENCH, late, Event.TIME, stop - 1) == late
    ended = step(BENCH, late, Event.TIME, stop)
    assert (ended.state, ended.fault, ended.since_ns) == (RunState.STOPPING, Fault.SENSOR_LOST, stop)


def test_a_pair_and_nothing_else_forgives_what_was_missed_before_it() -> None:
    late = Run(RunState.ACTIVE, last_pair_ns=100 * MS, late=True)
    assert step(BENCH, late, Event.TIME, 100 * MS) == late
    assert step(BENCH, late, Event.PAIR, 117 * MS) == Run(RunState.ACTIVE, last_pair_ns=117 * MS)


def test_time_stops_nothing_while_the_run_stops() -> None:
    run = Run(RunState.STOPPING, since_ns=0, last_pair_ns=0, fault=Fault.SENSOR_LOST)
    assert step(BENCH, run, Event.TIME, 10**12) == run


@given(st.integers(0, 10**7), st.integers(1, 10**9))
def test_a_period_is_missed_when_it_is_half_a_period_overdue(n: int, period_ns: int) -> None:
    bench = replace(BENCH, timing=replace(BENCH.timing, sample_time=2e-9 * period_ns))
    run = Run(RunState.ACTIVE, last_pair_ns=17)
    overdue_ns = 17 + n * 2 * period_ns + period_ns
    assert missed(bench, run, overdue_ns) == n
    assert missed(bench, run, overdue_ns - 1) == max(0, n - 1)


@given(st.lists(st.tuples(st.sampled_from([*Event, *Fault]), st.integers(0, 10**10)), max_size=60))
def test_whatever_happens_a_fault_stays_and_only_stopping_follows_what_may_have_sent(
    events: list[tuple[Event | Fault, int]],
) -> None:
    run, now_ns = Run(), 0
    for event, waited_ns in events:
        now_ns += waited_ns
        try:
            after = step(BENCH, run, event, now_ns)
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
    machine = StateMachine(BENCH, lambda *event: events.append(event))
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
    assert machine.run == Run(RunState.OVER, 5 * MS, 2 * MS, False, Fault.INTERRUPTED)
