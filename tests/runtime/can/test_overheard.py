"""What is dropped while nobody listens, and what of it the next run must still see."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import pytest

from emb_bench.sim.transport import SteppedClock
from emb_runtime.can.messages import Layout
from emb_runtime.cli.bus_monitor import BusMonitor, listen
from emb_runtime.cli.main import Operator
from emb_runtime.cli.options import parser, prepare
from emb_runtime.cli.session import Bus, drop_backlog
from emb_runtime.config.bench import Bench
from emb_runtime.records import Frame
from emb_runtime.system.terminal import StopRequest
from tests.runtime.operating import Keyboard

MS = 1_000_000
NOW = 1_000 * MS
COMMAND = 0x80
FOREIGN = Frame(COMMAND, bytes(5), NOW - 3 * MS)
BUS_OFF = Frame(0x40, bytes(8), NOW - 2 * MS, error=True)
ORDINARY = (
    Frame(0x100, bytes(8), NOW - 4 * MS),
    Frame(COMMAND, bytes(5), NOW - 4 * MS, own=True),
    Frame(COMMAND, bytes(5), NOW - 4 * MS, extended=True),
    Frame(0x40, bytes(8), NOW - 4 * MS),
)


class Waiting:
    """A bus on which these frames wait."""

    name = "can0"
    truth = None
    obtained: Mapping[str, str] = {}

    def __init__(self, frames: Iterable[Frame]) -> None:
        self.frames = list(frames)
        self.typed: Callable[[str], object] = lambda _text: None

    def send(self, frame: Frame) -> None:
        raise AssertionError("nothing is sent here")

    def receive(self, deadline_ns: int) -> Frame | None:
        if len(self.frames) == 1:
            self.typed("y\n")
        return self.frames.pop(0) if self.frames else None

    def close(self) -> None:
        pass


def bus_of(*frames: Frame) -> tuple[Waiting, Bus]:
    waiting = Waiting(frames)
    return waiting, Bus("can0", waiting, SteppedClock(NOW, 0))


def test_of_what_piled_up_the_alarming_frames_are_kept_once_and_the_rest_is_dropped(layout: Layout) -> None:
    last = Frame(COMMAND + 1, b"", NOW + MS)
    _, bus = bus_of(*ORDINARY, FOREIGN, BUS_OFF, FOREIGN, BUS_OFF, last, last)
    assert drop_backlog(bus, layout) == (FOREIGN, BUS_OFF)
    assert drop_backlog(bus, layout) == ()


def test_the_frame_that_ends_the_dropping_is_looked_at_too(layout: Layout) -> None:
    fresh = FOREIGN._replace(time_ns=NOW)
    waiting, bus = bus_of(*ORDINARY, fresh, BUS_OFF)
    assert drop_backlog(bus, layout) == (fresh,)
    assert waiting.frames == [BUS_OFF]


def test_what_comes_while_the_operator_is_asked_is_kept_for_the_run(
    layout: Layout, keyboard: Keyboard, handlers: None
) -> None:
    plan = prepare(parser().parse_args(["--confirm"]))
    waiting, bus = bus_of(*ORDINARY, FOREIGN, BUS_OFF, *ORDINARY)
    waiting.typed = keyboard
    assert Operator(plan, StopRequest()).may_arm(bus)
    assert drop_backlog(bus, layout) == (FOREIGN, BUS_OFF)


@pytest.mark.parametrize(("frame", "commanded", "errors"), [(FOREIGN, True, 0), (BUS_OFF, False, 1)])
def test_the_pre_flight_sees_an_alarming_frame_that_came_before_it_listened(
    bench: Bench, layout: Layout, frame: Frame, commanded: bool, errors: int
) -> None:
    waiting, bus = bus_of(*ORDINARY, frame)
    monitor = BusMonitor(layout, bench, lambda _frame, _why: None)
    listen(monitor, waiting.receive, bus.clock, MS, NOW + 9 * MS, lambda *_: False, lambda: not waiting.frames)
    heard = monitor.statistics()
    assert (heard.commanded, len(heard.bus_errors)) == (commanded, errors)
    assert (heard.frames, heard.others) == ({}, 0)
