"""One experiment: wait, read, check, decide, shield, guard, send, record, at the pace of the node's samples.

The loop reads no clock and opens no socket: time, reception, guard and journal are handed in, so that the same code
runs on a real bus, in lock-step simulation, and from a log. The node's own 1 kHz clock sets the pace; a pair that
does not come in time is a missed period on a grid that runs on from the last arrival: it is counted, and nothing is
sent for it. What is sent answers the newest sample or is not sent: nothing repeats a command.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from emb_runtime.bench import Bench
from emb_runtime.clock import Clock
from emb_runtime.e2e import NO_COUNTER
from emb_runtime.errors import BusError, PolicyRefusedError
from emb_runtime.frames import Layout, StopReason, bench_identity
from emb_runtime.guard import OLDEST_SAMPLE_PERIODS, Guard, GuardRejectedError
from emb_runtime.reception import Reception
from emb_runtime.records import (
    CurrentCommand,
    CycleRecord,
    Frame,
    NodeState,
    Reason,
    RunState,
    SensorSample,
)
from emb_runtime.ring import Level
from emb_runtime.shield import ShieldLaw, shield
from emb_runtime.states import FAULTS, Event, Fault, next_state
from emb_runtime.transport import is_bus_off

READY_PAIRS = 10
"""Valid pairs in a row, idle and at home, before the loop arms."""
STOP_FRAMES = 3
"""Stop frames on every way out; one would do, and the bus may lose one."""
STOP_LISTEN_NS = 400_000_000
"""How long to watch the node come to rest after the stop frames, so that the log shows it [ns]."""
DRAIN_FRAMES = 64
"""Most frames looked at, after a pair, for a newer one: a babbling node must not hold the loop."""

NAN = math.nan


class Journal(Protocol):
    """Where the loop writes; never waits."""

    def push_frame(self, frame: Frame) -> None:
        """A frame that was on the bus."""

    def push_cycle(self, record: CycleRecord) -> None:
        """One control cycle."""

    def push_event(self, time_ns: int, code: str, text: str) -> None:
        """Something that the safety chain did."""

    def push_log(self, time_ns: int, level: Level, text: str) -> None:
        """A line for a person."""


class Actor(Protocol):
    """What decides."""

    def act(self, angle: float, velocity: float, step: float) -> float:
        """Current wanted for the period that begins at this sample [A]."""
        ...


@dataclass
class Tally:
    """What happened in a run, counted."""

    pairs: int = 0
    """Valid sensor pairs from the experiment's first sample to its closing one, which needs no answer."""
    answered: int = 0
    """Pairs answered by a command."""
    unanswered: int = 0
    """Pairs that a newer one had overtaken before they could be answered."""
    missed: int = 0
    """Sampling periods without a valid pair."""
    not_obeyed: int = 0
    """Commands that came too late for their period, by the node's own account."""
    rejected: int = 0
    """Frames rejected by the reception."""
    dropped: int = 0
    """Frames that the kernel dropped."""
    clipped: int = 0
    limited: int = 0
    """Commands changed to keep the brake inside its limits."""
    returning: int = 0
    """Commands that the shield took over to be home in time."""
    angle_min: float = 0.0
    angle_max: float = 0.0
    top_speed: float = 0.0
    top_current: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """How a run ended."""

    fault: Fault | None
    detail: str
    tally: Tally
    armed: bool
    end_angle: float
    """Measured at the experiment's last sample [rad]."""
    end_velocity: float
    home: bool
    """Whether that is home, and the experiment was complete."""
    node_state: NodeState | None
    """What the node said last."""
    node_at_rest: bool
    """Whether the node reported idle after the stop frames."""
    node_stop_reason: StopReason | None
    """Why the node last stopped, in its own latest words."""
    last_angle: float
    """Measured at the very last sample, after the stop frames [rad]."""
    duration_ns: int
    """From the first sample of the experiment to the last one, device time [ns]."""


class _StopError(Exception):
    """Leaves the experiment with a fault."""

    def __init__(self, fault: Fault, detail: str = "") -> None:
        super().__init__(fault.name)
        self.fault = fault
        self.detail = detail


@dataclass
class Loop:
    """One run of one experiment. Make it, :meth:`run` it once."""

    bench: Bench
    layout: Layout
    law: ShieldLaw
    actor: Actor
    current_limit: float
    """Largest current that the policy's contract allows it to ask for [A]."""
    steps: int
    """Samples to answer."""
    guard: Guard
    receive: Callable[[int], Frame | None]
    """Gives the next frame, or None at a deadline (monotonic [ns])."""
    clock: Clock
    journal: Journal
    stop_requested: Callable[[], bool]
    tally: Tally = field(default_factory=Tally)
    state: RunState = RunState.INIT

    def __post_init__(self) -> None:
        """Set up what the cycles carry from one to the next."""
        self._reception = Reception(self.layout, self.bench, self._on_rejected)
        self._period_ns = self.bench.timing.sample_time_ns
        self._latest_answer_ns = latest_answer_ns(self.bench)
        self._current_step = self.layout.command.signal("Current").factor
        noise, sigmas = self.bench.noise, self.bench.shield.noise_sigmas
        self._angle_slack, self._velocity_slack = sigmas * noise.angle, sigmas * noise.velocity
        self._sent = (0.0, 0.0, 0.0)  # the last own commands, newest first
        self._sent_counter: int | None = None  # of the command that answered the last sample
        self._unobeyed_in_a_row = 0
        self._last: SensorSample | None = None
        self._start_ns = 0
        self._wake_ns = 0
        self._missed_before = 0

    def run(self) -> Outcome:
        """Arm, run the experiment, stop. Whatever happens, what was armed ends with stop frames."""
        fault, detail = None, ""
        try:
            self._move(Event.PREPARED)
            self._await_node()
            self._experiment()
        except _StopError as stop:
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
        armed = self.state in (RunState.ARMED, RunState.ACTIVE, RunState.STOPPING)
        end = self._last if armed else None
        if fault is not None:
            self._report(fault, detail)
            self._move(Event.FAULT)
        at_rest = self._stop() if self.state is RunState.STOPPING else False
        self.tally.rejected, self.tally.dropped = self._reception.rejected, self._reception.dropped
        return Outcome(
            fault=fault,
            detail=detail,
            tally=self.tally,
            armed=armed,
            end_angle=end.angle if end else NAN,
            end_velocity=end.velocity if end else NAN,
            home=fault is None and end is not None and self._is_home(end),
            node_state=self._last.node_state if self._last else None,
            node_at_rest=at_rest,
            node_stop_reason=self._reception.status.stop_reason if self._reception.status else None,
            last_angle=self._last.angle if self._last else NAN,
            duration_ns=end.device_time_ns - self._start_ns if end and self._start_ns else 0,
        )

    # --- SILENT: listen until the node has shown itself -------------------------------------------------------------

    def _await_node(self) -> None:
        deadline_ns = self.clock.now_ns() + round(self.bench.watch.start_timeout * 1e9)
        ready = pairs = 0
        reason = ""
        while ready < READY_PAIRS:
            self._check_requests()
            now_ns = self.clock.now_ns()
            if now_ns >= deadline_ns:
                waited = f"within {self.bench.watch.start_timeout:g} s"
                raise _StopError(Fault.NODE_NOT_READY, reason) if pairs else _StopError(Fault.NO_NODE, waited)
            frame = self.receive(min(deadline_ns, now_ns + 10 * self._period_ns))
            sample = None if frame is None else self._take(frame)
            if sample is not None:
                pairs += 1
                reason = self._not_ready(sample, now_ns)
                ready = 0 if reason else ready + 1
        self._move(Event.NODE_READY)

    def _not_ready(self, sample: SensorSample, now_ns: int) -> str:
        """Why the experiment may not begin at this sample; empty if it may."""
        if now_ns - sample.receive_time_ns > OLDEST_SAMPLE_PERIODS * self._period_ns:
            return "its samples are read too late, this computer is too slow"  # or catching up with what had piled up
        status = self._reception.status
        if status is None:
            return "it has not sent its status, so nobody knows what it is"
        if status.protocol_version != self.layout.protocol_version:
            return f"it speaks protocol {status.protocol_version}, expected {self.layout.protocol_version}"
        expected = bench_identity(self.bench.contract_hash)
        if status.bench_identity != expected:
            return f"it was set up for bench {status.bench_identity:#06x}, expected {expected:#06x}: another bench file"
        if sample.node_state is not NodeState.IDLE:
            return f"the node is {sample.node_state.name}, expected IDLE"
        if not self._is_home(sample):
            return (
                f"at {sample.angle:.3f} rad and {sample.velocity:.1f} rad/s; home is within "
                f"{self.bench.shield.home_angle:g} rad and {self.bench.shield.home_velocity:g} rad/s"
            )
        return ""

    def _is_home(self, sample: SensorSample) -> bool:
        home = self.bench.shield
        return (
            abs(sample.angle) <= home.home_angle + self._angle_slack
            and abs(sample.velocity) <= home.home_velocity + self._velocity_slack
        )

    # --- ACTIVE: one cycle per sample -------------------------------------------------------------------------------

    def _experiment(self) -> None:
        sample = self._next_sample()
        self._start_ns = sample.device_time_ns
        self._move(Event.BEGIN)
        self.tally.pairs = 1
        while (step := self._step_of(sample)) < self.steps:
            self._answer(sample, step)
            sample = self._next_sample()
        self._record(sample, step, Reason.NONE, missed=self._missed_before)
        self._move(Event.FINISHED)

    def _step_of(self, sample: SensorSample) -> int:
        """Index of a sample on the experiment's grid, by the node's own clock."""
        return round((sample.device_time_ns - self._start_ns) / self._period_ns)

    def _answer(self, sample: SensorSample, step: int) -> None:
        self._check_requests()
        self._check_sample(sample)
        wanted = self.actor.act(sample.angle, sample.velocity, step)
        clipped = self._clipped(wanted)
        current, reasons = shield(self.law, sample.angle, sample.velocity, clipped, *self._sent, step)
        command = CurrentCommand(self.guard.next_counter, sample.counter, current, enable=True)
        decide_ns = self.clock.now_ns()
        if decide_ns - sample.receive_time_ns > self._latest_answer_ns:
            self._leave_unanswered(sample, self._missed_before, decide_ns)
            return
        self._send(command, sample.receive_time_ns, decide_ns)
        send_ns = self.clock.now_ns()
        current = round(current / self._current_step) * self._current_step  # what is on the bus
        self._sent = (current, *self._sent[:2])
        self._sent_counter = command.counter
        if clipped != wanted:
            reasons |= Reason.CLIPPED
        self._count(reasons, current)
        self._record(
            sample, step, reasons, missed=self._missed_before,
            command_counter=command.counter, wanted=wanted, clipped=clipped, sent=current,
            decide_ns=decide_ns, send_ns=send_ns,
        )  # fmt: skip

    def _check_sample(self, sample: SensorSample) -> None:
        """Leave the experiment if the brake or the node is not where it must be."""
        limits = self.bench.limits
        low, high = limits.angle
        if not low - self._angle_slack <= sample.angle <= high + self._angle_slack:
            raise _StopError(Fault.OUT_OF_LIMITS, f"angle {sample.angle:.2f} rad, limits {low:g} to {high:g} rad")
        if not abs(sample.velocity) <= limits.velocity + self._velocity_slack:
            raise _StopError(
                Fault.OUT_OF_LIMITS, f"velocity {sample.velocity:.1f} rad/s, limit {limits.velocity:g} rad/s"
            )
        if sample.node_state in (NodeState.STOPPING, NodeState.FAULT):
            raise _StopError(Fault.NODE_STOPPED, f"it says {sample.node_state.name}")
        if self._unobeyed_in_a_row >= self.bench.watch.stop_missed:
            raise _StopError(Fault.NOT_OBEYED, f"{self._unobeyed_in_a_row} periods in a row")

    def _clipped(self, wanted: float) -> float:
        """The policy's wish within the bench's limit; finite is asked first, since NaN passes min and max."""
        if not math.isfinite(wanted):
            raise _StopError(Fault.POLICY_NOT_FINITE, f"it answered {wanted}")
        if abs(wanted) > self.current_limit * (1.0 + 1e-6):
            raise _StopError(
                Fault.POLICY_BEYOND_CONTRACT, f"it asked for {wanted:g} A, its contract allows {self.current_limit:g} A"
            )
        limit = self.bench.limits.current
        return min(max(wanted, -limit), limit)

    def _send(self, command: CurrentCommand, sample_time_ns: int, now_ns: int) -> None:
        self.guard.send(self.layout.encode_command(command), self.state, sample_time_ns, now_ns)

    # --- reception --------------------------------------------------------------------------------------------------

    def _next_sample(self) -> SensorSample:
        """The newest valid pair; periods without one are counted."""
        last = self._last
        deadline_ns = (last.receive_time_ns if last else self.clock.now_ns()) + self._period_ns * 3 // 2
        silent = 0
        while True:
            self._check_requests()
            frame = self.receive(deadline_ns)
            if frame is None or frame.time_ns >= deadline_ns:
                silent += 1
                deadline_ns += self._period_ns
                self._check_silence(silent)
            if frame is not None and (sample := self._take(frame)) is not None:
                return self._newest(sample)

    def _newest(self, sample: SensorSample) -> SensorSample:
        """Prefer what has come meanwhile: the node obeys an answer to its newest sample only."""
        self._wake_ns = self.clock.now_ns()
        if self._wake_ns - sample.receive_time_ns < self._period_ns // 2:
            return sample  # the next one is not due yet
        for _ in range(DRAIN_FRAMES):
            frame = self.receive(0)
            if frame is None:
                break
            missed = self._missed_before
            newer = self._take(frame)
            if newer is not None:
                self._leave_unanswered(sample, missed)
                sample = newer
        return sample

    def _leave_unanswered(self, sample: SensorSample, missed: int, decide_ns: int = 0) -> None:
        """Too late for this one: it is braked by the node, counted here, and nothing is sent for it."""
        if self.state is RunState.ACTIVE:
            self.tally.unanswered += 1
            self._unobeyed_in_a_row += 1
            self._record(sample, self._step_of(sample), Reason.MISSED, missed=missed, decide_ns=decide_ns)

    def _take(self, frame: Frame) -> SensorSample | None:
        self.journal.push_frame(frame)
        if is_bus_off(frame):
            raise BusError("the CAN controller reports bus-off: it has stopped taking part")
        before = self._last
        sample = self._reception.take(frame)
        if sample is None:
            return None
        self._last = sample
        if self.state is RunState.ACTIVE and before is not None:
            self._follow(before, sample)
        return sample

    def _follow(self, before: SensorSample, sample: SensorSample) -> None:
        """Count what lies between two samples, and whether the node obeyed."""
        tally = self.tally
        tally.pairs += 1
        gap = round((sample.device_time_ns - before.device_time_ns) / self._period_ns)
        self._missed_before = max(0, gap - 1)
        tally.missed += self._missed_before
        tally.angle_min, tally.angle_max = min(tally.angle_min, sample.angle), max(tally.angle_max, sample.angle)
        tally.top_speed = max(tally.top_speed, abs(sample.velocity))
        # Across a gap the node does not tell: it names the command of the last period only.
        if self._sent_counter is not None and gap == 1:
            if sample.command_counter == self._sent_counter:
                self._unobeyed_in_a_row = 0
            else:
                tally.not_obeyed += 1
                self._unobeyed_in_a_row += 1
        self._sent_counter = None

    def _check_requests(self) -> None:
        if self.stop_requested():
            raise _StopError(Fault.INTERRUPTED)
        if self._reception.foreign_command:
            raise _StopError(Fault.FOREIGN_COMMAND, f"identifier {self.layout.command.identifier:#05x}")
        if self._reception.too_many_rejected:
            raise _StopError(Fault.FRAMES_REJECTED, f"{self._reception.rejected} so far")

    def _check_silence(self, silent: int) -> None:
        watch = self.bench.watch
        if silent == watch.soft_missed:
            self.journal.push_event(self.clock.now_ns(), "SENSOR_LATE", f"{silent} periods without a valid pair")
        if silent >= watch.stop_missed:
            raise _StopError(Fault.SENSOR_LOST, f"{silent} periods without a valid pair")

    def _on_rejected(self, _frame: Frame, why: str) -> None:
        self.journal.push_event(self.clock.now_ns(), "FRAME_REJECTED", why)

    # --- STOPPING ---------------------------------------------------------------------------------------------------

    def _stop(self) -> bool:
        """Send the stop frames, then watch until the node is idle; gives whether it was."""
        for _ in range(STOP_FRAMES):
            try:
                now_ns = self.clock.now_ns()
                answers = self._last.counter if self._last else 0
                self._send(CurrentCommand(self.guard.next_counter, answers, 0.0, enable=False), now_ns, now_ns)
            except Exception as err:  # whatever is broken, the next stop frame is still tried
                self.journal.push_event(self.clock.now_ns(), "STOP_FRAME_NOT_SENT", _one_line(err))
            # Each in a period of its own: what stood in the way of one may be gone for the next.
            self._watch(self.clock.now_ns() + self._period_ns)
        at_rest = self._watch(self.clock.now_ns() + STOP_LISTEN_NS, until_idle=True)
        self._move(Event.STOPPED)
        return at_rest

    def _watch(self, deadline_ns: int, until_idle: bool = False) -> bool:
        """:meth:`_listen`, on a bus that may be broken."""
        try:
            return self._listen(deadline_ns, until_idle)
        except Exception as err:  # the run is being stopped: nothing may keep it from its end
            self.journal.push_event(self.clock.now_ns(), "LISTENING_FAILED", _one_line(err))
            return False

    def _listen(self, deadline_ns: int, until_idle: bool = False) -> bool:
        """Log what comes until a deadline; gives whether the node said idle."""
        idle = False
        while not (idle and until_idle):
            frame = self.receive(deadline_ns)
            if frame is None:
                break
            sample = self._take(frame)
            idle = idle if sample is None else sample.node_state is NodeState.IDLE
            if frame.time_ns >= deadline_ns:
                break  # on a babbling bus there is always one more
        return idle

    # --- records ----------------------------------------------------------------------------------------------------

    def _move(self, event: Event) -> None:
        self.state = next_state(self.state, event)
        self.journal.push_event(self.clock.now_ns(), self.state.name, f"after {event.name}")

    def _report(self, fault: Fault, detail: str) -> None:
        info = FAULTS[fault]
        self.journal.push_event(self.clock.now_ns(), fault.name, f"{info.cause}: {detail}" if detail else info.cause)

    def _count(self, reasons: int, current: float) -> None:
        tally = self.tally
        tally.answered += 1
        tally.clipped += bool(reasons & Reason.CLIPPED)
        tally.limited += bool(reasons & Reason.LIMITED)
        tally.returning += bool(reasons & Reason.RETURNING)
        tally.top_current = max(tally.top_current, abs(current))

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


def _one_line(err: Exception) -> str:
    return f"{type(err).__name__}: {err}".partition("\n")[0]
