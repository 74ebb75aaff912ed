"""The guard: the one place that can reach the bus, independent of all that computes a command.

It decodes the bytes of a frame by the table of signals, not by the generated code that encoded it, and rejects or
passes: it changes nothing. A rejection is an error in the program and ends the run. A frame that passes is a command of
the right identifier and length, with a valid CRC and the next counter, whose enable bit and current agree, within the
current limit and the slew, permitted by the run's state, computed from a sample no older than two periods, and not
faster than the bench's rate. The guard also compares the current that the drive reports with the commands that passed,
and device time with this computer's. After the watchdog process has tripped nothing passes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, cast

from emb_runtime.can.e2e import COUNTER_MODULUS, next_counter
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import CEILING_CURRENT, Bench
from emb_runtime.errors import BusError, FrameError, SafetyStopError
from emb_runtime.records import CurrentCommand, Frame, RunState, SensorSample
from emb_runtime.safety.device_clock import DeviceClock
from emb_runtime.safety.drive_monitor import DriveCheck
from emb_runtime.safety.heartbeat import Heartbeat, Unwatched
from emb_runtime.safety.state_machine import Fault, StopError, may_enable, may_send

RATE_WINDOW_PERIODS: Final = 20
RATE_SURPLUS: Final = 1.2  # as opendbc: 20 % above nominal
OLDEST_SAMPLE_PERIODS: Final = 2


class GuardRejectedError(SafetyStopError):
    """A command that the guard rejected."""


class Guard:
    """Passes commands that satisfy its contract to the bus, and counts.

    Args:
        layout: the bus layout, whose command message it decodes.
        bench: for the limits and the sample time.
        send: puts a frame on the bus; the only reference to it.
        pulse: to the watchdog process.
        limit: a current narrower than the bench's, where the operator gave one [A].
    """

    def __init__(
        self,
        layout: Layout,
        bench: Bench,
        send: Callable[[Frame], None],
        pulse: Heartbeat | None = None,
        limit: float = CEILING_CURRENT,
    ) -> None:
        self._message = layout.command
        self._limit = layout.current_within(min(bench.limits.current, CEILING_CURRENT, limit))
        self._period_ns = bench.timing.sample_time_ns
        # The bus carries multiples of the signal's step: the largest change may be rounded beyond the slew by half
        # of it. One step is granted, so that floating point does not matter.
        self._slew = bench.guard.slew * bench.timing.sample_time + layout.command.signal("Current").factor
        self._send = send
        self._pulse = pulse or Unwatched()
        self._drive = DriveCheck(bench.guard.current_error, bench.limits.current)
        self._device_clock = DeviceClock(self._period_ns)
        self._last: CurrentCommand | None = None
        self._allowed: Frame | None = None  # that one's frame, until it is sent
        self._sample_ns = 0  # that it was computed from
        self._most = math.ceil(RATE_WINDOW_PERIODS * RATE_SURPLUS)
        self._times: list[int] = []  # of the last commands, as many at most
        self.passed = 0
        self.rejected = 0

    @property
    def next_counter(self) -> int:
        """The alive counter that the next command must have: a refused one has used up none."""
        return 0 if self._last is None else next_counter(self._last.counter)

    def too_fast(self, now_ns: int) -> bool:
        """Returns True if one more command now, monotonic [ns], would be more than the bench's rate allows."""
        return len(self._times) == self._most and now_ns - self._times[0] < RATE_WINDOW_PERIODS * self._period_ns

    def check(self, frame: Frame, state: RunState, sample_time_ns: int, now_ns: int) -> CurrentCommand:
        """Check a command frame, which :meth:`send` may then put on the bus; gives the command in it.

        Args:
            frame: the frame.
            state: the state of the run.
            sample_time_ns: arrival of the sample that an enabled command was computed from, monotonic [ns].
            now_ns: now, monotonic [ns].

        Raises:
            GuardRejectedError: the frame is not in the guard's contract.
        """
        self._allowed = None
        try:
            command = self._checked(frame, state, sample_time_ns, now_ns)
        except GuardRejectedError:
            self.rejected += 1
            raise
        # Counted before it leaves: if the bus fails, the node may have seen this counter value all the same.
        self._last, self._sample_ns = command, sample_time_ns
        self._drive.sent(command.counter, command.current)
        if len(self._times) == self._most:
            del self._times[0]
        self._times.append(now_ns)
        self._pulse.publish(command.counter, command.answers)
        self._allowed = frame  # last: a check that fails on its way allows nothing
        return command

    def send(self, frame: Frame) -> None:
        """Put the frame that was checked last on the bus, once.

        Raises:
            GuardRejectedError: it is another one, or was sent before; nothing was sent.
            BusError: the bus did not take it.
        """
        allowed, self._allowed = self._allowed, None
        if allowed is not frame:
            self.rejected += 1
            raise _rejected("it is not the one that was checked last")
        # Last check. A frame sent after a trip answers an old sample (the watchdog waits for periods), so that the node
        # does not obey it.
        if self._pulse.tripped:
            raise StopError(Fault.WATCHDOG_TRIPPED)
        try:
            self._send(frame)
        except BusError:
            # The node brakes: the next one begins at zero.
            self._last = cast("CurrentCommand", self._last)._replace(current=0.0)
            raise
        self.passed += 1

    def check_drive(self, sample: SensorSample) -> None:
        """Compare the reported current with the commands that passed; raises StopError if it does not follow them."""
        if problem := self._drive.current_problem(sample.command_counter, sample.applied_current):
            raise StopError(Fault.CURRENT_MISMATCH, problem)

    def learn_time(self, sample: SensorSample, *, first: bool) -> bool:
        """Add a sample before arming to the reference of the two clocks; with ``first`` begin a new reference.

        Returns False if it does not continue the reference; it then begins a new one.
        """
        if first:
            self._device_clock.restart()
        return self._device_clock.learn(sample.device_time_ns, sample.receive_time_ns)

    def check_time(self, sample: SensorSample, seen_ns: int) -> None:
        """Compare a sample's device time with this computer's monotonic time at which it was read [ns].

        Raises:
            StopError: the node's clock is wrong; from then on no enabled command passes.
        """
        if problem := self._device_clock.time_problem(sample.device_time_ns, sample.receive_time_ns, seen_ns):
            raise StopError(Fault.DEVICE_TIME, problem)

    def _checked(self, frame: Frame, state: RunState, sample_time_ns: int, now_ns: int) -> CurrentCommand:
        if not may_send(state):
            raise _rejected(f"nothing may leave in state {state.name}")
        try:
            values = self._message.decode(frame)
        except FrameError as err:
            raise _rejected(str(err)) from err
        counter, answers, current = int(values["Counter"]), int(values["Answers"]), float(values["Current"])
        command = CurrentCommand(counter, answers, current, values["Enable"] != 0)
        if self._last is not None and command.counter != self.next_counter:
            raise _rejected(f"counter {command.counter} does not follow {self._last.counter}")
        if not math.isfinite(command.current) or abs(command.current) > self._limit:
            raise _rejected(f"{command.current:g} A is beyond {self._limit:g} A")
        if command.enable:
            self._check_enabled(command, state, sample_time_ns, now_ns)
        elif command.current != 0.0:
            raise _rejected(f"disabled, but with {command.current:g} A")
        return command

    def _check_enabled(self, command: CurrentCommand, state: RunState, sample_time_ns: int, now_ns: int) -> None:
        if not may_enable(state):
            raise _rejected(f"enabled in state {state.name}")
        if self._device_clock.problem:
            raise _rejected(f"the device time of what it answers is wrong: {self._device_clock.problem}")
        # A stop frame is never too fast.
        if self.too_fast(now_ns):
            raise _rejected(f"more than {self._most} commands in {RATE_WINDOW_PERIODS} periods")
        # Another transport's clock may put the stamp just ahead of now.
        if not -self._period_ns <= now_ns - sample_time_ns <= OLDEST_SAMPLE_PERIODS * self._period_ns:
            raise _rejected(f"computed from a sample {(now_ns - sample_time_ns) / 1e6:.3f} ms old")
        # Counters repeat after 15 periods: without its time an older sample looks like the one before.
        recent = sample_time_ns - self._sample_ns < COUNTER_MODULUS // 2 * self._period_ns
        change = command.current - slew_reference(self._last if recent else None, command.answers)
        if abs(change) > self._slew:
            raise _rejected(f"a change by {change:.4g} A in one period is beyond {self._slew:.4g} A")


def slew_reference(last: CurrentCommand | None, answers: int) -> float:
    """Slew reference [A]: the command for the previous sample, else 0 A, as the node braked."""
    return last.current if last is not None and answers == next_counter(last.answers) else 0.0


def _rejected(reason: str) -> GuardRejectedError:
    return GuardRejectedError(f"the guard refused a command: {reason}")
