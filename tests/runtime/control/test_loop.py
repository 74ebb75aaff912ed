"""The loop on the simulated bus: one experiment, and every way it can end."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from emb_bench.sim.transport import SimTransport, SteppedClock
from emb_runtime.can.messages import Layout, StopReason
from emb_runtime.config.bench import PARAMETER_NAMES, Bench
from emb_runtime.records import Frame, NodeState, Reason
from emb_runtime.safety.heartbeat import STOP_FRAMES, Unwatched
from emb_runtime.safety.state_machine import Fault

from tests.conftest import SimRun, Simulate  # isort: skip

from tests.scenarios.injections import changing, dropping, saying

from .test_faults import assert_within_limits, commands

MS = 1_000_000
ANGLE, VELOCITY, STATUS, COMMAND = 0x100, 0x101, 0x102, 0x80


def assert_ended_safely(run: SimRun, layout: Layout) -> None:
    """Whatever happened: valid commands in order, within ±6 A, none before arming, stop frames at the end."""
    sent = commands(run, layout)
    assert all(abs(c.current) <= 6.0 for c in sent)
    assert [c.counter for c in sent] == [n % 15 for n in range(len(sent))]
    if run.outcome.end is not None:
        assert [(c.enable, c.current) for c in sent[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES
        assert all(c.enable for c in sent[:-STOP_FRAMES])
    else:
        assert sent == []
    assert_within_limits(run)


def older_by(duration_ns: int) -> Callable[[Frame], Frame]:
    """Gives a frame that came earlier."""
    return lambda frame: frame._replace(time_ns=frame.time_ns - duration_ns)


def corner(bench: Bench, number: int) -> str:
    """One of the 16 brakes at the corners of the shield's ranges, as options of the simulated bus."""
    box = bench.range_set(bench.shield.ranges)
    ends = [(box.low, box.high)[number >> place & 1] for place in range(4)]
    return ",".join(f"{name}={getattr(end, name)!r}" for name, end in zip(PARAMETER_NAMES, ends, strict=True))


@pytest.mark.parametrize("plant", ["exact", "euler"])
def test_an_end_by_the_operator_is_explained_by_nothing_else(simulate: Simulate, bench: Bench, plant: str) -> None:
    for number, period in enumerate(range(5 if plant == "exact" else 15, 500, 30)):
        asked = iter([False] * 2 * period)
        options = f"plant={plant},{corner(bench, number)},seed={number + 1}"
        run = simulate(lambda *_: 6.0, options=options, stop_requested=lambda asked=asked: next(asked, True))
        row = f"period {period}, {options}"
        assert (run.outcome.fault, run.outcome.detail) == (Fault.INTERRUPTED, ""), row
        assert set(run.journal.codes) <= {"SILENT", "ARMED", "ACTIVE", "INTERRUPTED", "STOPPING", "OVER"}, row


@pytest.mark.parametrize("limit", [0.0, 0.5, 1.0, 2.0, 4.0])
def test_a_short_run_of_a_few_amperes_ends_without_a_fault_wherever_it_ends(
    simulate: Simulate, bench: Bench, limit: float
) -> None:
    for number, steps in enumerate(range(40, 320, 40)):
        options = f"{corner(bench, number + int(4 * limit))},seed={number + 1}"
        fault = simulate(lambda *_: 6.0, options=options, steps=steps, limit=limit).outcome.fault
        assert fault is None, f"{steps} periods, {options}: {fault}"


def test_a_full_experiment_answers_every_sample_once_and_comes_home(simulate: Simulate, layout: Layout) -> None:
    run = simulate(lambda *_: 6.0, options="f_v=3e-5")
    counters = run.outcome.counters
    assert run.outcome.fault is None
    assert run.outcome.home
    assert run.outcome.node_at_rest
    assert (counters.pairs, counters.answered) == (501, 500)
    assert (counters.unanswered, counters.missed, counters.not_obeyed) == (0, 0, 0)
    assert counters.limited > 0  # constant 6 A leaves the limits without the shield
    assert counters.returning > 0
    assert run.outcome.duration_ns == 500 * MS
    assert [c.step for c in run.journal.cycles] == list(range(501))
    assert run.transport.node.obeyed == 500
    assert len(run.sent) == 500 + STOP_FRAMES
    assert_ended_safely(run, layout)
    assert run.journal.codes == ["SILENT", "ARMED", "ACTIVE", "STOPPING", "OVER"]


def test_the_record_says_what_was_wanted_what_was_sent_and_why(simulate: Simulate, layout: Layout) -> None:
    run = simulate(lambda _a, _v, k: 6.0 if k % 2 else -6.0)
    by_step = {c.step: c for c in run.journal.cycles}
    for command, k in zip(commands(run, layout), range(500), strict=False):
        record = by_step[k]
        assert record.policy_current == (6.0 if k % 2 else -6.0)
        assert record.sent_current == pytest.approx(command.current, abs=1e-12)
        assert (record.command_counter, record.counter) == (command.counter, command.answers)
        if record.sent_current != record.policy_current:
            assert record.reasons & (Reason.LIMITED | Reason.RETURNING | Reason.CLIPPED)
        assert by_step[k + 1].applied_current == pytest.approx(command.current, abs=1e-12)


def test_the_actor_sees_the_measured_sample_and_its_index(simulate: Simulate) -> None:
    seen: list[tuple[float, float, float]] = []

    def law(angle: float, velocity: float, step: float) -> float:
        seen.append((angle, velocity, step))
        return 1.0

    run = simulate(law, steps=50)
    assert seen == [(c.angle, c.velocity, c.step) for c in run.journal.cycles[:50]]


def test_the_policy_is_clipped_to_a_narrower_bench(simulate: Simulate, bench: Bench, layout: Layout) -> None:
    narrow = replace(bench, limits=replace(bench.limits, current=4.0))
    narrow = replace(narrow, shield=narrow.shield._replace(ranges="viscous"))
    run = simulate(on_bench=narrow)
    assert run.outcome.counters.clipped > 0
    assert max(abs(c.current) for c in commands(run, layout)) == pytest.approx(4.0)


# --- frames that do not come, or come wrong -------------------------------------------------------------------------


@pytest.mark.parametrize("identifier", [ANGLE, VELOCITY])
def test_a_missing_frame_is_a_missed_period_in_which_nothing_is_sent(
    simulate: Simulate, layout: Layout, identifier: int
) -> None:
    run = simulate(on_receive=dropping(identifier, range(100, 103)))
    counters = run.outcome.counters
    assert run.outcome.fault is None
    assert (counters.missed, counters.answered, counters.pairs) == (3, 497, 498)
    assert [c.missed for c in run.journal.cycles if c.missed] == [3]
    assert run.transport.node.braked == 3
    assert run.outcome.home
    assert_ended_safely(run, layout)


def test_a_damaged_frame_is_not_answered_and_is_logged(simulate: Simulate, layout: Layout) -> None:
    def damage(frame: Frame) -> Frame:
        return frame._replace(data=frame.data[:7] + bytes([frame.data[7] ^ 1]))

    run = simulate(on_receive=changing(damage, ANGLE, range(200, 201)))
    assert (run.outcome.counters.missed, run.outcome.counters.rejected) == (1, 1)
    assert run.journal.codes.count("FRAME_REJECTED") == 1
    assert_ended_safely(run, layout)


def test_when_several_pairs_wait_the_newest_is_answered_and_the_others_are_recorded(
    simulate: Simulate, layout: Layout
) -> None:
    held: list[Frame] = []

    def stall(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        """The computer stands still in period 150: three pairs are waiting when it goes on."""
        if held:
            held.extend([] if frame is None else [frame])
            return held.pop(0)
        if frame is not None and frame.identifier == ANGLE and transport.node.periods == 150:
            held.append(frame)
            while transport.node.periods < 152 or len(held) < 4:
                following = transport.receive(clock.now_ns() + 2 * MS)
                assert following is not None
                held.append(following)
            return held.pop(0)
        return frame

    run = simulate(on_receive=stall)
    counters = run.outcome.counters
    assert (counters.unanswered, counters.missed, counters.answered, counters.pairs) == (2, 0, 498, 501)
    left = [c for c in run.journal.cycles if c.reasons & Reason.MISSED]
    assert len(left) == counters.unanswered
    assert all(c.command_counter == 15 for c in left)
    assert_ended_safely(run, layout)


def test_a_sample_that_arrived_after_the_waking_is_no_clock_that_is_fast(simulate: Simulate, layout: Layout) -> None:
    """The computer stands still for seven periods after it has woken for a sample, and then takes the newest."""
    held: list[Frame] = []
    woken = False

    def stall(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        nonlocal woken
        if frame is not None and frame.identifier == VELOCITY and transport.node.periods == 150:
            clock.advance_to(clock.now_ns() + MS * 6 // 10)  # so late that the loop looks for a newer one
            woken = True
        elif woken and frame is None and not held and transport.node.periods < 157:
            while transport.node.periods < 157 or held[-1].identifier != VELOCITY:
                following = transport.receive(clock.now_ns() + 2 * MS)
                assert following is not None
                held.append(following)
        if held:
            held.extend([] if frame is None else [frame])
            return held.pop(0)
        return frame

    run = simulate(on_receive=stall)
    assert run.outcome.fault is None, run.outcome.detail
    assert run.outcome.counters.unanswered == 7
    assert_ended_safely(run, layout)


def test_a_policy_that_takes_too_long_is_not_sent_late(simulate: Simulate, layout: Layout, bench: Bench) -> None:
    class SlowClock:
        """Three periods pass between waking and deciding, in steps 50 to 52."""

        def __init__(self) -> None:
            self.base: Any = None
            self.offset_ns = 0

        def now_ns(self) -> int:
            return int(self.base.now_ns()) + self.offset_ns

        def wall_offset_ns(self) -> int:
            return 0

    clock = SlowClock()

    def law(_a: float, _v: float, k: float) -> float:
        clock.offset_ns = 3 * MS if 50 <= k <= 52 else 0
        return 2.0

    def tie(frame: Frame | None, _transport: SimTransport, base: SteppedClock) -> Frame | None:
        clock.base, clock.offset_ns = base, 0
        return frame

    # The loop reads its clock before the first frame, so the real one has to be there by then.
    clock.base = SteppedClock(10**15)
    run = simulate(law, on_receive=tie, now_ns=clock.now_ns)
    assert run.outcome.counters.unanswered == 3
    assert run.transport.node.braked == 3
    assert_ended_safely(run, layout)


# --- the ends --------------------------------------------------------------------------------------------------------


def test_the_outcome_names_class_and_place_of_an_error_in_the_program(simulate: Simulate) -> None:
    run = simulate(lambda _a, _v, k: 1.0 / (k - 150.0))
    assert re.fullmatch(r"ZeroDivisionError: .* \(test_loop\.py, line \d+\)", run.outcome.detail)


def test_a_node_of_another_bench_or_protocol_is_not_armed(simulate: Simulate, bench: Bench) -> None:
    for changes, reason in (
        ({"BenchIdentity": 0x1234}, "another bench file"),
        ({"ProtocolVersion": 99}, "protocol 99"),
    ):
        hasty = replace(bench, watch=replace(bench.watch, start_timeout=0.5))
        run = simulate(on_bench=hasty, on_receive=changing(saying(**changes), STATUS))
        assert run.outcome.fault is Fault.NODE_NOT_READY
        assert reason in run.outcome.detail
        assert run.sent == []


def test_what_piled_up_before_the_loop_listened_is_logged_but_not_what_it_arms_on(
    simulate: Simulate, layout: Layout
) -> None:
    """Frames are a second old until period 300; the run begins with the first fresh ones."""

    run = simulate(on_receive=changing(older_by(1_000 * MS), periods=range(301)))
    assert run.outcome.fault is None
    assert run.journal.cycles[0].device_time_ns == (300 + 10 + 1) * MS
    assert len(run.journal.frames) > 600
    assert_ended_safely(run, layout)


def test_the_row_of_pairs_that_arms_a_run_begins_anew_after_a_gap(simulate: Simulate) -> None:
    run = simulate(on_receive=dropping(ANGLE, range(6, 7)))
    assert run.journal.cycles[0].device_time_ns == (6 + 10 + 1) * MS


def test_how_old_a_sample_is_is_asked_when_it_is_in_hand(simulate: Simulate) -> None:
    run = simulate(on_receive=changing(older_by(5 * MS // 2), periods=range(31)))
    assert run.journal.cycles[0].device_time_ns == (30 + 10 + 1) * MS


def test_the_stop_reason_is_that_of_this_stop_or_is_not_told(simulate: Simulate) -> None:
    assert simulate().outcome.node_stop_reason is StopReason.DISABLED
    silent = simulate(on_receive=dropping(STATUS, range(505, 10_000)))
    assert (silent.outcome.fault, silent.outcome.node_at_rest, silent.outcome.node_stop_reason) == (None, True, None)


def test_a_status_from_before_the_node_stopped_does_not_say_why(simulate: Simulate, layout: Layout) -> None:
    before_the_stop = saying(NodeState=NodeState.ACTIVE, StopReason=StopReason.WATCHDOG)
    run = simulate(on_receive=changing(before_the_stop, STATUS, range(521, 10_000)))
    assert run.outcome.node_stop_reason is None


@pytest.mark.parametrize(
    ("frame", "fault"),
    [(Frame(COMMAND, bytes(5)), Fault.FOREIGN_COMMAND), (Frame(0x40, bytes(8), error=True), Fault.BUS_LOST)],
)
def test_what_was_overheard_before_a_run_ends_it_before_anything_is_sent(
    simulate: Simulate, frame: Frame, fault: Fault
) -> None:
    run = simulate(overheard=(frame,))
    assert run.outcome.fault is fault
    assert run.journal.frames == [frame]
    assert run.sent == []


def test_a_babbling_node_does_not_hold_the_loop(simulate: Simulate, layout: Layout) -> None:
    babble = [0]

    def flood(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        """From period 100 on a stranger's frame is always waiting, and the node's own are never seen again."""
        if transport.node.periods < 100:
            return frame
        babble[0] += 1
        if babble[0] % 10 == 0:
            clock.advance_to(clock.now_ns() + MS // 10)
        return Frame(0x7FF, b"", clock.now_ns())

    run = simulate(on_receive=flood)
    assert run.outcome.fault is Fault.SENSOR_LOST
    assert babble[0] < 100_000


def test_while_it_stops_the_loop_shows_that_it_lives_before_each_stop_frame(simulate: Simulate) -> None:
    calls: list[str] = []

    class Watched(Unwatched):
        def beat(self, now_ns: int) -> None:
            calls.append("beat")

        def disarm(self) -> None:
            calls.append("disarm")

    simulate(steps=20, pulse=Watched(), on_send=lambda _frame: calls.append("frame"))
    assert calls[-2 * STOP_FRAMES - 1 :] == [*["beat", "frame"] * STOP_FRAMES, "disarm"]
