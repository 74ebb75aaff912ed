"""Logs of loops on a bus where everything takes time and goes wrong, written in the order in which the loop wrote."""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import gaussian_noise
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Bench
from emb_runtime.control.result import Outcome
from emb_runtime.errors import BusError
from emb_runtime.estimator.estimator import Estimator, estimated
from emb_runtime.log.recorder_process import LogWriter
from emb_runtime.log.ring_buffer import (
    Attachment,
    EventRecord,
    LogHeader,
    Record,
)
from emb_runtime.records import Frame
from tests.conftest import FunctionActor, Journal, make_loop

WALL = 1_700_000_000_000_000_000
US = 1_000
MS = 1_000_000


def write_trace(
    path: Path,
    records: list[Record],
    bench: Bench,
    layout: Layout,
    outcome: Outcome | None,
    *,
    steps: int,
    policy: bytes = b"",
    flush_every: int = 100_000,
    **identity: str,
) -> Path:
    """Write a log as the recorder would, with the trailer of emb-run."""
    begin_ns = next(record.time_ns for record in records if isinstance(record, EventRecord))
    files = [Attachment("bench.toml", "application/toml", bench.text.encode())]
    if policy:
        files.append(Attachment("policy.onnx", "application/octet-stream", policy))
    header = LogHeader(
        start_ns=begin_ns,
        wall_offset_ns=WALL,
        simulated=True,
        dbc=layout.text,
        messages=layout.all_messages,
        metadata={"emb.run": {"steps": str(steps), "purpose": "experiment", "limit": "6.0", **identity}},
        attachments=files,
        topics=["/estimate"] if estimated(bench) else [],
    )
    with path.open("wb") as file:
        writer = LogWriter(file, header)
        for n, record in enumerate(records):
            writer.write(record, WALL + begin_ns)
            if n % flush_every == flush_every - 1:
                writer.flush()
        if outcome is not None:
            trailer = {"exit_reason": outcome.fault.name if outcome.fault else "DONE", "detail": outcome.detail}
            writer.finish({**trailer, **{k: str(v) for k, v in asdict(outcome.counters).items()}})
        else:
            writer.finish({"exit_reason": "the runtime process died"})
    return path


@dataclass
class HostileBus:
    """A node on a bus, and a computer on which every reading of the clock finds it later; both may misbehave."""

    bench: Bench
    layout: Layout
    dice: random.Random
    slow: float = 0.0  # Chance that the computer stands still for some milliseconds while it decides
    lost: float = 0.0  # Chance that a frame does not come
    silent: float = 0.0  # Chance that a silence of some periods begins
    damaged: float = 0.0  # Chance that a frame comes with another byte
    refusing: float = 0.0  # Chance that the bus does not take a frame
    foreign: float = 0.0  # Chance that somebody else commands
    dying: float = 0.0  # Chance that the bus is lost while the loop waits
    backlog_ms: int = 0  # How long frames have piled up when the loop begins to listen
    reading_us: int = 30  # Longest time between two readings of the clock
    stop_after: int | None = None  # How many times the operator is asked before he wants an end
    now: int = 10**15
    _queue: deque[Frame] = field(default_factory=deque)
    _quiet_until: int = 0

    def __post_init__(self) -> None:
        seed = self.dice.randrange(1000)
        self.node = BrakeNode(self.bench, self.layout, self.bench.brake, gaussian_noise(self.bench.noise, seed))
        self._tick_at = self.now + MS
        self._asked = 0
        self._let_pass(self.backlog_ms * MS)

    def _let_pass(self, duration_ns: int) -> None:
        self.now += duration_ns
        while self._tick_at <= self.now:
            at = self._tick_at
            for frame in self.node.tick():
                at += self.dice.randrange(200 * US)
                self._arrive(frame._replace(time_ns=at))
            self._tick_at += MS

    def _arrive(self, frame: Frame) -> None:
        roll = self.dice.random
        if roll() < self.silent:
            self._quiet_until = frame.time_ns + self.dice.randrange(2, 30) * MS
        if roll() < self.lost or frame.time_ns < self._quiet_until:
            return
        if roll() < self.damaged:
            at = self.dice.randrange(len(frame.data))
            frame = frame._replace(data=frame.data[:at] + bytes([frame.data[at] ^ 4]) + frame.data[at + 1 :])
        self._queue.append(frame)
        if roll() < self.foreign:
            self._queue.append(Frame(self.layout.command.identifier, bytes(5), frame.time_ns))

    # What the loop is given.

    def now_ns(self) -> int:
        self._let_pass(self.dice.randrange(1, self.reading_us * US))
        return self.now

    def receive(self, deadline_ns: int) -> Frame | None:
        if deadline_ns and self.dice.random() < self.dying:
            raise BusError("vcan0: the interface is down")
        while True:
            self._let_pass(self.dice.randrange(1, 10 * US))
            if self._queue and self._queue[0].time_ns <= self.now:
                return self._queue.popleft()
            if self.now >= deadline_ns:
                return None
            following = self._queue[0].time_ns if self._queue else self._tick_at
            self._let_pass(max(0, min(following, deadline_ns) - self.now))

    def send(self, frame: Frame) -> None:
        self._let_pass(self.dice.randrange(1, 20 * US))
        if self.dice.random() < self.refusing:
            raise BusError("vcan0: transmit queue full")
        frame = frame._replace(time_ns=self.now)
        self.node.receive(frame)
        late = [waiting for waiting in self._queue if waiting.time_ns > self.now]
        soon = [waiting for waiting in self._queue if waiting.time_ns <= self.now]
        self._queue = deque([*soon, frame._replace(own=True), *late])

    def stop_requested(self) -> bool:
        self._asked += 1
        return self.stop_after is not None and self._asked > self.stop_after

    def think(self) -> None:
        """Called by the actor: deciding takes a while."""
        if self.dice.random() < self.slow:
            self._let_pass(self.dice.randrange(1, 5 * MS))


@dataclass(frozen=True)
class Driven:
    """A run on a hostile bus."""

    outcome: Outcome
    journal: Journal
    steps: int


class Thoughtful(FunctionActor):
    """An actor made of a function, that takes the bus's time."""

    def __init__(self, law: Callable[[float, float, float], float], think: Callable[[], None] = lambda: None) -> None:
        super().__init__(law)
        self._think = think

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        self._think()
        return super().act(angle, velocity, step, estimator)


def drive(bus: HostileBus, law: Callable[[float, float, float], float], steps: int) -> Driven:
    """Run the loop on a hostile bus."""
    journal = Journal()
    driven: Any = {"send": bus.send, "receive": bus.receive, "now_ns": bus.now_ns, "push": journal.push}
    loop = make_loop(bus.bench, Thoughtful(law, bus.think), steps, **driven, stop_requested=bus.stop_requested)
    return Driven(loop.run(), journal, steps)
