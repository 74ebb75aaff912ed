"""Every fault is injected into a whole run; a fault that nothing injects fails here."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import pytest

from emb_bench.sim.transport import SimTransport, SteppedClock
from emb_runtime.can.messages import Layout, load_layout
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import Sensors, load_bench
from emb_runtime.errors import BusError
from emb_runtime.records import CurrentCommand, Frame, NodeState
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.heartbeat import STOP_FRAMES, Unwatched
from emb_runtime.safety.state_machine import FAULTS, Fault

from tests.conftest import SimRun, Simulate  # isort: skip
from tests.benches import SENSOR_BENCH
from tests.independent import encoded, read

MS = 1_000_000
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


Receive = Callable[[Frame | None, SimTransport, SteppedClock], Frame | None]


def at_period(period: int, action: Callable[[SimTransport], object]) -> Receive:
    """Does something to the node while it is in one of its sampling periods."""

    def receive(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if transport.node.periods == period:
            action(transport)
        return frame

    return receive


def moved_unseen(move: Callable[[SimTransport], object]) -> Receive:
    """Moves the brake in the first five periods, in which nobody looks but for the status."""

    def receive(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
        if transport.node.periods < 5:
            move(transport)
        while frame is not None and frame.identifier != STATUS and transport.node.periods < 5:
            frame = transport.receive(clock.now_ns() + MS)
        return frame

    return receive


def push(transport: SimTransport) -> None:
    transport.node.angle, transport.node.velocity = -4.0, -450.0


def away(transport: SimTransport) -> None:
    transport.node.angle = 2.0


def nothing(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
    while frame is not None:
        frame = transport.receive(clock.now_ns())
    return None


def drift(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
    late = max(transport.node.periods - 100, 0)
    return frame and saying(Angle=lambda angle: angle + 0.03 * late)(frame)


def stop(transport: SimTransport) -> None:
    transport.node.state = NodeState.STOPPING


def deafen(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
    transport.node.receive = lambda frame: None  # type: ignore[method-assign]
    return frame


def intruding() -> Receive:
    once: Iterator[int] = iter([1])

    def intrude(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is not None and transport.node.periods == 200 and next(once, 0):
            return Frame(COMMAND, b"\x00\x00\x00\x00\x00", frame.time_ns)
        return frame

    return intrude


def failing(error: type[BusError], *at: int) -> Callable[[Frame], None]:
    """Fails to send the frames of these numbers."""
    asked = iter(range(10**9))

    def send(_frame: Frame) -> None:
        if next(asked) in at:
            raise error("can0: it does not go")

    return send


def asked_often(times: int) -> Callable[[], bool]:
    asked = iter(range(10**9))
    return lambda: next(asked) > times


def an_error_before_the_guard(simulate: Simulate) -> SimRun:
    """Whatever comes before it allows 6 A."""
    buses: list[SimTransport] = []
    guard = Guard(load_layout(), load_bench(), lambda frame: buses[0].send(frame), limit=1.0)

    def on_receive(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        buses[:] = [transport]
        return frame

    run = simulate(lambda _a, _v, k: 0.5 if k < 10 else 4.0, on_receive=on_receive, guard=guard)
    run.sent.extend(f._replace(own=False) for f in run.journal.frames if f.own)
    return run


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


def later(identifier: int, begin: int, **changes: Any) -> Receive:
    """Changes what the node says from a sampling period on."""
    return changing(saying(**changes), identifier, range(begin, 10_000))


def shortened(frame: Frame) -> Frame:
    return frame._replace(data=frame.data[:4])


def reported(frame: Frame) -> Frame:
    return Frame(0x8, bytes(8), frame.time_ns, error=True)


# Too many for an experiment, and within half a second not yet too many for the node to be lost.
MISSING_21_PERCENT = [n for n in range(20, 10_000) if 21 * n % 100 < 21]
INJECTIONS: dict[Fault, Callable[[Simulate], SimRun]] = {
    Fault.NO_NODE: lambda run: run(on_receive=nothing),
    Fault.NODE_NOT_READY: lambda run: run(on_receive=moved_unseen(away)),
    Fault.SENSOR_LOST: lambda run: run(on_receive=dropping(ANGLE, range(100, 10_000))),
    Fault.FRAMES_REJECTED: lambda run: run(on_receive=changing(shortened, VELOCITY, range(100, 110))),
    Fault.OUT_OF_LIMITS: lambda run: run(homing=True, on_receive=moved_unseen(push)),
    Fault.SENSORS_CONTRADICT: lambda run: run(on_receive=drift),
    Fault.MOTION_OUTSIDE_SET: lambda run: run(options="k_m=0.06,f_v=1e-6,T_c=2e-4"),
    Fault.WRONG_POLARITY: lambda run: run(on_receive=changing(saying(Angle=lambda x: -x, Velocity=lambda v: -v))),
    Fault.NODE_STOPPED: lambda run: run(on_receive=at_period(200, stop)),
    Fault.NOT_OBEYED: lambda run: run(on_receive=deafen),
    Fault.FOREIGN_COMMAND: lambda run: run(on_receive=intruding()),
    Fault.POLICY_NOT_FINITE: lambda run: run(lambda _a, _v, k: math.nan if k == 120 else 4.0),
    Fault.POLICY_BEYOND_CONTRACT: lambda run: run(lambda _a, _v, k: 1e9 if k == 120 else 4.0),
    Fault.GUARD_REJECTED: an_error_before_the_guard,
    Fault.BUS_LOST: lambda run: run(on_send=failing(BusError, 99)),
    Fault.INTERRUPTED: lambda run: run(stop_requested=asked_often(700)),
    Fault.INTERNAL: lambda run: run(lambda _a, _v, k: 1.0 / (k - 150.0)),
    Fault.CURRENT_MISMATCH: lambda run: run(lambda *_: 3.0, on_receive=later(VELOCITY, 200, AppliedCurrent=0.5)),
    Fault.WATCHDOG_TRIPPED: lambda run: run(pulse=Pulse(trips_at=1500)),
    Fault.WATCHDOG_LOST: lambda run: run(pulse=Pulse(silent_at=150)),
    Fault.NOT_HOME: lambda run: run(lambda *_: 0.0, homing=True, steps=30, angle=40.0),
    Fault.DEVICE_TIME: lambda run: run(on_receive=later(ANGLE, 200, DeviceTime=lambda time: time + 0.5)),
    Fault.INCOMPLETE: lambda run: run(on_receive=dropping(ANGLE, MISSING_21_PERCENT)),
    Fault.NODE_CHANGED: lambda run: run(on_receive=later(STATUS, 200, BenchIdentity=lambda number: int(number) ^ 1)),
    Fault.MOTION_UNEXPLAINED: lambda run: run(
        lambda _x, _v, step: 6.0 if step // 60 % 2 == 0 else -6.0,
        on_receive=later(VELOCITY, 0, AppliedCurrent=lambda current: current + 0.4),
    ),
    Fault.RESPONSE_LATE: lambda run: run(options="plant=lag"),
    Fault.NOT_AT_REST: lambda run: run(on_receive=later(VELOCITY, 520, NodeState=NodeState.FAULT)),
    # What passes by itself.
    Fault.SENSOR_LATE: lambda run: run(on_receive=dropping(VELOCITY, range(100, 106))),
    Fault.SEND_QUEUE_FULL: lambda run: run(on_send=failing(TransmitQueueFullError, 100, 200, 201)),
    Fault.FRAMES_DROPPED: lambda run: run(
        on_receive=changing(lambda frame: frame._replace(dropped=7), periods=range(200, 10_000))
    ),
    Fault.BUS_ERRORS: lambda run: run(on_receive=changing(reported, VELOCITY, range(200, 203))),
    Fault.PERMISSION_LOST: lambda run: run(on_receive=dropping(STATUS, range(100, 300))),
}
"""A whole run with each fault in it."""


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
    assert (run.outcome.end is not None) == armed
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
    run = INJECTIONS[Fault.SEND_QUEUE_FULL](simulate)
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


def assert_within_limits(run: SimRun) -> None:
    low, high = run.transport.node.angle_range
    assert -10.0 <= low <= high <= 100.0
    assert run.transport.node.top_speed <= 500.0


def commands(run: SimRun, layout: Layout) -> list[CurrentCommand]:
    return [layout.decode_command(frame) for frame in run.sent]


@pytest.mark.parametrize(
    ("state", "fault", "within"),
    [
        (NodeState.FAULT, Fault.NODE_STOPPED, 1),
        (NodeState.STOPPING, Fault.NODE_STOPPED, 1),
        (NodeState.IDLE, Fault.NODE_CHANGED, 101),
    ],
)
def test_a_status_that_contradicts_the_pairs_ends_the_run(
    simulate: Simulate, state: NodeState, fault: Fault, within: int
) -> None:
    said: list[int] = []

    def receive(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
        if frame is None or frame.identifier != STATUS or transport.node.periods < 250:
            return frame
        said.append(transport.node.periods)
        return saying(NodeState=int(state))(frame)

    run = simulate(on_receive=receive)
    assert run.outcome.fault is fault, run.outcome.detail
    assert f"status says {state.name}" in run.outcome.detail
    assert run.journal.cycles[-1].step + run.journal.cycles[0].device_time_ns // 1_000_000 <= said[0] + within
    assert_within_limits(run)


@pytest.mark.parametrize(("state", "until"), [(NodeState.IDLE, 101), (NodeState.STOPPING, 1)])
def test_a_status_from_before_the_first_command_ends_no_run(simulate: Simulate, state: NodeState, until: int) -> None:
    late = changing(saying(NodeState=int(state)), STATUS, range(until + 1))
    assert simulate(on_receive=late).outcome.fault is None


def test_a_node_whose_status_says_fault_is_not_armed(simulate: Simulate) -> None:
    outcome = simulate(on_receive=changing(saying(NodeState=int(NodeState.FAULT)), STATUS)).outcome
    assert (outcome.fault, outcome.end) == (Fault.NODE_NOT_READY, None)
    assert outcome.detail == "its status says FAULT"


@pytest.mark.parametrize(
    ("plant", "named"),
    [
        ("observer", r"\[sensors\] velocity = \"observer\", observer_bandwidth = (14[5-9]0|15[0-2]0) at most$"),
        ("lag", r"\[shield\] current_lag = (0\.002)$"),
        ("late", r"\[shield\] frame_age = \[0, (2)\]$"),
    ],
)
def test_an_undeclared_response_ends_the_run_below_every_limit_and_with_the_named_value_the_next_run_is_done(
    plant: str, named: str, simulate: Simulate
) -> None:
    for seed in range(3):
        ran = simulate(options=f"plant={plant},seed={seed}", on_bench=SENSOR_BENCH)
        assert ran.outcome.fault is Fault.RESPONSE_LATE
        assert ran.outcome.response == ""
        assert max(abs(cycle.velocity) for cycle in ran.journal.cycles) < 250.0
        found = re.search(named, ran.outcome.detail)
        assert found is not None, ran.outcome.detail
        bench, value = SENSOR_BENCH, float(found[1])
        keys: dict[str, dict[str, Any]] = {"lag": {"current_lag": value}, "late": {"frame_age": (0, int(value))}}
        shield = keys.get(plant, {})
        sensors = Sensors("observer", value) if plant == "observer" else bench.sensors
        declared = dataclasses.replace(bench, sensors=sensors, shield=bench.shield._replace(**shield))
        assert simulate(options=f"plant={plant},seed={seed}", on_bench=declared).outcome.fault is None


@pytest.mark.parametrize(
    ("plant", "declared"),
    [
        ("exact", {}),
        ("observer", {"sensors": Sensors("observer", 1480.0)}),
        ("lag", {"shield": SENSOR_BENCH.shield._replace(current_lag=0.002)}),
        ("late", {"shield": SENSOR_BENCH.shield._replace(frame_age=(0, 2))}),
    ],
)
def test_a_response_that_is_declared_is_proven_and_the_outcome_says_so(
    plant: str, declared: dict[str, Any], simulate: Simulate
) -> None:
    ran = simulate(options=f"plant={plant}", on_bench=dataclasses.replace(SENSOR_BENCH, **declared))
    assert ran.outcome.fault is None, ran.outcome.detail
    assert re.fullmatch(
        r"the velocity follows the commands -?\d\.\d ± \d\.\d samples late, at most [\d.]+ are declared",
        ran.outcome.response,
    )
