"""One experiment: wait, read, check, decide, shield, guard, send, record, at the pace of the node's samples.

The loop opens no socket: clock, reception, guard and journal are handed in, so that the same code runs on a real bus,
in lock-step simulation, and from a log. The node's own 1 kHz clock sets the pace; a pair that does not come in time is
a missed period on a grid that runs on from the last arrival: it is counted, and nothing is sent for it. What is sent
answers the newest sample or is not sent: nothing repeats a command.

The clock is read once per event, in :meth:`Loop._read_clock`, and the cycle record keeps each reading that decides
anything: a sample or a timeout is in hand (``wake_time_ns``), the command is decided, the command is sent. What a frame
says is dated by the frame's own stamp, and a missed period by its deadline.
"""

from __future__ import annotations

import contextlib
import math
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, cast

from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, LeakyCount, next_counter
from emb_runtime.can.messages import Layout, StatusFrame
from emb_runtime.can.receiver import Reception
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import CEILING_CURRENT, Bench
from emb_runtime.control.interfaces import Actor, Journal
from emb_runtime.control.result import Outcome, RunCounters
from emb_runtime.control.start_conditions import READY_PAIRS, Bounds, StartConditions
from emb_runtime.control.stop_condition import REACHED, StopCondition
from emb_runtime.errors import BusError, PolicyRefusedError
from emb_runtime.estimator.estimator import Estimator
from emb_runtime.learning.known import numbers
from emb_runtime.learning.learner import Learner, words
from emb_runtime.log.ring_buffer import Level
from emb_runtime.records import CurrentCommand, CycleRecord, Frame, NodeState, Reason, RunState, SensorSample
from emb_runtime.safety.command_limits import Decision, Reach, checked, decide
from emb_runtime.safety.guard import OLDEST_SAMPLE_PERIODS, Guard, GuardRejectedError
from emb_runtime.safety.heartbeat import STOP_FRAMES, Pulse, Unwatched
from emb_runtime.safety.motion_balance import REST_SAMPLES, MotionBalance, steady_motion
from emb_runtime.safety.sensor_monitor import SensorMonitor
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield import NO_PAST
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Event, Fault, Run, StateMachine, StopError, may_enable, timeouts
from emb_runtime.system.clock import Clock

HOME_PAIRS: Final = 50  # Valid pairs in a row, at home, that end a way home
STOP_LISTEN_NS: Final = 1_500_000_000
"""Longest time that the node may take to come to rest after the stop frames [ns]: a mapped one has a second, and then
lets its drive go."""
UNSTEADY: Final = "its samples come earlier and earlier by its own clock: they had piled up, or that clock is fast"
"""Reason why a node is not ready."""
DRAIN_FRAMES: Final = 64  # Most frames looked at, after a pair, for a newer one: a babbling node must not hold the loop

COVERAGE: Final = 0.8
"""Share of an experiment's periods that must have had a sample and a command that acted: the rest may be what the leaky
counts let pass."""

NAN: Final = math.nan


@dataclass
class Loop:
    """One run: an experiment, or the way home. Make it, :meth:`run` it once."""

    bench: Bench
    layout: Layout
    law: ShieldLaw
    actor: Actor
    current_limit: float  # Largest current that the policy's contract allows it to ask for [A]
    steps: int  # Samples to answer; on the way home, at most
    guard: Guard
    receive: Callable[[int], Frame | None]  # Returns the next frame, or None at a deadline (monotonic [ns])
    clock: Clock
    journal: Journal
    stop_requested: Callable[[], bool]
    pulse: Pulse = field(default_factory=Unwatched)  # To the watchdog process
    limit: float = CEILING_CURRENT  # A current narrower than the bench's, where the operator asked for one [A]
    homing: bool = False  # Begin anywhere, let the shield bring the brake home, and end when it rests there
    stop_condition: StopCondition | None = None  # Precision of the estimate at which the way home begins early
    judges_sensors: bool = True
    """The sensor monitor judges, and limits the first move; not in a rerun of a log of a version without it."""
    constant_first_move: bool = False
    """The limit of the first move is constant, as in a log of a version that did not reckon with friction."""
    overheard: Sequence[Frame] = ()  # Frames from just before the run that must not be missed

    def __post_init__(self) -> None:
        """Set up what the cycles carry from one to the next."""
        bench = self.bench
        self.counters = RunCounters()
        self._machine = StateMachine(timeouts(bench), self.journal.push_event)
        self._reception = Reception(self.layout, bench, self._on_rejected)
        self._period_ns = bench.timing.sample_time_ns
        self._latest_answer_ns = latest_answer_ns(bench)
        self._current_step = self.layout.command.signal("Current").factor
        self._bounds = Bounds(bench)
        self._start_conditions = StartConditions(bench, self.layout, self._bounds, anywhere=self.homing)
        limit = self.layout.current_within(min(self.limit, bench.limits.current))
        self._reach = Reach(limit, bench.guard.slew * bench.timing.sample_time)
        self._monitor = SensorMonitor(self.law, sensor_thresholds(bench, self.law), constant=self.constant_first_move)
        self._balance = MotionBalance(bench)
        self._unexplained = NAN, math.inf  # unexplained velocity and what is allowed, at the end [rad/s]
        self._moves_at_rest = ""  # velocity that the node measures at rest, in words
        # The way home may begin anywhere, and is not worth learning for.
        self._learner = Learner(bench, self.law, active=not self.homing)
        self._estimator = Estimator(bench)
        self._reversed: StopError | None = None  # the sign may be wrong, and friction is stopping the brake
        self._coasting = 0.0  # time left for that [s]
        self._late_step = self.law.steps - 2 - math.ceil(self.law.settling / self.law.sample_time)
        self._now_ns = 0  # time of the event in hand
        self._wake_ns = 0  # when the newest sample was in hand
        self._start_ns = 0  # device time of the first sample
        self._last: SensorSample | None = None  # the newest valid sample
        self._missed = 0  # periods without a valid pair just before it
        self._sent_counter: int | None = None  # counter of the command that answered it
        self._unobeyed = LeakyCount(bench.watch.stop_missed)  # periods in which the node obeyed no command
        self._lost = LeakyCount(bench.watch.stop_missed)  # periods without a valid pair
        self._skipped = 0  # samples that the node's counter has skipped, and its device time has not
        self._was_active = False  # the node has obeyed a command of this run
        self._status: StatusFrame | None = None  # the newest status judged
        self._past = NO_PAST  # the last own commands, newest first
        self._answered: int | None = None  # counter of the sample that the newest of them answered
        self._permitted = True
        self._estimate: tuple[float, ...] = ()  # the latest
        self._condition_met = False
        self._met_ns = 0  # from the first sample to that at which it was met, device time
        self._at_rest = False  # the newest sample since the first stop frame says idle
        self._leaving: BaseException | None = None  # the first error that is no Exception
        self._failures: list[tuple[str, BaseException]] = []  # steps of the stop that failed, not yet recorded
        self._records_failures = False  # the fault that ended the run is recorded

    @property
    def state(self) -> RunState:
        """State of the run."""
        return self._machine.run.state

    def run(self) -> Outcome:
        """Arm, run, stop. Whatever happens, what was armed ends with stop frames.

        Raises:
            BaseException: raised by something that was called, and no Exception: after the stop.
        """
        fault: Fault | None = None
        cause: BaseException | None = None
        try:
            self._machine.handle_event(Event.PREPARED, self._read_clock())
            for frame in self.overheard:
                self._take(frame)
            self._run_experiment(self._await_node())
        except StopError as stop:
            fault, cause = stop.fault, stop
        except GuardRejectedError as refusal:
            fault, cause = Fault.GUARD_REJECTED, refusal
        except PolicyRefusedError as refused:
            fault, cause = Fault.POLICY_NOT_FINITE, refused
        except BusError as lost:
            fault, cause = Fault.BUS_LOST, lost
        except BaseException as err:
            fault, cause = Fault.INTERNAL, err
        # Invariant: from here on only stop frames can leave, and nothing that is called can keep them back.
        armed = self.state not in (RunState.INIT, RunState.SILENT)
        end = self._last if armed else None
        if cause is not None:
            self._keep(cause)
        detail = self._stop(fault, cause)
        if self._leaving is not None:
            raise self._leaving
        return self._outcome(detail, armed, end)

    def _outcome(self, detail: str, armed: bool, end: SensorSample | None) -> Outcome:
        fault, last, reception = self._machine.run.fault, self._last, self._reception
        self.counters.rejected, self.counters.dropped = reception.rejected, reception.dropped
        return Outcome(
            fault=fault,
            detail=detail or self._moves_at_rest,
            counters=self.counters,
            armed=armed,
            end_angle=end.angle if end else NAN,
            end_velocity=end.velocity if end else NAN,
            home=fault is None and end is not None and self._bounds.is_home(end),
            node_state=last.node_state if last else None,
            node_at_rest=self._at_rest,
            node_stop_reason=reception.stop_reason,
            last_angle=last.angle if last else NAN,
            duration_ns=end.device_time_ns - self._start_ns if end and self._start_ns else 0,
            rejections=reception.rejections(),
            bus_errors={str(name): count for name, count in reception.bus_errors.counts.items()},
            estimate=self._estimate,
            goal_reached=self._condition_met,
            goal_ns=self._met_ns,
            learnt=self._learner.known if self._start_ns else None,  # not of the warming up
            unexplained=self._unexplained[0],
            allowed=self._unexplained[1],
        )

    def _read_clock(self) -> int:
        """Time of the event in hand [ns]: the only place where the loop reads its clock."""
        self._now_ns = self.clock.now_ns()
        return self._now_ns

    # --- SILENT: listen until the node has shown itself -------------------------------------------------------------

    def _await_node(self) -> SensorSample:
        """Listen until enough pairs in a row meet the start conditions; returns the last of them."""
        deadline_ns = self._now_ns + round(self.bench.watch.start_timeout * 1e9)
        ready = 0
        reason = ""
        while True:
            self._check_requests()
            try:
                self._machine.handle_event(Event.TIME, self._now_ns)
            except StopError as stop:
                unpaired = self._reception.unpaired
                fault = Fault.NODE_NOT_READY if unpaired else stop.fault
                raise StopError(fault, reason or unpaired or stop.detail) from None
            before = self._last
            frame = self.receive(min(deadline_ns, self._now_ns + 10 * self._period_ns))
            now_ns = self._read_clock()
            if frame is None or (sample := self._take(frame)) is None:
                continue
            reason = self._start_conditions.not_ready(self._reception.status, sample, now_ns)
            gap_ns = 0 if before is None else sample.device_time_ns - before.device_time_ns
            in_row = ready > 0 and not reason and gap_ns < self._period_ns * 3 // 2
            steady = self.guard.learn_time(sample, first=not in_row)
            ready = 0 if reason else ready + 1 if in_row and steady else 1
            self._warm_up(sample)
            reason = reason or ("" if steady else UNSTEADY)
            if ready == READY_PAIRS:
                self._machine.handle_event(Event.NODE_READY, now_ns)
                return sample

    def _warm_up(self, sample: SensorSample) -> None:
        """Judge and decide for nothing: Python runs code several times before it runs it fast, and first cycles count.

        The monitor begins anew with the experiment.
        """
        self._monitor.begin(sample)
        with contextlib.suppress(StopError):
            self._monitor.check(self.law.sample_time, sample, True, 0.0)
        reach = self._reach._replace(limit=self._monitor.largest_current(self._reach.limit))
        self._balance.begin(sample)
        self._balance.take(sample, True)
        self._balance.judge()
        self._learner.begin(sample)
        self._learner.hear(sample, 1)
        self._estimator.begin()
        self._estimator.take(sample.angle, sample.velocity, 0, sample.applied_current)
        law, angle, velocity = self._learner.question(sample)
        decide(law, reach, angle, velocity, 0.0, NO_PAST, 0.0, 0)

    # --- ACTIVE or HOMING: one cycle per sample ---------------------------------------------------------------------

    def _run_experiment(self, sample: SensorSample) -> None:
        sample = self._next_sample(sample)
        self._start_ns = sample.device_time_ns
        self.pulse.arm(self._now_ns)
        self._machine.handle_event(Event.BEGIN_HOMING if self.homing else Event.BEGIN, self._now_ns)
        self._monitor.begin(sample)
        self._balance.begin(sample)
        self._learner.begin(sample)
        self._estimator.begin()
        self.counters.pairs = 1
        self.actor.begin()
        at_home = 0
        # With a wrong sign beyond the last sample as well, until friction has stopped the brake: that ends as a fault.
        while ((step := self._step_of(sample)) < self.steps and at_home < HOME_PAIRS) or self._reversed is not None:
            self._answer(sample, step)
            if not self.homing and (estimate := self._estimator.estimate):
                self._keep_estimate(estimate, sample, step)
            if self._learner.known is not None:
                learnt = numbers(self._learner.known, self._learner.age)
                self.journal.push_learnt(sample.receive_time_ns, step, learnt)
            sample = self._next_sample(sample)
            returns = self.homing or self._condition_met
            at_home = at_home + 1 if returns and self._bounds.is_home(sample) else 0
        self._record(sample, step, Reason.NONE, missed=self._missed)
        if self.homing and at_home < HOME_PAIRS:
            raise StopError(Fault.NOT_HOME, f"at {sample.angle:.2f} rad after {step} periods")
        if not self.homing and (why := self._incomplete(sample, min(step, self.steps))):
            raise StopError(Fault.INCOMPLETE, why)
        if not self.homing:
            self._unexplained = self._balance.judge()
        self._machine.handle_event(Event.FINISHED, self._now_ns)

    def _incomplete(self, end: SensorSample, periods: int) -> str:
        """Reason why an experiment of so many periods is not complete; empty if it is."""
        counters = self.counters
        acted = counters.answered + counters.left - counters.not_obeyed
        if acted < COVERAGE * periods:
            return f"{acted} of {periods} periods had a sample and a command that acted, at least {COVERAGE:.0%} must"
        # Below the bench's limit the shield cannot always bring the brake home in time: that is the operator's choice.
        if self._bounds.is_home(end) or self.limit < self.bench.limits.current:
            return ""
        return f"the brake is not home: at {end.angle:.2f} rad and {end.velocity:.1f} rad/s after {periods} periods"

    def _step_of(self, sample: SensorSample) -> int:
        """Index of a sample on the run's grid, by the node's own clock."""
        return round((sample.device_time_ns - self._start_ns) / self._period_ns)

    def _next_sample(self, last: SensorSample) -> SensorSample:
        """Wait for the newest valid pair after a sample; periods without one are counted.

        Raises:
            StopError: they are too many, or somebody ends the run.
            BusError: the bus is lost.
        """
        deadline_ns = last.receive_time_ns + self._period_ns * 3 // 2
        while True:
            self._check_requests()
            frame = self.receive(deadline_ns)
            if frame is None or frame.time_ns >= deadline_ns:
                self._wake()
                # The deadline and not the clock: a computer that stood still has frames waiting, and they come first.
                self._machine.handle_event(Event.TIME, deadline_ns)
                deadline_ns += self._period_ns
            if frame is not None and (sample := self._take(frame)) is not None:
                sample = self._newest(sample)
                # Before its device time says which step it is, or that it is the last one. What was taken in place of
                # the sample that woke the loop may have arrived after the waking.
                self.guard.judge_time(sample, max(self._wake_ns, sample.receive_time_ns))
                return sample

    def _wake(self) -> int:
        """Read the clock for a sample or a timeout in hand, and exchange signs of life with the watchdog."""
        now_ns = self._read_clock()
        self.pulse.beat(now_ns)
        if not self.pulse.watched(now_ns):
            raise StopError(Fault.WATCHDOG_LOST)
        return now_ns

    def _newest(self, sample: SensorSample) -> SensorSample:
        """Replace a sample by what has come meanwhile: the node obeys an answer to its newest sample only."""
        self._wake_ns = self._wake()
        if self._wake_ns - sample.receive_time_ns < self._period_ns // 2:
            return sample  # the next one is not due yet
        for _ in range(DRAIN_FRAMES):
            frame = self.receive(0)
            if frame is None:
                break
            missed = self._missed
            newer = self._take(frame)
            if newer is not None:
                self._remember(*NO_PAST[:missed], 0.0)
                self._leave_unanswered(sample, missed)
                sample = newer
        return sample

    def _answer(self, sample: SensorSample, step: int) -> None:
        """Decide, and send the command; or leave the sample unanswered, and the node brakes."""
        self._check_requests()
        self._check_sample(sample)
        self._remember(*NO_PAST[: self._missed])
        self._estimator.take(sample.angle, sample.velocity, step, sample.applied_current)
        asked = self.actor.act(sample.angle, sample.velocity, step, sample.applied_current)
        wanted = checked(asked, self.current_limit)
        decision = self._decide(sample, wanted, step)
        decide_ns = self._read_clock()
        if not self._may_answer(sample, decision, decide_ns):
            self._remember(0.0)
            in_time = decide_ns - sample.receive_time_ns <= self._latest_answer_ns
            left = decision.reasons & Reason.LEFT if in_time else Reason.NONE
            self._leave_unanswered(sample, self._missed, decide_ns, left)
            return
        answer = self.guard.next_counter, sample.counter, decision.current, True
        command = tuple.__new__(CurrentCommand, answer)
        try:
            self._send(command, sample.receive_time_ns, decide_ns)
        except TransmitQueueFullError as err:  # lost: sent later, it would answer an old sample
            self.counters.not_taken += 1
            self._machine.note(Fault.SEND_QUEUE_FULL, str(err), decide_ns)
            self._remember(0.0)
            self._leave_unanswered(sample, self._missed, decide_ns)
            return
        send_ns = self._read_clock()
        current = round(decision.current / self._current_step) * self._current_step  # what is on the bus
        self._remember(current)
        self._answered = sample.counter
        self._sent_counter = command.counter
        self.counters.count_answer(decision.reasons, current)
        self._record(
            sample, step, decision.reasons, missed=self._missed,
            command_counter=command.counter, wanted=wanted, clipped=decision.clipped, sent=current,
            decide_ns=decide_ns, send_ns=send_ns,
        )  # fmt: skip

    def _check_sample(self, sample: SensorSample) -> None:
        """Leave the run if the brake or the node is not where it must be."""
        if outside := self._bounds.outside(sample):
            raise StopError(Fault.OUT_OF_LIMITS, outside)
        if sample.node_state in (NodeState.STOPPING, NodeState.FAULT):
            raise StopError(Fault.NODE_STOPPED, f"the node's state is {sample.node_state.name}")
        if changed := self._changed(sample):
            raise StopError(Fault.NODE_CHANGED, changed)
        if self._unobeyed.exceeded:
            found = f"{self.counters.not_obeyed} commands not obeyed, {self.counters.unanswered} samples not answered"
            raise StopError(Fault.NOT_OBEYED, f"{found} of {self.counters.pairs}, a fifth or too many in a row")
        if self._lost.exceeded:
            found = (
                f"{self.counters.missed} of {self.counters.missed + self.counters.pairs} periods without a valid pair"
            )
            found += ", more than a fifth or too many in a row"
            if self._skipped:
                found += f"; {self._skipped} of them are missing by the node's counter and not by its time"
            raise StopError(Fault.SENSOR_LOST, found)
        self.guard.judge(sample)

    def _changed(self, sample: SensorSample) -> str:
        """Property of the node that has changed since the run began, in words; empty if none has."""
        # Until it has obeyed the first command it may be idle: the first ones may be lost.
        self._was_active |= sample.node_state is NodeState.ACTIVE
        if sample.node_state is NodeState.IDLE and (self._was_active or sample.command_counter != NO_COUNTER):
            return "the node's state is IDLE after it has obeyed a command of this run"
        status = self._reception.status
        if status is self._status:
            return ""
        self._status = status
        return self._start_conditions.mismatch(status)

    def _decide(self, sample: SensorSample, wanted: float, step: int) -> Decision:
        """Command for a sample, in the shield's view of time: on the way home the end is always near."""
        follows = self._answered is not None and sample.counter == next_counter(self._answered)
        last = self._past[0] if follows else 0.0
        if self._reversed is not None:
            slew = self._reach.slew
            return Decision(0.0, min(max(0.0, last - slew), last + slew), Reason.LIMITED)
        if self.homing:
            step = self._late_step
        elif self._condition_met:
            step, wanted = max(step, self._late_step), 0.0
        reach = self._reach
        if self.judges_sensors and (most := self._monitor.largest_current(reach.limit)) < reach.limit:
            reach = reach._replace(limit=max(most, abs(last) - reach.slew))  # down to it as fast as may be
        law, angle, velocity = self._learner.question(sample)
        decision = decide(law, reach, angle, velocity, wanted, self._past, last, step)
        return decision._replace(reasons=decision.reasons | Reason.RETURNING) if self._condition_met else decision

    def _may_answer(self, sample: SensorSample, decision: Decision, decide_ns: int) -> bool:
        """Returns True if the command is not late, every message of the node permits it, and there is one."""
        if decide_ns - sample.receive_time_ns > self._latest_answer_ns:  # late: the sample that it answers is stale
            return False
        if self.guard.too_fast(decide_ns):  # samples came in a burst, and there is a newer one
            return False
        why = self._reception.permitted(decide_ns)
        if why and self._permitted:
            self._machine.note(Fault.PERMISSION_LOST, why, decide_ns)
        self._permitted = not why
        return not (why or math.isnan(decision.current))

    def _leave_unanswered(self, sample: SensorSample, missed: int, decide_ns: int = 0, reasons: int = 0) -> None:
        """Count and record a sample for which nothing is sent: the node brakes in its period."""
        if not may_enable(self.state):
            return
        self.counters.unanswered += 1
        self.counters.left += bool(reasons)
        if not reasons:  # else the node brakes because the loop decided so
            self._unobeyed.reject()
        self._record(sample, self._step_of(sample), reasons or Reason.MISSED, missed=missed, decide_ns=decide_ns)

    def _keep_estimate(self, estimate: tuple[float, ...], sample: SensorSample, step: int) -> None:
        """Record the estimate; once it meets the stop condition, all that is left is the way home."""
        self._estimate = estimate
        self.journal.push_estimate(sample.receive_time_ns, step, self._estimate)
        condition = self.stop_condition
        if condition is not None and not self._condition_met and condition.reached(self._estimate):
            self._condition_met = True
            self._met_ns = sample.device_time_ns - self._start_ns
            self.journal.push_event(sample.receive_time_ns, REACHED, condition.describe(self._estimate))

    def _remember(self, *currents: float) -> None:
        """Keep the commands of the periods that have passed, oldest first [A]."""
        for current in currents:
            self._past = (current, *self._past[:4])

    def _send(self, command: CurrentCommand, sample_time_ns: int, now_ns: int) -> None:
        self.guard.send(self.layout.encode_command(command), self.state, sample_time_ns, now_ns)

    # --- STOPPING ---------------------------------------------------------------------------------------------------

    def _stop(self, fault: Fault | None, cause: BaseException | None) -> str:
        """Send the stop frames, say what ended the run, watch the node come to rest; returns the fault's detail.

        Nothing is described or recorded before the first stop frame has left.
        """
        if fault is not None:
            self._attempt("CLOCK_FAILED", self._read_clock)
        tripped, fault_ns, before = self._has_tripped(), self._now_ns, self._machine.run
        if fault is not None:
            if tripped:  # it takes the bus from this process: that is the cause
                fault = Fault.WATCHDOG_TRIPPED
            self._machine.latch(fault, fault_ns)
        frames = STOP_FRAMES if self.state is RunState.STOPPING and not tripped else 0  # else the watchdog sends them
        if frames:
            self._send_stop_frame()
        detail = "" if cause is None else _detail(cause)
        if fault is not None:
            if cause is not None and fault is Fault.INTERNAL:
                self._attempt("TRACEBACK_FAILED", lambda: self._record_traceback(cause, fault_ns))
            self._record_fault(before, fault, detail, fault_ns)
        self._records_failures = True
        self._record_failures()
        for sent in range(1, frames + 1):
            # Each in a period of its own: what stood in the way of one may be gone for the next.
            self._listen(self._now_ns + self._period_ns)
            if sent < frames:
                self._send_stop_frame()
        if self.state is RunState.STOPPING:
            self._end_stop()
        return detail

    def _end_stop(self) -> None:
        """Let the watchdog go, and watch the node come to rest."""
        self._attempt("DISARM_FAILED", self.pulse.disarm)
        self._attempt("CLOCK_FAILED", self._read_clock)
        if self._machine.run.fault is None and self._has_tripped():  # while the stop frames went out
            self._fail(Fault.WATCHDOG_TRIPPED, "")
        self._reception.status = None  # what it said of a stop was of another one
        self._listen(self._now_ns + STOP_LISTEN_NS, until_idle=True)
        if self._machine.run.fault is None:
            if not self._at_rest:
                self._fail(
                    Fault.NOT_AT_REST, f"the node's last state is {self._last.node_state.name}" if self._last else ""
                )
            elif self._moves_at_rest:
                self._fail(Fault.MOTION_UNEXPLAINED, self._moves_at_rest)
        self._attempt("CLOCK_FAILED", self._read_clock)
        self._attempt("RECORD_FAILED", lambda: self._machine.handle_event(Event.STOPPED, self._now_ns))

    def _fail(self, fault: Fault, detail: str) -> None:
        """Take a fault that shows itself while the run is stopped, and record it."""
        before = self._machine.run
        self._machine.latch(fault, self._now_ns)
        self._record_fault(before, fault, detail, self._now_ns)

    def _attempt(self, failure: str, call: Callable[[], object]) -> None:
        """Do a step of the stop. Its failure keeps nothing back; it is recorded as an event, after the fault's."""
        try:
            call()
        except BaseException as err:
            self._keep(err)
            self._failures.append((failure, err))
        if self._records_failures:
            self._record_failures()

    def _record_failures(self) -> None:
        failures, self._failures = self._failures, []
        for failure, err in failures:
            try:
                self.journal.push_event(self._now_ns, failure, _one_line(err))
            except BaseException as again:
                self._keep(again)

    def _keep(self, err: BaseException) -> None:
        """Keep the first error that is no Exception: it is raised once the run has stopped."""
        if self._leaving is None and not issubclass(type(err), Exception):
            self._leaving = err

    def _has_tripped(self) -> bool:
        """Returns True if the watchdog has tripped; False if it cannot be asked."""
        try:
            return self.pulse.tripped
        except BaseException as err:
            self._keep(err)
            return False

    def _record_fault(self, before: Run, fault: Fault, detail: str, now_ns: int) -> None:
        self._attempt("RECORD_FAILED", lambda: self._machine.note(fault, detail, now_ns))
        self._attempt("RECORD_FAILED", lambda: self._machine.note_change(before, fault, now_ns))

    def _record_traceback(self, cause: BaseException, now_ns: int) -> None:
        self.journal.push_log(now_ns, Level.FATAL, "".join(traceback.format_exception(cause, limit=-3)))

    def _send_stop_frame(self) -> None:
        """Send a stop frame. Whatever is broken, the next one is still tried."""
        self._attempt("CLOCK_FAILED", self._read_clock)
        self._attempt("BEAT_FAILED", lambda: self.pulse.beat(self._now_ns))
        self._attempt("STOP_FRAME_NOT_SENT", self._send_disabled)

    def _send_disabled(self) -> None:
        answers = self._last.counter if self._last else 0
        self._send(CurrentCommand(self.guard.next_counter, answers, 0.0, enable=False), self._now_ns, self._now_ns)

    def _listen(self, deadline_ns: int, until_idle: bool = False) -> None:
        """Record what comes until a deadline, or until the node has said idle and its status why it stopped."""
        self._attempt("LISTENING_FAILED", lambda: self._take_until(deadline_ns, until_idle))

    def _take_until(self, deadline_ns: int, until_idle: bool) -> None:
        velocities: list[float] = []
        while not (until_idle and self._at_rest and self._reception.stop_reason is not None):
            frame = self.receive(deadline_ns)
            if frame is None:
                break
            if (sample := self._take(frame)) is not None:
                self._at_rest = sample.node_state is NodeState.IDLE
                velocities.append(sample.velocity)
            if frame.time_ns >= deadline_ns:
                break  # on a babbling bus there is always one more
        if speed := steady_motion(velocities[-REST_SAMPLES:], self.bench.noise.velocity):
            self._moves_at_rest = f"without a current the node goes on to measure {speed:.1f} rad/s: friction stops any"

    # --- in every state: what the bus says --------------------------------------------------------------------------

    def _check_requests(self) -> None:
        """Ask everybody who may end the run.

        Raises:
            StopError: somebody does.
        """
        # The watchdog first: its stop frames come from another socket and look like a stranger's commands.
        if self.pulse.tripped:
            raise StopError(Fault.WATCHDOG_TRIPPED)
        if self.stop_requested():
            raise StopError(Fault.INTERRUPTED)
        if self._reception.foreign_command:
            raise StopError(Fault.FOREIGN_COMMAND, f"identifier {self.layout.command.identifier:#05x}")
        if self._reception.too_many_rejected:
            raise StopError(Fault.FRAMES_REJECTED, f"{self._reception.rejected} so far")

    def _take(self, frame: Frame) -> SensorSample | None:
        """Take one frame; returns a sample if the frame completes a valid pair.

        Raises:
            BusError: the frame says that the bus is lost.
        """
        self.journal.push_frame(frame)
        if frame.own:
            self.counters.confirmed += 1
            return None
        if frame.error:
            self._take_error(frame)
            return None
        dropped = self._reception.dropped
        sample = self._reception.take(frame)
        if self._reception.dropped > dropped:
            self._machine.note(Fault.FRAMES_DROPPED, f"{self._reception.dropped} so far", frame.time_ns)
        if sample is None:
            return None
        before, self._last = self._last, sample
        self._machine.handle_event(Event.PAIR, sample.receive_time_ns)
        if may_enable(self.state) and before is not None:
            self._follow(before, sample)
        return sample

    def _take_error(self, frame: Frame) -> None:
        self.counters.bus_errors += 1
        self._reception.take(frame)
        if self._reception.bus_errors.bus_off:
            raise BusError("the CAN controller reports bus-off: it has stopped taking part")
        if self.counters.bus_errors == 1:
            self._machine.note(Fault.BUS_ERRORS, ", ".join(self._reception.bus_errors.counts), frame.time_ns)

    def _follow(self, before: SensorSample, sample: SensorSample) -> None:
        """Count the periods between two samples, and check that the node obeyed and that the sensors can be right."""
        elapsed_ns = sample.device_time_ns - before.device_time_ns
        gap = round(elapsed_ns / self._period_ns)
        self._missed = max(0, gap - 1)
        # What the counter has skipped within the device time was sampled, and did not come.
        steps = (sample.counter - before.counter) % COUNTER_MODULUS
        skipped = max(0, steps - gap) if gap < COUNTER_MODULUS else 0
        self._skipped += skipped
        self.counters.count_pair(sample, self._missed + skipped)
        self._lost.forgive()
        self._lost.reject(self._missed + skipped)
        # Across a gap the node does not tell: it names the command of the last period only.
        sent, obeyed = self._sent_counter is not None, sample.command_counter == self._sent_counter
        if sent and gap == 1:
            if obeyed:
                self._unobeyed.forgive()
            else:
                self.counters.not_obeyed += 1
                self._unobeyed.reject()
        self._sent_counter = None
        self._judge_sensors(elapsed_ns * 1e-9, sample, sent and obeyed, self._past[0] if sent else 0.0)
        if not self.homing and self._reversed is None:
            self._balance.take(sample, sent and obeyed and gap == 1)
        self._learn(sample, gap)

    def _judge_sensors(self, elapsed: float, sample: SensorSample, obeyed: bool, command: float) -> None:
        """End the run if the sensors cannot be right.

        With a wrong sign the node's own stop would drive the brake on: where the sign is not known to be right and
        friction alone can stop the brake, that is waited for with 0 A, and then the run ends. Meanwhile everything but
        the sensors' sums is judged as ever.
        """
        if not self.judges_sensors:
            return
        if self._reversed is not None:
            self._coasting -= elapsed
            if self._coasting <= 0.0:
                raise self._reversed
            return
        try:
            self._monitor.check(elapsed, sample, obeyed, command)
        except StopError as stop:
            self._coasting = self._monitor.coasting_time(stop.fault, sample)
            if self._coasting == 0.0:
                raise
            self._reversed = stop
            # Now, since something else may end the run meanwhile, and would hide it.
            self._machine.note(stop.fault, stop.detail, sample.receive_time_ns)

    def _learn(self, sample: SensorSample, periods: int) -> None:
        """Hear a sample; where it contradicts what the shield takes for granted, nothing that it learnt is to be used.

        Raises:
            StopError: it does.
        """
        if self._reversed is not None:
            return
        self._learner.hear(sample, periods)
        if self._learner.contradicted:
            before = self._learner.known
            raise StopError(Fault.SET_CONTRADICTED, "" if before is None else f"until then {words(before)} of nominal")

    def _on_rejected(self, frame: Frame, why: str) -> None:
        self.journal.push_event(frame.time_ns, "FRAME_REJECTED", why)

    # --- records ----------------------------------------------------------------------------------------------------

    def _record(
        self,
        sample: SensorSample,
        step: int,
        reasons: int,
        *,
        missed: int,
        command_counter: int = NO_COUNTER,
        wanted: float = NAN,
        clipped: float = NAN,
        sent: float = NAN,
        decide_ns: int = 0,
        send_ns: int = 0,
    ) -> None:
        self.journal.push_cycle(
            CycleRecord(
                step=step,
                state=self.state,
                reasons=int(reasons),
                counter=sample.counter,
                command_counter=command_counter,
                missed=missed,
                node_state=sample.node_state,
                angle=sample.angle,
                velocity=sample.velocity,
                applied_current=sample.applied_current,
                policy_current=wanted,
                clipped_current=clipped,
                sent_current=sent,
                device_time_ns=sample.device_time_ns,
                receive_time_ns=sample.receive_time_ns,
                wake_time_ns=self._wake_ns,
                decide_time_ns=decide_ns,
                send_time_ns=send_ns,
            )
        )


def latest_answer_ns(bench: Bench) -> int:
    """Age of a sample beyond which an answer cannot act any more in the period that it is meant for [ns]."""
    return min(1 + bench.shield.frame_age[1], OLDEST_SAMPLE_PERIODS) * bench.timing.sample_time_ns


def _detail(cause: BaseException) -> str:
    """The end of a run in one line: the message of a refusal, class and message of an error in the program."""
    kind = type(cause)
    if issubclass(kind, StopError):
        return cast("StopError", cause).detail
    return _one_line(cause, named=not issubclass(kind, GuardRejectedError | PolicyRefusedError | BusError))


def _one_line(err: BaseException, *, named: bool = True) -> str:
    """Message of an error in one line, after its class; the class alone if the message cannot be had."""
    name = type(err).__name__
    try:
        return (f"{name}: {err}" if named else f"{err}").partition("\n")[0]
    except BaseException:
        return name
