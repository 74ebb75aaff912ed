"""emb-node: its clock skips and never bursts, and what a user gets wrong is one line."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import pairwise

from emb_bench.cli.node import run_node
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.transport import SteppedClock
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Bench
from emb_runtime.records import Frame

MS = 1_000_000


class LateClock(SteppedClock):
    """A clock on which sleeping sometimes takes longer than was asked for."""

    def __init__(self, late_ns: dict[int, int]) -> None:
        super().__init__()
        self.late_ns = late_ns
        self.sleeps = 0

    def sleep_until(self, time_ns: int) -> int:
        self.sleeps += 1
        return super().sleep_until(time_ns + self.late_ns.get(self.sleeps, 0))


class QuietBus:
    """A bus with nobody else on it."""

    name = "quiet"
    truth = None

    def __init__(self, clock: SteppedClock) -> None:
        self.clock = clock
        self.obtained: dict[str, str] = {}
        self.inbox: deque[Frame] = deque()
        self.sent: list[tuple[int, Frame]] = []

    def send(self, frame: Frame) -> None:
        self.sent.append((self.clock.now_ns(), frame))

    def receive(self, deadline_ns: int) -> Frame | None:
        assert deadline_ns <= self.clock.now_ns(), "the node waits for its tick, not for frames"
        return self.inbox.popleft() if self.inbox else None

    def close(self) -> None: ...


def node_times_ms(bus: QuietBus, layout: Layout) -> list[float]:
    return [layout.decode_angle(f).device_time_ns / MS for _, f in bus.sent if f.identifier == 0x100]


def test_a_late_node_skips_and_its_stamps_tell_the_true_time(bench: Bench, layout: Layout) -> None:
    bus = QuietBus(clock := LateClock({5: round(3.4 * MS)}))
    node = BrakeNode(bench, layout, bench.brake, lambda: (0.0, 0.0, 0.0))
    assert run_node(node, bus, clock, MS, 20, lambda: False) == 3
    assert node_times_ms(bus, layout) == [1, 2, 3, 4, *range(8, 21)]
    sent_ns = [t for t, f in bus.sent if f.identifier == 0x100]
    assert min(b - a for a, b in pairwise(sent_ns[5:])) == MS  # no burst, and no drift
    assert sent_ns[5] == 9 * MS
    assert node.periods == 20


def test_a_babbling_commander_does_not_hold_the_node_up(bench: Bench, layout: Layout) -> None:
    class Babble(QuietBus):
        def receive(self, deadline_ns: int) -> Frame | None:
            return Frame(0x80, b"")

    bus = Babble(clock := SteppedClock())
    node = BrakeNode(bench, layout, bench.brake, lambda: (0.0, 0.0, 0.0))
    assert run_node(node, bus, clock, MS, 5, lambda: False) == 0
    assert node.samples == 5


def test_commands_that_came_meanwhile_are_heard_before_the_tick(bench: Bench, layout: Layout) -> None:
    bus = QuietBus(clock := SteppedClock())
    node = BrakeNode(bench, layout, bench.brake, lambda: (0.0, 0.0, 0.0))
    stop: Iterator[bool] = iter([False, False, True])

    def asked() -> bool:
        if node.samples == 1:
            bus.inbox.append(layout.encode_command(0, 0, 2.0, True))
        return next(stop)

    run_node(node, bus, clock, MS, None, asked)
    assert (node.samples, node.obeyed) == (2, 1)
