"""A run again: what the log says of frames, times and faults from outside goes into the core, its records come out.

The log has the frames of each read with its time, and the cycle records have the times of deciding and sending. A fault
from outside (the operator, the watchdog, a lost bus) and a wait in vain stand in the log as events: where the next
record is one, it is given to the core. A stop frame names the newest sample, and so its place among the frames.
"""

from __future__ import annotations

import contextlib
import math
from collections import deque
from collections.abc import Mapping
from typing import NamedTuple

from emb_bench.logs import learnt
from emb_bench.logs.estimates import by_step
from emb_bench.logs.log import RunLog
from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.control.core import Core, Proposal
from emb_runtime.control.loop import detail_of, fault_of
from emb_runtime.errors import BusError, FrameError, LogError
from emb_runtime.log.ring_buffer import Direction, EstimateRecord, EventRecord, FrameRecord, LearntRecord
from emb_runtime.records import CycleRecord, Frame, RunState
from emb_runtime.safety.heartbeat import STOP_FRAMES
from emb_runtime.safety.state_machine import FAULTS, Fault

Item = FrameRecord | CycleRecord | EventRecord

WAITED = frozenset({Fault.SENSOR_LATE, Fault.SENSOR_LOST, Fault.NO_NODE, Fault.NODE_NOT_READY})
"""Faults by a wait in which no frame came."""
FROM_OUTSIDE = frozenset(
    {Fault.INTERRUPTED, Fault.WATCHDOG_TRIPPED, Fault.WATCHDOG_LOST, Fault.BUS_LOST, Fault.INTERNAL}
)
"""Faults that the driver gives to the core."""
AT_REST = frozenset({RunState.OVER.name, Fault.NOT_AT_REST.name, Fault.MOTION_UNEXPLAINED.name})
"""Events at the end of a stop."""


class Difference(NamedTuple):
    """Difference between the log and the rerun."""

    step: int | None  # Step of the experiment; None before and after it
    what: str
    recorded: str
    came: str


class LeftError(Exception):
    """The core has left the log: nothing after this can be compared."""


def read_items(log: RunLog) -> tuple[Item, ...]:
    """Frames, cycles and events of a log, in the order in which the loop recorded them; times are monotonic [ns].

    Raises:
        LogError: the log has no bench, layout, clock or control cycles, topics with other fields, or not the beginning
            of the run.
    """
    offset_ns, tables = log.wall_offset_ns, log.tables
    ordered: list[tuple[int, Item]] = []
    reads: list[tuple[int, int]] = []
    for topic in ("/can/rx", "/can/tx"):
        if topic in tables:
            log.require(topic, ["read_time_ns"])
            reads += zip(tables[topic]["order"].tolist(), tables[topic]["read_time_ns"].tolist(), strict=True)
    for (order, read_ns), frame in zip(sorted(reads), log.frames, strict=True):
        ordered.append((order, FrameRecord(Direction.TX if frame.own else Direction.RX, frame, read_ns)))
    cycles = log.cycles
    rows = zip(*(cycles[name].tolist() for name in CycleRecord._fields), strict=True)
    ordered += zip(cycles["order"].tolist(), map(CycleRecord._make, rows), strict=True)
    events = [EventRecord(event.time_ns - offset_ns, event.code, event.text) for event in log.events]
    ordered += zip(tables["/safety"]["order"].tolist() if events else [], events, strict=True)
    items = tuple(item for _, item in sorted(ordered, key=lambda pair: pair[0]))
    if not items or not isinstance(items[0], EventRecord) or items[0].code != RunState.SILENT.name:
        raise LogError(f"{log.path}: the beginning of the run is not in this log, and a rerun starts there")
    return items


class Playback:
    """One run again.

    Args:
        log: what was recorded.
    """

    def __init__(self, log: RunLog) -> None:
        self._items = read_items(log)
        self._estimates, self._learnt = by_step(log), learnt.by_step(log)
        self._layout = log.layout
        self._at = 0
        self._step: int | None = None
        self._refusal: BusError | None = None  # of the next frame by the bus
        self._sent: list[tuple[int | None, Frame]] = []
        self._echoed = 0  # frames of those that were found on the bus
        self._stop_echoes = deque(self._recorded_stop_frames())
        self._stops = 0  # stop frames tried
        self.decisions = 0
        """Cycle records compared."""
        self.frames = 0
        """Sent frames found on the bus."""
        self.events = 0
        """Safety events compared."""
        self.differences: list[Difference] = []
        """Differences in the order in which they came."""

    @property
    def at_end(self) -> bool:
        """Returns True if all that was recorded has been played."""
        return self._at == len(self._items)

    def send(self, frame: Frame) -> None:
        """Take a frame that the guard has let out.

        Raises:
            BusError: the bus had not taken it.
        """
        refusal, self._refusal = self._refusal, None
        if refusal is not None:
            raise refusal
        self._sent.append((self._step, frame))

    def play(self, core: Core) -> None:
        """Play all that was recorded, or until the core leaves it."""
        try:
            core.begin(_time_ns(self._items[0]))
            self._compare(core)
            while not self.at_end:
                self._send_stop_frames(core)
                item = self._items[self._at]
                if isinstance(item, FrameRecord):
                    self._give_read(core)
                elif isinstance(item, EventRecord):
                    self._give_event(core, item)
                else:
                    raise self._left(_words(item), "no command was due")
                self._compare(core)
        except LeftError:
            return
        if core.state is RunState.OVER and core.fault is not Fault.BUS_LOST:  # else the last one may have been lost
            for step, frame in self._sent[self._echoed :]:
                self.differences.append(Difference(step, "sent frame", "no such frame", _hex(frame)))

    # --- what goes in -----------------------------------------------------------------------------------------------

    def _give_read(self, core: Core) -> None:
        """Give the frames of one read, and let the command be sent as it was."""
        frames: list[Frame] = []
        for item in self._items[self._at :]:
            if isinstance(item, FrameRecord):
                frames.append(item.frame)
                if item.read_ns:
                    break
        else:
            self._at = len(self._items)  # the log was cut within it
            return
        try:
            proposal = core.take(frames, item.read_ns)
        except Exception as err:  # of the actor
            self._fail(core, fault_of(err), detail_of(err), item.read_ns)
            return
        self._compare(core)
        if proposal is not None and not self.at_end:
            self._step = proposal.step
            self._answer(core, proposal)

    def _answer(self, core: Core, proposal: Proposal) -> None:
        lost = ""
        for item in self._items[self._at :]:
            if isinstance(item, EventRecord) and item.code == Fault.SEND_QUEUE_FULL.name:
                lost = _detail(item)
                self._refusal = TransmitQueueFullError(lost)
            elif not isinstance(item, EventRecord) or item.code != Fault.PERMISSION_LOST.name:
                break
        else:
            self._at = len(self._items)
            return
        if isinstance(item, CycleRecord):
            decide_ns, send_ns = item.decide_time_ns, item.send_time_ns
        else:
            decide_ns = send_ns = _time_ns(item)
            if not isinstance(item, EventRecord) or item.code not in (Fault.BUS_LOST.name, Fault.WATCHDOG_TRIPPED.name):
                raise self._left(_words(item), f"the record of step {proposal.step}")
            self._refusal = BusError(_detail(item))
        frame = core.commit(proposal, decide_ns)
        if frame is None:
            return
        try:
            core.guard.send(frame, core.state, proposal.sample.receive_time_ns, decide_ns)
        except TransmitQueueFullError:
            core.sent(proposal, decide_ns, lost)
        except BusError:
            pass  # the next record says what came of it
        else:
            core.sent(proposal, send_ns)

    def _give_event(self, core: Core, event: EventRecord) -> None:
        """Give what stands in the log as an event, and does not follow from the frames."""
        fault = Fault.__members__.get(event.code)
        if core.running and fault in WAITED:
            if core.state is RunState.SILENT:
                core.timeout(event.time_ns)
            while not core.records and core.deadline_ns <= event.time_ns:
                core.timeout(event.time_ns)
        elif fault in FROM_OUTSIDE and core.fault is None:
            assert fault is not None
            self._fail(core, fault, _detail(event), event.time_ns)
        elif core.state is RunState.STOPPING and event.code == "STOP_FRAME_NOT_SENT":
            self._refusal = BusError(_detail(event))
            self._send_stop_frame(core, event.time_ns)
            core.note(event.time_ns, event.code, event.text)
        elif core.state is RunState.STOPPING and event.code.endswith("_FAILED"):  # a step of the stop
            core.note(event.time_ns, event.code, event.text)
        elif core.state is RunState.STOPPING and event.code in AT_REST:
            while self._stops < STOP_FRAMES and core.fault is not Fault.WATCHDOG_TRIPPED:
                self._send_stop_frame(core, event.time_ns)
            core.end(event.time_ns)
        if not core.records:
            raise self._left(_words(event), "no such event")

    @staticmethod
    def _fail(core: Core, fault: Fault, detail: str, time_ns: int) -> None:
        core.fail(fault, time_ns)
        core.explain(fault, detail)

    def _send_stop_frames(self, core: Core) -> None:
        """Send the stop frames that were sent before the next sample."""
        while core.state is RunState.STOPPING and self._stop_echoes and self._stop_echoes[0] == core.newest_counter:
            self._stop_echoes.popleft()
            self._send_stop_frame(core, 0)

    def _send_stop_frame(self, core: Core, time_ns: int) -> None:
        self._stops += 1
        with contextlib.suppress(BusError):
            core.guard.send(core.stop_frame(), core.state, time_ns, time_ns)

    def _recorded_stop_frames(self) -> list[int]:
        """Samples that the stop frames on the bus answer."""
        answers = []
        for item in self._items:
            if isinstance(item, FrameRecord) and item.frame.own:
                with contextlib.suppress(FrameError):  # of another log than ours
                    command = self._layout.decode_command(item.frame)
                    answers += [] if command.enable else [command.answers]
        return answers

    # --- what comes out ---------------------------------------------------------------------------------------------

    def _compare(self, core: Core) -> None:
        records, core.records = core.records, []
        for record in records:
            if isinstance(record, EstimateRecord):
                self._compare_numbers("estimate", self._estimates, record.step, record.numbers)
            elif isinstance(record, LearntRecord):
                self._compare_numbers("learnt", self._learnt, record.step, record.numbers)
            elif isinstance(record, FrameRecord | CycleRecord | EventRecord) and not self.at_end:
                item = self._items[self._at]
                self._at += 1
                self._compare_record(item, record)

    def _compare_record(self, item: Item, record: Item) -> None:
        if isinstance(item, CycleRecord) and isinstance(record, CycleRecord):
            self.decisions += 1
            for name, recorded, came in zip(record._fields, item, record, strict=True):
                if not _same(recorded, came):
                    self.differences.append(Difference(item.step, name, repr(recorded), repr(came)))
        elif isinstance(item, EventRecord) and isinstance(record, EventRecord) and item.code == record.code:
            self.events += 1
        elif isinstance(item, FrameRecord) and isinstance(record, FrameRecord):
            if item.frame.own:
                self._find_sent(item.frame)
        else:
            raise self._left(_words(item), _words(record))

    def _compare_numbers(
        self, what: str, of_step: Mapping[int, tuple[float, ...]], step: int, came: tuple[float, ...]
    ) -> None:
        recorded = of_step.get(step)
        if recorded is None and self.at_end:
            return  # the log was cut just there
        if recorded is None or len(recorded) != len(came) or not all(map(_same, recorded, came)):
            self.differences.append(Difference(step, what, repr(recorded), repr(came)))

    def _find_sent(self, echo: Frame) -> None:
        """Find the sent frame whose echo was recorded; those before it were not on the bus."""
        waiting = self._sent[self._echoed : self._echoed + COUNTER_MODULUS]
        bare = echo._replace(time_ns=0, own=False, dropped=0)
        at = next((n for n, (_, frame) in enumerate(waiting) if frame == bare), None)
        if at is None:
            step, came = (waiting[0][0], _hex(waiting[0][1])) if waiting else (self._step, "no such frame")
            self.differences.append(Difference(step, "sent frame", _hex(echo), came))
            self._echoed += bool(waiting)
            return
        for step, frame in waiting[:at]:
            self.differences.append(Difference(step, "sent frame", "no such frame", _hex(frame)))
        self._echoed += at + 1
        self.frames += 1

    def _left(self, recorded: str, came: str) -> LeftError:
        self.differences.append(Difference(self._step, "what came next", recorded, came))
        return LeftError()


def _same(recorded: float, came: float) -> bool:
    """Returns True if equal to the last bit; NaN is NaN, and minus zero is not zero."""
    if recorded != recorded or came != came:
        return recorded != recorded and came != came
    return recorded == came and math.copysign(1.0, recorded) == math.copysign(1.0, came)


def _detail(event: EventRecord) -> str:
    """Text of a fault's event without its cause."""
    cause = FAULTS[Fault[event.code]].cause if event.code in Fault.__members__ else ""
    return "" if event.text == cause else event.text.removeprefix(f"{cause}: ")


def _time_ns(item: Item) -> int:
    match item:
        case FrameRecord():
            return item.frame.time_ns
        case CycleRecord():
            return item.receive_time_ns
        case EventRecord():
            return item.time_ns


def _hex(frame: Frame) -> str:
    return f"{frame.identifier:03x}#{frame.data.hex()}"


def _words(item: Item) -> str:
    match item:
        case FrameRecord():
            return f"frame {_hex(item.frame)}"
        case CycleRecord():
            return f"the record of step {item.step}"
        case EventRecord(_, code, text):
            return f"{code} ({text})"
