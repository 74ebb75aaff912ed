"""Where the guard's yes turns into its no, to the nanosecond and to the last step of a current."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.errors import BusError
from emb_runtime.records import CurrentCommand, Frame, RunState
from emb_runtime.safety.drive_monitor import DriveCheck
from emb_runtime.safety.guard import Guard, GuardRejectedError

MS = 1_000_000
NOW = 100 * MS
ACTIVE = RunState.ACTIVE
BENCH = load_bench()
LAYOUT = load_layout()


def guard_of(bench: Bench = BENCH, layout: Layout = LAYOUT, limit: float = 6.0) -> Guard:
    return Guard(layout, bench, lambda _frame: None, limit=limit)


def command(guard: Guard, current: float = 0.0, layout: Layout = LAYOUT) -> Frame:
    return layout.encode_command(CurrentCommand(guard.next_counter, 0, current, True))


def passes(guard: Guard, frame: Frame, now_ns: int = NOW, sample_ns: int | None = None) -> bool:
    try:
        guard.send(frame, ACTIVE, now_ns if sample_ns is None else sample_ns, now_ns)
    except GuardRejectedError:
        return False
    return True


@pytest.mark.parametrize(
    ("age_ns", "expected"), [(2 * MS, True), (2 * MS + 1, False), (-MS, True), (-MS - 1, False), (0, True)]
)
def test_a_sample_may_be_two_periods_old_and_its_stamp_one_period_ahead_and_no_more(
    age_ns: int, expected: bool
) -> None:
    guard = guard_of()
    assert passes(guard, command(guard), sample_ns=NOW - age_ns) == expected


def test_a_guard_begins_with_counter_0_and_nothing_counted() -> None:
    guard = guard_of()
    assert (guard.next_counter, guard.passed, guard.rejected) == (0, 0, 0)
    assert not passes(guard, command(guard, 6.0)._replace(extended=True))
    assert (guard.next_counter, guard.passed, guard.rejected) == (0, 0, 1)
    assert passes(guard, command(guard))
    assert (guard.next_counter, guard.passed, guard.rejected) == (1, 1, 1)


def test_the_rate_counts_from_the_oldest_of_the_last_24_commands() -> None:
    guard = guard_of()
    oldest, second = 100 * MS, 101 * MS
    for time_ns in [oldest, second, *[109 * MS] * 22]:
        assert passes(guard, command(guard), time_ns)
    assert not passes(guard, command(guard), oldest + 20 * MS - 1)
    assert passes(guard, command(guard), oldest + 20 * MS)
    assert not passes(guard, command(guard), second + 20 * MS - 1)
    assert passes(guard, command(guard), second + 20 * MS)


def test_no_bench_no_limit_and_no_dbc_reaches_beyond_the_ceiling_of_six_ampere() -> None:
    wide = load_layout(LAYOUT.text.replace("(0.0002,0) [-6|6]", "(0.0002,0) [-6.5|6.5]"))
    bench = replace(BENCH, limits=replace(BENCH.limits, current=6.5))
    guard = guard_of(bench, wide, limit=6.5)
    assert not passes(guard, command(guard, 6.0002, wide))
    assert passes(guard, command(guard, 6.0, wide))


def test_a_change_may_be_the_slew_and_one_step_of_the_signal_and_no_more() -> None:
    bench = replace(BENCH, guard=replace(BENCH.guard, slew=1000.0), timing=replace(BENCH.timing, sample_time=2e-3))
    for current, expected in ((2.0002, True), (2.0004, False), (-2.0002, True), (-2.0004, False)):
        guard = guard_of(bench)
        assert passes(guard, command(guard, current)) == expected


@pytest.mark.parametrize(
    ("elapsed_ns", "follows"), [(MS // 2, True), (MS, True), (7 * MS - 1, True), (7 * MS, False), (16 * MS, False)]
)
def test_a_counter_that_has_come_round_is_not_that_of_the_next_sample(elapsed_ns: int, follows: bool) -> None:
    bench = replace(BENCH, guard=replace(BENCH.guard, slew=2000.0))
    for current, expected in ((4.0, follows), (-2.0, not follows)):
        guard = guard_of(bench)
        assert passes(guard, LAYOUT.encode_command(CurrentCommand(0, 3, 2.0, True)))
        answer = LAYOUT.encode_command(CurrentCommand(1, 4, current, True))
        assert passes(guard, answer, NOW + elapsed_ns) == expected


def test_after_a_command_that_the_bus_did_not_take_the_slew_counts_from_zero() -> None:
    bench = replace(BENCH, guard=replace(BENCH.guard, slew=2000.0))
    for current, expected in ((2.0, True), (2.4, False), (5.0, False), (-2.0, True), (-1.4, True), (-2.4, False)):
        full = iter([False, True, False])

        def send(_frame: Frame, full: Iterator[bool] = full) -> None:
            if next(full):
                raise BusError("no room")

        guard = Guard(LAYOUT, bench, send)
        assert passes(guard, LAYOUT.encode_command(CurrentCommand(0, 0, 2.0, True)))
        with pytest.raises(BusError):
            passes(guard, LAYOUT.encode_command(CurrentCommand(1, 1, 4.0, True)))
        assert passes(guard, LAYOUT.encode_command(CurrentCommand(2, 2, current, True))) == expected


def test_six_commands_excuse_a_current_and_five_currents_out_of_place_are_too_many() -> None:
    drive = DriveCheck(0.1, 6.0)
    for current in (5.0, 0.0, 0.0, 0.0, 0.0, 0.0):
        drive.sent(0, current)
        drive.judge(0, current)
    assert drive.errors == 0
    drive.judge(0, 5.0)  # 5 A is the seventh last
    assert drive.errors == 4
    assert [drive.judge(0, 5.0) != "" for _ in range(4)] == [False, False, False, True]
