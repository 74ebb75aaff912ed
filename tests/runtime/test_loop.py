"""The loop on the simulated bus: one experiment, and every way it can end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest

from emb_bench.sim import SimTransport
from emb_runtime.bench import Bench, load_bench
from emb_runtime.clock import SteppedClock
from emb_runtime.errors import BusError
from emb_runtime.frames import Layout, load_layout
from emb_runtime.guard import Guard
from emb_runtime.loop import STOP_FRAMES
from emb_runtime.records import CurrentCommand, Frame, NodeState, Reason, RunState
from emb_runtime.states import FAULTS, Fault

from tests.conftest import SimRun, Simulate  # isort: skip

MS = 1_000_000
ANGLE, VELOCITY, COMMAND = 0x100, 0x101, 0x80


def commands(run: SimRun, layout: Layout) -> list[CurrentCommand]:
    return [layout.decode_command(frame) for frame in run.sent]


def assert_ended_safely(run: SimRun, layout: Layout) -> None:
    """Whatever happened: valid commands in order, within ±6 A, none before arming, stop frames at the end."""
    sent = commands(run, layout)
    assert all(abs(c.current) <= 6.0 for c in sent)
    assert [c.counter for c in sent] == [n % 15 for n in range(len(sent))]
    if run.outcome.armed:
        assert [(c.enable, c.current) for c in sent[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES
        assert all(c.enable for c in sent[:-STOP_FRAMES])
    else:
        assert sent == []
    low, high = run.transport.node.angle_range
    assert low >= -10.0
    assert high <= 100.0
    assert run.transport.node.top_speed <= 500.0


def test_a_full_experiment_answers_every_sample_once_and_comes_home(simulate: Simulate, layout: Layout) -> None:
    run = simulate(lambda *_: 6.0, options="f_v=3e-5")
    tally = run.outcome.tally
    assert run.outcome.fault is None
    assert run.outcome.home
    assert run.outcome.node_at_rest
    assert (tally.pairs, tally.answered, tally.unanswered, tally.missed, tally.not_obeyed) == (501, 500, 0, 0, 0)
    assert tally.limited > 0  # constant 6 A leaves the limits without the shield
    assert tally.returning > 0
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


def test_two_runs_with_the_same_seed_decide_the_same_and_another_seed_does_not(simulate: Simulate) -> None:
    first, second, other = (simulate(options=f"seed={seed}").journal.cycles for seed in (4, 4, 5))
    decisions = [[c[:13] for c in cycles[:-1]] for cycles in (first, second, other)]
    assert decisions[0] == decisions[1]
    assert decisions[0] != decisions[2]


def test_a_shorter_experiment_still_comes_home(simulate: Simulate, layout: Layout) -> None:
    run = simulate(steps=250)
    assert run.outcome.tally.answered == 250
    assert run.outcome.home
    assert_ended_safely(run, layout)


def test_the_policy_is_clipped_to_a_narrower_bench(simulate: Simulate, bench: Bench, layout: Layout) -> None:
    narrow = replace(bench, limits=replace(bench.limits, current=4.0))
    narrow = replace(narrow, shield=replace(narrow.shield, ranges="viscous"))
    run = simulate(on_bench=narrow)
    assert run.outcome.tally.clipped > 0
    assert max(abs(c.current) for c in commands(run, layout)) == pytest.approx(4.0)


# --- frames that do not come, or come wrong -------------------------------------------------------------------------


def dropping(identifier: int, periods: range) -> Callable[[Frame | None, SimTransport, SteppedClock], Frame | None]:
    """Loses one message during some sampling periods of the node."""

    def lose(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        while frame is not None and frame.identifier == identifier and transport.node.periods in periods:
            frame = transport.receive(clock.now_ns())
        return frame

    return lose


@pytest.mark.parametrize("identifier", [ANGLE, VELOCITY])
def test_a_missing_frame_is_a_missed_period_in_which_nothing_is_sent(
    simulate: Simulate, layout: Layout, identifier: int
) -> None:
    run = simulate(on_receive=dropping(identifier, range(100, 103)))
    tally = run.outcome.tally
    assert run.outcome.fault is None
    assert (tally.missed, tally.answered, tally.pairs) == (3, 497, 498)
    assert [c.missed for c in run.journal.cycles if c.missed] == [3]
    assert run.transport.node.braked == 3
    assert run.outcome.home
    assert_ended_safely(run, layout)


def test_a_long_gap_is_reported_and_then_survived(simulate: Simulate, bench: Bench, layout: Layout) -> None:
    run = simulate(on_receive=dropping(ANGLE, range(100, 100 + bench.watch.soft_missed)))
    assert run.journal.codes.count("SENSOR_LATE") == 1
    assert run.outcome.fault is None
    assert_ended_safely(run, layout)


def test_a_damaged_frame_is_not_answered_and_is_logged(simulate: Simulate, layout: Layout) -> None:
    def damage(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is not None and frame.identifier == ANGLE and transport.node.periods == 200:
            return frame._replace(data=frame.data[:7] + bytes([frame.data[7] ^ 1]))
        return frame

    run = simulate(on_receive=damage)
    assert (run.outcome.tally.missed, run.outcome.tally.rejected) == (1, 1)
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
    tally = run.outcome.tally
    assert (tally.unanswered, tally.missed, tally.answered, tally.pairs) == (2, 0, 498, 501)
    left = [c for c in run.journal.cycles if c.reasons & Reason.MISSED]
    assert len(left) == tally.unanswered
    assert all(c.command_counter == 15 for c in left)
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
    run = simulate(law, on_receive=tie, clock=clock)
    assert run.outcome.tally.unanswered == 3
    assert run.transport.node.braked == 3
    assert_ended_safely(run, layout)


# --- every fault is injected ----------------------------------------------------------------------------------------

INJECTIONS: dict[Fault, Callable[[Simulate], SimRun]] = {}


def injects(fault: Fault) -> Callable[[Callable[[Simulate], SimRun]], Callable[[Simulate], SimRun]]:
    def register(function: Callable[[Simulate], SimRun]) -> Callable[[Simulate], SimRun]:
        INJECTIONS[fault] = function
        return function

    return register


@injects(Fault.NO_NODE)
def _silence(simulate: Simulate) -> SimRun:
    def nothing(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        while frame is not None:
            frame = transport.receive(clock.now_ns())
        return None

    return simulate(on_receive=nothing)


@injects(Fault.NODE_NOT_READY)
def _away_from_home(simulate: Simulate) -> SimRun:
    def move(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        transport.node.angle = 2.0
        while frame is not None and transport.node.periods < 5:  # nobody looks while it is moved
            frame = transport.receive(clock.now_ns() + MS)
        return frame

    return simulate(on_receive=move)


@injects(Fault.SENSOR_LOST)
def _sensor_lost(simulate: Simulate) -> SimRun:
    return simulate(on_receive=dropping(ANGLE, range(100, 10_000)))


@injects(Fault.FRAMES_REJECTED)
def _noise_on_the_line(simulate: Simulate) -> SimRun:
    def damage(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is not None and frame.identifier == VELOCITY and 100 <= transport.node.periods < 110:
            return frame._replace(data=frame.data[:4])
        return frame

    return simulate(on_receive=damage)


@injects(Fault.OUT_OF_LIMITS)
def _a_brake_outside_the_box(simulate: Simulate) -> SimRun:
    return simulate(lambda _a, _v, _k: 6.0, options="k_m=0.06,f_v=1e-6,T_c=2e-4")


@injects(Fault.NODE_STOPPED)
def _node_stops(simulate: Simulate) -> SimRun:
    def stop(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if transport.node.periods == 200:
            transport.node.state = NodeState.STOPPING
        return frame

    return simulate(on_receive=stop)


@injects(Fault.NOT_OBEYED)
def _deaf_node(simulate: Simulate) -> SimRun:
    def deafen(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        transport.node.receive = lambda frame: None  # type: ignore[method-assign]
        return frame

    return simulate(on_receive=deafen)


@injects(Fault.FOREIGN_COMMAND)
def _foreign(simulate: Simulate) -> SimRun:
    once: Iterator[int] = iter([1])

    def intrude(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is not None and transport.node.periods == 200 and next(once, 0):
            return Frame(COMMAND, b"\x00\x00\x00\x00\x00", frame.time_ns)
        return frame

    return simulate(on_receive=intrude)


@injects(Fault.POLICY_NOT_FINITE)
def _nan(simulate: Simulate) -> SimRun:
    return simulate(lambda _a, _v, k: math.nan if k == 120 else 4.0)


@injects(Fault.POLICY_BEYOND_CONTRACT)
def _giant(simulate: Simulate) -> SimRun:
    return simulate(lambda _a, _v, k: 1e9 if k == 120 else 4.0)


@injects(Fault.GUARD_REJECTED)
def _broken_shield(simulate: Simulate) -> SimRun:
    class Traitor(Guard):
        """Stands for an error anywhere before the guard: the command it is given has the wrong counter."""

        def send(self, frame: Frame, state: RunState, sample_time_ns: int, now_ns: int) -> None:
            if len(self._times) == 10 and state is RunState.ACTIVE:
                data = frame.data[:1] + bytes([frame.data[1] ^ 0x01]) + frame.data[2:]
                frame = frame._replace(data=data)
            super().send(frame, state, sample_time_ns, now_ns)

    guards: list[Traitor] = []

    def on_receive(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        guards[0]._send = transport.send
        return frame

    guards.append(Traitor(load_layout(), load_bench(), lambda _frame: None))
    run = simulate(on_receive=on_receive, guard=guards[0])
    run.sent.extend(f._replace(own=False) for f in run.journal.frames if f.own)
    return run


@injects(Fault.BUS_LOST)
def _bus_lost(simulate: Simulate) -> SimRun:
    lost: list[int] = []

    def fail(_frame: Frame) -> None:
        lost.append(1)
        if len(lost) == 100:
            raise BusError("vcan0: the interface is down")

    return simulate(on_send=fail)


@injects(Fault.INTERRUPTED)
def _ctrl_c(simulate: Simulate) -> SimRun:
    asked = iter(range(10**9))
    return simulate(stop_requested=lambda: next(asked) > 700)


@injects(Fault.INTERNAL)
def _bug(simulate: Simulate) -> SimRun:
    return simulate(lambda _a, _v, k: 1.0 / (k - 150.0))


def test_every_fault_has_an_injection() -> None:
    assert set(INJECTIONS) == set(Fault)


@pytest.mark.parametrize("fault", Fault, ids=lambda fault: fault.name)
def test_every_fault_ends_the_run_with_stop_frames_and_within_limits(
    fault: Fault, simulate: Simulate, layout: Layout
) -> None:
    run = INJECTIONS[fault](simulate)
    assert run.outcome.fault is fault, run.outcome.detail
    assert fault.name in run.journal.codes
    assert run.journal.codes[-1] == "OVER"
    assert not run.outcome.home
    sent = commands(run, layout)
    assert all(abs(c.current) <= 6.0 for c in sent)
    armed = fault not in (Fault.NO_NODE, Fault.NODE_NOT_READY)
    assert run.outcome.armed == armed
    if not armed:
        assert sent == []
        return
    assert [(c.enable, c.current) for c in sent[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES
    if fault is not Fault.OUT_OF_LIMITS:  # that one is a brake for which nothing was promised
        assert run.transport.node.top_speed <= 500.0
        assert run.transport.node.angle_range[0] >= -10.0
        assert run.transport.node.angle_range[1] <= 100.0
    if fault is not Fault.NOT_OBEYED:  # that node hears nothing, stop frames neither
        assert run.transport.node.state in (NodeState.STOPPING, NodeState.IDLE)
    assert FAULTS[fault].exit_code in (3, 4)


def test_an_error_in_the_program_leaves_its_traceback_in_the_log(simulate: Simulate) -> None:
    run = _bug(simulate)
    assert "ZeroDivisionError" in run.outcome.detail
    assert any("ZeroDivisionError" in text for _, _, text in run.journal.lines)


def test_whatever_breaks_while_stopping_every_stop_frame_is_tried_and_the_run_ends(simulate: Simulate) -> None:
    def break_down(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if transport.node.periods > 100:
            raise OSError("the adapter is gone")
        return frame

    run = simulate(on_receive=break_down)
    assert run.outcome.fault is Fault.INTERNAL
    assert "the adapter is gone" in run.outcome.detail
    assert len([f for f in run.sent if not f.data[4] & 1]) == STOP_FRAMES
    assert run.journal.codes[-1] == "OVER"


def test_a_node_of_another_bench_or_protocol_is_not_armed(simulate: Simulate, layout: Layout) -> None:
    def pretend(version: int, identity: int) -> Callable[..., Frame | None]:
        def lie(frame: Frame | None, _transport: SimTransport, _clock: SteppedClock) -> Frame | None:
            if frame is None or frame.identifier != layout.status.identifier:
                return frame
            status = layout.decode_status(frame)
            values = {
                "Counter": status.counter,
                "NodeState": status.node_state,
                "ProtocolVersion": version,
                "StopReason": status.stop_reason,
                "RejectedCommands": 0,
                "BenchIdentity": identity,
            }
            return layout.status.encode(values)._replace(time_ns=frame.time_ns)

        return lie

    run = simulate(on_receive=pretend(layout.protocol_version, 0x1234))
    assert run.outcome.fault is Fault.NODE_NOT_READY
    assert "another bench file" in run.outcome.detail
    assert run.sent == []
    run = simulate(on_receive=pretend(99, 0))
    assert "protocol 99" in run.outcome.detail
    assert run.sent == []


def test_bus_off_is_a_lost_bus(simulate: Simulate) -> None:
    def bus_off(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is not None and transport.node.periods == 200:
            return Frame(0x40, bytes(8), frame.time_ns, error=True)
        return frame

    run = simulate(on_receive=bus_off)
    assert run.outcome.fault is Fault.BUS_LOST
    assert "bus-off" in run.outcome.detail


def test_what_piled_up_before_the_loop_listened_is_logged_but_not_what_it_arms_on(
    simulate: Simulate, layout: Layout
) -> None:
    """Frames are a second old until period 300; the run begins with the first fresh ones."""

    def age(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is not None and transport.node.periods <= 300:
            return frame._replace(time_ns=frame.time_ns - 1_000 * MS)
        return frame

    run = simulate(on_receive=age)
    assert run.outcome.fault is None
    assert run.journal.cycles[0].device_time_ns == (300 + 10 + 1) * MS
    assert len(run.journal.frames) > 600
    assert_ended_safely(run, layout)


def test_a_bus_that_refuses_even_the_stop_frames_does_not_hang_the_end(simulate: Simulate) -> None:
    def fail(_frame: Frame) -> None:
        raise BusError("vcan0: transmit queue full")

    run = simulate(on_send=fail)
    assert run.outcome.fault is Fault.BUS_LOST
    assert run.journal.codes.count("STOP_FRAME_NOT_SENT") == STOP_FRAMES
    assert run.journal.codes[-1] == "OVER"


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
