"""Whole runs on a hostile bus: the loop on the simulated node, with everything that can be wrong with frames between.

Judged from outside: each command that reaches the bus by an account of it that shares no code with loop, reception and
guard, and the run by how it ends.
"""

from __future__ import annotations

import math
from collections import deque
from random import Random
from typing import Any

from emb_bench.sim.node import BrakeNode
from emb_bench.sim.transport import SimTransport, SteppedClock, open_sim
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import load_bench
from emb_runtime.control.result import Outcome
from emb_runtime.errors import BusError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.records import Frame
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.state_machine import Fault
from tests.conftest import Journal, make_loop
from tests.fuzz.model import ReceptionModel
from tests.fuzz.stream import ANGLE, COMMAND, MS, STATUS, Played, anything, chance, damaged, demand
from tests.independent import read

BENCH, LAYOUT = load_bench(), load_layout()
MOST_RECEIVES = 200_000
"""Far more than any run needs: the longest waits for its node through 5 s, and each period has a handful of frames."""
FRAME_NS = 50_000  # Least time that a frame takes on the bus
SLEW = BENCH.guard.slew * BENCH.timing.sample_time + 2e-4


class HangError(BaseException):
    """The run does not come to an end. Not an Exception: the loop must not be able to catch it."""


class PolicyError(RuntimeError):
    """The policy has failed, as any code may."""


class HostileBus:
    """The simulated bus, with somebody between it and the loop."""

    def __init__(self, draw: Random, transport: SimTransport, clock: SteppedClock) -> None:
        self._draw, self._transport, self._clock = draw, transport, clock
        self._queue: deque[Frame] = deque()
        self._lost_until_ns = 0
        self.muted = draw.choice([None] * 7 + [STATUS, ANGLE])
        """A message that is lost for good at some time, and nothing else happens."""
        self._muted_from_ns = clock.now_ns() + draw.randint(0, 200) * MS
        self._percent = draw.choice([0, 1, 5, 20]) if self.muted is None else 0
        self.judge = Judge()
        self.forged = False
        """Somebody has sent well-formed frames in the node's name: what the loop believes may be false."""
        self.broken = False
        """The bus itself has failed."""
        self.receives = 0

    @property
    def node(self) -> BrakeNode:
        """The brake behind it."""
        return self._transport.node

    def spend(self, duration_ns: int) -> None:
        """Let time pass; what comes meanwhile waits."""
        until_ns = self._clock.now_ns() + duration_ns
        while (frame := self._transport.receive(until_ns)) is not None:
            self._queue.append(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        """The next frame, true or not."""
        self.receives += 1
        if self.receives > MOST_RECEIVES:
            raise HangError
        frame = self._next(deadline_ns)
        while frame is not None and self._loses(frame):
            frame = self._next(deadline_ns)
        if chance(self._draw, self._percent):
            frame = self._spoiled(frame)
        if frame is not None:
            self.judge.seen(frame)
        return frame

    def _next(self, deadline_ns: int) -> Frame | None:
        return self._queue.popleft() if self._queue else self._transport.receive(deadline_ns)

    def _loses(self, frame: Frame) -> bool:
        muted = frame.identifier == self.muted and frame.time_ns >= self._muted_from_ns
        return not frame.own and (muted or frame.time_ns < self._lost_until_ns)

    def send(self, frame: Frame) -> None:
        """Judge a command and put it on the bus."""
        self.judge.sent(frame, self._clock.now_ns())
        if chance(self._draw, self._percent) and chance(self._draw, 10):
            if chance(self._draw, 50):
                self.judge.lost()
                raise TransmitQueueFullError("no room")
            self.broken = True
            raise BusError("the cable is gone")
        self._transport.send(frame)

    def _spoiled(self, frame: Frame | None) -> Frame | None:
        draw, how = self._draw, self._draw.randint(0, 8)
        if how == 0 and chance(draw, 5):
            self.broken = True
            raise BusError("the cable is gone")
        if how == 1:
            self._lost_until_ns = self._clock.now_ns() + draw.choice([1, 3, 6, 25]) * MS
        elif how == 2 and chance(draw, 30):  # this computer stands still
            self.spend(draw.choice([MS, 3 * MS, 12 * MS]))
        elif how == 3:
            self.spend(FRAME_NS)
            self.forged = True
            if frame is not None:
                self._queue.appendleft(frame)
            return anything(draw, self._clock.now_ns())
        elif frame is not None and not frame.own:
            return self._changed(frame, how)
        return frame

    def _changed(self, frame: Frame, how: int) -> Frame | None:
        draw = self._draw
        if how == 4:
            return None  # lost, and the deadline comes earlier than it should
        if how == 5:
            self._queue.appendleft(frame)
        elif how == 6:
            self._queue.insert(draw.randint(0, len(self._queue)), frame)
            return None
        elif how == 7:
            self.forged = True
            return damaged(draw, frame)
        elif how == 8 and chance(draw, 20):
            self.forged = True
            return frame._replace(
                time_ns=frame.time_ns + draw.choice([-1, 1]) * draw.choice([MS, 5 * MS, 3600_000 * MS])
            )
        return frame


class Judge:
    """What the bus has seen of the loop, and what it had told the loop before."""

    def __init__(self) -> None:
        self._model = ReceptionModel(BENCH)
        self._pairs = self.stops = self.enabled = 0
        self._counter = 14
        self._last: tuple[int, float] | None = None

    def seen(self, frame: Frame) -> None:
        """A frame that the loop has been given."""
        self._pairs += self._model.take(frame) is not None

    def sent(self, frame: Frame, now_ns: int) -> None:
        """A command that has left the guard."""
        values = read(frame)
        demand(values is not None and frame.identifier == COMMAND, "not a command:", frame)
        assert values is not None
        self._counter = (self._counter + 1) % 15
        demand(values["Counter"] == self._counter, "counter", values, "expected", self._counter)
        if not values["Enable"]:
            self.stops += 1
            demand(values["Current"] == 0.0 and self.stops <= 3, "not a stop frame:", values, self.stops)
            return
        self.enabled += 1
        current, answers, pair = values["Current"], int(values["Answers"]), self._model.last
        demand(self.stops == 0, "enabled after a stop frame:", values)
        demand(self._pairs > 10, "enabled before the node had shown itself:", values, self._pairs)
        demand(abs(current) <= 6.0, "beyond 6 A:", values)
        demand(pair is not None and pair.counter == answers, "answers no pair:", values, pair)
        demand(self._model.permitted(now_ns), "no fresh valid frames:", values, self._model, now_ns)
        follows = self._last is not None and answers == (self._last[0] + 1) % 15
        before = self._last[1] if follows and self._last is not None else 0.0
        demand(abs(current - before) <= SLEW + 1e-9, "slew", values, "after", before)
        self._last = answers, current

    def lost(self) -> None:
        """The command that was judged last did not get onto the bus."""
        if self._last is not None:
            self._last = self._last[0], 0.0


class Actor:
    """A policy that may be broken in every way; what it wants is drawn."""

    def __init__(self, draw: Random, bus: HostileBus) -> None:
        self._draw, self._bus = draw, bus
        self._constant = draw.choice([6.0, -6.0, 0.0, None])
        self._slow, self._broken = draw.choice([0, 0, 2]), chance(draw, 10)

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """A current, or what is none."""
        if chance(self._draw, self._slow):  # it thinks for longer than it may
            self._bus.spend(self._draw.choice([MS // 2, MS, 3 * MS, 12 * MS]))
        if self._broken and chance(self._draw, 2):
            if chance(self._draw, 50):
                raise PolicyError("out of memory")
            return self._draw.choice([math.nan, math.inf, -math.inf, 1e30, 6.1])
        return self._draw.randint(-30_000, 30_000) * 2e-4 if self._constant is None else self._constant


def run(draw: Random) -> Played:
    """One run."""
    transport, clock = open_sim(f"seed={draw.randint(0, 10**6)}", BENCH)
    bus = HostileBus(draw, transport, clock)
    homing, steps = chance(draw, 20), draw.choice([20, 60, 150])
    if bus.muted is not None:
        homing, steps = False, 450  # long enough to miss it
    if homing:
        transport.node.angle = draw.randint(-3, 80)
    journal = Journal()
    stop = chance(draw, 5)
    driven: Any = {"send": bus.send, "receive": bus.receive, "now_ns": clock.now_ns, "push": journal.push}
    asked: Any = {"stop_requested": lambda: stop and chance(draw, 1), "homing": homing}
    loop = make_loop(BENCH, Actor(draw, bus), steps, layout=LAYOUT, **driven, **asked)
    judge_end(loop.run(), bus, loop.core.guard)
    return Played(bus.receives, bus.judge.enabled + bus.judge.stops)


def judge_end(outcome: Outcome, bus: HostileBus, guard: Guard) -> None:
    """A run ends for a reason that it can name, with stop frames if anything could have left before."""
    internal = outcome.fault is Fault.INTERNAL and not outcome.detail.startswith(PolicyError.__name__)
    demand(not internal, outcome.detail)
    demand(guard.rejected == 0 and outcome.fault is not Fault.GUARD_REJECTED, "refused:", outcome.detail)
    judge = bus.judge
    demand(judge.enabled == 0 or judge.stops > 0 or bus.broken, "no stop frame:", outcome)
    demand(outcome.end is not None or judge.enabled + judge.stops == 0, "sent before it was armed:", outcome)
    node = bus.node
    inside = node.angle_range[0] >= -10.0 and node.angle_range[1] <= 100.0 and node.top_speed <= 500.0
    demand(inside or bus.forged, "limits passed:", node.angle_range, node.top_speed)
