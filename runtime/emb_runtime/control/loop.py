"""Driver of a run: it waits for frames, reads the clock and writes bytes; all else is :mod:`emb_runtime.control.core`.

A cycle has three verbs: **read** the frames that have come by the core's deadline; **answer** the newest sample with
the frame that the guard has checked; **record** what happened. One invariant: however the cycles end, from then on only
stop frames leave, each is tried, and nothing that is called can keep them back. None leaves where nothing was armed, or
where the watchdog sends them. Any other BaseException than an Exception or SystemExit is raised after the stop.

One driver serves a real bus and a simulated one in lock-step: clock and reception are handed in. The clock is read once
per event: frames or a timeout are in hand, a decision is made, a command is sent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, cast

from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.control.core import SILENT, Core
from emb_runtime.control.result import Outcome
from emb_runtime.errors import BusError, PolicyRefusedError
from emb_runtime.log.ring_buffer import Record
from emb_runtime.records import Frame, RunState
from emb_runtime.safety.guard import GuardRejectedError
from emb_runtime.safety.heartbeat import STOP_FRAMES, Heartbeat, Unwatched
from emb_runtime.safety.state_machine import Fault, StopError, may_enable
from emb_runtime.system.terminal import one_line

STOP_LISTEN_NS: Final = 1_500_000_000
"""Longest time that the node may take to come to rest after the stop frames [ns]: a mapped one has a second, and then
lets its drive go."""
MOST_FRAMES: Final = 64  # Of one read: a babbling node must not hold the loop
STOP_FRAME_NOT_SENT: Final = "STOP_FRAME_NOT_SENT"  # Code of its event
HELD_RECORDS: Final = 4  # Without a command fewer records are not passed on yet: not between a pair's two frames


@dataclass
class Loop:
    """Driver of one run. Make it, :meth:`run` it once."""

    core: Core
    receive: Callable[[int], Frame | None]  # Returns the next frame, or None at a deadline (monotonic [ns])
    now_ns: Callable[[], int]  # Monotonic clock [ns]
    push: Callable[[Record], object]  # Records; never waits
    stop_requested: Callable[[], bool]
    pulse: Heartbeat = field(default_factory=Unwatched)  # To the watchdog process
    overheard: Sequence[Frame] = ()  # Frames from just before the run that must not be missed

    def __post_init__(self) -> None:
        """Set up what the cycles carry from one to the next."""
        self._now_ns = 0  # time of the event in hand
        self._period_ns = self.core.setup.bench.timing.sample_time_ns
        self._watched = False  # the watchdog has been armed
        self._fault = Fault.INTERNAL  # of what was raised
        self._cause: BaseException | None = None  # what was raised
        self._leaving: BaseException | None = None  # the first error that is no Exception
        self._failures: list[tuple[str, BaseException]] = []  # steps of the stop that failed, not yet recorded

    def run(self) -> Outcome:
        """Arm, run, stop; no Exception is raised."""
        core = self.core
        try:
            core.begin(self._read_clock())
            core.process_frames(self.overheard, self._now_ns)
            while core.running:
                self._cycle()
        except BaseException as err:
            self._latch(err)
        finally:
            self._stop()  # the invariant holds from here on
        if self._leaving is not None:
            raise self._leaving
        return core.outcome()

    def _read_clock(self) -> int:
        self._now_ns = self.now_ns()
        return self._now_ns

    def _cycle(self) -> None:
        """Read, answer, record."""
        core = self.core
        frames = self._read_frames(core.deadline_ns)
        # Before the frames: the watchdog's stop frames come from another socket and look like a stranger's commands.
        if (fault := self._fault_from_outside(self._now_ns)) is not None:
            core.latch(fault, self._now_ns)
            core.explain(fault, self._now_ns)
        if not frames:
            core.timeout(self._now_ns)
        else:
            core.process_frames(frames, self._now_ns)
            if not self._answer() and len(core.records) < HELD_RECORDS:
                return
        self._push_records()

    def _read_frames(self, deadline_ns: int) -> list[Frame]:
        """The next frame; with it all that wait if it is so old that newer ones are due. None of them at a deadline."""
        frame = self.receive(deadline_ns)
        now_ns = self._read_clock()
        if frame is None:
            return []
        frames = [frame]
        if now_ns - frame.time_ns >= self._period_ns // 2:
            while len(frames) < MOST_FRAMES and (frame := self.receive(0)) is not None:
                frames.append(frame)
            self._read_clock()
        return frames

    def _fault_from_outside(self, now_ns: int) -> Fault | None:
        """Beat the watchdog's heartbeat; returns a fault of the watchdog or the operator."""
        if self.pulse.tripped:
            return Fault.WATCHDOG_TRIPPED
        if self.stop_requested():
            return Fault.INTERRUPTED
        if self.core.state is not SILENT:
            self.pulse.beat(now_ns)
            if not self.pulse.watched(now_ns):
                return Fault.WATCHDOG_LOST
        return None

    def _answer(self) -> bool:
        """Write the frame that answers the newest sample; returns False if there is none."""
        core = self.core
        if not self._watched and may_enable(core.state):
            self.pulse.arm(self._now_ns)
            self._watched = True
        decide_ns = self._read_clock()
        frame = core.answer(decide_ns)
        if frame is None:
            return False
        try:
            core.guard.send(frame)
        except TransmitQueueFullError as err:
            core.sent(decide_ns, lost=str(err))
        else:
            core.sent(self._read_clock())
        return True

    def _push_records(self) -> None:
        """Record what has happened."""
        records = self.core.records
        while records:
            self.push(records.pop(0))

    # --- STOPPING ---------------------------------------------------------------------------------------------------

    def _latch(self, err: BaseException) -> None:
        """Latch the fault of an error; :meth:`_stop` explains it after the first stop frame."""
        self._cause = err
        self._keep(err)
        self._attempt("CLOCK_FAILED", self._read_clock)
        # A watchdog that tripped has unbound the socket: that is the cause of the error.
        self._fault = Fault.WATCHDOG_TRIPPED if self._has_tripped() else fault_of(err)
        self.core.latch(self._fault, self._now_ns)

    def _stop(self) -> None:
        """Send the stop frames, record what ended the run, and watch the node come to rest."""
        core = self.core
        frames = STOP_FRAMES if core.state is RunState.STOPPING and not self._has_tripped() else 0
        if frames:  # else there is nothing to stop, or the watchdog does
            self._send_stop_frame()
        if self._cause is not None:
            core.explain(self._fault, self._now_ns, detail_of(self._cause))
        self._record()
        for sent in range(1, frames + 1):
            # One in each period: what stood in the way of one may be gone for the next.
            self._listen(self._now_ns + self._period_ns)
            if sent < frames:
                self._send_stop_frame()
        if core.state is RunState.STOPPING:
            self._end_stop()
        self._record()

    def _end_stop(self) -> None:
        """Disarm the watchdog, and wait until the node is at rest."""
        core = self.core
        self._attempt("DISARM_FAILED", self.pulse.disarm)
        self._attempt("CLOCK_FAILED", self._read_clock)
        if core.fault is None and self._has_tripped():  # while the stop frames went out
            core.latch(Fault.WATCHDOG_TRIPPED, self._now_ns)
            core.explain(Fault.WATCHDOG_TRIPPED, self._now_ns)
        self._listen(self._now_ns + STOP_LISTEN_NS, until_rest=True)
        self._attempt("CLOCK_FAILED", self._read_clock)
        core.end(self._now_ns)

    def _send_stop_frame(self) -> None:
        """Send a stop frame. Whatever is broken, the next one is still tried."""
        self._attempt("CLOCK_FAILED", self._read_clock)
        self._attempt("BEAT_FAILED", lambda: self.pulse.beat(self._now_ns))
        core = self.core
        self._attempt(STOP_FRAME_NOT_SENT, lambda: core.guard.send(core.stop_frame(self._now_ns)))

    def _listen(self, deadline_ns: int, *, until_rest: bool = False) -> None:
        """Record what comes until a deadline, or until the node is at rest."""

        def listen() -> None:
            while not (until_rest and self.core.at_rest):
                frames = self._read_frames(deadline_ns)
                self.core.process_frames(frames, self._now_ns)
                self._push_records()
                if not frames or frames[-1].time_ns >= deadline_ns:
                    break  # on a babbling bus there is always one more

        self._attempt("LISTENING_FAILED", listen)
        self._record()

    def _attempt(self, failure: str, call: Callable[[], object]) -> None:
        """Run one step of the stop; store its exception for :meth:`_record`, and continue."""
        try:
            call()
        except BaseException as err:
            self._keep(err)
            self._failures.append((failure, err))

    def _record(self) -> None:
        """Record what has happened, and which steps have failed."""
        failures, self._failures = self._failures, []
        for failure, err in failures:
            self.core.note(self._now_ns, failure, _message_of(err))
        while self.core.records:
            self._attempt("RECORD_FAILED", self._push_records)

    def _has_tripped(self) -> bool:
        """Returns True if the watchdog has tripped; False if it cannot be read."""
        try:
            return self.pulse.tripped
        except BaseException as err:
            self._keep(err)
            return False

    def _keep(self, err: BaseException) -> None:
        """Store the first error that is raised after the stop: neither an Exception nor SystemExit."""
        if self._leaving is None and not issubclass(type(err), Exception | SystemExit):
            self._leaving = err


def fault_of(err: BaseException) -> Fault:
    """Fault of what was raised in a run."""
    kind = type(err)
    if issubclass(kind, StopError):
        return cast("StopError", err).fault
    errors = (GuardRejectedError, Fault.GUARD_REJECTED), (PolicyRefusedError, Fault.POLICY_NOT_FINITE)
    return next(
        (fault for error, fault in (*errors, (BusError, Fault.BUS_LOST)) if issubclass(kind, error)), Fault.INTERNAL
    )


def detail_of(err: BaseException) -> str:
    """Message of a refusal; class, message and place of an error in the program. One line."""
    if issubclass(type(err), StopError):
        return cast("StopError", err).detail
    if issubclass(type(err), GuardRejectedError | PolicyRefusedError | BusError):
        return _message_of(err, named=False)
    return _message_of(err) + _place(err)


def _place(err: BaseException) -> str:
    """Place at which an error was raised: the log has no traceback."""
    last = err.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None:
        return ""
    return f" ({last.tb_frame.f_code.co_filename.rpartition('/')[2]}, line {last.tb_lineno})"


def _message_of(err: BaseException, *, named: bool = True) -> str:
    """Message of an error in one line, after its class; the class alone if the message cannot be had."""
    name = type(err).__name__
    try:
        return one_line((f"{name}: {err}" if named else f"{err}").partition("\n")[0])
    except BaseException:
        return name
