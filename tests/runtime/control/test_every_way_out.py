"""Whatever is raised, wherever: the last frame is a stop frame, and nothing enabled follows the first one."""

from __future__ import annotations

from collections.abc import Callable
from inspect import isfunction
from typing import Any, NoReturn

import pytest

from emb_bench.sim.transport import SimTransport, SteppedClock
from emb_runtime.can.messages import Layout
from emb_runtime.errors import BusError, FrameError, PolicyRefusedError, UsageError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.records import Frame
from emb_runtime.safety.guard import Guard, GuardRejectedError
from emb_runtime.safety.heartbeat import STOP_FRAMES, Heartbeat, Unwatched
from emb_runtime.safety.sensor_monitor import SensorMonitor
from emb_runtime.safety.state_machine import Fault

from tests.conftest import Simulate  # isort: skip


class HostileError(Exception):
    """Neither its text nor its class can be asked for."""

    def __str__(self) -> str:
        raise KeyboardInterrupt

    def __repr__(self) -> str:
        raise SystemExit(0)

    @property  # type: ignore[misc]
    def __class__(self) -> NoReturn:  # type: ignore[override]
        raise RuntimeError


class TextlessError(BusError):
    def __str__(self) -> str:
        return 7  # type: ignore[return-value]


FAULTS: dict[type[BaseException], Fault] = {
    BusError: Fault.BUS_LOST,
    TextlessError: Fault.BUS_LOST,
    PolicyRefusedError: Fault.POLICY_NOT_FINITE,
    GuardRejectedError: Fault.GUARD_REJECTED,
    FrameError: Fault.INTERNAL,
    UsageError: Fault.INTERNAL,
    Exception: Fault.INTERNAL,
    OSError: Fault.INTERNAL,
    TypeError: Fault.INTERNAL,
    ZeroDivisionError: Fault.INTERNAL,
    RecursionError: Fault.INTERNAL,
    MemoryError: Fault.INTERNAL,
    HostileError: Fault.INTERNAL,
    SystemExit: Fault.INTERNAL,
}
LEAVING = (BaseException, KeyboardInterrupt, GeneratorExit)
"""No Exceptions: raised again, once the run has stopped."""

HANDED_IN: tuple[str, ...] = (
    "act",
    "stop_requested",
    "clock",
    "receive",
    "send",
    "push",
    "beat",
    "watched",
    "tripped",
    "publish",
)
OURS: dict[str, tuple[type, str]] = {
    "monitor": (SensorMonitor, "check"),
    "estimator": (Estimator, "add_sample"),
    "guard": (Guard, "send"),
    "guard's check": (Guard, "check"),
    "guard's drive": (Guard, "check_drive"),
    "guard's clock": (Guard, "check_time"),
}
WHILE_STOPPING = ("clock", "receive", "send", "push", "beat", "tripped", "publish", "disarm", "guard", "guard's check")
SILENCING = ("send", "guard", "guard's check", "publish", "tripped")
"""Places through which every frame leaves: where one fails for ever, no frame can."""


At = Callable[[str], None]


class PlantedPulse:
    """A pulse in which each call may raise."""

    def __init__(self, at: At, pulse: Heartbeat) -> None:
        self._at, self._pulse = at, pulse

    @property
    def tripped(self) -> bool:
        self._at("tripped")
        return self._pulse.tripped

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*arguments: int) -> Any:
            self._at(name)
            return getattr(self._pulse, name)(*arguments)

        return call


class Actor:
    """An actor in which each call may raise."""

    def __init__(self, at: At) -> None:
        self._at = at

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        self._at("act")
        return 4.0


class PlantedClock:
    """The clock of the simulated bus, once that is there."""

    def __init__(self, at: At) -> None:
        self.base, self._at = SteppedClock(10**15), at

    def now_ns(self) -> int:
        self._at("clock")
        return self.base.now_ns()

    def wall_offset_ns(self) -> int:
        return 0


class Planted:
    """A run in which one place raises: ``often`` times, from its first call on after so many frames have left."""

    def __init__(self, place: str, kind: type[BaseException], *, after: int = 10, often: int = 1) -> None:
        self.place, self._kind, self._after, self._often = place, kind, after, often
        self.raised = 0
        self.sent: list[bool] = []
        """Enable bit of each frame that left."""

    def at(self, place: str) -> None:
        if place == self.place and len(self.sent) >= self._after and self.raised < self._often:
            self.raised += 1
            raise self._kind("in the way")

    def run(self, simulate: Simulate, layout: Layout, pulse: Heartbeat) -> Any:
        """The outcome; raises what the loop raises."""
        clock = PlantedClock(self.at)

        def receive(frame: Frame | None, _transport: SimTransport, base: SteppedClock) -> Frame | None:
            clock.base = base
            self.at("receive")
            return frame

        def send(frame: Frame) -> None:
            self.at("send")
            self.sent.append(layout.decode_command(frame).enable)

        def ask() -> bool:
            self.at("stop_requested")
            return False

        return simulate(
            steps=40,
            actor=Actor(self.at),
            on_receive=receive,
            on_send=send,
            stop_requested=ask,
            push=lambda _record: self.at("push"),
            pulse=PlantedPulse(self.at, pulse),
            now_ns=clock.now_ns,
        ).outcome


def ended(planted: Planted, simulate: Simulate, layout: Layout, watched: bool) -> Fault | type[BaseException] | None:
    """The fault of a run, or what it raised."""
    pulse: Heartbeat = Heartbeat.create(1e9, SteppedClock(10**15).now_ns()) if watched else Unwatched()
    with pytest.MonkeyPatch.context() as patch:
        if planted.place in OURS:
            plant(patch, planted)
        try:
            fault: Fault | type[BaseException] | None = planted.run(simulate, layout, pulse).fault
        except BaseException as err:
            fault = type(err)
    if isinstance(pulse, Heartbeat):
        pulse.close()
    return fault


def plant(patch: pytest.MonkeyPatch, planted: Planted) -> None:
    """Put a place of our own into the way of its method."""
    owner, name = OURS[planted.place]
    method = getattr(owner, name)

    def call(*arguments: Any, **named: Any) -> Any:
        planted.at(planted.place)
        return method(*arguments, **named)

    patch.setattr(owner, name, call)


PLACES = (*HANDED_IN, *(OURS if isfunction(SensorMonitor.check) else ()))
"""Of the compiled core only what is handed in can be replaced."""


@pytest.mark.parametrize("place", PLACES)
def test_whatever_is_raised_in_a_run_stop_frames_follow_and_nothing_else(
    place: str, simulate: Simulate, layout: Layout
) -> None:
    for kind in (*FAULTS, *LEAVING):
        for after in (0, 10) if kind in (HostileError, KeyboardInterrupt) else (10,):
            planted = Planted(place, kind, after=after)
            end = ended(planted, simulate, layout, watched=True)
            row = f"{kind.__name__} after {after} frames: {end}, {planted.sent}"
            assert planted.raised == 1, row
            assert end == FAULTS.get(kind, kind), row
            enabled = planted.sent.count(True)
            stops = STOP_FRAMES if enabled >= after > 0 else planted.sent.count(False)
            assert planted.sent == [True] * enabled + [False] * stops, row
            assert stops in (0, STOP_FRAMES), row
            assert stops == STOP_FRAMES or enabled == 0, row


@pytest.mark.parametrize("place", PLACES)
def test_what_is_raised_for_ever_keeps_no_stop_frame_back_that_can_leave(
    place: str, simulate: Simulate, layout: Layout
) -> None:
    for kind in (HostileError, SystemExit, KeyboardInterrupt):
        planted = Planted(place, kind, after=10, often=1 << 30)
        end = ended(planted, simulate, layout, watched=False)
        row = f"{kind.__name__}: {end}, {planted.sent}"
        assert end == FAULTS.get(kind, kind), row
        stops = 0 if place in SILENCING else STOP_FRAMES
        assert planted.sent == [True] * planted.sent.count(True) + [False] * stops, row


@pytest.mark.parametrize("place", [place for place in WHILE_STOPPING if place in PLACES or place == "disarm"])
def test_what_is_raised_in_the_stop_keeps_no_other_stop_frame_back(
    place: str, simulate: Simulate, layout: Layout
) -> None:
    for kind in (HostileError, TypeError, BusError, KeyboardInterrupt, SystemExit, GeneratorExit):
        for after in (40, 41, 42):  # before each of the stop frames
            planted = Planted(place, kind, after=after)
            end = ended(planted, simulate, layout, watched=True)
            row = f"{kind.__name__} after {after} frames: {end}, {planted.sent}"
            assert planted.raised == 1, row
            assert end in ((kind,) if kind in LEAVING else (None, FAULTS[kind])), row
            assert planted.sent[:40] == [True] * 40, row
            assert planted.sent[40:] in ([False] * STOP_FRAMES, [False] * (STOP_FRAMES - 1)), row
