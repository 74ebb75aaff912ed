"""Bus, clock, journal and operator of a rerun, played from a log.

The loop records every frame that it takes, every cycle and every event, in one order, and all that it does between two
of them follows from them. So that order decides each call of the loop in a rerun: a frame is there if it was taken
next, a wait times out if another record comes next, an operator pressed Ctrl-C if that comes next.

The loop reads its clock once per event, and the cycle record has the readings of its cycle. Outside of a cycle a
reading decides only between two ways whose ends are recorded; a bound on it is enough:

* before arming, the arrival of the last frame, or :attr:`Trace.listening_ns` if that is later;
* before a fault that left no cycle record, the latest for waking, the earliest for deciding;
* while the run stops, the latest: the stop frames show where a wait ended (:attr:`Trace.pauses`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from emb_bench.replay.trace import LATCHED, RUNS_ON, Item, Trace
from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.messages import Layout
from emb_runtime.can.transport import STEP_SLACK_NS, TransmitQueueFullError
from emb_runtime.control.interfaces import Actor
from emb_runtime.errors import BusError
from emb_runtime.log.ring_buffer import EventRecord, Level
from emb_runtime.records import CycleRecord, Frame, RunState
from emb_runtime.safety.state_machine import FAULTS, Fault

_IN_CONTROL = (RunState.ARMED, RunState.ACTIVE, RunState.HOMING)

_RAISED = frozenset({Fault.BUS_LOST.name, Fault.INTERNAL.name, "LISTENING_FAILED"})
"""Events of a failed wait for a frame."""
_IN_VAIN = frozenset(
    {
        *("SENSOR_LATE", "STOP_FRAME_NOT_SENT", RunState.OVER.name),
        *(Fault.SENSOR_LOST.name, Fault.NO_NODE.name, Fault.NODE_NOT_READY.name, Fault.NOT_AT_REST.name),
    }
)
"""Events that follow a wait in which no frame came."""


class Difference(NamedTuple):
    """Difference between the log and the rerun."""

    step: int | None  # Step of the experiment; None before and after it
    what: str
    recorded: str
    came: str


class PlaybackOverError(BaseException):
    """Ends the loop: the trace has nothing more, or the loop has left it. What its stop then does does not count."""


class _Sent(NamedTuple):
    frame: Frame
    step: int | None


class Playback:
    """Inputs of a loop, played from a trace; compares the loop's outputs with the log.

    Args:
        trace: the records of the run.
        layout: of its bus.
        actor: decides.
    """

    def __init__(self, trace: Trace, layout: Layout, actor: Actor) -> None:
        self._layout = layout
        self._items = trace.items
        self._pauses = dict(trace.pauses)
        self._last_ns = trace.last_ns
        self._actor = actor
        self._estimates = trace.estimates
        self._learnt = trace.learnt
        self._at = 0
        self._state = RunState.INIT
        self._step: int | None = None
        self._reading = "wake_time_ns"  # of the cycle record: the event that the loop dates next
        self._arrived_ns = trace.listening_ns
        self._stops_tried = 0
        self._is_over = False
        self._tripped = False
        self._sent: list[_Sent] = []
        self._echoed = 0
        self.decisions = 0
        """Cycle records compared."""
        self.frames = 0
        """Sent frames found on the bus."""
        self.events = 0
        """Safety events compared."""
        self.bus_lost = False
        """The bus was lost: what was sent last may never have been on it."""
        self.differences: list[Difference] = []
        """Differences in the order in which they came."""

    @property
    def at_end(self) -> bool:
        """Returns True if all that was recorded has been played."""
        return self._at == len(self._items)

    def finish(self) -> None:
        """Compare what is left when the loop has returned."""
        if not self.at_end:
            self._differ("what came next", _words(self._items[self._at]), "the run was over")
        if not self.bus_lost:
            for sent in self._sent[self._echoed :]:
                self._differ_at(sent.step, "sent frame", "no such frame", _hex(sent.frame))

    # --- the clock --------------------------------------------------------------------------------------------------

    def now_ns(self) -> int:
        """Time of the event that the loop has in hand [ns]."""
        if self._state in (RunState.INIT, RunState.SILENT):
            return self._arrived_ns
        if self._state not in _IN_CONTROL:
            return self._last_ns
        cycle, end_ns = self._ahead()
        if cycle is not None:
            return int(getattr(cycle, self._reading))
        return min(end_ns, self._arrived_ns) if self._reading == "decide_time_ns" else end_ns

    def wall_offset_ns(self) -> int:
        """Zero: all times of a rerun are monotonic."""
        return 0

    def sleep_until(self, time_ns: int) -> int:
        """Time passes by itself here."""
        return time_ns

    def _ahead(self) -> tuple[CycleRecord | None, int]:
        """The record of the present cycle; None if it left none, and when the experiment ended [ns]."""
        for n in range(self._at, len(self._items)):
            item = self._items[n]
            if isinstance(item, CycleRecord):
                return item, self._last_ns
            if isinstance(item, EventRecord) and item.code not in RUNS_ON:
                return None, item.time_ns
        return None, self._last_ns

    # --- the bus ----------------------------------------------------------------------------------------------------

    def receive(self, deadline_ns: int) -> Frame | None:
        """The frame that was taken next, or None if the wait timed out.

        Raises:
            BusError: it was lost here.
            PlaybackOverError: there is nothing more, or the loop had not waited here.
        """
        self._reading = "wake_time_ns"
        item = self._next()
        if self._state is RunState.STOPPING and self._at >= self._pauses.get(self._stops_tried, len(self._items)):
            del self._pauses[self._stops_tried]
            return None
        if isinstance(item, Frame):
            self._arrived_ns = max(self._arrived_ns, item.time_ns)
            return item
        if deadline_ns <= 0:
            return None  # it only looked
        if isinstance(item, EventRecord) and item.code in _RAISED:
            raise RuntimeError(item.text) if item.code == Fault.INTERNAL.name else _bus_error(item)
        if isinstance(item, CycleRecord) or item.code not in _IN_VAIN:
            raise self._left("the loop waited for another frame")
        # A deadline comes from a frame's stamp, which is the wall clock's, translated: it may be off by a small step.
        if self._state in _IN_CONTROL and deadline_ns > item.time_ns + STEP_SLACK_NS:
            raise self._left(f"the loop waited for another {(deadline_ns - item.time_ns) / 1e6:.1f} ms")
        if self._state is RunState.SILENT:
            self._arrived_ns = max(self._arrived_ns, deadline_ns)
        return None

    def send(self, frame: Frame) -> None:
        """Take a frame that the guard has let out.

        Raises:
            BusError: the bus did not take it.
        """
        if self._is_over:
            return
        stops = not self._layout.decode_command(frame).enable
        self._stops_tried += stops
        # The first stop frame leaves before its fault is recorded.
        item = self._behind_the_fault() if stops else None if self.at_end else self._items[self._at]
        if isinstance(item, EventRecord) and item.code == ("STOP_FRAME_NOT_SENT" if stops else Fault.BUS_LOST.name):
            raise _bus_error(item)
        if self._comes(Fault.SEND_QUEUE_FULL):
            raise TransmitQueueFullError(_detail(self._items[self._at]))
        self._sent.append(_Sent(frame, self._step))
        self._reading = "send_time_ns"

    def _behind_the_fault(self) -> Item | None:
        """The next record that is not the fault which ended the run, nor the state after it."""
        skipped = {RunState.STOPPING.name, *LATCHED}
        rest = self._items[self._at :]
        return next((item for item in rest if not (isinstance(item, EventRecord) and item.code in skipped)), None)

    def stop_requested(self) -> bool:
        """Returns True if the operator had requested the end."""
        return self._comes(Fault.INTERRUPTED)

    # --- the watchdog -----------------------------------------------------------------------------------------------

    @property
    def tripped(self) -> bool:
        """The watchdog had stopped the run; never taken back."""
        self._tripped |= self._comes(Fault.WATCHDOG_TRIPPED)
        return self._tripped

    def watched(self, _now_ns: int) -> bool:
        """Returns True if there was a sign of life from it."""
        return not self._comes(Fault.WATCHDOG_LOST)

    def arm(self, now_ns: int) -> None:
        """Nobody watches a rerun."""

    def disarm(self) -> None:
        """Nobody watches a rerun."""

    def beat(self, now_ns: int) -> None:
        """Nobody watches a rerun."""

    def publish(self, counter: int, answers: int) -> None:
        """Nobody watches a rerun."""

    def _comes(self, fault: Fault) -> bool:
        """Returns True if that fault is the next record."""
        item = None if self.at_end else self._items[self._at]
        return isinstance(item, EventRecord) and item.code == fault.name

    # --- the actor --------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """A run begins."""
        self._actor.begin()

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """Current that the actor requests [A]."""
        self._step = int(step)
        self._reading = "decide_time_ns"
        return self._actor.act(angle, velocity, step, applied_current)

    # --- the journal ------------------------------------------------------------------------------------------------

    def push_frame(self, frame: Frame) -> None:
        """Handles a frame that was taken; the echo of a sent one identifies its record."""
        self._at += 1
        if frame.own:
            self._compare_echo(frame)

    def push_cycle(self, record: CycleRecord) -> None:
        """Compare a cycle."""
        item = self._next()
        if not isinstance(item, CycleRecord):
            raise self._left(_words(record))
        self._at += 1
        self.decisions += 1
        for name, recorded, came in zip(record._fields, item, record, strict=True):
            if not _same(recorded, came):
                self._differ_at(item.step, name, repr(recorded), repr(came))

    def push_estimate(self, _time_ns: int, step: int, estimate: tuple[float, ...]) -> None:
        """Compare an estimate."""
        self._compare_numbers("estimate", self._estimates, step, estimate)

    def push_learnt(self, _time_ns: int, step: int, numbers: tuple[float, ...]) -> None:
        """Compare what the shield has learnt."""
        self._compare_numbers("learnt", self._learnt, step, numbers)

    def _compare_numbers(
        self, what: str, of_step: Mapping[int, tuple[float, ...]], step: int, came: tuple[float, ...]
    ) -> None:
        recorded = of_step.get(step)
        if recorded is None and self.at_end:
            raise self._over()  # the log was cut just there
        if recorded is None or len(recorded) != len(came) or not all(map(_same, recorded, came)):
            self._differ_at(step, what, repr(recorded), repr(came))

    def push_event(self, _time_ns: int, code: str, text: str) -> None:
        """Compare an event."""
        item = self._next()
        if not isinstance(item, EventRecord) or item.code != code:
            raise self._left(f"{code} ({text})")
        self._at += 1
        self.events += 1
        if code in RunState.__members__:
            self._state = RunState[code]
        self.bus_lost |= code == Fault.BUS_LOST.name
        if code == "LISTENING_FAILED":
            self._pauses.pop(self._stops_tried, None)

    def push_log(self, time_ns: int, level: Level, text: str) -> None:
        """Lines are for people; nothing follows from them."""

    # --- comparing --------------------------------------------------------------------------------------------------

    def _next(self) -> Item:
        if self.at_end or self._is_over:
            raise self._over()
        return self._items[self._at]

    def _left(self, came: str) -> PlaybackOverError:
        """The loop has left the trace: nothing after this can be compared."""
        self._differ("what came next", _words(self._items[self._at]), came)
        return self._over()

    def _over(self) -> PlaybackOverError:
        self._is_over = True
        return PlaybackOverError()

    def _compare_echo(self, echo: Frame) -> None:
        waiting = self._sent[self._echoed : self._echoed + COUNTER_MODULUS]
        echo = echo._replace(time_ns=0, own=False, dropped=0)
        for n, sent in enumerate(waiting):
            if sent.frame == echo:
                for lost in waiting[:n]:
                    self._differ_at(lost.step, "sent frame", "no such frame", _hex(lost.frame))
                self._echoed += n + 1
                self.frames += 1
                return
        step, came = (waiting[0].step, _hex(waiting[0].frame)) if waiting else (self._step, "no such frame")
        self._differ_at(step, "sent frame", _hex(echo), came)
        self._echoed += bool(waiting)

    def _differ(self, what: str, recorded: str, came: str) -> None:
        self._differ_at(self._step, what, recorded, came)

    def _differ_at(self, step: int | None, what: str, recorded: str, came: str) -> None:
        self.differences.append(Difference(step, what, recorded, came))


def _same(recorded: float, came: float) -> bool:
    """Returns True if equal to the last bit; NaN is NaN, and minus zero is not zero."""
    if recorded != recorded or came != came:
        return recorded != recorded and came != came
    return recorded == came and math.copysign(1.0, recorded) == math.copysign(1.0, came)


def _detail(item: Item) -> str:
    """Text of a fault's event without its cause."""
    assert isinstance(item, EventRecord)
    cause = FAULTS[Fault[item.code]].cause if item.code in Fault.__members__ else ""
    return item.text.removeprefix(f"{cause}: ")


def _bus_error(event: EventRecord) -> BusError:
    return BusError(_detail(event))


def _hex(frame: Frame) -> str:
    return f"{frame.identifier:03x}#{frame.data.hex()}"


def _words(item: Item) -> str:
    match item:
        case Frame():
            return f"frame {_hex(item)}"
        case CycleRecord():
            return f"the record of step {item.step}"
        case EventRecord(_, code, text):
            return f"{code} ({text})"
