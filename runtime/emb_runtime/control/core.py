"""Core of a run: frames and times go in; commands, records and faults come out. It reads no clock and opens no socket.

A driver does all that blocks (:mod:`emb_runtime.control.loop`; a rerun plays a log instead):

* :meth:`Core.process_frames` gets the frames of one read, and decides on a command for the newest sample among them;
* :meth:`Core.answer` gives the frame to send, checked by the guard, if there is one and it may still be sent;
* :meth:`Core.sent` records the cycle;
* :meth:`Core.timeout` counts a period without a sample.

Each input is recorded before its consequences: a frame with the time of its read, any other call as an
:class:`~emb_runtime.log.ring_buffer.InputRecord`. :attr:`Core.records` holds the records in order until the driver
removes them. A fault is a value of the state, not an error. A command answers the newest sample, or none is sent:
nothing repeats a command.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from emb_runtime.can.receiver import BUS_OFF
from emb_runtime.control.memory import latest_answer_ns
from emb_runtime.control.monitors import check_bus
from emb_runtime.control.phases import Phase, Silent, Stopping
from emb_runtime.control.result import Outcome
from emb_runtime.control.setup import Setup
from emb_runtime.log.ring_buffer import FrameRecord, InputRecord, Record
from emb_runtime.records import Call, Frame, Reason, RunState, SensorSample
from emb_runtime.safety.command_limits import Decision
from emb_runtime.safety.response_cause import cause
from emb_runtime.safety.state_machine import Event, Fault, StopError

SILENT: Final = RunState.SILENT
OVER: Final = RunState.OVER
IN_CONTROL: Final = (RunState.ARMED, RunState.ACTIVE, RunState.HOMING)
ENDING: Final = (RunState.STOPPING, OVER)
ANSWER: Final = int(Call.ANSWER)
OF_RESPONSE: Final = (
    Fault.RESPONSE_LATE,
    Fault.SENSORS_CONTRADICT,
    Fault.MOTION_OUTSIDE_SET,
    Fault.WRONG_POLARITY,
    Fault.OUT_OF_LIMITS,
)
"""Faults as which an undeclared response may end a run."""


class Core:
    """Core of one run: an experiment, or the way home."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.guard = setup.guard
        self._memory = setup.memory
        self._machine = setup.machine
        self._reception = setup.reception
        self._phase: Phase = Silent(setup)
        self._stopping: Stopping | None = None  # the last phase
        self._latest_answer_ns = latest_answer_ns(setup.bench)
        self._decision: Decision | None = None  # on the newest sample, to be answered
        self._permitted = True
        self._detail = ""  # of the fault
        self._answer_at = 0  # place of the newest answer in the records

    # --- state ------------------------------------------------------------------------------------------------------

    @property
    def records(self) -> list[Record]:
        """Records in order; the driver removes those that it has passed on."""
        return self._memory.records

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
        """Returns True if the node has come to rest after the stop frames, and its status has the stop's reason."""
        rests = self._stopping is not None and self._stopping.rests
        return rests and self._reception.stop_reason is not None

    @property
    def has_answer(self) -> bool:
        """Returns True if :meth:`answer` has a command for the newest sample."""
        return self._decision is not None

    @property
    def deadline_ns(self) -> int:
        """Time until which the next frames are waited for, monotonic [ns]."""
        return self._phase.deadline_ns

    @property
    def newest_counter(self) -> int:
        """Counter of the newest sample; 0 before the first."""
        newest = self._memory.newest
        return newest.counter if newest else 0

    # --- the run ----------------------------------------------------------------------------------------------------

    def begin(self, now_ns: int) -> None:
        """Begin the run: listen for the node."""
        self._record_call(Call.BEGIN, now_ns)
        self._memory.read_ns = now_ns
        self._machine.handle_event(Event.PREPARED, now_ns)

    def process_frames(self, frames: Sequence[Frame], now_ns: int) -> None:
        """Process the frames of one read at a monotonic time [ns]; :meth:`answer` comes next."""
        memory, self._decision = self._memory, None
        memory.read_ns = now_ns
        for at, frame in enumerate(frames, 1 - len(frames)):
            memory.records.append(tuple.__new__(FrameRecord, (frame, now_ns if at == 0 else 0)))
            try:
                if self.state is not OVER:
                    self._process_frame(frame)
            except StopError as stop:
                self._fail(stop, now_ns)
        if not self.running:
            return
        try:
            check_bus(self.setup.layout, self._reception)
            self._decision = self._phase.decide()
            if self._decision is None:
                self._follow_state()
        except StopError as ended:
            self._fail(ended, now_ns)

    def answer(self, now_ns: int) -> Frame | None:
        """Frame that answers the newest sample, decided at a monotonic time [ns]; None: no command, or none may leave.

        If there is one, :meth:`sent` comes next, before the driver takes the records.

        Raises:
            GuardRejectedError: the frame is not in the guard's contract.
        """
        memory, decision = self._memory, self._decision
        sample, self._decision = memory.newest, None  # nothing is answered twice
        if decision is None or sample is None:
            return None
        self._answer_at = len(memory.records)
        memory.records.append(tuple.__new__(InputRecord, (now_ns, ANSWER, 0, "", "")))
        in_time = now_ns - sample.receive_time_ns <= self._latest_answer_ns  # else the sample is stale
        if not in_time or not self._may_answer(now_ns) or math.isnan(decision.current):
            reasons = decision.reasons & Reason.LEFT if in_time else 0
            memory.unanswered(sample, memory.missed, now_ns, reasons)
            self._end_cycle(sample)
            return None
        encode, guard = self.setup.layout.encode_command, self.guard
        frame = encode(guard.next_counter, sample.counter, decision.current, True)
        memory.decided(decision, guard.check(frame, self.state, sample.receive_time_ns, now_ns))
        return frame

    def sent(self, now_ns: int, lost: str = "") -> None:
        """Record the cycle of a command that was handed to the bus at a monotonic time [ns].

        Where the bus had no room for it, ``lost`` has the error, and the time is that of the decision: sent later, it
        would answer an old sample.
        """
        memory, at = self._memory, self._answer_at
        sample = memory.newest
        assert sample is not None
        decide_ns = memory.records[at].time_ns
        memory.records[at] = tuple.__new__(InputRecord, (decide_ns, ANSWER, 0 if lost else now_ns, "", lost))
        if lost:
            memory.counters.not_taken += 1
            self._machine.record_fault(Fault.SEND_QUEUE_FULL, lost, now_ns)
            memory.unanswered(sample, memory.missed, now_ns)
        else:
            memory.answered(decide_ns, now_ns)
        self._end_cycle(sample)

    def timeout(self, now_ns: int) -> None:
        """Count that no frame came until :attr:`deadline_ns`."""
        self._record_call(Call.TIMEOUT, now_ns)
        self._memory.read_ns = now_ns
        try:
            self._phase.miss()
        except StopError as stop:
            self._fail(stop, now_ns)

    def latch(self, fault: Fault, now_ns: int) -> None:
        """Latch a fault of the driver; :meth:`explain` records it, where it was raised after a stop frame."""
        self._record_call(Call.LATCH, now_ns, fault.name)
        self._machine.latch(fault, now_ns)
        self._follow_state()

    def explain(self, fault: Fault, now_ns: int, detail: str = "") -> None:
        """Record a fault that was latched."""
        self._record_call(Call.EXPLAIN, now_ns, fault.name, detail)
        self._explain(fault, detail)

    def stop_frame(self, now_ns: int) -> Frame:
        """Next stop frame, checked by the guard at a monotonic time [ns].

        Raises:
            GuardRejectedError: the frame is not in the guard's contract.
        """
        self._record_call(Call.STOP_FRAME, now_ns)
        frame = self.setup.layout.encode_command(self.guard.next_counter, self.newest_counter, 0.0, False)
        self.guard.check(frame, self.state, now_ns, now_ns)
        return frame

    def end(self, now_ns: int) -> None:
        """Check how the node came to rest; the run is over."""
        self._record_call(Call.END, now_ns)
        setup, self._memory.read_ns = self.setup, now_ns
        if self.fault in OF_RESPONSE:
            response = setup.sensors.response
            named = cause(setup.bench, response.model, response.rows, response.stop, response.proven)
            self._detail = "; ".join(filter(None, (self._detail, named)))
        if self.fault is None and self._stopping is not None:
            try:
                self._stopping.check_rest()
            except StopError as stop:
                self._fail(stop, now_ns)
        self._machine.handle_event(Event.STOPPED, now_ns)

    def note(self, time_ns: int, code: str, text: str) -> None:
        """Record an event of the driver."""
        self._record_call(Call.NOTE, time_ns, code, text)
        self._memory.note(time_ns, code, text)

    def outcome(self) -> Outcome:
        """Outcome of the run, when it is over."""
        setup, memory, reception = self.setup, self._memory, self._reception
        end = self._stopping.end if self._stopping else None
        counters, estimate, response = memory.counters, setup.estimate, setup.sensors.response
        counters.rejected, counters.dropped = reception.rejected, reception.dropped
        return Outcome(
            fault=self.fault,
            detail=self._detail,
            counters=counters,
            end=end,
            last=memory.newest,
            home=self.fault is None and end is not None and setup.conditions.bounds.is_home(end),
            node_at_rest=self._stopping is not None and self._stopping.rests,
            node_stop_reason=reception.stop_reason,
            duration_ns=end.device_time_ns - memory.start_ns if end and memory.start_ns else 0,
            rejections=reception.rejections(),
            bus_errors=dict(reception.bus_errors),
            estimate=estimate.numbers,
            model_fits=estimate.estimator.fits,
            unexplained=setup.sensors.unexplained,
            response=response.description if response.proven else "",
            goal_ns=estimate.goal_ns,
        )

    # --- frames -----------------------------------------------------------------------------------------------------

    def _process_frame(self, frame: Frame) -> None:
        """Process a frame, and the sample that it completes."""
        memory, reception = self._memory, self._reception
        while frame.time_ns >= memory.deadline_ns and self.state in IN_CONTROL:
            self._phase.miss()
        if frame.own:
            memory.counters.confirmed += 1
            return
        dropped = reception.dropped
        sample = reception.add_frame(frame)
        if frame.error:
            self._count_error(frame)
            return
        if reception.dropped > dropped:
            self._machine.record_fault(Fault.FRAMES_DROPPED, f"{reception.dropped} so far", frame.time_ns)
        if sample is not None:
            self._phase = self._phase.process_sample(sample)

    def _count_error(self, frame: Frame) -> None:
        counters, errors = self._memory.counters, self._reception.bus_errors
        counters.bus_errors += 1
        if BUS_OFF in errors and self.running:
            raise StopError(Fault.BUS_LOST, "the CAN controller reports bus-off: it has stopped taking part")
        if counters.bus_errors == 1:
            self._machine.record_fault(Fault.BUS_ERRORS, ", ".join(errors), frame.time_ns)

    def _may_answer(self, now_ns: int) -> bool:
        """Returns True if one more command is not too fast, and every message of the node permits it."""
        if self.guard.too_fast(now_ns):  # samples came in a burst, and there is a newer one
            return False
        why = self._reception.inhibit_reason(now_ns)
        if why and self._permitted:
            self._machine.record_fault(Fault.PERMISSION_LOST, why, now_ns)
        self._permitted = not why
        return not why

    def _end_cycle(self, sample: SensorSample) -> None:
        """Record the estimate and update the motion balance, after the command was sent."""
        self.setup.estimate.record(sample, self._memory)
        try:
            self.setup.sensors.update_balance()
        except StopError as stop:
            self._fail(stop, self._memory.read_ns)

    def _record_call(self, call: Call, now_ns: int, code: str = "", text: str = "") -> None:
        """Record a call of the driver."""
        self._memory.records.append(InputRecord(now_ns, call, 0, code, text))

    def _fail(self, stop: StopError, now_ns: int) -> None:
        """Latch a fault that the core has found, and record it."""
        self._machine.latch(stop.fault, now_ns)
        self._follow_state()
        self._explain(stop.fault, stop.detail)

    def _explain(self, fault: Fault, detail: str) -> None:
        self._detail = self._detail or detail
        self._machine.explain(fault, detail)

    def _follow_state(self) -> None:
        """Enter the last phase, where an end or a fault leads to it."""
        if self._stopping is None and not self.running:
            armed = not isinstance(self._phase, Silent)
            self._phase = self._stopping = Stopping(self.setup, self._memory.newest if armed else None)
