"""Where a run stands, kept: every event goes through the state machine and into the journal here."""

from __future__ import annotations

from typing import Protocol

from emb_runtime.log.ring_buffer import Level
from emb_runtime.records import CycleRecord, Frame, RunState
from emb_runtime.safety.state_machine import FAULTS, Event, Fault, Run, StopError, Timeouts, missed, step


class Journal(Protocol):
    """Where the loop writes; never waits."""

    def push_frame(self, frame: Frame) -> None:
        """A frame that was on the bus."""

    def push_cycle(self, record: CycleRecord) -> None:
        """One control cycle."""

    def push_estimate(self, time_ns: int, step: int, estimate: tuple[float, ...]) -> None:
        """What the actor estimates at a sample: values, then standard deviations."""

    def push_event(self, time_ns: int, code: str, text: str) -> None:
        """Something that the safety chain did."""

    def push_log(self, time_ns: int, level: Level, text: str) -> None:
        """A line for a person."""


class StateMachine:
    """The run so far.

    Args:
        times: what the machine counts in.
        journal: told of every change and every fault.
    """

    def __init__(self, times: Timeouts, journal: Journal) -> None:
        self._times = times
        self._journal = journal
        self.run = Run()

    @property
    def state(self) -> RunState:
        """Where the run stands."""
        return self.run.state

    def handle_event(self, event: Event, now_ns: int) -> None:
        """Take an event.

        Raises:
            StopError: by this the run has failed; who catches it says so with :meth:`fail`.
        """
        before, after = self.run, step(self._times, self.run, event, now_ns)
        if after.fault is not None and before.fault is None:
            raise StopError(after.fault, self._why(before, now_ns))
        if after.late and not before.late:
            self.note(Fault.SENSOR_LATE, f"{missed(self._times, before, now_ns)} so far", now_ns)
        self.run = after
        if after.state is not before.state:
            self._journal.push_event(now_ns, after.state.name, f"after {event.name}")

    def fail(self, fault: Fault, detail: str, now_ns: int) -> None:
        """Take a fault that latches."""
        self.note(fault, detail, now_ns)
        before, self.run = self.run, step(self._times, self.run, fault, now_ns)
        if self.run.state is not before.state:
            self._journal.push_event(now_ns, self.run.state.name, f"after {fault.name}")

    def note(self, fault: Fault, detail: str, now_ns: int) -> None:
        """Write down a fault; a soft one changes nothing else."""
        cause = FAULTS[fault].cause
        self._journal.push_event(now_ns, fault.name, f"{cause}: {detail}" if detail else cause)

    def _why(self, run: Run, now_ns: int) -> str:
        if run.state is RunState.SILENT:
            return f"within {self._times.start_ns * 1e-9:g} s"
        return f"{missed(self._times, run, now_ns)} periods without a valid pair"
