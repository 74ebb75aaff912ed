"""The guard: the one place that can reach the bus, independent of all that computes a command.

It takes a frame as bytes, decodes it by itself, and rejects: it never mends. A rejection is an error in the program
and ends the run. What may pass is a command frame of the right identifier and length, with a valid CRC and the next
counter, whose enable bit and current agree, within the current limit, permitted by the run's state, computed from a
sample no older than two periods, and not faster than the bench's rate.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

from emb_runtime.bench import CEILING_CURRENT, Bench
from emb_runtime.e2e import next_counter
from emb_runtime.errors import FrameError, SafetyStopError
from emb_runtime.frames import Layout
from emb_runtime.records import CurrentCommand, Frame, RunState
from emb_runtime.states import may_enable, may_send

RATE_WINDOW_PERIODS = 20
RATE_SURPLUS = 1.2  # as opendbc: 20 % above nominal
OLDEST_SAMPLE_PERIODS = 2


class GuardRejectedError(SafetyStopError):
    """A command that the guard did not let out."""


class Guard:
    """Lets commands out that satisfy its contract, and counts.

    Args:
        layout: the bus layout, to decode with.
        bench: for the current limit and the sample time.
        send: puts a frame on the bus; nobody else holds it.
    """

    def __init__(self, layout: Layout, bench: Bench, send: Callable[[Frame], None]) -> None:
        self._layout = layout
        self._limit = min(bench.limits.current, CEILING_CURRENT)
        self._period_ns = bench.timing.sample_time_ns
        self._send = send
        self._last_counter: int | None = None
        self._times: deque[int] = deque(maxlen=math.ceil(RATE_WINDOW_PERIODS * RATE_SURPLUS))
        self.passed = 0
        self.rejected = 0

    @property
    def next_counter(self) -> int:
        """The alive counter that the next command must have: a refused one has not spent its own."""
        return 0 if self._last_counter is None else next_counter(self._last_counter)

    def send(self, frame: Frame, state: RunState, sample_time_ns: int, now_ns: int) -> None:
        """Check a command frame and put it on the bus.

        Args:
            frame: the frame.
            state: the state of the run.
            sample_time_ns: arrival of the sample that an enabled command was computed from, monotonic [ns].
            now_ns: now, monotonic [ns].

        Raises:
            GuardRejectedError: the frame is not in the guard's contract; nothing was sent.
            BusError: the bus did not take it.
        """
        try:
            command = self._checked(frame, state, sample_time_ns, now_ns)
        except GuardRejectedError:
            self.rejected += 1
            raise
        # Counted before it leaves: if the bus fails, the node may have seen this counter value all the same.
        self._last_counter = command.counter
        self._times.append(now_ns)
        self._send(frame)
        self.passed += 1

    def _checked(self, frame: Frame, state: RunState, sample_time_ns: int, now_ns: int) -> CurrentCommand:
        if not may_send(state):
            raise _rejected(f"nothing may leave in state {state.name}")
        if frame.extended or frame.remote or frame.error or frame.identifier != self._layout.command.identifier:
            raise _rejected(f"not the command message: identifier {frame.identifier:#x}")
        try:
            command = self._layout.decode_command(frame)
        except FrameError as err:
            raise _rejected(str(err)) from err
        if self._last_counter is not None and command.counter != self.next_counter:
            raise _rejected(f"counter {command.counter} does not follow {self._last_counter}")
        if not math.isfinite(command.current) or abs(command.current) > self._limit:
            raise _rejected(f"{command.current:g} A is beyond {self._limit:g} A")
        if command.enable:
            self._check_enabled(state, sample_time_ns, now_ns)
        elif command.current != 0.0:
            raise _rejected(f"disabled, but with {command.current:g} A")
        return command

    def _check_enabled(self, state: RunState, sample_time_ns: int, now_ns: int) -> None:
        if not may_enable(state):
            raise _rejected(f"enabled in state {state.name}")
        # A stop frame is never too fast.
        if len(self._times) == self._times.maxlen and now_ns - self._times[0] < RATE_WINDOW_PERIODS * self._period_ns:
            raise _rejected(f"more than {self._times.maxlen} commands in {RATE_WINDOW_PERIODS} periods")
        # The stamp is the wall clock's, translated: a small step of that clock may put it just ahead of now.
        if not -self._period_ns <= now_ns - sample_time_ns <= OLDEST_SAMPLE_PERIODS * self._period_ns:
            raise _rejected(f"computed from a sample {(now_ns - sample_time_ns) / 1e6:.3f} ms old")


def _rejected(reason: str) -> GuardRejectedError:
    return GuardRejectedError(f"the guard refused a command: {reason}")
