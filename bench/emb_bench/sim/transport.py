"""``--iface sim``: the node in lock-step with simulated time. Deterministic, faster than real time, no CAN needed.

Time moves only while the runtime waits for a frame, so that whatever it computes takes no time on this bus.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Protocol

from emb_bench.sim.node import BrakeNode
from emb_bench.sim.plant_spec import NOISES, gaussian_noise, parse_assignments, true_parameters, with_sensors
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import Bench
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import UsageError
from emb_runtime.records import Frame
from emb_runtime.system.clock import SteppedClock

DEFAULT_SEED = 1
LONGEST_SEED = 18  # Digits of a seed


class Device(Protocol):
    """A simulated device: it takes frames, and sends some at the end of each period."""

    def receive(self, frame: Frame) -> None:
        """Take one frame from the bus."""
        ...

    def tick(self, skipped: int = 0) -> list[Frame]:
        """Let one period pass; gives the frames that it sends at its end."""
        ...


class LockstepBus:
    """A bus with one simulated device on it and nothing else.

    Args:
        device: the device.
        clock: the simulated clock; this transport alone moves it.
        period_ns: the device's sampling period [ns].
        truth: the brake's true parameters, the plant's name and the seed, for the log.
    """

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
        """Nothing is held."""


class SimTransport(LockstepBus):
    """A bus with the simulated node on it and nothing else.

    Args:
        node: the node.
        clock: this and what follows as for :class:`LockstepBus`.
        period_ns: the node's sampling period [ns].
        truth: the brake's true parameters, the plant's name and the seed, for the log.
    """

    def __init__(self, node: BrakeNode, clock: SteppedClock, period_ns: int, truth: Mapping[str, float | str]) -> None:
        super().__init__(node, clock, period_ns, truth)
        self.node = node


def open_sim(options: str, bench: Bench) -> tuple[SimTransport, SteppedClock]:
    """Open the simulated bus.

    Args:
        options: ``plant=exact,seed=3,f_v=3e-5``: which of the bench's plants, a seed for the sensors' noise, and true
            parameters; ``exact``, 1 and nominal where none is given. ``charge=1``: the node sends the integral of its
            current along. ``angle_noise`` [rad] and ``velocity_noise`` [rad/s] are standard deviations of sensors that
            are not as the bench file says.
        bench: knows the plants.

    Raises:
        UsageError: an option is unknown or has no sensible value.
        BenchFileError: the bench has no such plant.
    """
    assignments = parse_assignments(options, "sim: ")
    seed_text = assignments.pop("seed", str(DEFAULT_SEED))
    if not seed_text.isdecimal() or len(seed_text) > LONGEST_SEED:
        raise UsageError(f"sim: seed: expected a whole number from 0 of up to {LONGEST_SEED} digits, got '{seed_text}'")
    plant = bench.plant(assignments.pop("plant", DEFAULT_PLANT))
    charge = assignments.pop("charge", "0")
    if charge not in ("0", "1"):
        raise UsageError(f"sim: charge: expected 0 or 1, got '{charge}'")
    sensors = with_sensors(bench, assignments, "sim: ")
    theta = true_parameters(bench, assignments, ("plant", "seed", "charge", *NOISES), "sim: ")
    noise = gaussian_noise(sensors, int(seed_text), plant.instruments.clock_jitter)
    node = BrakeNode(bench, load_layout(), theta, noise, plant, charge=charge == "1")
    # Monotonic time starts where the computer's stands, so that a log has the date of its run.
    now_ns = time.monotonic_ns()
    clock = SteppedClock(now_ns, time.time_ns() - now_ns)
    truth = {**theta._asdict(), "seed": int(seed_text), "plant": plant.name}
    return SimTransport(node, clock, bench.timing.sample_time_ns, truth), clock
