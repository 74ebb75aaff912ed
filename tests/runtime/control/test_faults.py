"""Every fault is injected into a whole run; a fault that nothing injects fails here."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import pytest

from emb_bench.sim.transport import SimTransport
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import load_bench, parse_bench, shipped_bench_text
from emb_runtime.errors import BusError
from emb_runtime.records import CurrentCommand, Frame, NodeState
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.heartbeat import STOP_FRAMES, Unwatched
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.system.clock import SteppedClock

from tests.conftest import SimRun, Simulate  # isort: skip
from tests.independent import encoded, read

MS = 1_000_000
LEARNING = parse_bench(shipped_bench_text().replace("[shield]", "[shield]\nlearn = true\n#"), "learning")
ANGLE, VELOCITY, STATUS, COMMAND = 0x100, 0x101, 0x102, 0x80


def dropping(
    identifier: int, periods: Sequence[int]
) -> Callable[[Frame | None, SimTransport, SteppedClock], Frame | None]:
    """Loses one message during some sampling periods of the node."""

    def lose(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        while frame is not None and frame.identifier == identifier and transport.node.periods in periods:
            frame = transport.receive(clock.now_ns())
        return frame

    return lose


def changing(
    change: Callable[[Frame], Frame], identifier: int | None = None, periods: range = range(10_000)
) -> Callable[[Frame | None, SimTransport, SteppedClock], Frame | None]:
    """Changes each frame, or those of one message, that comes during some sampling periods of the node."""

    def receive(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is None or identifier not in (None, frame.identifier) or transport.node.periods not in periods:
            return frame
        return change(frame)

    return receive


def saying(**changes: float | Callable[[float], float]) -> Callable[[Frame], Frame]:
    """Changes signals of each frame that has them: to a value, or by a function of the old one."""

    def change(frame: Frame) -> Frame:
        values = read(frame) or {}
        new = {name: by(values[name]) if callable(by) else by for name, by in changes.items() if name in values}
        return encoded(frame.identifier, values | new)._replace(time_ns=frame.time_ns) if new else frame

    return change


Injection = Callable[[Simulate], SimRun]
INJECTIONS: dict[Fault, Injection] = {}


def injects(fault: Fault) -> Callable[[Injection], Injection]:
    def register(function: Injection) -> Injection:
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
    return simulate(on_receive=changing(lambda frame: frame._replace(data=frame.data[:4]), VELOCITY, range(100, 110)))


@injects(Fault.OUT_OF_LIMITS)
def _pushed_by_hand(simulate: Simulate) -> SimRun:
    def push(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        if transport.node.periods < 5:
            transport.node._x[:2] = -4.0, -450.0
        # Nobody looks while it is pushed.
        while frame is not None and frame.identifier != STATUS and transport.node.periods < 5:
            frame = transport.receive(clock.now_ns() + MS)
        return frame

    return simulate(homing=True, on_receive=push)


@injects(Fault.SENSORS_CONTRADICT)
def _drifting_angle(simulate: Simulate) -> SimRun:
    def drift(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        late = max(transport.node.periods - 100, 0)
        return frame and saying(Angle=lambda angle: angle + 0.03 * late)(frame)

    return simulate(on_receive=drift)


@injects(Fault.MOTION_OUTSIDE_SET)
def _a_brake_outside_the_set(simulate: Simulate) -> SimRun:
    return simulate(options="k_m=0.06,f_v=1e-6,T_c=2e-4")


@injects(Fault.WRONG_POLARITY)
def _sensor_with_the_wrong_sign(simulate: Simulate) -> SimRun:
    return simulate(on_receive=changing(saying(Angle=lambda angle: -angle, Velocity=lambda velocity: -velocity)))


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
def _error_before_the_guard(simulate: Simulate) -> SimRun:
    guard = Guard(
        load_layout(), load_bench(), lambda _frame: None, limit=1.0
    )  # and whatever comes before it allows 6 A

    def on_receive(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        guard._send = transport.send
        return frame

    run = simulate(lambda _a, _v, k: 0.5 if k < 10 else 4.0, on_receive=on_receive, guard=guard)
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


@injects(Fault.CURRENT_MISMATCH)
def _weak_drive(simulate: Simulate) -> SimRun:
    weak = saying(AppliedCurrent=0.5)
    return simulate(lambda *_: 3.0, on_receive=changing(weak, VELOCITY, range(200, 10_000)))


class Pulse(Unwatched):
    """A watchdog that speaks, or falls silent, at the n-th time that the loop asks."""

    def __init__(self, trips_at: int = 10**9, silent_at: int = 10**9) -> None:
        super().__init__()
        self.trips_at, self.silent_at = trips_at, silent_at
        self.asked = self.signs = 0
        self.calls: list[bool] = []

    @property
    def tripped(self) -> bool:
        self.asked += 1
        return self.asked > self.trips_at

    def watched(self, now_ns: int) -> bool:
        self.signs += 1
        return self.signs <= self.silent_at

    def arm(self, now_ns: int) -> None:
        self.calls.append(True)

    def disarm(self) -> None:
        self.calls.append(False)


@injects(Fault.WATCHDOG_TRIPPED)
def _watchdog_trips(simulate: Simulate) -> SimRun:
    return simulate(pulse=Pulse(trips_at=1500))


@injects(Fault.WATCHDOG_LOST)
def _watchdog_dies(simulate: Simulate) -> SimRun:
    return simulate(pulse=Pulse(silent_at=150))


@injects(Fault.NOT_HOME)
def _too_far_away(simulate: Simulate) -> SimRun:
    return simulate(lambda *_: 0.0, homing=True, steps=30, angle=40.0)


@injects(Fault.DEVICE_TIME)
def _clock_jumps(simulate: Simulate) -> SimRun:
    later = saying(DeviceTime=lambda time: time + 0.5)
    return simulate(on_receive=changing(later, ANGLE, range(200, 10_000)))


@injects(Fault.INCOMPLETE)
def _21_percent_are_missing(simulate: Simulate) -> SimRun:
    """Too many for an experiment, and within half a second not yet too many for the node to be lost."""
    return simulate(on_receive=dropping(ANGLE, [n for n in range(20, 10_000) if 21 * n % 100 < 21]))


@injects(Fault.NODE_CHANGED)
def _another_node(simulate: Simulate) -> SimRun:
    other = saying(BenchIdentity=lambda identity: int(identity) ^ 1)
    return simulate(on_receive=changing(other, STATUS, range(200, 10_000)))


@injects(Fault.SET_CONTRADICTED)
def _another_brake_than_the_shield_was_told(simulate: Simulate) -> SimRun:
    return simulate(on_bench=LEARNING, options="plant=euler")


@injects(Fault.MOTION_UNEXPLAINED)
def _a_reported_current_that_is_off(simulate: Simulate) -> SimRun:
    more = saying(AppliedCurrent=lambda current: current + 0.4)
    return simulate(lambda _x, _v, step: 6.0 if step // 60 % 2 == 0 else -6.0, on_receive=changing(more, VELOCITY))


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


@injects(Fault.NOT_AT_REST)
def _the_node_does_not_let_go(simulate: Simulate) -> SimRun:
    failed = saying(NodeState=NodeState.FAULT)
    return simulate(on_receive=changing(failed, VELOCITY, range(520, 10_000)))


def test_a_counter_that_skips_every_other_sample_ends_the_run(simulate: Simulate, layout: Layout) -> None:
    seen: list[SimTransport] = []

    def skip(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        node = transport.node
        if transport not in seen:
            seen.append(transport)
            tick = node.tick

            def skipping(skipped: int = 0) -> list[Frame]:
                node._counter = (node._counter + 1) % 15  # of a sample that it does not send
                return tick(skipped)

            node.tick = skipping  # type: ignore[method-assign]
        return frame

    run = simulate(on_receive=skip)
    assert run.outcome.fault is Fault.SENSOR_LOST
    assert "by the node's counter" in run.outcome.detail
    assert [(c.enable, c.current) for c in commands(run, layout)[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES


# --- what passes by itself ------------------------------------------------------------------------------------------


@injects(Fault.SENSOR_LATE)
def _a_pause(simulate: Simulate) -> SimRun:
    return simulate(on_receive=dropping(VELOCITY, range(100, 106)))


@injects(Fault.SEND_QUEUE_FULL)
def _no_room(simulate: Simulate) -> SimRun:
    asked = iter(range(10**9))

    def refuse(_frame: Frame) -> None:
        if next(asked) in (100, 200, 201):
            raise TransmitQueueFullError("can0: transmit queue full")

    return simulate(on_send=refuse)


@injects(Fault.FRAMES_DROPPED)
def _small_buffer(simulate: Simulate) -> SimRun:
    return simulate(on_receive=changing(lambda frame: frame._replace(dropped=7), periods=range(200, 10_000)))


@injects(Fault.BUS_ERRORS)
def _bus_errors(simulate: Simulate) -> SimRun:
    def report(frame: Frame) -> Frame:
        return Frame(0x8, bytes(8), frame.time_ns, error=True)

    return simulate(on_receive=changing(report, VELOCITY, range(200, 203)))


@injects(Fault.PERMISSION_LOST)
def _no_status(simulate: Simulate) -> SimRun:
    return simulate(on_receive=dropping(STATUS, range(100, 300)))


def test_every_fault_has_an_injection() -> None:
    assert set(INJECTIONS) == set(Fault)


LATCHED = [fault for fault, info in FAULTS.items() if info.latched]
SOFT = [fault for fault, info in FAULTS.items() if not info.latched]


@pytest.mark.parametrize("fault", LATCHED, ids=lambda fault: fault.name)
def test_every_fault_that_latches_ends_the_run_with_stop_frames_and_within_limits(
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
    if fault is Fault.WATCHDOG_TRIPPED:  # the watchdog sends the stop frames, and this process is silent
        assert all(c.enable for c in sent)
    else:
        assert [(c.enable, c.current) for c in sent[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES
    if fault is not Fault.OUT_OF_LIMITS:  # that one is a brake for which nothing was promised
        assert_within_limits(run)
    if fault is not Fault.NOT_OBEYED:  # that node hears nothing, stop frames neither
        assert run.transport.node.state in (NodeState.STOPPING, NodeState.IDLE)
    assert FAULTS[fault].exit_code in (3, 4, 8)


@pytest.mark.parametrize("fault", SOFT, ids=lambda fault: fault.name)
def test_every_soft_fault_is_told_and_ends_nothing_by_itself(fault: Fault, simulate: Simulate, layout: Layout) -> None:
    run = INJECTIONS[fault](simulate)
    assert fault.name in run.journal.codes
    assert run.outcome.fault in (None, Fault.NODE_STOPPED)  # the node ends it where nobody may command it for long
    assert (run.outcome.fault is None) == (fault is not Fault.PERMISSION_LOST)
    sent = commands(run, layout)
    assert [(c.enable, c.current) for c in sent[-STOP_FRAMES:]] == [(False, 0.0)] * STOP_FRAMES
    assert_within_limits(run)


def test_a_command_without_room_is_lost_and_never_sent_later(simulate: Simulate, layout: Layout) -> None:
    run = _no_room(simulate)
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


def test_the_status_of_the_node_is_missed_after_two_of_its_periods(simulate: Simulate) -> None:
    run = _no_status(simulate)
    lost = next(time_ns for time_ns, code, _ in run.journal.events if code == Fault.PERMISSION_LOST.name)
    last = max(f.time_ns for f in run.journal.frames if f.identifier == STATUS and f.time_ns < lost)
    assert 200 * MS <= lost - last <= 202 * MS
    enabled = [f.time_ns for f in run.journal.frames if f.own and f.data[4] & 1]
    assert max(enabled) < lost


def assert_within_limits(run: SimRun) -> None:
    low, high = run.transport.node.angle_range
    assert -10.0 <= low <= high <= 100.0
    assert run.transport.node.top_speed <= 500.0


def commands(run: SimRun, layout: Layout) -> list[CurrentCommand]:
    return [layout.decode_command(frame) for frame in run.sent]


def test_a_brake_whose_motor_has_the_wrong_sign_is_left_to_friction_before_its_node_may_brake_it(
    simulate: Simulate, layout: Layout
) -> None:
    def swapped(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        theta = transport.node._theta
        transport.node._theta = theta._replace(k_m=-abs(theta.k_m))
        return frame

    run = simulate(on_receive=swapped)
    assert run.outcome.fault is Fault.WRONG_POLARITY
    assert "the opposite sign would fit" in run.outcome.detail
    assert run.transport.node.angle_range[0] > -1.0
    assert run.transport.node.angle_range[1] < 1.0
    assert run.transport.node.top_speed < 40.0
    enabled = [c.current for c in commands(run, layout) if c.enable]
    assert 1 <= sum(current != 0.0 for current in enabled) <= 2  # the first move: then the sign is known
    assert enabled[-1] == 0.0
