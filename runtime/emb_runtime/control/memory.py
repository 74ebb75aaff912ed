"""Memory of a run by sampling periods: newest sample, missed periods, sent commands, and the record of each cycle.

Missed periods are counted by device time, between two samples; until the next sample comes, by the deadlines that pass.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, LeakyCount, next_counter
from emb_runtime.config.bench import Bench
from emb_runtime.log.ring_buffer import EventRecord, Record
from emb_runtime.records import CurrentCommand, CycleRecord, Reason, RunState, SensorSample
from emb_runtime.safety.command_limits import Decision
from emb_runtime.safety.guard import OLDEST_SAMPLE_PERIODS
from emb_runtime.safety.shield import NO_PAST

CLIPPED: Final = int(Reason.CLIPPED)
LIMITED: Final = int(Reason.LIMITED)
RETURNING: Final = int(Reason.RETURNING)
MISSED: Final = int(Reason.MISSED)
NONE_SENT: Final = (math.nan, math.nan, math.nan)
NO_COMMAND: Final = CurrentCommand(NO_COUNTER, NO_COUNTER, 0.0, False)


class Interval(NamedTuple):
    """Interval between a sample and the one before."""

    elapsed: float  # By the device's clock [s]
    command: float  # That answered the sample before; 0 if none was sent [A]
    obeyed: bool  # True if the node reports that this command acted
    follows: bool  # True if nothing is missing between the two samples either


@dataclass
class RunCounters:
    """Counts and extremes of a run."""

    pairs: int = 0  # Valid sensor pairs from the first sample to the closing one, which needs no answer
    answered: int = 0  # Pairs answered by a command
    unanswered: int = 0  # Pairs that got none: overtaken by a newer one, or nothing could or might be sent
    missed: int = 0  # Sampling periods without a valid pair
    not_obeyed: int = 0  # Commands that came too late for their period, by the node's account
    not_taken: int = 0  # Commands that the interface had no room for; they count as unanswered
    confirmed: int = 0  # Frames of ours whose echo came back: they were on the bus
    rejected: int = 0  # Frames rejected by the reception
    dropped: int = 0  # Frames that the kernel dropped
    bus_errors: int = 0  # Error frames of the CAN controller
    clipped: int = 0
    limited: int = 0  # Commands changed to keep the brake inside its limits
    returning: int = 0  # Commands that the shield took over to be home in time
    left: int = 0  # Periods in which the node brakes: what had to be sent lay beyond what may be sent
    angle_min: float = 0.0
    angle_max: float = 0.0
    top_speed: float = 0.0
    top_current: float = 0.0

    def count_pair(self, sample: SensorSample, missed: int) -> None:
        """Count a valid pair, and the periods without one just before it."""
        self.pairs += 1
        self.missed += missed
        angle, speed = sample.angle, abs(sample.velocity)
        if angle < self.angle_min:
            self.angle_min = angle
        if angle > self.angle_max:
            self.angle_max = angle
        if speed > self.top_speed:
            self.top_speed = speed

    def count_answer(self, reasons: int, current: float) -> None:
        """Count a command that was sent, by its :class:`Reason` bits and its current [A]."""
        self.answered += 1
        self.clipped += bool(reasons & CLIPPED)
        self.limited += bool(reasons & LIMITED)
        self.returning += bool(reasons & RETURNING)
        if abs(current) > self.top_current:
            self.top_current = abs(current)


class Memory:
    """Memory of one run."""

    def __init__(self, bench: Bench, *, homing: bool) -> None:
        self.period_ns = bench.timing.sample_time_ns
        self.records: list[Record] = []  # What happened, in its order, until the driver takes it
        self.counters = RunCounters()
        self.read_ns = 0  # Time of the last read, monotonic [ns]
        self.deadline_ns = 0  # Time at which the next sample is half a period late, monotonic [ns]
        self.start_ns = 0  # Device time of the first sample [ns]
        self.newest: SensorSample | None = None  # Newest valid sample
        self.step = 0  # Its index on the grid, once it is to be answered
        self.interval = Interval(0.0, 0.0, False, False)  # Between it and the sample before, in control
        self.missed = 0  # Periods without a valid pair just before it
        self.skipped = 0  # Samples that the node's counter has skipped, and its device time has not
        self.lost = LeakyCount(bench.watch.stop_missed)  # Periods without a valid pair
        self.unobeyed = LeakyCount(bench.watch.stop_missed)  # Periods in which the node obeyed no command
        self.past = NO_PAST  # Last commands, newest first [A]
        self._decision: Decision | None = None  # for the newest sample, not sent yet
        self._command = NO_COMMAND  # the last one that was decided
        self._answered = False  # it was sent, and answers the newest sample
        self._state = RunState.HOMING if homing else RunState.ACTIVE  # of the cycles

    def note(self, time_ns: int, code: str, text: str) -> None:
        """Record an event."""
        self.records.append(EventRecord(time_ns, code, text))

    # --- the grid ---------------------------------------------------------------------------------------------------

    def add_sample(self, sample: SensorSample) -> SensorSample | None:
        """Add a sample; returns the one before."""
        before, self.newest = self.newest, sample
        self.deadline_ns = sample.receive_time_ns + self.period_ns * 3 // 2
        return before

    def start_run(self, sample: SensorSample) -> None:
        """Start the experiment, or the way home, with its first sample."""
        self.start_ns = sample.device_time_ns
        self.counters.pairs = 1

    def step_of(self, sample: SensorSample) -> int:
        """Index of a sample on the run's grid, by the node's clock."""
        return round((sample.device_time_ns - self.start_ns) / self.period_ns)

    def is_next(self, before: SensorSample | None, sample: SensorSample) -> bool:
        """Returns True if no sample is missing between two."""
        return before is None or sample.device_time_ns - before.device_time_ns < self.period_ns * 3 // 2

    def miss(self) -> tuple[int, int]:
        """Move the deadline on by a period; returns the old one, and how many have passed since the newest sample."""
        # Not the clock: after a stall frames are waiting in the socket, and they come first.
        sample, deadline_ns = self.newest, self.deadline_ns
        assert sample is not None
        self.deadline_ns += self.period_ns
        return deadline_ns, (deadline_ns - sample.receive_time_ns) // self.period_ns

    def follow(self, before: SensorSample, sample: SensorSample) -> None:
        """Count the periods between two samples, and whether the node obeyed."""
        elapsed_ns = sample.device_time_ns - before.device_time_ns
        periods = round(elapsed_ns / self.period_ns)
        self.missed = periods - 1 if periods > 1 else 0
        # What the counter has skipped within the device time was sampled, and did not come.
        steps = (sample.counter - before.counter) % COUNTER_MODULUS
        skipped = steps - periods if steps > periods else 0
        self.skipped += skipped
        self.counters.count_pair(sample, self.missed + skipped)
        self.lost.forgive()
        if self.missed + skipped:
            self.lost.reject(self.missed + skipped)
        command, obeyed = 0.0, False
        if self._answered:
            command, obeyed = self._command.current, sample.command_counter == self._command.counter
            # Unknown across a gap: the node names the command of the last period only.
            if periods == 1 and obeyed:
                self.unobeyed.forgive()
            elif periods == 1:
                self.counters.not_obeyed += 1
                self.unobeyed.reject()
        self._answered = False
        self.interval = tuple.__new__(Interval, (elapsed_ns * 1e-9, command, obeyed, obeyed and periods == 1))

    # --- what was sent ----------------------------------------------------------------------------------------------

    def slew_reference(self, sample: SensorSample) -> float:
        """Command of the period before; 0 if there was none [A]."""
        return self.past[0] if sample.counter == next_counter(self._command.answers) else 0.0

    def pass_missed(self, missed: int) -> None:
        """Store 0 A for the missed periods before a sample: nothing was sent."""
        for _ in range(min(missed, len(NO_PAST))):
            self._remember(0.0)

    def decided(self, decision: Decision, command: CurrentCommand) -> None:
        """Store a decision on the newest sample, and the command that the guard has read in its frame."""
        self._decision, self._command = decision, command

    def answered(self, decide_ns: int, send_ns: int) -> None:
        """Count and record the command of the last decision, handed to the bus; monotonic times of both [ns]."""
        sample, decision, command = self.newest, self._decision, self._command
        assert sample is not None
        assert decision is not None
        self._decision, self._answered = None, True
        self._remember(command.current)
        self.counters.count_answer(decision.reasons, command.current)
        times, currents = (decide_ns, send_ns), (decision.requested, decision.clipped, command.current)
        self.record(sample, self.step, decision.reasons, self.missed, times, currents, command.counter)

    def unanswered(self, sample: SensorSample, missed: int, decide_ns: int = 0, reasons: int = 0) -> None:
        """Count and record a sample for which nothing is sent: the node brakes in its period.

        With ``reasons`` it does so because the core decided that. The caller gives the periods missed before it: the
        memory's are those before the newest sample, which may have overtaken this one.
        """
        self._remember(0.0)
        self.counters.unanswered += 1
        self.counters.left += bool(reasons)
        if not reasons:
            self.unobeyed.reject()
        self.record(sample, self.step_of(sample), reasons or MISSED, missed, (decide_ns, 0))

    def _remember(self, current: float) -> None:
        self.past = (current, *self.past[:4])

    def record(
        self,
        sample: SensorSample,
        step: int,
        reasons: int,
        missed: int,
        times: tuple[int, int] = (0, 0),
        currents: tuple[float, float, float] = NONE_SENT,
        command_counter: int = NO_COUNTER,
    ) -> None:
        """Record a cycle: times of decision and sending [ns]; currents of the policy, clipped, and sent [A]."""
        counter, angle, velocity, device_ns, receive_ns, applied, _, node_state = sample
        of_cycle = step, self._state, int(reasons), counter, command_counter, missed, node_state
        before = device_ns, receive_ns, self.read_ns
        values = *of_cycle, angle, velocity, applied, *currents, *before, *times
        self.records.append(tuple.__new__(CycleRecord, values))


def latest_answer_ns(bench: Bench) -> int:
    """Age of a sample beyond which an answer cannot act any more in the period that it is meant for [ns]."""
    return min(1 + bench.shield.frame_age[1], OLDEST_SAMPLE_PERIODS) * bench.timing.sample_time_ns
