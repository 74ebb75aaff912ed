"""No step and no rate of the wall clock changes how a run ends: the socket class on a kernel in simulated time."""

from __future__ import annotations

import socket
import struct
from collections import deque
from typing import Any, NamedTuple, cast

import pytest

from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import read_brake
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import SocketCan
from emb_runtime.config.bench import Bench
from emb_runtime.records import Frame
from tests.conftest import FunctionActor, Journal, make_loop

PERIOD_NS = 1_000_000
BOOT_NS, UNIX_NS = 10**12, 17 * 10**17
STEPS = 20  # of a run

HOUR_NS = 3_600_000_000_000
DENSE = [round((1.0 + 0.05 * i) * 1e6) for i in range(23)]  # 1 to 2.1 ms
SWEEP = [*DENSE, 1_000, 15_000, 60_000, 300_000, 700_000, 3_000_000, 20_000_000, 10**9, HOUR_NS]
SWEEP_NS = [sign * step for step in SWEEP for sign in (1, -1)]
"""Steps of the wall clock [ns]."""

ANGLE_NS, VELOCITY_NS, STATUS_NS = 5_000, 130_000, 260_000  # arrival after the node's tick
MOMENTS_NS = (-5, 2_000, 5_400, 60_000, 130_300, 160_000, 400_000, 990_000)
"""Step after the node's tick: in silence, at a frame, while one is read, between angle and velocity [ns]."""
TICKS = {"before the first frame": 0, "before arming": 9, "in the run": 21, "in the stop": 14 + STEPS}


class Step(NamedTuple):
    """At a monotonic time the wall clock goes on by so much more [ns]."""

    at_ns: int
    by_ns: int


class Kernel:
    """Socket, both clocks and the bus with the node on it; each reading of a clock and each system call takes time."""

    def __init__(self, bench: Bench, steps: tuple[Step, ...], rate: float) -> None:
        brake = read_brake("", bench, "test: ")
        self.node = BrakeNode(bench, load_layout(), brake.theta, brake.noise, brake.plant)
        self.time_ns = BOOT_NS
        self._steps, self._rate = steps, rate
        self._tick_ns = BOOT_NS + PERIOD_NS
        self._arriving: deque[tuple[int, Frame]] = deque()
        self._stamped: deque[tuple[int, Frame]] = deque()

    def wall_at(self, time_ns: int) -> int:
        steps = sum(step.by_ns for step in self._steps if step.at_ns <= time_ns)
        return UNIX_NS + time_ns + steps + round(self._rate * (time_ns - BOOT_NS))

    def go_on(self, duration_ns: int) -> None:
        end_ns = self.time_ns + duration_ns
        while (arrival := min(self._tick_ns, self._arriving[0][0] if self._arriving else end_ns)) < end_ns:
            self.time_ns = arrival
            if self._arriving and self._arriving[0][0] == arrival:
                self._stamped.append((self.wall_at(arrival), self._arriving.popleft()[1]))
            else:
                delays = (ANGLE_NS, VELOCITY_NS, STATUS_NS)
                self._arriving.extend((arrival + d, f) for d, f in zip(delays, self.node.tick(), strict=False))
                self._tick_ns += PERIOD_NS
        self.time_ns = end_ns

    # The clock.

    def now_ns(self) -> int:
        self.go_on(100)
        return self.time_ns

    def wall_offset_ns(self) -> int:
        before_ns = self.now_ns()
        wall_ns = self.wall_at(self.time_ns)
        return wall_ns - (before_ns + self.now_ns()) // 2

    def sleep_until(self, time_ns: int) -> int:
        raise NotImplementedError

    # The socket.

    def recvmsg(self, *_: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, None]:
        self.go_on(1_000)
        if not self._stamped:
            raise BlockingIOError
        wall_ns, frame = self._stamped.popleft()
        stamp = struct.pack("@ll", *divmod(wall_ns, 10**9))
        data = struct.pack("=IB3x8s", frame.identifier, len(frame.data), frame.data)
        self.go_on(2_000)
        return data, [(socket.SOL_SOCKET, 35, stamp)], socket.MSG_CONFIRM * frame.own, None

    def send(self, data: bytes, _flags: int) -> None:
        identifier, length, payload = struct.unpack("=IB3x8s", data)
        frame = Frame(identifier, payload[:length])
        self.node.receive(frame)
        self._stamped.append((self.wall_at(self.time_ns), frame._replace(own=True)))

    def wait(self, _descriptor: int, timeout_s: float) -> bool:
        end_ns = self.time_ns + round(timeout_s * 1e9)
        while not self._stamped and self.time_ns < end_ns:
            next_ns = self._arriving[0][0] if self._arriving else self._tick_ns
            self.go_on(max(1, min(next_ns, end_ns) + 1 - self.time_ns))
        self.go_on(20_000)  # until this process runs again
        return bool(self._stamped)

    def getsockopt(self, *_: int) -> int:
        return 0

    def fileno(self) -> int:
        return 3

    def __getattr__(self, name: str) -> Any:
        assert name in ("setblocking", "setsockopt", "bind", "close")
        return lambda *_: None


def run(bench: Bench, *steps: Step, rate: float = 0.0) -> tuple[Any, ...]:
    """How a run ends, its periods without an answer, and what it wrote of faults."""
    kernel, journal = Kernel(bench, steps, rate), Journal()
    bus = SocketCan("vcan0", kernel, open_socket=lambda: cast(socket.socket, kernel), wait_readable=kernel.wait)
    driven: Any = {"send": bus.send, "receive": bus.receive, "now_ns": kernel.now_ns, "push": journal.push}
    outcome = make_loop(bench, FunctionActor(lambda *_: 3.0), STEPS, **driven).run()
    counters = outcome.counters
    return (outcome.fault, outcome.node_at_rest, outcome.node_stop_reason, outcome.home), counters.unanswered, journal


def at(tick: int, moment_ns: int) -> int:
    """Monotonic time after a tick of the node [ns]."""
    return BOOT_NS + (1 + tick) * PERIOD_NS + moment_ns


@pytest.mark.parametrize("half", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("when", TICKS)
def test_no_step_of_the_wall_clock_ends_a_run(bench: Bench, when: str, half: int) -> None:
    """By every other size of step, in both directions; by those between at night."""
    end, unanswered, _ = run(bench)
    assert (end[0], unanswered) == (None, 0)
    for number, step_ns in enumerate(sign * step for step in SWEEP[half::2] for sign in (1, -1)):
        for moment_ns in MOMENTS_NS[number // 2 % 3 :: 3]:
            stepped, lost, journal = run(bench, Step(at(TICKS[when], moment_ns), step_ns))
            row = f"{step_ns / 1e6} ms, {moment_ns / 1e6} ms after the tick: {journal.codes}"
            assert stepped == end, row
            assert lost <= 1, row  # the sample that waited while it stepped may look too old to be answered


@pytest.mark.parametrize("apart", [1, 2, 3, 7])
def test_no_steps_of_the_wall_clock_end_a_run(bench: Bench, apart: int) -> None:
    end, _, _ = run(bench)
    for step_ns in SWEEP_NS[::6]:
        for moment_ns in (2_000, 60_000, 160_000):
            for sign in (1, -1):
                steps = [Step(at(tick, moment_ns), step_ns * sign**tick) for tick in range(0, STEPS + 30, apart)]
                stepped, _, journal = run(bench, *steps)
                assert stepped == end, f"{step_ns / 1e6} ms: {journal.codes}"


@pytest.mark.parametrize("rate", [500e-6, -500e-6, 0.1, -0.1])
def test_no_rate_of_the_wall_clock_ends_a_run(bench: Bench, rate: float) -> None:
    assert run(bench, rate=rate)[:2] == run(bench)[:2]
