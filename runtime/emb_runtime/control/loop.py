"""One experiment: wait, read, check, decide, shield, guard, send, record, at the pace of the node's samples.

The loop reads no clock and opens no socket: time, reception, guard and journal are handed in, so that the same code
runs on a real bus, in lock-step simulation, and from a log. The node's own 1 kHz clock sets the pace; a pair that
does not come in time is a missed period on a grid that runs on from the last arrival: it is counted, and nothing is
sent for it. What is sent answers the newest sample or is not sent: nothing repeats a command.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from emb_runtime.can.e2e import NO_COUNTER, next_counter
from emb_runtime.can.messages import Layout
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import CEILING_CURRENT, Bench
from emb_runtime.control.result import Outcome, RunCounters
from emb_runtime.control.sample_receiver import Listener
from emb_runtime.control.start_conditions import Bounds, StartConditions
from emb_runtime.control.stop_condition import REACHED, StopCondition
from emb_runtime.errors import BusError, PolicyRefusedError
from emb_runtime.log.ring_buffer import Level
from emb_runtime.records import CurrentCommand, CycleRecord, Frame, NodeState, Reason, RunState, SensorSample
from emb_runtime.safety.command_limits import Decision, Reach, checked, decide
from emb_runtime.safety.guard import OLDEST_SAMPLE_PERIODS, Guard, GuardRejectedError
from emb_runtime.safety.heartbeat import STOP_FRAMES, Pulse, Unwatched
from emb_runtime.safety.run_state import Journal, StateMachine
from emb_runtime.safety.shield import NO_PAST
from emb_runtime.safety.shield_design import ShieldLaw
from emb_runtime.safety.state_machine import Event, Fault, StopError, may_enable, timeouts
from emb_runtime.system.clock import Clock

READY_PAIRS = 10
"""Valid pairs in a row, idle and where the run may begin, before the loop arms."""
HOME_PAIRS = 50
"""Valid pairs in a row, at home, that end a way home."""
STOP_LISTEN_NS = 400_000_000
"""How long to watch the node come to rest after the stop frames, so that the log shows it [ns]."""

NAN = math.nan


class Actor(Protocol):
    """What decides."""

    @property
    def estimate(self) -> tuple[float, ...]:
        """What it now holds some quantities for, then their standard deviations; empty if it estimates nothing."""
        ...

    def begin(self) -> None:
        """Forget what was seen: a run begins."""
        ...

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """Current wanted for the period that begins at this sample [A]; the last argument acted in the one before."""
        ...


@dataclass
class Loop:
    """One run: an experiment, or the way home. Make it, :meth:`run` it once."""

    bench: Bench
    layout: Layout
    law: ShieldLaw
    actor: Actor
    current_limit: float
    """Largest current that the policy's contract allows it to ask for [A]."""
    steps: int
    """Samples to answer; on the way home, at most."""
    guard: Guard
    receive: Callable[[int], Frame | None]
    """Gives the next frame, or None at a deadline (monotonic [ns])."""
    clock: Clock
    journal: Journal
    stop_requested: Callable[[], bool]
    pulse: Pulse = field(default_factory=Unwatched)
    """To the watchdog process."""
    limit: float = CEILING_CURRENT
    """A current narrower than the bench's, where the operator asked for one [A]."""
    homing: bool = False
    """Begin anywhere, let the shield bring the brake home, and end when it rests there."""
    stop_condition: StopCondition | None = None
    """How well what has to be known for the way home to begin early."""
    overheard: Sequence[Frame] = ()
    """What was on the bus just before and must not be missed."""

    def __post_init__(self) -> None:
        """Set up what the cycles carry from one to the next."""
        self.counters = RunCounters()
        self._course = StateMachine(timeouts(self.bench), self.journal)
        self._ear = Listener(
            layout=self.layout,
            bench=self.bench,
            receive=self.receive,
            clock=self.clock,
            journal=self.journal,
            course=self._course,
            pulse=self.pulse,
            counters=self.counters,
            stop_requested=self.stop_requested,
            overtaken=self._overtaken,
        )
        self._period_ns = self.bench.timing.sample_time_ns
        self._latest_answer_ns = latest_answer_ns(self.bench)
        self._current_step = self.layout.command.signal("Current").factor
        self._bounds = Bounds(self.bench)
        self._start_conditions = StartConditions(self.bench, self.layout, self._bounds, anywhere=self.homing)
        limit = self.layout.current_within(min(self.limit, self.bench.limits.current))
        self._reach = Reach(limit, self.bench.guard.slew * self.bench.timing.sample_time)
        self._past = NO_PAST  # the last own commands, newest first
        self._answered: int | None = None  # counter of the sample that the newest of them answered
        self._permitted = True
        self._start_ns = 0
        self._late_step = self.law.steps - 2 - math.ceil(self.law.settling / self.law.sample_time)
        self._estimate: tuple[float, ...] = ()  # the actor's latest
        self._known = False  # the goal is reached

    @property
    def state(self) -> RunState:
        """Where the run stands."""
        return self._course.state

    def run(self) -> Outcome:
        """Arm, run, stop. Whatever happens, what was armed ends with stop frames."""
        fault, detail = None, ""
        try:
            self._course.handle_event(Event.PREPARED, self.clock.now_ns())
            self._ear.overhear(self.overheard)
            self._await_node()
            self._act()
        except StopError as stop:
            fault, detail = stop.fault, stop.detail
        except GuardRejectedError as err:
            fault, detail = Fault.GUARD_REJECTED, str(err)
        except PolicyRefusedError as err:
            fault, detail = Fault.POLICY_NOT_FINITE, str(err)
        except BusError as err:
            fault, detail = Fault.BUS_LOST, str(err)
        except Exception as err:
            # Invariant: from here on only stop frames can leave.
            fault, detail = Fault.INTERNAL, _one_line(err)
            self.journal.push_log(self.clock.now_ns(), Level.FATAL, traceback.format_exc(limit=-3))
        if fault is not None and self.pulse.tripped:  # it takes the bus from this process: that is the cause
            fault = Fault.WATCHDOG_TRIPPED
        armed = self.state not in (RunState.INIT, RunState.SILENT)
        end = self._ear.last if armed else None
        if fault is not None:
            self._course.fail(fault, detail, self.clock.now_ns())
        at_rest = self._stop() if self.state is RunState.STOPPING else False
        fault = self._course.run.fault
        reception = self._ear.reception
        self.counters.rejected, self.counters.dropped = reception.rejected, reception.dropped
        last = self._ear.last
        return Outcome(
            fault=fault,
            detail=detail,
            counters=self.counters,
            armed=armed,
            end_angle=end.angle if end else NAN,
            end_velocity=end.velocity if end else NAN,
            home=fault is None and end is not None and self._bounds.is_home(end),
            node_state=last.node_state if last else None,
            node_at_rest=at_rest,
            node_stop_reason=reception.stop_reason,
            last_angle=last.angle if last else NAN,
            duration_ns=end.device_time_ns - self._start_ns if end and self._start_ns else 0,
            rejections=reception.rejections(),
            bus_errors={str(name): count for name, count in reception.bus_errors.counts.items()},
            estimate=self._estimate,
            goal_reached=self._known,
        )

    # --- SILENT: listen until the node has shown itself -------------------------------------------------------------

    def _await_node(self) -> None:
        deadline_ns = self.clock.now_ns() + round(self.bench.watch.start_timeout * 1e9)
        ready = 0
        reason = ""
        while ready < READY_PAIRS:
            self._ear.check_requests()
            now_ns = self.clock.now_ns()
            try:
                self._course.handle_event(Event.TIME, now_ns)
            except StopError as stop:
                raise StopError(stop.fault, reason or stop.detail) from None
            before = self._ear.last
            sample = self._ear.hear(min(deadline_ns, now_ns + 10 * self._period_ns))
            if sample is not None:
                reason = self._start_conditions.not_ready(self._ear.reception.status, sample, self.clock.now_ns())
                gap_ns = 0 if before is None else sample.device_time_ns - before.device_time_ns
                ready = 0 if reason else ready + 1 if gap_ns < self._period_ns * 3 // 2 else 1
        self._course.handle_event(Event.NODE_READY, self.clock.now_ns())

    # --- ACTIVE or HOMING: one cycle per sample ---------------------------------------------------------------------

    def _act(self) -> None:
        sample = self._ear.next_sample()
        self._start_ns = sample.device_time_ns
        now_ns = self.clock.now_ns()
        self.pulse.arm(now_ns)
        self._course.handle_event(Event.BEGIN_HOMING if self.homing else Event.BEGIN, now_ns)
        self.counters.pairs = 1
        self.actor.begin()
        at_home = 0
        while (step := self._step_of(sample)) < self.steps and at_home < HOME_PAIRS:
            self._answer(sample, step)
            if self.actor.estimate:
                self._learn(sample, step)
            sample = self._ear.next_sample()
            returns = self.homing or self._known
            at_home = at_home + 1 if returns and self._bounds.is_home(sample) else 0
        self._record(sample, step, Reason.NONE, missed=self._ear.missed)
        if self.homing and at_home < HOME_PAIRS:
            raise StopError(Fault.NOT_HOME, f"at {sample.angle:.2f} rad after {step} periods")
        self._course.handle_event(Event.FINISHED, self.clock.now_ns())

    def _step_of(self, sample: SensorSample) -> int:
        """Index of a sample on the run's grid, by the node's own clock."""
        return round((sample.device_time_ns - self._start_ns) / self._period_ns)

    def _answer(self, sample: SensorSample, step: int) -> None:
        self._ear.check_requests()
        self._check_sample(sample)
        self._remember(*NO_PAST[: self._ear.missed])
        asked = self.actor.act(sample.angle, sample.velocity, step, sample.applied_current)
        wanted = checked(asked, self.current_limit)
        decision = self._decide(sample, wanted, step)
        decide_ns = self.clock.now_ns()
        if not self._may_answer(sample, decision, decide_ns):
            self._remember(0.0)
            in_time = decide_ns - sample.receive_time_ns <= self._latest_answer_ns
            left = decision.reasons & Reason.LEFT if in_time else Reason.NONE
            self._leave_unanswered(sample, self._ear.missed, decide_ns, left)
            return
        command = CurrentCommand(self.guard.next_counter, sample.counter, decision.current, enable=True)
        try:
            self._send(command, sample.receive_time_ns, decide_ns)
        except TransmitQueueFullError as err:  # lost: sent later, it would answer an old sample
            self.counters.not_taken += 1
            self._course.note(Fault.SEND_QUEUE_FULL, str(err), decide_ns)
            self._remember(0.0)
            self._leave_unanswered(sample, self._ear.missed, decide_ns)
            return
        send_ns = self.clock.now_ns()
        current = round(decision.current / self._current_step) * self._current_step  # what is on the bus
        self._remember(current)
        self._answered = sample.counter
        self._ear.sent_counter = command.counter
        self._count(decision.reasons, current)
        self._record(
            sample, step, decision.reasons, missed=self._ear.missed,
            command_counter=command.counter, wanted=wanted, clipped=decision.clipped, sent=current,
            decide_ns=decide_ns, send_ns=send_ns,
        )  # fmt: skip

    def _decide(self, sample: SensorSample, wanted: float, step: int) -> Decision:
        """What to send, in the shield's view of time: on the way home the end is always near."""
        follows = self._answered is not None and sample.counter == next_counter(self._answered)
        last = self._past[0] if follows else 0.0
        if self.homing:
            step = self._late_step
        elif self._known:
            step, wanted = max(step, self._late_step), 0.0
        decision = decide(self.law, self._reach, sample.angle, sample.velocity, wanted, self._past, last, step)
        return decision._replace(reasons=decision.reasons | Reason.RETURNING) if self._known else decision

    def _learn(self, sample: SensorSample, step: int) -> None:
        """Keep what the actor estimates; once that is known well enough, all that is left is the way home."""
        self._estimate = self.actor.estimate
        self.journal.push_estimate(sample.receive_time_ns, step, self._estimate)
        if self.stop_condition is not None and not self._known and self.stop_condition.reached(self._estimate):
            self._known = True
            self.journal.push_event(sample.receive_time_ns, REACHED, self.stop_condition.describe(self._estimate))

    def _may_answer(self, sample: SensorSample, decision: Decision, decide_ns: int) -> bool:
        """Whether there is something to send, in time, by leave of all messages."""
        if decide_ns - sample.receive_time_ns > self._latest_answer_ns:
            return False
        why = self._ear.reception.permitted(decide_ns)
        if why and self._permitted:
            self._course.note(Fault.PERMISSION_LOST, why, decide_ns)
        self._permitted = not why
        return not (why or math.isnan(decision.current))

    def _check_sample(self, sample: SensorSample) -> None:
        """Leave the run if the brake or the node is not where it must be."""
        if outside := self._bounds.outside(sample):
            raise StopError(Fault.OUT_OF_LIMITS, outside)
        if sample.node_state in (NodeState.STOPPING, NodeState.FAULT):
            raise StopError(Fault.NODE_STOPPED, f"it says {sample.node_state.name}")
        if self._ear.unobeyed >= self.bench.watch.stop_missed:
            raise StopError(Fault.NOT_OBEYED, f"{self._ear.unobeyed} periods in a row")
        self.guard.judge(sample)

    def _leave_unanswered(self, sample: SensorSample, missed: int, decide_ns: int = 0, reasons: int = 0) -> None:
        """Nothing is sent for this one: the node brakes in its period, counted here."""
        if not may_enable(self.state):
            return
        self.counters.unanswered += 1
        self.counters.left += bool(reasons)
        self._ear.unobeyed += 1
        self._record(sample, self._step_of(sample), reasons or Reason.MISSED, missed=missed, decide_ns=decide_ns)

    def _overtaken(self, sample: SensorSample, missed: int) -> None:
        self._remember(*NO_PAST[:missed], 0.0)
        self._leave_unanswered(sample, missed)

    def _remember(self, *currents: float) -> None:
        """The commands of the periods that have passed, oldest first [A]."""
        for current in currents:
            self._past = (current, *self._past[:4])

    def _send(self, command: CurrentCommand, sample_time_ns: int, now_ns: int) -> None:
        self.guard.send(self.layout.encode_command(command), self.state, sample_time_ns, now_ns)

    # --- STOPPING ---------------------------------------------------------------------------------------------------

    def _stop(self) -> bool:
        """Send the stop frames, then watch until the node is idle; gives whether it was."""
        if not self.pulse.tripped:  # else the watchdog has sent them, and this process may not talk any more
            for _ in range(STOP_FRAMES):
                self._send_stop_frame()
                # Each in a period of its own: what stood in the way of one may be gone for the next.
                self._watch(self.clock.now_ns() + self._period_ns)
                self.pulse.beat(self.clock.now_ns())
        self.pulse.disarm()
        if self.pulse.tripped and self._course.run.fault is None:  # while the stop frames went out
            self._course.fail(Fault.WATCHDOG_TRIPPED, "", self.clock.now_ns())
        self._ear.reception.status = None  # what it said of a stop was of another one
        at_rest = self._watch(self.clock.now_ns() + STOP_LISTEN_NS, until_idle=True)
        self._course.handle_event(Event.STOPPED, self.clock.now_ns())
        return at_rest

    def _send_stop_frame(self) -> None:
        try:
            now_ns = self.clock.now_ns()
            last = self._ear.last
            stop = CurrentCommand(self.guard.next_counter, last.counter if last else 0, 0.0, enable=False)
            self._send(stop, now_ns, now_ns)
        except Exception as err:  # whatever is broken, the next stop frame is still tried
            self.journal.push_event(self.clock.now_ns(), "STOP_FRAME_NOT_SENT", _one_line(err))

    def _watch(self, deadline_ns: int, until_idle: bool = False) -> bool:
        """Listen on a bus that may be broken; gives whether the node said idle."""
        try:
            return self._ear.watch(deadline_ns, until_idle)
        except Exception as err:  # the run is being stopped: nothing may keep it from its end
            self.journal.push_event(self.clock.now_ns(), "LISTENING_FAILED", _one_line(err))
            return False

    # --- records ----------------------------------------------------------------------------------------------------

    def _count(self, reasons: int, current: float) -> None:
        counters = self.counters
        counters.answered += 1
        counters.clipped += bool(reasons & Reason.CLIPPED)
        counters.limited += bool(reasons & Reason.LIMITED)
        counters.returning += bool(reasons & Reason.RETURNING)
        counters.top_current = max(counters.top_current, abs(current))

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
                wake_time_ns=self._ear.wake_ns,
                decide_time_ns=decide_ns,
                send_time_ns=send_ns,
            )
        )


def latest_answer_ns(bench: Bench) -> int:
    """Age of a sample beyond which an answer cannot act any more in the period that it is meant for [ns]."""
    return min(1 + bench.shield.frame_age[1], OLDEST_SAMPLE_PERIODS) * bench.timing.sample_time_ns


def _one_line(err: Exception) -> str:
    return f"{type(err).__name__}: {err}".partition("\n")[0]
