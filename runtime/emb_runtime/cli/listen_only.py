"""``--read-only``: the pre-flight's listening, for as long as was asked for, with a log; nothing is ever sent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from emb_runtime.cli.bus_monitor import BusMonitor, BusStatistics
from emb_runtime.cli.options import Plan
from emb_runtime.cli.preflight import CheckResult, RefusedError, check, refuse
from emb_runtime.cli.preflight import table as preflight_table
from emb_runtime.cli.session import Bus, Console, findings, paced_receive, push_clock, start_recorder
from emb_runtime.cli.summary import log_facts, result_facts
from emb_runtime.control.start_conditions import Bounds, StartConditions
from emb_runtime.errors import EXIT_DONE, EXIT_LOG, BusError
from emb_runtime.log.recorder import Recorder, RecorderResult
from emb_runtime.records import Frame, RunType
from emb_runtime.safety.state_machine import FAULTS, Event, Fault, StateMachine, timeouts
from emb_runtime.system.terminal import as_json


@dataclass(frozen=True)
class StartCheck:
    """Decision on whether a run could begin."""

    fault: Fault | None  # Fault that it would be in a run; None as well where something is refused that no run comes to
    detail: str  # Reason why a run could not begin; empty if it could
    exit_code: int

    @property
    def result(self) -> str:
        """Decision in a word."""
        if self.fault is not None:
            return self.fault.name
        return "REFUSED" if self.detail else "DONE"


@dataclass(frozen=True)
class ListenResult:
    """Result of listening."""

    lines: tuple[CheckResult, ...]  # Pre-flight of what was heard
    heard: BusStatistics
    verdict: StartCheck
    log: RecorderResult

    @property
    def exit_code(self) -> int:
        """Exit code of the command."""
        return self.verdict.exit_code or (EXIT_DONE if self.log.complete else EXIT_LOG)


def read(plan: Plan, bus: Bus, path: Path, console: Console) -> ListenResult:
    """Listen, and log all that comes.

    Args:
        plan: what was asked for.
        bus: open.
        path: of the log, which must not exist.
        console: the operator.

    Raises:
        UsageError: the log cannot be written.
    """
    recorder = start_recorder(plan, bus, RunType.LISTEN_ONLY, path, (), 0)
    clock = bus.clock
    trailer = {"exit_reason": Fault.INTERNAL.name, "detail": "the listening ended before its time"}
    try:
        push_clock(recorder, clock)
        machine = StateMachine(timeouts(plan.bench), recorder.push_event)
        machine.handle_event(Event.PREPARED, clock.now_ns())

        def rejected(_frame: Frame, why: str) -> None:
            recorder.push_event(clock.now_ns(), "FRAME_REJECTED", why)

        monitor = BusMonitor(plan.layout, plan.bench, rejected)

        ended = _listen(plan, bus, paced_receive(bus, recorder), monitor, machine, recorder, console.stop_requested)
        heard = monitor.statistics()
        start_conditions = StartConditions(plan.bench, plan.layout, Bounds(plan.bench), anywhere=False)
        lines = check(findings(plan, bus, start_conditions, heard, plan.listen, path))
        verdict = ended or _verdict(lines)
        if verdict.fault is not None:
            machine.fail(verdict.fault, verdict.detail, clock.now_ns())
        push_clock(recorder, clock)
        trailer = {"exit_reason": verdict.result, "detail": verdict.detail, "heard": as_json(heard_document(heard))}
        trailer["preflight"] = as_json([line.document() for line in lines])
    finally:
        result = recorder.finish(trailer)
    return ListenResult(lines, heard, verdict, result)


def _listen(
    plan: Plan,
    bus: Bus,
    receive: Callable[[int], Frame | None],
    monitor: BusMonitor,
    machine: StateMachine,
    recorder: Recorder,
    stop_requested: Callable[[], bool],
) -> StartCheck | None:
    """Take every frame until the time is over; returns what ended it before, if something did."""
    now_ns = bus.clock.now_ns()
    deadline_ns = now_ns + round(plan.listen * 1e9)
    while now_ns < deadline_ns:
        if stop_requested():  # heard enough: what was heard is judged
            break
        try:
            frame = receive(min(deadline_ns, now_ns + 10 * plan.bench.timing.sample_time_ns))
        except BusError as err:
            return _stopped(Fault.BUS_LOST, str(err))
        now_ns = bus.clock.now_ns()
        if frame is not None:
            recorder.push_frame(frame)
            if monitor.take(frame) is not None:
                machine.handle_event(Event.PAIR, frame.time_ns)
    return None


def _stopped(fault: Fault, detail: str = "") -> StartCheck:
    return StartCheck(fault, detail or FAULTS[fault].cause, FAULTS[fault].exit_code)


def _verdict(lines: tuple[CheckResult, ...]) -> StartCheck:
    try:
        refuse(lines)
    except RefusedError as err:
        return StartCheck(err.fault, str(err), err.exit_code)
    return StartCheck(None, "", EXIT_DONE)


def heard_document(heard: BusStatistics) -> dict[str, Any]:
    """Bus statistics as plain data."""
    status, sample = heard.status, heard.sample
    fields = asdict(heard)
    fields["status"] = None if status is None else _names(status)
    fields["sample"] = None if sample is None else _names(sample)
    return fields


def _names(record: Any) -> dict[str, Any]:
    """A record's fields, with the names of what is enumerated."""
    return {name: getattr(value, "name", value) for name, value in record._asdict().items()}


def document(plan: Plan, iface: str, read: ListenResult) -> dict[str, Any]:
    """Result as plain data, with the log."""
    verdict = read.verdict
    return {
        **result_facts(verdict.fault, read.exit_code, verdict.detail),
        "result": "done" if verdict.result == "DONE" else verdict.result,
        "purpose": str(RunType.LISTEN_ONLY),
        "stage": str(plan.stage),
        "iface": iface,
        "bench": plan.bench.name,
        "heard": heard_document(read.heard),
        "preflight": [line.document() for line in read.lines],
        **log_facts(read.log),
    }


def text(read: ListenResult) -> str:
    """Result as text."""
    heard, verdict = read.heard, read.verdict
    lines = [f"a run could NOT begin ({verdict.result}): {verdict.detail}" if verdict.detail else "a run could begin"]
    lines.append(preflight_table(read.lines))
    lines.append(f"  heard for {heard.duration:.3f} s")
    for name, count in heard.frames.items():
        rejected = sum(heard.rejections.get(name, {}).values())
        rate = heard.rates.get(name, 0.0)
        lines.append(f"    {name:<13} {count:8} frames, {rate:7.1f} per second, {rejected} rejected")
    if heard.others:
        lines.append(f"    others        {heard.others:8} frames")
    missing = "" if read.log.complete else f", INCOMPLETE: {read.log.error}"
    lines.append(f"  log       {read.log.path} ({read.log.messages} messages{missing})")
    return "\n".join(lines)
