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
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import msgspec

from emb_bench.logs.estimates import by_step
from emb_bench.logs.log import RunLog, require_driven
from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import CEILING_CURRENT
from emb_runtime.control.actor import Actor, Still, homing_steps
from emb_runtime.control.core import Core
from emb_runtime.control.loop import detail_of, fault_of
from emb_runtime.control.memory import Proposal
from emb_runtime.control.result import Outcome
from emb_runtime.control.setup import Setup
from emb_runtime.control.stop_condition import StopCondition, parse_stop_condition
from emb_runtime.drives.mapping import mapping_hash
from emb_runtime.errors import BusError, FrameError, LogError, UsageError
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.recorder_process import DIED
from emb_runtime.log.ring_buffer import EstimateRecord, EventRecord, FrameRecord
from emb_runtime.records import CycleRecord, Frame, RunState
from emb_runtime.safety.guard import Guard
from emb_runtime.safety.heartbeat import STOP_FRAMES
from emb_runtime.safety.shield_design import make_law
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
    """Frames, cycles and events of a log, in the order in which the loop recorded them; times are monotonic [ns]."""
    offset_ns, tables = log.wall_offset_ns, log.tables
    ordered: list[tuple[int, Item]] = []
    reads: list[tuple[int, int]] = []
    for topic in ("/can/rx", "/can/tx"):
        if topic in tables:
            log.require(topic, ["read_time_ns"])
            reads += zip(tables[topic]["order"].tolist(), tables[topic]["read_time_ns"].tolist(), strict=True)
    for (order, read_ns), frame in zip(sorted(reads), log.frames, strict=True):
        ordered.append((order, FrameRecord(frame, read_ns)))
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
    """The run of a log again."""

    def __init__(self, log: RunLog) -> None:
        self._items = read_items(log)
        self._estimates = by_step(log)
        self._layout = log.layout
        self._at = 0
        self._step: int | None = None
        self._refusal: BusError | None = None  # of the next frame by the bus
        self._sent: list[tuple[int | None, Frame]] = []
        self._echoed = 0  # frames of those that were found on the bus
        self._stop_echoes = deque(self._recorded_stop_frames())
        self._stops = 0  # stop frames tried
        self.decisions = 0  # Cycle records compared
        self.frames = 0  # Sent frames found on the bus
        self.events = 0  # Safety events compared
        self.differences: list[Difference] = []  # Differences in the order in which they came

    @property
    def at_end(self) -> bool:
        """Returns True if all that was recorded has been played."""
        return self._at == len(self._items)

    def send(self, frame: Frame) -> None:
        """Take a frame that the guard has let out."""
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
        frame = core.answer(proposal, decide_ns)
        if frame is None:
            return
        try:
            core.guard.send(frame)
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
        core.fail(fault, time_ns, detail)

    def _send_stop_frames(self, core: Core) -> None:
        """Send the stop frames that were sent before the next sample."""
        while core.state is RunState.STOPPING and self._stop_echoes and self._stop_echoes[0] == core.newest_counter:
            self._stop_echoes.popleft()
            self._send_stop_frame(core, 0)

    def _send_stop_frame(self, core: Core, time_ns: int) -> None:
        self._stops += 1
        with contextlib.suppress(BusError):
            core.guard.send(core.stop_frame(time_ns))

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
        records = core.records.copy()
        core.records.clear()
        for record in records:
            if isinstance(record, EstimateRecord):
                self._compare_estimate(record)
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

    def _compare_estimate(self, record: EstimateRecord) -> None:
        _, step, came = record
        recorded = self._estimates.get(step)
        if recorded is None and self.at_end:
            return  # the log was cut just there
        if recorded is None or len(recorded) != len(came) or not all(map(_same, recorded, came)):
            self.differences.append(Difference(step, "estimate", repr(recorded), repr(came)))

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


if TYPE_CHECKING:
    from emb_runtime.policy.policy import Policy

SHOWN = 10  # Differences that are printed, unless all are asked for


class Recorded(msgspec.Struct, frozen=True):
    """Part of a log's identity that the loop depends on."""

    purpose: Literal["experiment", "homing"]
    steps: Annotated[int, msgspec.Meta(ge=1)]  # Samples that the run was to answer
    limit: Annotated[float, msgspec.Meta(ge=0.0, le=CEILING_CURRENT)]  # Largest current that might be sent [A]


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


def rerun_as_recorded(log: RunLog) -> Rerun:
    """Run the loop of a log again with the policy that it carries, and compare what it carries with its hashes."""
    if recorded_run(log).purpose == "homing":
        again = rerun(log, Still(), log.bench.limits.current)
        carried: dict[str, str] = {}
    else:
        policy = carried_policy(log)
        again = rerun(log, policy, policy.contract.limits.current, _stop_condition(log))
        carried = {"policy_sha256": policy.sha256}
    return replace(again, differences=(*_identity(log, carried), *again.differences))


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
    setup = Setup(
        bench=bench,
        layout=layout,
        law=make_law(bench)._replace(steps=run.steps),
        actor=actor,
        current_limit=current_limit,
        steps=run.steps,
        guard=Guard(layout, bench, playback.send, limit=run.limit),
        limit=run.limit,
        homing=run.purpose == "homing",
        stop_condition=stop_condition,
    )
    core = Core(setup)
    playback.play(core)
    outcome = core.outcome() if core.state is RunState.OVER and playback.at_end else None
    return Rerun(
        log=log,
        decisions=playback.decisions,
        frames=playback.frames,
        events=playback.events,
        differences=(*playback.differences, *(() if outcome is None else _end(log.end, outcome))),
        followed=playback.at_end,
        outcome=outcome,
    )


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
    """Stop condition of the run, if it had one."""
    stop_when = log.run.get("stop_when")
    try:
        return None if stop_when is None else parse_stop_condition(stop_when, estimated(log.bench))
    except UsageError as err:
        raise LogError(f"{log.path}: emb.run: stop_when: {err}") from err


def _end(recorded: Mapping[str, str], outcome: Outcome) -> list[Difference]:
    """Differences between the outcome in the log's trailer and that of the rerun; a run whose process died has none."""
    if recorded.get("exit_reason", DIED) == DIED:
        return []
    came = {"exit_reason": outcome.fault.name if outcome.fault else "DONE"}
    came |= {name: str(value) for name, value in asdict(outcome.counters).items()}
    return [
        Difference(None, name, recorded[name], value)
        for name, value in came.items()
        if name in recorded and recorded[name] != value
    ]


def _identity(log: RunLog, carried: Mapping[str, str]) -> list[Difference]:
    """Differences between the hashes of what the log carries and those that it records."""
    recorded = dict(log.run)
    if log.drive_files is not None:
        carried = {**carried, "mapping_sha256": mapping_hash(*log.drive_files)}
        recorded["mapping_sha256"] = log.metadata["emb.drive"]["sha256"]
    return [
        Difference(None, name, recorded[name], value)
        for name, value in {**carried, "bench_hash": log.bench.identity_hash}.items()
        if recorded.get(name, value) != value
    ]


def document(again: Rerun) -> dict[str, Any]:
    """The result as plain data."""
    log = again.log
    return {
        "log": str(log.path),
        "complete": log.complete,
        "missing": log.missing,
        "reproduced": again.reproduced,
        "decisions": again.decisions,
        "frames": again.frames,
        "events": again.events,
        "ended": again.outcome is not None,
        "home": None if again.outcome is None else again.outcome.home,
        "followed": again.followed,
        "differences": [difference._asdict() for difference in again.differences],
    }


def text(again: Rerun, *, verbose: bool = False) -> str:
    """Result as text; with ``verbose`` every difference."""
    log, shown = again.log, len(again.differences) if verbose else SHOWN
    lines = [f"WARNING: {log.missing}"] if log.missing else []
    counts = f"{again.decisions} decisions, {again.frames} sent frames, {again.events} events"
    if again.reproduced:
        lines.append(f"reproduced   each of {counts}")
    else:
        found = len(again.differences)
        lines.append(f"NOT reproduced: {found} difference{'s' * (found != 1)} in {counts}")
    if again.outcome is not None:
        home = "home" if again.outcome.home else "not home"
        lines.append(f"outcome      {again.outcome.fault.name if again.outcome.fault else 'DONE'}, {home}")
    elif again.followed:
        lines.append("outcome      none: the log ends before the run does, and was followed up to there")
    else:
        lines.append("outcome      none: the loop went another way than the log, the last difference says where")
    for difference in again.differences[:shown]:
        where = "" if difference.step is None else f"step {difference.step}, "
        lines.append(f"  {where}{difference.what}: recorded {difference.recorded}, came {difference.came}")
    if len(again.differences) > shown:
        lines.append(f"  and {len(again.differences) - shown} more (-v shows all)")
    if not again.reproduced:
        names = ("tool", "python", "numpy", "onnxruntime")
        made = ", ".join(f"{name} {log.run[name]}" for name in names if name in log.run)
        lines.append(f"  the log was made with {made}: rounding may differ with others")
    return "\n".join(lines)
