"""``--iface sim``: the node in lock-step with simulated time. Deterministic, faster than real time, no CAN needed.

Time advances only while the runtime waits for a frame: its computations take no time on this bus.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Protocol

from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import BrakeToSimulate, read_brake
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import Bench
from emb_runtime.records import Frame


class SteppedClock:
    """Simulated time: stands still until it is set."""

    def __init__(self, start_ns: int = 0, wall_offset_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._wall_offset_ns = wall_offset_ns

    def now_ns(self) -> int:
        """Simulated time [ns]."""
        return self._now_ns

    def wall_offset_ns(self) -> int:
        """Offset from simulated to Unix time [ns]."""
        return self._wall_offset_ns

    def sleep_until(self, time_ns: int) -> int:
        """Move time on to a later one [ns]; gives the time that it is then."""
        self.advance_to(max(time_ns, self._now_ns))
        return self._now_ns

    def advance_to(self, time_ns: int) -> None:
        """Move time on, never back."""
        if time_ns < self._now_ns:
            raise ValueError(f"time cannot go back: it is {self._now_ns} ns, got {time_ns} ns")
        self._now_ns = time_ns


class Device(Protocol):
    """A simulated device: it takes frames, and sends some at the end of each period."""

    def receive(self, frame: Frame) -> None:
        """Take one frame from the bus."""

    def tick(self, skipped: int = 0) -> list[Frame]:
        """Let one period pass, and as many more as were skipped; gives the frames that it sends at their end."""


class LockstepBus:
    """A bus with one simulated device on it and nothing else; it alone moves the clock. ``truth`` is for the log."""

    name = "sim"
    obtained: Mapping[str, str] = {}

    def __init__(self, device: Device, clock: SteppedClock, period_ns: int, truth: Mapping[str, float | str]) -> None:
        self._device = device
        self.truth = truth
        self._clock = clock
        self._period_ns = period_ns
        self._next_tick_ns = clock.now_ns() + period_ns
        self._queue: deque[Frame] = deque()

    def send(self, frame: Frame) -> None:
        """Put a frame on the bus: the node has it at once, and the sender its echo."""
        sent = frame._replace(time_ns=self._clock.now_ns())
        self._device.receive(sent)
        self._queue.append(sent._replace(own=True))

    def receive(self, deadline_ns: int) -> Frame | None:
        """The next frame, or None when none comes until the deadline (simulated time [ns])."""
        while not self._queue:
            if self._next_tick_ns > deadline_ns:
                self._clock.advance_to(max(deadline_ns, self._clock.now_ns()))
                return None
            self._clock.advance_to(self._next_tick_ns)
            now_ns = self._clock.now_ns()
            self._queue.extend(frame._replace(time_ns=now_ns) for frame in self._device.tick())
            self._next_tick_ns += self._period_ns
        return self._queue.popleft()

    def close(self) -> None:
        """There is nothing to release."""


class SimTransport(LockstepBus):
    """A bus with the simulated node on it and nothing else."""

    def __init__(self, node: BrakeNode, clock: SteppedClock, period_ns: int, truth: Mapping[str, float | str]) -> None:
        super().__init__(node, clock, period_ns, truth)
        self.node = node


def open_sim(options: str, bench: Bench) -> tuple[SimTransport, SteppedClock]:
    """Open the simulated bus with the options of :func:`~emb_bench.sim.simulated_brake.read_brake`."""
    return open_brake(read_brake(options, bench, "sim: "), bench)


def open_brake(brake: BrakeToSimulate, bench: Bench) -> tuple[SimTransport, SteppedClock]:
    """Open a bus with a simulated brake on it."""
    node = BrakeNode(
        bench, load_layout(), brake.theta, brake.noise, brake.plant, charge=brake.charge, conditions=brake.conditions
    )
    # Monotonic time starts where the computer's stands, so that a log has the date of its run.
    now_ns = time.monotonic_ns()
    clock = SteppedClock(now_ns, time.time_ns() - now_ns)
    return SimTransport(node, clock, bench.timing.sample_time_ns, brake.truth), clock
