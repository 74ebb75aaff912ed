"""The state machine's times and its first state, to the nanosecond."""

from __future__ import annotations

from dataclasses import replace

import pytest

from emb_runtime.config.bench import load_bench
from emb_runtime.records import RunState
from emb_runtime.safety.state_machine import Event, Fault, Run, StopError, Timeouts, step, timeouts

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
