"""The state machine: every pair of state and event, against the picture drawn by hand, and its time-outs to the ns."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.config.bench import Bench
from emb_runtime.errors import EXIT_BUS, EXIT_DONE, EXIT_SAFETY_STOP
from emb_runtime.records import RunState
from emb_runtime.safety.state_machine import (
    FAULTS,
    Event,
    Fault,
    Run,
    Timeouts,
    may_enable,
    may_send,
    missed,
    step,
    timeouts,
)

MS = 1_000_000
TIMES = Timeouts(period_ns=MS, start_ns=5_000 * MS, soft_missed=5, stop_missed=20)
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
    run = Run(RunState[name], since_ns=100 * MS, heard_ns=100 * MS)
    for event, target in zip([*Event, Fault.INTERRUPTED, Fault.BUS_ERRORS], targets, strict=True):
        if target == "-":
            with pytest.raises(ValueError, match=f"{event.name} cannot happen in {name}"):
                step(TIMES, run, event, 101 * MS)
            continue
        after = step(TIMES, run, event, 101 * MS)
        assert after.state is (run.state if target == "=" else RunState[target])
        assert after.since_ns == (100 * MS if target == "=" else 101 * MS)


@pytest.mark.parametrize("heard_ns", [0, 7 * MS])
def test_a_node_that_does_not_show_itself_in_time_ends_the_run_before_anything_has_left(heard_ns: int) -> None:
    run = Run(RunState.SILENT, since_ns=3, heard_ns=heard_ns)
    assert step(TIMES, run, Event.TIME, 2 + 5_000 * MS) == run
    over = step(TIMES, run, Event.TIME, 3 + 5_000 * MS)
    assert over.state is RunState.OVER
    assert over.fault is (Fault.NODE_NOT_READY if heard_ns else Fault.NO_NODE)


@pytest.mark.parametrize("state", [RunState.ARMED, RunState.ACTIVE, RunState.HOMING])
def test_missed_periods_are_told_at_the_soft_limit_and_stop_the_run_at_the_other(state: RunState) -> None:
    run = Run(state, since_ns=0, heard_ns=100 * MS)
    last_fine, soft, last_soft, stop = (100 * MS + n for n in (5 * MS + MS // 2 - 1, 5 * MS + MS // 2, 0, 0))
    last_soft, stop = 100 * MS + 20 * MS + MS // 2 - 1, 100 * MS + 20 * MS + MS // 2
    assert step(TIMES, run, Event.TIME, last_fine) == run
    late = step(TIMES, run, Event.TIME, soft)
    assert late == run._replace(late=True)
    assert step(TIMES, late, Event.TIME, last_soft) == late
    ended = step(TIMES, late, Event.TIME, stop)
    assert (ended.state, ended.fault, ended.since_ns) == (RunState.STOPPING, Fault.SENSOR_LOST, stop)


def test_a_pair_forgives_what_was_missed_before_it() -> None:
    late = Run(RunState.ACTIVE, heard_ns=100 * MS, late=True)
    assert step(TIMES, late, Event.PAIR, 117 * MS) == Run(RunState.ACTIVE, heard_ns=117 * MS)


def test_time_stops_nothing_while_the_run_stops() -> None:
    run = Run(RunState.STOPPING, since_ns=0, heard_ns=0, fault=Fault.SENSOR_LOST)
    assert step(TIMES, run, Event.TIME, 10**12) == run


@given(st.integers(0, 10**7), st.integers(1, 10**9))
def test_a_period_is_missed_when_it_is_half_a_period_overdue(n: int, period_ns: int) -> None:
    times, run = TIMES._replace(period_ns=2 * period_ns), Run(RunState.ACTIVE, heard_ns=17)
    overdue_ns = 17 + n * 2 * period_ns + period_ns
    assert missed(times, run, overdue_ns) == n
    assert missed(times, run, overdue_ns - 1) == max(0, n - 1)


def test_the_first_fault_that_latches_is_the_run_s() -> None:
    run = Run(RunState.ACTIVE)
    for fault in (Fault.FRAMES_DROPPED, Fault.INTERRUPTED, Fault.BUS_LOST, Fault.INTERNAL):
        run = step(TIMES, run, fault, 5)
    assert run.fault is Fault.INTERRUPTED
    assert step(TIMES, step(TIMES, run, Event.STOPPED, 6), Fault.BUS_LOST, 7).fault is Fault.INTERRUPTED


@given(st.lists(st.tuples(st.sampled_from([*Event, *Fault]), st.integers(0, 10**10)), max_size=60))
def test_whatever_happens_a_fault_stays_and_only_stopping_follows_what_may_have_sent(
    events: list[tuple[Event | Fault, int]],
) -> None:
    run, now_ns = Run(), 0
    for event, waited_ns in events:
        now_ns += waited_ns
        try:
            after = step(TIMES, run, event, now_ns)
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


def test_the_times_are_those_of_the_bench(bench: Bench) -> None:
    assert timeouts(bench) == TIMES


def test_every_fault_tells_cause_advice_and_exit_code() -> None:
    assert set(FAULTS) == set(Fault)
    assert {info.exit_code for info in FAULTS.values() if info.latched} == {EXIT_SAFETY_STOP, EXIT_BUS}
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
