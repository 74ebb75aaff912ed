"""Core of a run: frames and times go in; commands, records and faults come out. It reads no clock and opens no socket.

A driver does all that blocks (:mod:`emb_runtime.control.loop`; a rerun plays a log instead):

* :meth:`Core.take` gets the frames of one read, and gives a proposal for the newest sample among them;
* :meth:`Core.commit` gives the frame to send, unless it is too late or not permitted;
* :meth:`Core.sent` records the cycle;
* :meth:`Core.timeout` counts a period without a sample.

What happened lies in :attr:`Core.records`, in its order, until the driver takes it. A fault is a value of the state,
not an error. The node's 1 kHz clock sets the pace. A sample that does not come in time is a missed period on a grid
that runs on from the last arrival. A command answers the newest sample, or none is sent: nothing repeats a command.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER, LeakyCount, next_counter
from emb_runtime.can.messages import Layout, StatusFrame
from emb_runtime.can.receiver import BUS_OFF, Reception
from emb_runtime.config.bench import CEILING_CURRENT, Bench
from emb_runtime.control.actor import Actor
from emb_runtime.control.result import Outcome, RunCounters
from emb_runtime.control.start_conditions import READY_PAIRS, Bounds, StartConditions
from emb_runtime.control.stop_condition import REACHED, StopCondition
from emb_runtime.estimator.estimate import LOST
from emb_runtime.estimator.estimator import Estimator, estimated
from emb_runtime.log.ring_buffer import EstimateRecord, EventRecord, FrameRecord, Record
from emb_runtime.records import CycleRecord, Frame, NodeState, Reason, RunState, SensorSample
from emb_runtime.safety.command_limits import CommandLimits, Decision, checked, decide
from emb_runtime.safety.guard import OLDEST_SAMPLE_PERIODS, Guard
from emb_runtime.safety.motion_balance import REST_SAMPLES, MotionBalance, unheld_motion
from emb_runtime.safety.response import Response
from emb_runtime.safety.response_cause import cause
from emb_runtime.safety.sensor_monitor import SensorMonitor
from emb_runtime.safety.sensor_thresholds import sensor_thresholds
from emb_runtime.safety.shield import NO_PAST
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Event, Fault, StateMachine, StopError, may_enable

HOME_PAIRS: Final = 50  # Valid pairs in a row, at home, that end a way home
UNSTEADY: Final = "its samples come earlier and earlier by its own clock: they had piled up, or that clock is fast"
"""Reason why a node is not ready."""
SILENT_WAIT: Final = 10  # Periods after which a driver that waits for the node asks again for the operator's wish
# What each cycle asks for, by a name of its own: in Python 3.11 a member of an enumeration takes as long as a call.
SILENT: Final = RunState.SILENT
ARMED: Final = RunState.ARMED
STOPPING: Final = RunState.STOPPING
OVER: Final = RunState.OVER
IN_CONTROL: Final = (ARMED, RunState.ACTIVE, RunState.HOMING)
ENDING: Final = (STOPPING, OVER)
IDLE: Final = NodeState.IDLE
OBEYING: Final = NodeState.ACTIVE
UNFIT: Final = (NodeState.STOPPING, NodeState.FAULT)
PAIR: Final = Event.PAIR
OF_RESPONSE: Final = (
    Fault.RESPONSE_LATE,
    Fault.SENSORS_CONTRADICT,
    Fault.MOTION_OUTSIDE_SET,
    Fault.WRONG_POLARITY,
    Fault.OUT_OF_LIMITS,
)
"""Faults as which an undeclared response may end a run."""
COVERAGE: Final = 0.8
"""Share of an experiment's periods that must have had a sample and a command that acted: the rest may be what the leaky
counts let pass."""

NAN: Final = math.nan


class Proposal(NamedTuple):
    """Command for a sample, of which it is not known yet whether it comes in time."""

    sample: SensorSample
    step: int
    wanted: float  # By the policy [A]
    decision: Decision


@dataclass
class Core:
    """Core of one run: an experiment, or the way home."""

    bench: Bench
    layout: Layout
    law: ShieldLaw
    actor: Actor
    current_limit: float  # Largest current that the policy's contract allows it to ask for [A]
    steps: int  # Samples to answer; on the way home, at most
    guard: Guard
    limit: float = CEILING_CURRENT  # A current narrower than the bench's, where the operator asked for one [A]
    homing: bool = False  # Begin anywhere, let the shield bring the brake home, and end when it rests there
    stop_condition: StopCondition | None = None  # Precision of the estimate at which the way home begins early

    def __post_init__(self) -> None:
        """Set up what the cycles carry from one to the next."""
        bench = self.bench
        self.records: list[Record] = []
        self.counters = RunCounters()
        self._machine = StateMachine(bench, self.note)
        self._reception = Reception(self.layout, bench, self._on_rejected)
        self._period_ns = bench.timing.sample_time_ns
        self._latest_answer_ns = latest_answer_ns(bench)
        self._current_step = self.layout.command.signal("Current").factor
        self._bounds = Bounds(bench)
        self._start_conditions = StartConditions(bench, self.layout, self._bounds, anywhere=self.homing)
        limit = self.layout.current_within(min(self.limit, bench.limits.current))
        self._limits = CommandLimits(limit, bench.guard.slew * bench.timing.sample_time)
        self._monitor = SensorMonitor(self.law, sensor_thresholds(bench, self.law))
        self._response = Response(bench, self.law)
        self._balance = MotionBalance(bench)
        self._unbalanced: tuple[SensorSample, bool] | None = (
            None  # the newest sample, not yet in it; it follows the last
        )
        self._unexplained = NAN, math.inf  # unexplained velocity and what is allowed, at the end [rad/s]
        self._estimator = Estimator(bench)
        self._reversed: StopError | None = None  # the sign may be wrong, and friction is stopping the brake
        self._coasting = 0.0  # time left for that [s]
        self._late_step = self.law.steps - 2 - math.ceil(self.law.settling / self.law.sample_time)
        self._now_ns = 0  # time of the last read
        self._give_up_ns = 0  # time until which the node must have shown itself
        self._deadline_ns = 0  # time at which the next sample is half a period late
        self._ready = 0  # samples in a row that met the start conditions
        self._not_ready = ""  # reason why the last one did not
        self._start_ns = 0  # device time of the first sample
        self._last: SensorSample | None = None  # the newest valid sample
        self._end: SensorSample | None = None  # the newest of those before the stop
        self._missed = 0  # periods without a valid pair just before it
        self._at_home = 0  # samples in a row at home, once the brake is to return
        self._counter = NO_COUNTER  # of the last command that was committed
        self._decide_ns = 0  # and when
        self._sent_counter: int | None = None  # counter of the command that answered the newest sample
        self._unobeyed = LeakyCount(bench.watch.stop_missed)  # periods in which the node obeyed no command
        self._lost = LeakyCount(bench.watch.stop_missed)  # periods without a valid pair
        self._skipped = 0  # samples that the node's counter has skipped, and its device time has not
        self._was_active = False  # the node has obeyed a command of this run
        self._status: StatusFrame | None = None  # the newest status judged
        self._active_then = False  # it came when the node had obeyed
        self._past = NO_PAST  # the last own commands, newest first
        self._answered: int | None = None  # counter of the sample that the newest of them answered
        self._permitted = True
        self._estimate: tuple[float, ...] = ()  # the latest
        self._estimates = not self.homing and bool(estimated(bench))  # there is an estimate, and it was finite so far
        self._condition_met = False
        self._met_ns = 0  # from the first sample to that at which it was met, device time
        self._silent: SensorSample | None = None  # the newest one before arming
        self._armed = False
        self._stopped = False  # a sample since the stop began says that the node obeys no more
        self._rests = False  # the newest sample since then says idle
        self._stopping: list[SensorSample] = []  # the last ones since then
        self._detail = ""  # of the fault

    # --- what the driver asks ---------------------------------------------------------------------------------------

    @property
    def state(self) -> RunState:
        """State of the run."""
        return self._machine.run.state

    @property
    def fault(self) -> Fault | None:
        """First fault that latched."""
        return self._machine.run.fault

    @property
    def running(self) -> bool:
        """Returns True until the run has been completed or has failed."""
        return self.state not in ENDING

    @property
    def at_rest(self) -> bool:
        """Returns True if the node has come to rest after the stop frames, and its status says why it stopped."""
        return self._rests and self._reception.stop_reason is not None

    @property
    def deadline_ns(self) -> int:
        """Time until which the next frames are waited for, monotonic [ns]."""
        if self.state is SILENT:
            return min(self._give_up_ns, self._now_ns + SILENT_WAIT * self._period_ns)
        return self._deadline_ns

    @property
    def newest_counter(self) -> int:
        """Counter of the newest sample; 0 before the first."""
        return self._last.counter if self._last else 0

    # --- the run ----------------------------------------------------------------------------------------------------

    def begin(self, now_ns: int) -> None:
        """Begin to listen for the node."""
        self._now_ns = now_ns
        self._give_up_ns = now_ns + round(self.bench.watch.start_timeout * 1e9)
        self._machine.handle_event(Event.PREPARED, now_ns)

    def take(self, frames: Sequence[Frame], now_ns: int) -> Proposal | None:
        """Take the frames of one read, in hand at a monotonic time [ns]; gives a command for the newest sample."""
        self._now_ns = now_ns
        newest: SensorSample | None = None
        for left, frame in enumerate(frames, 1 - len(frames)):
            self.records.append(tuple.__new__(FrameRecord, (frame, now_ns if left == 0 else 0)))
            try:
                newest = self._take(frame, newest) if self.state is not OVER else None
            except StopError as stop:
                self.fail(stop.fault, self._now_ns, stop.detail)
                newest = None
        if not self.running:
            return None
        try:
            self._check_bus()
            if self.state is SILENT:
                self._wait_for_node()
                return None
            return None if newest is None else self._propose(newest)
        except StopError as ended:
            self.fail(ended.fault, now_ns, ended.detail)
        return None

    def commit(self, proposal: Proposal, now_ns: int) -> Frame | None:
        """Frame that answers a sample, decided at a monotonic time [ns]; None if it is left to the node."""
        sample, step, _, decision = proposal
        self._decide_ns = now_ns
        if self._may_answer(sample, decision, now_ns):
            self._counter = self.guard.next_counter
            return self.layout.encode_command(self._counter, sample.counter, decision.current, True)
        self._remember(0.0)
        in_time = now_ns - sample.receive_time_ns <= self._latest_answer_ns
        left = decision.reasons & Reason.LEFT if in_time else Reason.NONE
        self._leave_unanswered(sample, self._missed, now_ns, left)
        self._end_cycle(sample, step)
        return None

    def sent(self, proposal: Proposal, now_ns: int, lost: str = "") -> None:
        """Record the cycle of a command that was handed to the bus at a monotonic time [ns].

        Where the bus had no room for it, ``lost`` says so: sent later, it would answer an old sample.
        """
        sample, step, wanted, decision = proposal
        if lost:
            self.counters.not_taken += 1
            self._machine.note(Fault.SEND_QUEUE_FULL, lost, self._decide_ns)
            self._remember(0.0)
            self._leave_unanswered(sample, self._missed, self._decide_ns)
        else:
            current = round(decision.current / self._current_step) * self._current_step  # what is on the bus
            self._remember(current)
            self._answered = sample.counter
            self._sent_counter = self._counter
            self.counters.count_answer(decision.reasons, current)
            currents = wanted, decision.clipped, current
            self._record(sample, step, decision.reasons, self._missed, self._decide_ns, currents, self._counter, now_ns)
        self._end_cycle(sample, step)

    def timeout(self, now_ns: int) -> None:
        """Count that no frame came until :attr:`deadline_ns`."""
        self._now_ns = now_ns
        try:
            if self.state is SILENT:
                self._wait_for_node()
            elif self.running:
                self._miss()
        except StopError as stop:
            self.fail(stop.fault, self._now_ns, stop.detail)

    def fail(self, fault: Fault, now_ns: int, detail: str = "") -> None:
        """Latch a fault, and record it."""
        self.latch(fault, now_ns)
        self.explain(fault, detail)

    def latch(self, fault: Fault, now_ns: int) -> None:
        """Latch a fault that was raised in the driver; :meth:`explain` records it, once a stop frame has left."""
        self._machine.latch(fault, now_ns)

    def explain(self, fault: Fault, detail: str) -> None:
        """Record a fault that was latched."""
        self._detail = self._detail or detail
        self._machine.explain(fault, detail)

    def stop_frame(self) -> Frame:
        """Next stop frame."""
        return self.layout.encode_command(self.guard.next_counter, self.newest_counter, 0.0, False)

    def end(self, now_ns: int) -> None:
        """Judge how the node came to rest; the run is over."""
        self._now_ns = now_ns
        if self.fault in OF_RESPONSE:
            response = self._response
            named = cause(self.bench, response.model, response.rows, response.stop, response.proven)
            self._detail = "; ".join(filter(None, (self._detail, named)))
        speed = unheld_motion(self.bench, self._stopping)
        if self.fault is None and not self._rests:
            self.fail(
                Fault.NOT_AT_REST,
                now_ns,
                f"the node's last state is {self._last.node_state.name}" if self._last else "",
            )
        elif self.fault is None and speed:
            moves = f"in the stop the node goes on to measure {speed:.1f} rad/s, where friction holds any brake"
            self.fail(Fault.MOTION_UNEXPLAINED, now_ns, moves)
        self._machine.handle_event(Event.STOPPED, now_ns)

    def note(self, time_ns: int, code: str, text: str) -> None:
        """Record an event."""
        self.records.append(EventRecord(time_ns, code, text))

    def outcome(self) -> Outcome:
        """Outcome of the run, when it is over."""
        end, last, reception = self._end if self._armed else None, self._last, self._reception
        self.counters.rejected, self.counters.dropped = reception.rejected, reception.dropped
        return Outcome(
            fault=self.fault,
            detail=self._detail,
            counters=self.counters,
            armed=self._armed,
            end_angle=end.angle if end else NAN,
            end_velocity=end.velocity if end else NAN,
            home=self.fault is None and end is not None and self._bounds.is_home(end),
            node_state=last.node_state if last else None,
            node_at_rest=self._rests,
            node_stop_reason=reception.stop_reason,
            last_angle=last.angle if last else NAN,
            duration_ns=end.device_time_ns - self._start_ns if end and self._start_ns else 0,
            rejections=reception.rejections(),
            bus_errors=dict(reception.bus_errors),
            estimate=self._estimate,
            model_fits=self._estimator.fits,
            goal_reached=self._condition_met,
            goal_ns=self._met_ns,
            unexplained=self._unexplained[0],
            allowed=self._unexplained[1],
            response=self._response.text if self._response.proven else "",
        )

    # --- in every state: what the bus says --------------------------------------------------------------------------

    def _take(self, frame: Frame, newest: SensorSample | None) -> SensorSample | None:
        """Take a frame; gives the newest sample of the read that is to be answered."""
        while frame.time_ns >= self._deadline_ns and self.state in IN_CONTROL:
            self._miss()
        missed = self._missed
        sample = self._sample(frame)
        if sample is None:
            return newest
        if self.state not in IN_CONTROL:
            if self.state is SILENT:
                self._judge_node(sample)
            return None
        if newest is not None:  # overtaken: the node obeys an answer to its newest sample only
            self._remember(*NO_PAST[:missed], 0.0)
            self._leave_unanswered(newest, missed)
        return sample

    def _sample(self, frame: Frame) -> SensorSample | None:
        """Sample that a frame completes."""
        if frame.own:
            self.counters.confirmed += 1
            return None
        dropped = self._reception.dropped
        sample = self._reception.take(frame)
        if frame.error:
            self._count_error(frame)
            return None
        if self._reception.dropped > dropped:
            self._machine.note(Fault.FRAMES_DROPPED, f"{self._reception.dropped} so far", frame.time_ns)
        if sample is None:
            return None
        before, self._last = self._last, sample
        self._machine.handle_event(PAIR, sample.receive_time_ns)
        state = self.state
        if state is STOPPING:
            self._watch_rest(sample)
            return sample
        self._end = sample
        self._deadline_ns = sample.receive_time_ns + self._period_ns * 3 // 2
        if before is not None and may_enable(state):
            self._follow(before, sample)
        return sample

    def _count_error(self, frame: Frame) -> None:
        self.counters.bus_errors += 1
        if BUS_OFF in self._reception.bus_errors and self.running:
            raise StopError(Fault.BUS_LOST, "the CAN controller reports bus-off: it has stopped taking part")
        if self.counters.bus_errors == 1:
            self._machine.note(Fault.BUS_ERRORS, ", ".join(self._reception.bus_errors), frame.time_ns)

    def _watch_rest(self, sample: SensorSample) -> None:
        self._response.watch(sample)
        if sample.node_state is not OBEYING and not self._stopped:
            self._stopped = True
            self._reception.status = None  # its reason was that of another stop
        self._rests = sample.node_state is IDLE
        self._stopping = [*self._stopping[1 - REST_SAMPLES :], sample]

    def _check_bus(self) -> None:
        if self._reception.foreign_command:
            raise StopError(Fault.FOREIGN_COMMAND, f"identifier {self.layout.command.identifier:#05x}")
        if self._reception.too_many_rejected:
            raise StopError(Fault.FRAMES_REJECTED, f"{self._reception.rejected} so far")

    def _miss(self) -> None:
        # The deadline and not the clock: a computer that stood still has frames waiting, and they come first.
        deadline_ns = self._deadline_ns
        self._deadline_ns += self._period_ns
        self._machine.handle_event(Event.TIME, deadline_ns)

    def _on_rejected(self, frame: Frame, why: str) -> None:
        self.note(frame.time_ns, "FRAME_REJECTED", why)

    # --- SILENT: until the node has shown itself --------------------------------------------------------------------

    def _wait_for_node(self) -> None:
        try:
            self._machine.handle_event(Event.TIME, self._now_ns)
        except StopError as stop:
            unpaired = self._reception.pairing_problem
            fault = Fault.NODE_NOT_READY if unpaired else stop.fault
            raise StopError(fault, self._not_ready or unpaired or stop.detail) from None

    def _judge_node(self, sample: SensorSample) -> None:
        """Arm, if enough samples in a row meet the start conditions."""
        reason = self._start_conditions.not_ready(self._reception.status, sample, self._now_ns)
        before = self._silent
        gap_ns = 0 if before is None else sample.device_time_ns - before.device_time_ns
        in_row = self._ready > 0 and not reason and gap_ns < self._period_ns * 3 // 2
        steady = self.guard.learn_time(sample, first=not in_row)
        self._ready = 0 if reason else self._ready + 1 if in_row and steady else 1
        self._warm_up(sample)
        self._silent, self._not_ready = sample, reason or ("" if steady else UNSTEADY)
        if self._ready == READY_PAIRS:
            self._machine.handle_event(Event.NODE_READY, self._now_ns)
            self._armed = True

    def _warm_up(self, sample: SensorSample) -> None:
        """Judge and decide for nothing: Python runs code several times before it runs it fast, and first cycles count.

        The monitor begins anew with the experiment.
        """
        self._monitor.begin(sample)
        with contextlib.suppress(StopError):
            self._monitor.check(self.law.sample_time, sample, True, 0.0)
        self._monitor.largest_current(self._limits.current)
        self._response.begin(sample)
        with contextlib.suppress(StopError):
            self._response.take(sample, True, 0.0)
        self._balance.begin(sample)
        self._balance.take(sample, True)
        self._balance.judge()
        self._estimator.begin()
        self._estimator.take(sample.angle, sample.velocity, 0, sample.applied_current)
        decide(self.law, self._limits, sample.angle, sample.velocity, 0.0, NO_PAST, 0.0, 0)

    # --- ACTIVE or HOMING: one cycle per sample ---------------------------------------------------------------------

    def _propose(self, sample: SensorSample) -> Proposal | None:
        """Decide on a command for a sample, the first of the run or a later one."""
        # Before its device time says which step it is, or that it is the last one. A stamp may be just ahead of now.
        self.guard.judge_time(sample, max(self._now_ns, sample.receive_time_ns))
        if self.state is ARMED:
            self._begin(sample)
        else:
            returns = self.homing or self._condition_met
            self._at_home = self._at_home + 1 if returns and self._bounds.is_home(sample) else 0
        step = self._step_of(sample)
        # With a wrong sign beyond the last sample as well, until friction has stopped the brake: that ends as a fault.
        if (step >= self.steps or self._at_home >= HOME_PAIRS) and self._reversed is None:
            self._finish(sample, step)
            return None
        self._check_sample(sample)
        if self._missed:
            self._remember(*NO_PAST[: self._missed])
        self._estimator.take(sample.angle, sample.velocity, step, sample.applied_current)
        asked = self.actor.act(sample.angle, sample.velocity, step, self._estimator)
        wanted = checked(asked, self.current_limit)
        return tuple.__new__(Proposal, (sample, step, wanted, self._decide(sample, wanted, step)))

    def _begin(self, sample: SensorSample) -> None:
        self._start_ns = sample.device_time_ns
        self._machine.handle_event(Event.BEGIN_HOMING if self.homing else Event.BEGIN, self._now_ns)
        self._monitor.begin(sample)
        self._response.begin(sample)
        self._balance.begin(sample)
        self._estimator.begin()
        self.counters.pairs = 1

    def _finish(self, sample: SensorSample, step: int) -> None:
        """Judge the whole run at its last sample."""
        self._record(sample, step, Reason.NONE, self._missed)
        if self.homing:
            if self._at_home < HOME_PAIRS:
                raise StopError(Fault.NOT_HOME, f"at {sample.angle:.2f} rad after {step} periods")
        else:
            if why := self._incomplete(sample, min(step, self.steps)):
                raise StopError(Fault.INCOMPLETE, why)
            self._judge_motion()
            self._unexplained = self._balance.judge()
            self._balance.judge_zero()
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

    def _check_sample(self, sample: SensorSample) -> None:
        """Leave the run if the brake or the node is not where it must be."""
        if outside := self._bounds.outside(sample):
            raise StopError(Fault.OUT_OF_LIMITS, outside)
        if sample.node_state in UNFIT:
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
        self._was_active |= sample.node_state is OBEYING
        if sample.node_state is IDLE and (self._was_active or sample.command_counter != NO_COUNTER):
            return "the node's state is IDLE after it has obeyed a command of this run"
        status = self._reception.status
        if status is self._status:
            return ""
        # The first one may be from before the run, when the node was still in another stop.
        found = self._contradicted(status) if self._status is not None and status is not None else ""
        self._status = status
        return found or self._start_conditions.mismatch(status)

    def _contradicted(self, status: StatusFrame) -> str:
        """Contradiction of a new status to the pairs, in words; empty if there is none.

        A node that stops or has a fault is not in control, whatever its pairs say: an honest one that sends its status
        first ends the run with its next pair. That it is idle it may have sent just before it obeyed the first command,
        but not once an earlier status has come while it did.
        """
        before, self._active_then = self._active_then, self._was_active
        if status.node_state in UNFIT:
            raise StopError(Fault.NODE_STOPPED, f"the node's status says {status.node_state.name}")
        idle = before and status.node_state is IDLE
        return "the node's status says IDLE while its pairs say ACTIVE" if idle else ""

    def _decide(self, sample: SensorSample, wanted: float, step: int) -> Decision:
        """Command for a sample, in the shield's view of time: on the way home the end is always near."""
        follows = self._answered is not None and sample.counter == next_counter(self._answered)
        last = self._past[0] if follows else 0.0
        if self._reversed is not None:
            slew = self._limits.slew
            return Decision(0.0, min(max(0.0, last - slew), last + slew), Reason.LIMITED)
        if self.homing:
            step = self._late_step
        elif self._condition_met:
            step, wanted = max(step, self._late_step), 0.0
        limits = self._limits
        if (most := self._monitor.largest_current(limits.current)) < limits.current:
            limits = limits._replace(current=max(most, abs(last) - limits.slew))  # down to it as fast as may be
        # Before the sign is shown the current is limited to what friction can stop: a way home may need it all.
        law = self._response.law if self._monitor.obeys else self.law
        decision = decide(law, limits, sample.angle, sample.velocity, wanted, self._past, last, step)
        return decision._replace(reasons=decision.reasons | Reason.RETURNING) if self._condition_met else decision

    def _may_answer(self, sample: SensorSample, decision: Decision, decide_ns: int) -> bool:
        """Returns True if the command is not late, every message of the node permits it, and there is one."""
        if decide_ns - sample.receive_time_ns > self._latest_answer_ns:  # late: the sample that it answers is stale
            return False
        if self.guard.too_fast(decide_ns):  # samples came in a burst, and there is a newer one
            return False
        why = self._reception.inhibit_reason(decide_ns)
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
        self._record(sample, self._step_of(sample), reasons or Reason.MISSED, missed, decide_ns)

    def _end_cycle(self, sample: SensorSample, step: int) -> None:
        """Record what is known at a sample, and judge the motion so far."""
        if self._estimates:
            self._keep_estimate(self._estimator.estimate, sample, step)
        try:
            self._judge_motion()
        except StopError as stop:
            self.fail(stop.fault, self._now_ns, stop.detail)

    def _keep_estimate(self, estimate: tuple[float, ...], sample: SensorSample, step: int) -> None:
        """Record the estimate; once it meets the stop condition, all that is left is the way home.

        Once it is not finite, the run has none.
        """
        self._estimate = estimate
        if not estimate:
            self._estimates = False
            text = "not finite: the measurements do not fit the bench's noise; the run goes on without an estimate"
            self.note(sample.receive_time_ns, LOST, text)
            return
        self.records.append(EstimateRecord(sample.receive_time_ns, step, estimate))
        condition = self.stop_condition
        if condition is not None and not self._condition_met and condition.reached(estimate):
            self._condition_met = True
            self._met_ns = sample.device_time_ns - self._start_ns
            self.note(sample.receive_time_ns, REACHED, condition.describe(estimate))

    def _remember(self, *currents: float) -> None:
        """Keep the commands of the periods that have passed, oldest first [A]."""
        for current in currents:
            self._past = (current, *self._past[:4])

    # --- consecutive samples ----------------------------------------------------------------------------------------

    def _follow(self, before: SensorSample, sample: SensorSample) -> None:
        """Count the periods between two samples, and check that the node obeyed and that the sensors can be right."""
        self._judge_motion()
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
        self._judge_sensors(elapsed_ns * 1e-9, sample, sent and obeyed, self._past[0] if sent else 0.0, gap)
        if not self.homing and self._reversed is None:
            self._unbalanced = sample, sent and obeyed and gap == 1

    def _judge_motion(self) -> None:
        """Take the newest sample into the balance, which no command depends on: once its own has left."""
        if self._unbalanced is not None:
            (sample, follows), self._unbalanced = self._unbalanced, None
            self._balance.take(sample, follows)

    def _judge_sensors(self, elapsed: float, sample: SensorSample, obeyed: bool, command: float, gap: int) -> None:
        """End the run if the sensors cannot be right.

        With a wrong sign the node's own stop would drive the brake on: where the sign is not known to be right and
        friction alone can stop the brake, that is waited for with 0 A, and then the run ends. Meanwhile everything but
        the sensors' sums is judged as ever.
        """
        if self._reversed is not None:
            self._response.watch(sample)
            self._coasting -= elapsed
            if self._coasting <= 0.0:
                raise self._reversed
            return
        try:
            self._monitor.check(elapsed, sample, obeyed, command)
            self._response.take(sample, obeyed and gap == 1, command)
        except StopError as stop:
            if stop.fault is not Fault.RESPONSE_LATE:  # which has taken it
                self._response.watch(sample)
            self._coasting = self._monitor.coasting_time(sample)
            if self._coasting == 0.0:
                raise
            self._reversed = stop
            # Now, since something else may end the run meanwhile, and would hide it.
            self._machine.note(stop.fault, stop.detail, sample.receive_time_ns)

    def _record(
        self,
        sample: SensorSample,
        step: int,
        reasons: int,
        missed: int,
        decide_ns: int = 0,
        currents: tuple[float, float, float] = (NAN, NAN, NAN),
        command_counter: int = NO_COUNTER,
        send_ns: int = 0,
    ) -> None:
        """Record a cycle; ``currents`` are those of the policy, clipped, and sent [A]."""
        counter, angle, velocity, device_ns, receive_ns, applied, _, node_state = sample
        of_cycle = step, self.state, int(reasons), counter, command_counter, missed, node_state
        times = device_ns, receive_ns, self._now_ns, decide_ns, send_ns
        self.records.append(tuple.__new__(CycleRecord, (*of_cycle, angle, velocity, applied, *currents, *times)))


def latest_answer_ns(bench: Bench) -> int:
    """Age of a sample beyond which an answer cannot act any more in the period that it is meant for [ns]."""
    return min(1 + bench.shield.frame_age[1], OLDEST_SAMPLE_PERIODS) * bench.timing.sample_time_ns
