"""Rerun of a log: the same core gets the recorded inputs, and its new records are compared with the log.

Inputs are the frames, each read with its time, and the calls in ``/input``. The core records each before what comes of
it: the order of the log is that of the core's records.
"""

from __future__ import annotations

import contextlib
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import msgspec

from emb_bench.logs.estimates import by_step
from emb_bench.logs.log import RunLog, require_driven
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import CEILING_CURRENT
from emb_runtime.control.actor import Actor, Still, homing_steps
from emb_runtime.control.core import Core
from emb_runtime.control.loop import STOP_FRAME_NOT_SENT, detail_of, fault_of
from emb_runtime.control.result import Outcome
from emb_runtime.control.setup import Setup
from emb_runtime.control.stop_condition import StopCondition, parse_stop_condition
from emb_runtime.drives.mapping import mapping_hash
from emb_runtime.errors import LogError, UsageError
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.recorder_process import DIED
from emb_runtime.log.ring_buffer import EstimateRecord, EventRecord, FrameRecord, InputRecord, Record, pack, unpack
from emb_runtime.records import Call, CycleRecord, Frame, RunState
from emb_runtime.safety.guard import Guard, GuardRejectedError
from emb_runtime.safety.shield_design import make_law
from emb_runtime.safety.state_machine import Fault
from emb_runtime.system.terminal import one_line

if TYPE_CHECKING:
    from emb_runtime.policy.policy import Policy

Item = FrameRecord | CycleRecord | EventRecord | InputRecord
ANSWER = Call.ANSWER.name
CALLS = {call.value: call.name for call in Call}
OF_THE_BUS = Fault.BUS_LOST.name, Fault.WATCHDOG_TRIPPED.name  # Faults that keep a command back
OF_THE_DRIVER = (*OF_THE_BUS, Fault.INTERNAL.name)  # Faults that may come while it sends an answer
DUE = Call.ANSWER.value, Call.LATCH.value  # Calls of which one may have to come next


class Difference(NamedTuple):
    """Difference between a log and its rerun."""

    step: int | None  # Step of the experiment; None before and after it
    what: str
    recorded: str
    came: str


@dataclass(frozen=True)
class Rerun:
    """Result of running a log's loop again."""

    log: RunLog
    decisions: int  # Cycle records compared
    frames: int  # Sent frames compared
    events: int  # Safety events compared
    differences: tuple[Difference, ...]  # Differences in the order in which they occurred
    followed: bool
    """True if the whole log was played; if not, the loop diverged from it, and the last difference shows where."""
    outcome: Outcome | None
    """Outcome of the rerun; None if it diverged from the log, or the log ended, before the rerun did."""

    @property
    def reproduced(self) -> bool:
        """Returns True if everything came out as recorded."""
        return not self.differences


class Recorded(msgspec.Struct, frozen=True):
    """Part of a log's identity that the loop depends on."""

    purpose: Literal["experiment", "homing"]
    steps: Annotated[int, msgspec.Meta(ge=1)]  # Samples that the run was to answer
    limit: Annotated[float, msgspec.Meta(ge=0.0, le=CEILING_CURRENT)]  # Largest current that might be sent [A]


def rerun_as_recorded(log: RunLog) -> Rerun:
    """Run the loop of a log again with the policy that it carries, and compare what it carries with its hashes."""
    recorded, came = dict(log.run), dict[str, str]()
    if recorded_run(log).purpose == "homing":
        again = rerun(log, Still(), log.bench.limits.current)
    else:
        policy = carried_policy(log)
        came["policy_sha256"] = policy.sha256
        again = rerun(log, policy, policy.contract.limits.current, _stop_condition(log))
    came["bench_hash"] = log.bench.identity_hash
    if log.drive_files is not None:
        came["mapping_sha256"] = mapping_hash(*log.drive_files)
        recorded["mapping_sha256"] = log.metadata["emb.drive"]["sha256"]
    return replace(again, differences=(*_differences(recorded, came), *again.differences))


def carried_policy(log: RunLog) -> Policy:
    """The policy that a log carries, with every check that ``emb-run`` makes."""
    if "policy.onnx" not in log.attachments:
        raise LogError(f"{log.path}: the log carries no policy.onnx, so its decisions cannot be made again")
    from emb_runtime.policy.trial import admit_policy  # takes its time, and no other command needs it

    return admit_policy(log.attachments["policy.onnx"], log.bench)


def rerun(log: RunLog, actor: Actor, current_limit: float, stop_condition: StopCondition | None = None) -> Rerun:
    """Run the loop of a log again with what decided, the largest current of its contract [A] and its stop condition."""
    bench, layout, run = log.bench, log.layout, recorded_run(log)
    playback = Playback(log)
    guard = Guard(layout, bench, playback.send, limit=run.limit)
    law, homing = make_law(bench)._replace(steps=run.steps), run.purpose == "homing"
    core = Core(Setup(bench, layout, law, actor, current_limit, guard, run.limit, homing, stop_condition))
    playback.play(core)
    counts, differences, outcome = playback.counts, playback.differences, None
    if core.state is RunState.OVER and playback.ended and not playback.items:
        outcome = core.outcome()
        end = {"exit_reason": outcome.fault.name if outcome.fault else "DONE"}
        end |= {name: str(value) for name, value in asdict(outcome.counters).items()}
        if log.end.get("exit_reason", DIED) != DIED:
            differences += _differences(log.end, end)
    compared = counts[CycleRecord], counts[FrameRecord], counts[EventRecord]
    return Rerun(log, *compared, tuple(differences), not playback.items, outcome)


def recorded_run(log: RunLog) -> Recorded:
    """Identity of a log's run, as far as the loop depends on it."""
    require_driven(log)
    try:
        run = msgspec.convert(dict(log.run), Recorded, strict=False)
    except msgspec.ValidationError as err:
        raise LogError(f"{log.path}: emb.run: {err}") from err
    most = homing_steps(log.bench) if run.purpose == "homing" else log.bench.timing.horizon
    if run.steps > most:
        raise LogError(f"{log.path}: emb.run: steps: expected at most {most}, got {run.steps}")
    return run


def _stop_condition(log: RunLog) -> StopCondition | None:
    stop_when = log.run.get("stop_when")
    try:
        return None if stop_when is None else parse_stop_condition(stop_when, estimated(log.bench))
    except UsageError as err:
        raise LogError(f"{log.path}: emb.run: stop_when: {err}") from err


def _differences(recorded: Mapping[str, str], came: Mapping[str, str]) -> list[Difference]:
    found = ((name, recorded.get(name, value), value) for name, value in came.items())
    return [Difference(None, name, said, value) for name, said, value in found if said != value]


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


class DivergedError(Exception):
    """The core has left the log: nothing after this can be compared."""


class Sent(NamedTuple):
    """A frame that the core has sent."""

    step: int | None
    frame: Frame
    was_there: bool  # On the bus, by the record of the call; else it may have been


class Playback:
    """Inputs of a log for a core, and a comparison of what the core records with what the log has."""

    def __init__(self, log: RunLog) -> None:
        self.items = read_items(log)  # What was not played yet
        self.ended = True  # False if the log ends before the run does
        self.counts = Counter[type[Record]]()  # Records that were compared
        self.differences: list[Difference] = []  # In the order in which they came
        self._estimates = by_step(log)
        self._due, self._came = tuple[str, ...](), ""  # inputs of which one comes next, and what the core has done
        self._sent = deque[Sent]()  # not found on the bus yet
        self._stop_frame: Sent | None = None  # of the last such call; None where the guard let none pass
        self._step: int | None = None

    def send(self, frame: Frame) -> None:
        """Bus of the rerun: takes a frame, or has no room for it, as recorded with the call in hand."""
        call = self.items[0]
        assert isinstance(call, InputRecord)
        if call.text:
            raise TransmitQueueFullError(call.text)
        is_stop = call.call == Call.STOP_FRAME
        sent = Sent(self._step, frame, call.send_time_ns > 0 or is_stop)
        self._sent.append(sent)
        if is_stop:
            self._stop_frame = sent

    def play(self, core: Core) -> None:
        """Play all that was recorded, or until the core leaves it."""
        with contextlib.suppress(DivergedError):
            while self.items:
                self._give(core, self.items[0])
                for record in core.records:
                    self._compare(record)
                core.records.clear()
            if core.state is RunState.OVER:
                for step, numbers in self._estimates.items():
                    self._check(step, "estimate", numbers, None)
                if core.fault is not Fault.BUS_LOST:  # else the last may have been lost
                    self._find_sent(None)

    # --- what goes in -----------------------------------------------------------------------------------------------

    def _give(self, core: Core, item: Item) -> None:
        """Give an input to the core: the next item must be one, and one that is due."""
        name = _name(item) if isinstance(item, InputRecord) and item.call in DUE else ""
        is_input = isinstance(item, InputRecord | FrameRecord)
        if name not in self._due if self._due else name == ANSWER or not is_input:
            raise self._diverged(item, self._came or "nothing")
        self._due, self._came = (), ""
        try:
            if isinstance(item, InputRecord):
                self._call(core, item)
            else:
                self._read(core)
        except DivergedError:
            raise
        except Exception as err:  # of the actor; of the core, in a log of nonsense
            fault = fault_of(err).name
            self._due, self._came = (fault, Fault.WATCHDOG_TRIPPED.name), f"{fault} ({detail_of(err)})"

    def _read(self, core: Core) -> None:
        """Give the frames of one read."""
        frames: list[Frame] = []
        for item in self.items:
            if isinstance(item, FrameRecord):
                frames.append(item.frame)
                if item.read_ns:
                    break
        else:
            if other := next((item for item in self.items if isinstance(item, CycleRecord | InputRecord)), None):
                raise self._diverged(other, "frames without the time of their read")
            self.items.clear()  # the log was cut within it
            return
        core.process_frames(frames, item.read_ns)
        if core.has_answer:
            self._step = core.setup.memory.step
            self._due, self._came = (ANSWER, *OF_THE_BUS), f"the record of step {self._step}"

    def _call(self, core: Core, item: InputRecord) -> None:
        time_ns, call, _, code, text = item
        match call:
            case Call.ANSWER:
                if (frame := core.answer(time_ns)) is not None:
                    self._answer(core, frame, item)
            case Call.LATCH:
                core.latch(Fault[code], time_ns)
            case Call.EXPLAIN:
                core.explain(Fault[code], time_ns, text)
            case Call.NOTE:
                core.note(time_ns, code, text)
                # The guard may have let none pass: then the last that waits is another one.
                if code == STOP_FRAME_NOT_SENT and self._sent and self._sent[-1] is self._stop_frame:
                    self._sent.append(self._sent.pop()._replace(was_there=False))
            case Call.STOP_FRAME:
                self._stop_frame = None
                with contextlib.suppress(GuardRejectedError):
                    core.guard.send(core.stop_frame(time_ns))
            case _:
                {Call.BEGIN: core.begin, Call.TIMEOUT: core.timeout, Call.END: core.end}[Call(call)](time_ns)

    def _answer(self, core: Core, frame: Frame, item: InputRecord) -> None:
        """Send or lose the frame of an answer as it was; where neither was recorded a fault came between."""
        try:
            core.guard.send(frame)
        except TransmitQueueFullError as err:
            core.sent(item.time_ns, str(err))
        else:
            if item.send_time_ns:
                core.sent(item.send_time_ns)
            else:
                self._due, self._came = OF_THE_DRIVER, f"the record of step {self._step}"

    # --- what comes out ---------------------------------------------------------------------------------------------

    def _compare(self, came: Record) -> None:
        if isinstance(came, EstimateRecord):
            numbers = self._estimates.pop(came.step, None)
            if numbers is not None or self.items:  # else the log was cut just there
                self._check(came.step, "estimate", numbers, came.numbers)
            return
        if not self.items:
            self.ended = False
            return
        item = self.items.popleft()
        if isinstance(item, FrameRecord) and isinstance(came, FrameRecord):
            if item.frame.own:
                self._find_sent(item.frame)
            return
        if type(item) is not type(came) or getattr(item, "code", "") != getattr(came, "code", ""):
            raise self._diverged(item, _words(came))
        self.counts[type(came)] += 1
        step, of = (item.step, "") if isinstance(item, CycleRecord) else (self._step, f" of {_name(item)}")
        # As they get into a log, where the ring cuts long texts.
        for name, recorded, value in zip(item._fields, unpack(*pack(item)), unpack(*pack(came)), strict=True):
            self._check(step, name + of, recorded, value)

    def _find_sent(self, echo: Frame | None) -> None:
        """Find the sent frame whose echo was recorded, None at the end: those before it were not on the bus.

        An echo of no frame that waits is compared with the first that was on the bus.
        """
        bare = echo and echo._replace(time_ns=0, own=False, dropped=0)
        is_other = echo is not None and all(sent.frame != bare for sent in self._sent)
        while self._sent:
            step, frame, was_there = self._sent.popleft()
            if frame == bare or (is_other and was_there):
                self.counts[FrameRecord] += 1
                self._check(step, "sent frame", _hex(bare), _hex(frame))
                return
            if was_there:
                self._check(step, "sent frame", _hex(None), _hex(frame))
        self._check(self._step, "sent frame", _hex(bare), _hex(None))

    def _check(self, step: int | None, what: str, recorded: object, came: object) -> None:
        """Compare to the last bit: NaN is NaN, and minus zero is not zero."""
        if str(recorded) != str(came):
            self.differences.append(Difference(step, what, str(recorded), str(came)))

    def _diverged(self, item: Item, came: str) -> DivergedError:
        self.differences.append(Difference(self._step, "what came next", _words(item), one_line(came)))
        return DivergedError()


def _hex(frame: Frame | None) -> str:
    return f"{frame.identifier:03x}#{frame.data.hex()}" if frame else "no such frame"


def _name(record: Record) -> str:
    """Code of a fault or an event, or name of an input."""
    return getattr(record, "code", "") or CALLS.get(getattr(record, "call", -1), "an unknown call")


def _words(record: Record) -> str:
    if isinstance(record, FrameRecord):
        return f"frame {_hex(record.frame)}"
    if isinstance(record, CycleRecord):
        return f"the record of step {record.step}"
    text = getattr(record, "text", "")
    return one_line(f"{_name(record)} ({text})" if text else _name(record))
