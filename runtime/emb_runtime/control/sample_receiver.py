"""The loop's ear: takes frames off the bus, gives the newest sample, and watches what it hears.

Reads the clock once for each sample and once for each wait in vain; where that is a system call, it is a good part of
a cycle.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from emb_runtime.can.messages import Layout
from emb_runtime.can.receiver import Reception
from emb_runtime.config.bench import Bench
from emb_runtime.control.result import RunCounters
from emb_runtime.errors import BusError
from emb_runtime.records import Frame, NodeState, SensorSample
from emb_runtime.safety.heartbeat import Pulse
from emb_runtime.safety.run_state import Journal, StateMachine
from emb_runtime.safety.state_machine import Event, Fault, StopError, may_enable
from emb_runtime.system.clock import Clock

DRAIN_FRAMES = 64
"""Most frames looked at, after a pair, for a newer one: a babbling node must not hold the loop."""


class Listener:
    """Hears the bus for one run.

    Args:
        layout: the bus layout.
        bench: what is plausible, and how long to wait.
        receive: gives the next frame, or None at a deadline (monotonic [ns]).
        clock: the time that those deadlines are on.
        journal: gets every frame.
        course: where the run stands; told of pairs and of time that passes without.
        pulse: to the watchdog process.
        tally: counts into it.
        stop_requested: whether the operator wants an end.
        overtaken: told of a sample that a newer one has overtaken, and of the periods missed before it.
    """

    def __init__(
        self,
        layout: Layout,
        bench: Bench,
        receive: Callable[[int], Frame | None],
        clock: Clock,
        journal: Journal,
        course: StateMachine,
        pulse: Pulse,
        counters: RunCounters,
        stop_requested: Callable[[], bool],
        overtaken: Callable[[SensorSample, int], None],
    ) -> None:
        self._command_id = layout.command.identifier
        self._receive = receive
        self._clock = clock
        self._journal = journal
        self._course = course
        self._pulse = pulse
        self._tally = counters
        self._stop_requested = stop_requested
        self._overtaken = overtaken
        self._period_ns = bench.timing.sample_time_ns
        self._stop_missed = bench.watch.stop_missed
        self.reception = Reception(layout, bench, self._on_rejected)
        self.last: SensorSample | None = None
        """The newest valid sample."""
        self.wake_ns = 0
        """When the loop had it in hand, monotonic [ns]."""
        self.missed = 0
        """Periods without a valid pair just before it."""
        self.sent_counter: int | None = None
        """Counter of the command that answered it; None if none did yet."""
        self.unobeyed = 0
        """Periods in a row in which the node obeyed no command."""

    def check_requests(self) -> None:
        """Ask everybody who may end the run.

        Raises:
            StopError: somebody does.
        """
        # The watchdog first: its stop frames come from another socket and look like a stranger's commands.
        if self._pulse.tripped:
            raise StopError(Fault.WATCHDOG_TRIPPED)
        if self._stop_requested():
            raise StopError(Fault.INTERRUPTED)
        if self.reception.foreign_command:
            raise StopError(Fault.FOREIGN_COMMAND, f"identifier {self._command_id:#05x}")
        if self.reception.too_many_rejected:
            raise StopError(Fault.FRAMES_REJECTED, f"{self.reception.rejected} so far")

    def overhear(self, frames: Iterable[Frame]) -> None:
        """Take frames that came before.

        Raises:
            BusError: they say that the bus is lost.
        """
        for frame in frames:
            self._take(frame)

    def hear(self, deadline_ns: int) -> SensorSample | None:
        """Take one frame; a sample if it completes one.

        Raises:
            BusError: the bus is lost.
        """
        frame = self._receive(deadline_ns)
        return None if frame is None else self._take(frame)

    def next_sample(self) -> SensorSample:
        """The newest valid pair; periods without one are counted.

        Raises:
            StopError: they are too many, or somebody ends the run.
            BusError: the bus is lost.
        """
        last = self.last
        deadline_ns = (last.receive_time_ns if last else self._clock.now_ns()) + self._period_ns * 3 // 2
        while True:
            self.check_requests()
            frame = self._receive(deadline_ns)
            if frame is None or frame.time_ns >= deadline_ns:
                self._wait_in_vain(deadline_ns)
                deadline_ns += self._period_ns
            if frame is not None and (sample := self._take(frame)) is not None:
                return self._newest(sample)

    def watch(self, deadline_ns: int, until_idle: bool = False) -> bool:
        """Log what comes until a deadline, or until the node has said idle and its status why it stopped.

        Gives whether it said idle.

        Raises:
            BusError: the bus is lost.
        """
        idle = False
        while not (until_idle and idle and self.reception.stop_reason is not None):
            frame = self._receive(deadline_ns)
            if frame is None:
                break
            sample = self._take(frame)
            idle = idle if sample is None else sample.node_state is NodeState.IDLE
            if frame.time_ns >= deadline_ns:
                break  # on a babbling bus there is always one more
        return idle

    def _wait_in_vain(self, deadline_ns: int) -> None:
        now_ns = self._clock.now_ns()
        self._pulse.beat(now_ns)
        if not self._pulse.watched(now_ns):
            raise StopError(Fault.WATCHDOG_LOST)
        # The deadline and not the clock: a computer that stood still has frames waiting, and they come first.
        self._course.handle_event(Event.TIME, deadline_ns)

    def _newest(self, sample: SensorSample) -> SensorSample:
        """Prefer what has come meanwhile: the node obeys an answer to its newest sample only."""
        self.wake_ns = self._clock.now_ns()
        self._pulse.beat(self.wake_ns)
        if not self._pulse.watched(self.wake_ns):
            raise StopError(Fault.WATCHDOG_LOST)
        if self.wake_ns - sample.receive_time_ns < self._period_ns // 2:
            return sample  # the next one is not due yet
        for _ in range(DRAIN_FRAMES):
            frame = self._receive(0)
            if frame is None:
                break
            missed = self.missed
            newer = self._take(frame)
            if newer is not None:
                self._overtaken(sample, missed)
                sample = newer
        return sample

    def _take(self, frame: Frame) -> SensorSample | None:
        self._journal.push_frame(frame)
        if frame.own:
            self._tally.confirmed += 1
            return None
        if frame.error:
            self._take_error(frame)
            return None
        dropped = self.reception.dropped
        sample = self.reception.take(frame)
        if self.reception.dropped > dropped:
            self._note(Fault.FRAMES_DROPPED, f"{self.reception.dropped} so far")
        if sample is None:
            return None
        before, self.last = self.last, sample
        self._course.handle_event(Event.PAIR, sample.receive_time_ns)
        if may_enable(self._course.state) and before is not None:
            self._follow(before, sample)
        return sample

    def _take_error(self, frame: Frame) -> None:
        self._tally.bus_errors += 1
        self.reception.take(frame)
        if self.reception.bus_errors.bus_off:
            raise BusError("the CAN controller reports bus-off: it has stopped taking part")
        if self._tally.bus_errors == 1:
            self._note(Fault.BUS_ERRORS, ", ".join(self.reception.bus_errors.counts))

    def _follow(self, before: SensorSample, sample: SensorSample) -> None:
        """Count what lies between two samples, and whether the node obeyed."""
        counters = self._tally
        counters.pairs += 1
        gap = round((sample.device_time_ns - before.device_time_ns) / self._period_ns)
        self.missed = max(0, gap - 1)
        counters.missed += self.missed
        counters.angle_min, counters.angle_max = (
            min(counters.angle_min, sample.angle),
            max(counters.angle_max, sample.angle),
        )
        counters.top_speed = max(counters.top_speed, abs(sample.velocity))
        # Across a gap the node does not tell: it names the command of the last period only.
        if self.sent_counter is not None and gap == 1:
            if sample.command_counter == self.sent_counter:
                self.unobeyed = 0
            else:
                counters.not_obeyed += 1
                self.unobeyed += 1
        self.sent_counter = None

    def _on_rejected(self, _frame: Frame, why: str) -> None:
        self._journal.push_event(self._clock.now_ns(), "FRAME_REJECTED", why)

    def _note(self, fault: Fault, detail: str) -> None:
        self._course.note(fault, detail, self._clock.now_ns())
