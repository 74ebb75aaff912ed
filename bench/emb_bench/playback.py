"""Playing the run of a log again: its inputs go into a core, and what the core records is compared with the log.

Inputs are the frames, each read with its time, and the calls in ``/input``. The core records each before what comes of
it: the order of the log is that of the core's records.
"""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from itertools import islice
from operator import itemgetter
from typing import NamedTuple

from emb_bench.logs.estimates import by_step
from emb_bench.logs.log import RunLog
from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.control.core import Core
from emb_runtime.control.loop import STOP_FRAME_NOT_SENT, detail_of, fault_of
from emb_runtime.control.memory import Proposal
from emb_runtime.errors import LogError
from emb_runtime.log.ring_buffer import EstimateRecord, EventRecord, FrameRecord, InputRecord, Record
from emb_runtime.records import Call, CycleRecord, Frame, RunState
from emb_runtime.safety.guard import GuardRejectedError
from emb_runtime.safety.state_machine import Fault
from emb_runtime.system.terminal import one_line

Item = FrameRecord | CycleRecord | EventRecord | InputRecord
ANSWER = Call.ANSWER.name
CALLS = {call.value: call.name for call in Call}
OF_THE_BUS = Fault.BUS_LOST.name, Fault.WATCHDOG_TRIPPED.name  # Faults that keep a command back


class Difference(NamedTuple):
    """Difference between the log and the rerun."""

    step: int | None  # Step of the experiment; None before and after it
    what: str
    recorded: str
    came: str


class LeftError(Exception):
    """The core has left the log: nothing after this can be compared."""


def read_items(log: RunLog) -> deque[Item]:
    """Inputs and records of the core of a log, in its order, but estimates; times are monotonic [ns]."""
    if "/input" not in log.topics:
        found = "expected the topic /input, with what went into the core, and it has none"
        raise LogError(f"{log.path}: {found}: record the run anew, or rerun it with the version that made it")
    log.require("/cycle", CycleRecord._fields)
    reads = sorted(row for topic in ("/can/rx", "/can/tx") for row in log.rows(topic, "order", "read_time_ns"))
    placed: list[tuple[int, Item]] = []
    placed += [(at, FrameRecord(frame, read_ns)) for (at, read_ns), frame in zip(reads, log.frames, strict=True)]
    placed += [(at, CycleRecord._make(row)) for at, *row in log.rows("/cycle", "order", *CycleRecord._fields)]
    kinds: tuple[tuple[str, type[EventRecord | InputRecord]], ...] = (("/safety", EventRecord), ("/input", InputRecord))
    for topic, kind in kinds:
        rows = log.rows(topic, "order", "publish_time", *kind._fields[1:])
        placed += [(at, kind(time_ns - log.wall_offset_ns, *row)) for at, time_ns, *row in rows]
    items = deque(item for _, item in sorted(placed, key=itemgetter(0)))
    if not items or not isinstance(items[0], InputRecord) or items[0].call != Call.BEGIN:
        raise LogError(f"{log.path}: the beginning of the run is not in this log, and a rerun starts there")
    return items


class Playback:
    """The run of a log again."""

    def __init__(self, log: RunLog) -> None:
        self._items = read_items(log)  # what was not played yet
        self._estimates = by_step(log)
        self._due, self._came = tuple[str, ...](), ""  # inputs of which one comes next, and what the core has done
        self._proposal: Proposal | None = None
        self._lost = ""  # why the bus has no room for the next frame
        self._sent = deque[tuple[int | None, Frame]]()  # steps and frames that were not found on the bus yet
        self._step: int | None = None
        self.cut = False  # The log ends before the run does
        self.counts = Counter[str]()  # Decisions, sent frames and events that were compared
        self.differences: list[Difference] = []  # In the order in which they came

    @property
    def at_end(self) -> bool:
        """Returns True if all that was recorded has been played."""
        return not self._items

    def send(self, frame: Frame) -> None:
        """Take a frame that the guard has let out."""
        if self._lost:
            raise TransmitQueueFullError(self._lost)
        self._sent.append((self._step, frame))

    def play(self, core: Core) -> None:
        """Play all that was recorded, or until the core leaves it."""
        with contextlib.suppress(LeftError):
            while not self.at_end:
                self._give(core, self._items[0])
                for record in core.records:
                    self._compare(record)
                core.records.clear()
            if core.state is RunState.OVER and core.fault is not Fault.BUS_LOST:  # else the last may have been lost
                self._skip_sent(len(self._sent))

    # --- what goes in -----------------------------------------------------------------------------------------------

    def _give(self, core: Core, item: Item) -> None:
        """Give an input to the core: the next item must be one, and one that is due."""
        name = _name(item)
        if name not in self._due if self._due else name in (ANSWER, None):
            raise self._left(item, self._came or "nothing")
        self._due, self._came = (), ""
        try:
            if isinstance(item, InputRecord):
                self._give_call(core, item)
            else:
                self._give_read(core)
        except LeftError:
            raise
        except Exception as err:  # of the actor; of the core, in a log of nonsense
            fault = fault_of(err).name
            self._due, self._came = (fault, Fault.WATCHDOG_TRIPPED.name), f"{fault} ({detail_of(err)})"

    def _give_read(self, core: Core) -> None:
        """Give the frames of one read."""
        frames: list[Frame] = []
        for item in self._items:
            if isinstance(item, FrameRecord):
                frames.append(item.frame)
                if item.read_ns:
                    break
        else:
            if other := next((item for item in self._items if isinstance(item, CycleRecord | InputRecord)), None):
                raise self._left(other, "frames without the time of their read")
            self._items.clear()  # the log was cut within it
            return
        self._proposal = core.take(frames, item.read_ns)
        if self._proposal is not None:
            self._step = self._proposal.step
            self._due, self._came = (ANSWER, *OF_THE_BUS), f"the record of step {self._step}"

    def _give_call(self, core: Core, item: InputRecord) -> None:
        time_ns, call, _, code, text = item
        if call == Call.ANSWER and self._proposal is not None:
            self._answer(core, self._proposal, item)
        elif call == Call.LATCH:
            core.latch(Fault[code], time_ns)
        elif call == Call.EXPLAIN:
            core.explain(Fault[code], time_ns, text)
        elif call == Call.STOP_FRAME:
            with contextlib.suppress(GuardRejectedError):
                core.guard.send(core.stop_frame(time_ns))
        elif call == Call.NOTE:
            core.note(time_ns, code, text)
            if code == STOP_FRAME_NOT_SENT and self._sent:
                self._sent.pop()
        else:
            {Call.BEGIN: core.begin, Call.TIMEOUT: core.timeout, Call.END: core.end}[Call(call)](time_ns)

    def _answer(self, core: Core, proposal: Proposal, item: InputRecord) -> None:
        """Answer a sample; the frame is sent or lost as it was, unless the run ended just there."""
        frame = core.answer(proposal, item.time_ns)
        if frame is None:
            return
        if len(self._items) > 1 and _name(self._items[1]):
            self._due, self._came = OF_THE_BUS, f"the record of step {proposal.step}"
            return
        self._lost = item.text
        with contextlib.suppress(TransmitQueueFullError):
            core.guard.send(frame)
        core.sent(proposal, item.time_ns if self._lost else item.send_time_ns, self._lost)
        self._lost = ""

    # --- what comes out ---------------------------------------------------------------------------------------------

    def _compare(self, came: Record) -> None:
        if isinstance(came, EstimateRecord):
            recorded = self._estimates.get(came.step)
            if recorded is not None or not self.at_end:  # else the log was cut just there
                self._check(came.step, "estimate", recorded, came.numbers)
        elif isinstance(came, FrameRecord | CycleRecord | EventRecord | InputRecord):
            if self.at_end:
                self.cut = True
            else:
                self._compare_item(self._items.popleft(), came)

    def _compare_item(self, item: Item, came: Item) -> None:
        if isinstance(item, CycleRecord) and isinstance(came, CycleRecord):
            self.counts["decisions"] += 1
            for name, recorded, value in zip(item._fields, item, came, strict=True):
                self._check(item.step, name, recorded, value)
        elif isinstance(item, EventRecord) and isinstance(came, EventRecord) and item.code == came.code:
            self.counts["events"] += 1
        elif isinstance(item, FrameRecord) and isinstance(came, FrameRecord):
            if item.frame.own:
                self._find_sent(item.frame)
        elif not (isinstance(item, InputRecord) and isinstance(came, InputRecord)):
            raise self._left(item, _words(came))

    def _find_sent(self, echo: Frame) -> None:
        """Find the sent frame whose echo was recorded; those before it were not on the bus."""
        bare = echo._replace(time_ns=0, own=False, dropped=0)
        waiting = [frame for _, frame in islice(self._sent, COUNTER_MODULUS)]
        if bare in waiting:
            self._skip_sent(waiting.index(bare))
            self.counts["frames"] += 1
        step, came = self._sent.popleft() if self._sent else (self._step, None)
        self._check(step, "sent frame", _hex(echo), _hex(came))

    def _skip_sent(self, count: int) -> None:
        for _ in range(count):
            step, frame = self._sent.popleft()
            self._check(step, "sent frame", _hex(None), _hex(frame))

    def _check(self, step: int | None, what: str, recorded: object, came: object) -> None:
        """Compare to the last bit: NaN is NaN, and minus zero is not zero."""
        if str(recorded) != str(came):
            self.differences.append(Difference(step, what, str(recorded), str(came)))

    def _left(self, item: Item, came: str) -> LeftError:
        self.differences.append(Difference(self._step, "what came next", _words(item), one_line(came)))
        return LeftError()


def _name(item: Item) -> str | None:
    """Name of an input that may be due, an answer or a fault; empty of another one, None of what is none."""
    if not isinstance(item, InputRecord):
        return "" if isinstance(item, FrameRecord) else None
    if item.call == Call.LATCH:
        return item.code
    return ANSWER if item.call == Call.ANSWER else ""


def _hex(frame: Frame | None) -> str:
    return f"{frame.identifier:03x}#{frame.data.hex()}" if frame else "no such frame"


def _words(item: Item) -> str:
    if isinstance(item, FrameRecord):
        return f"frame {_hex(item.frame)}"
    if isinstance(item, CycleRecord):
        return f"the record of step {item.step}"
    name = item.code or CALLS.get(item.call, "an unknown call") if isinstance(item, InputRecord) else item.code
    return one_line(f"{name} ({item.text})" if item.text else name)
