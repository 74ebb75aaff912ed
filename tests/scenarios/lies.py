"""Lies of a node, the simulated loop in front of one, and how each such run must end.

The node is written anew (:mod:`tests.lying.node`), the loop is the one that ships, on a bus whose time is simulated.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from emb_bench.sim.transport import SteppedClock
from emb_runtime.can.messages import bench_identity
from emb_runtime.config.bench import Bench, load_bench
from emb_runtime.control.actor import Actor
from emb_runtime.control.result import Outcome
from emb_runtime.records import Frame
from emb_runtime.safety.state_machine import Fault
from tests.conftest import FunctionActor, Journal, make_loop
from tests.lying.node import PERIOD_NS, Lie, LyingNode

BENCH = load_bench()


class LyingBus:
    """The lying node in lock-step with simulated time.

    Args:
        node: the node.
        delay_ns: latency of the frames of the next period [ns]; late frames come in order.
    """

    def __init__(self, node: LyingNode, delay_ns: Callable[[], int]) -> None:
        self.node = node
        self.clock = SteppedClock(10**12)
        self.stopped: int | None = None
        """Period of the first stop frame."""
        self._delay_ns = delay_ns
        self._tick_ns = self.clock.now_ns() + PERIOD_NS
        self._last_ns = 0
        self._queue: deque[Frame] = deque()

    def send(self, frame: Frame) -> None:
        if not frame.data[4] & 1 and self.stopped is None:
            self.stopped = self.node.periods
        self.node.receive(frame.identifier, frame.data)
        self._queue.appendleft(frame._replace(time_ns=self.clock.now_ns(), own=True))

    def receive(self, deadline_ns: int) -> Frame | None:
        while self._tick_ns <= max(deadline_ns, self.clock.now_ns()):
            if self._queue and self._queue[0].time_ns < self._tick_ns:
                break
            # What is late for the bus is late for this computer as well: the node goes on meanwhile.
            arrival_ns = max(self._tick_ns + self._delay_ns(), self._last_ns)
            self._last_ns = arrival_ns
            self._queue.extend(Frame(i, data, arrival_ns) for i, data in self.node.tick())
            self._tick_ns += PERIOD_NS
        if self._queue and self._queue[0].time_ns <= max(deadline_ns, self.clock.now_ns()):
            frame = self._queue.popleft()
            self.clock.advance_to(max(frame.time_ns, self.clock.now_ns()))
            return frame
        self.clock.advance_to(max(deadline_ns, self.clock.now_ns()))
        return None


@dataclass(frozen=True)
class Seen:
    """What came of a run."""

    outcome: Outcome
    node: LyingNode
    journal: Journal
    detected: int | None  # Periods from the first lie to the first stop frame


def run(
    lie: Lie,
    seed: int = 1,
    delay_ns: Callable[[], int] = lambda: 0,
    law: Callable[[float, float, float], float] = lambda *_: 6.0,
    steps: int = BENCH.timing.horizon,
    bench: Bench = BENCH,
    actor: Actor | None = None,
    **core: Any,
) -> Seen:
    node = LyingNode(bench_identity(bench.identity_hash), lie, seed)
    bus, journal = LyingBus(node, delay_ns), Journal()
    driven: Any = {"send": bus.send, "receive": bus.receive, "now_ns": bus.clock.now_ns, "push": journal.push}
    outcome = make_loop(bench, actor or FunctionActor(law), steps, **driven, **core).run()
    detected = None if bus.stopped is None or node.began is None else bus.stopped - node.began
    return Seen(outcome, node, journal, detected)


def assert_inside(seen: Seen) -> None:
    assert seen.node.lowest >= -10.0
    assert seen.node.highest <= 100.0
    assert seen.node.fastest <= 500.0


class End(NamedTuple):
    """How a run of 6 A with a lie ends: by one of these faults, with the first stop frame within so many periods."""

    lie: Lie
    faults: tuple[Fault, ...]
    within: int  # Periods of one millisecond from the first lie
    says: str = ""  # Part of the fault's detail


CLOCK = (Fault.DEVICE_TIME, Fault.FRAMES_REJECTED, Fault.SENSOR_LOST, Fault.SENSORS_CONTRADICT)
SENSORS = (Fault.SENSORS_CONTRADICT, Fault.MOTION_OUTSIDE_SET, Fault.WRONG_POLARITY, Fault.FRAMES_REJECTED)
CHANGED, OUTSIDE = (Fault.NODE_CHANGED,), (Fault.MOTION_OUTSIDE_SET,)
IDLE = "the node's state is IDLE after it has obeyed"
ENDS: dict[str, End] = {
    "the clock jumps by 0.5 s": End(Lie(clock_jump=0.5, begin=0.15), CLOCK, 1),
    "the clock jumps, and 5 rad": End(Lie(clock_jump=0.013, clock_jump_angle=-5.0, begin=0.15), CLOCK, 6),
    "the clock jumps by 13 ms": End(Lie(clock_jump=0.013, begin=0.15), CLOCK, 1),
    "the clock jumps by 4 ms": End(Lie(clock_jump=0.004), CLOCK, 6),
    "the clock is off by up to 2 s": End(Lie(clock_random=2.0), CLOCK, 20),
    "the clock is off by up to 10 ms": End(Lie(clock_random=0.01), CLOCK, 20),
    "the clock is off by up to 1 ms": End(Lie(clock_random=0.001), CLOCK, 20),
    "it is idle": End(Lie(idle=True), CHANGED, 1, IDLE),
    "it is idle now and then": End(Lie(idle=True, duty=0.1), CHANGED, 1, IDLE),
    "it is idle from the start": End(Lie(idle=True, begin=0.0), CHANGED, 1, IDLE),
    "another identity": End(Lie(identity=1), CHANGED, 101, "another bench file"),
    "another protocol": End(Lie(protocol=1), CHANGED, 101, "it speaks protocol 2, expected 1"),
    **{
        f"the angle drifts by {sign * drift} rad/s": End(Lie(drift=sign * drift, begin=0.1), SENSORS, within)
        for drift, within in ((5.0, 80), (30.0, 12), (100.0, 8))
        for sign in (1.0, -1.0)
    },
    **{f"the velocity is {v} rad/s off": End(Lie(offset=v, begin=0.1), SENSORS, 30) for v in (40.0, -10.0, 5.0, -5.0)},
    **{
        f"both sensors times {scale}": End(Lie(scale=scale, begin=0.0), OUTSIDE, within)
        for scale, within in ((0.2, 14), (0.3, 17), (0.33, 23), (2.0, 5))
    },
}
UNEXPLAINED: dict[str, Lie] = {
    "scale slides by 0.5/s": Lie(slide=0.5, blind=True, begin=0.0),
    "scale slides by -0.5/s": Lie(slide=-0.5, blind=True, begin=0.0),
    "scale swings": Lie(wave=0.1, blind=True, begin=0.0),
    "angle curved": Lie(curve=0.001, blind=True, begin=0.0),
    "zero at 5 rad": Lie(zero=5.0, blind=True),
    "zero at -5 rad": Lie(zero=-5.0, blind=True),
    "both drift by 5 rad/s": Lie(both=5.0, blind=True),
    "both drift by 5 rad/s with losses": Lie(both=5.0, blind=True, lost=0.05),
    "current times 0.8": Lie(gain=0.8),
    "current times 1.05": Lie(gain=1.05),
    "current grows by -0.5/s": Lie(gain_rate=-0.5),
    "current swings": Lie(gain_wave=0.1, begin=0.0),
    "reported current -0.4 A": Lie(reported=-0.4, begin=0.0),
    "reported current +0.1 A": Lie(reported=0.1, begin=0.0),
    "unreported current 0.4 A": Lie(offset_current=0.4, begin=0.0),
    "dead band of 1 A": Lie(dead=1.0, begin=0.0),
    "friction doubles": Lie(friction_rate=1.0, begin=0.0),
    "stiffness halves": Lie(stiffness=0.5, begin=0.25),
}
"""All of these were called done with exit code 0; the shipped actor drives. tests/searches/lies.py plays 64."""
