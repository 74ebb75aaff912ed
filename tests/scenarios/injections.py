"""How a fault is made in a run of the loop on the simulated bus: by what it receives, sends or is handed in."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from emb_bench.sim.transport import SimTransport, SteppedClock
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import BusError
from emb_runtime.records import Frame, NodeState
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.heartbeat import Unwatched
from tests.conftest import SimRun, Simulate
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


def away(transport: SimTransport) -> None:
    transport.node.angle = 2.0


def nothing(frame: Frame | None, transport: SimTransport, clock: SteppedClock) -> Frame | None:
    while frame is not None:
        frame = transport.receive(clock.now_ns())
    return None


def drift(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
    late = max(transport.node.periods - 100, 0)
    return frame and saying(Angle=lambda angle: angle + 0.03 * late)(frame)


def turned_out(frame: Frame | None, transport: SimTransport, _clock: SteppedClock) -> Frame | None:
    """A hand turns the brake slowly, beyond its lower limit as the way home begins."""
    transport.node.angle = -9.95 - 0.004 * transport.node.periods
    return frame


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
