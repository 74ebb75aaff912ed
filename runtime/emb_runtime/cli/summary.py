"""Words on a run: in its log's header and trailer, as JSON, and in lines for a person."""

from __future__ import annotations

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Any

from emb_runtime.can.transport import Transport
from emb_runtime.cli.bus_monitor import BusStatistics, planned_load
from emb_runtime.cli.options import Plan
from emb_runtime.cli.preflight import SLOW_MARK, CheckResult, RefusedError, advice_on, table
from emb_runtime.config.bench import Bench
from emb_runtime.control.result import Outcome
from emb_runtime.errors import EXIT_DONE, EXIT_LOG, EXIT_OUTSIDE, BusError, EmbError
from emb_runtime.estimator import estimate
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.recorder import RecorderResult
from emb_runtime.log.ring_buffer import Attachment, LogHeader
from emb_runtime.numbers import plain
from emb_runtime.records import RunType
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.safety.watchdog import WatchdogResult
from emb_runtime.system import compiled_core
from emb_runtime.system.clock import Clock
from emb_runtime.system.terminal import typed_command, without_folders

ESTIMATE_RATE = 100_000  # Log rate of the estimates [bytes per second]
LOG_RATE = 500_000  # Log rate of a run at 1 kHz, with room to spare: measured are 250 to 310 kB [bytes per second]

BORDER = 1e-6  # Share of a range's end that counts as the end
LOG_INCOMPLETE = "LOG_INCOMPLETE"  # Result of a run that was completed and not recorded


@dataclass(frozen=True)
class RunResult:
    """Result of a run."""

    run_type: RunType
    steps: int  # Samples that it was to answer, at most
    lines: tuple[CheckResult, ...]  # Its pre-flight
    outcome: Outcome
    log: RecorderResult
    watchdog: WatchdogResult | None  # None where there was none
    realtime: dict[str, str]  # Settings that were obtained

    @property
    def exit_code(self) -> int:
        """Exit code for this run."""
        if self.outcome.fault is not None:
            return FAULTS[self.outcome.fault].exit_code
        if not self.log.complete:
            return EXIT_LOG
        return EXIT_DONE


def header(
    plan: Plan,
    iface: str,
    transport: Transport,
    clock: Clock,
    run_type: RunType,
    lines: Sequence[CheckResult],
    steps: int,
) -> LogHeader:
    """Header of a log: versions, bench, policy, bus, and what the pre-flight found; 0 steps where none is answered."""
    bench, policy = plan.bench, plan.policy
    slow = os.environ.get(SLOW_MARK, "1")
    drive = plan.drive
    records = {
        "emb.run": {
            "tool": f"emb-excite {metadata.version('emb-excite')}",
            "command": typed_command("emb-run", plan.typed),
            "iface": without_folders(iface),
            "purpose": str(run_type),
            "stage": str(plan.stage),
            "limit": repr(plan.limit),
            "steps": str(steps),
            "bench_name": bench.name,
            "bench_hash": bench.identity_hash,
            "velocity": f"{bench.sensors}",
            "dbc_protocol": str(plan.layout.protocol_version),
            "bus_load_worst": f"{planned_load(bench, plan.layout, drive.mapping if drive is not None else None):.4f}",
            "core": compiled_core.running().text,
            "python": platform.python_version(),
            "onnxruntime": metadata.version("onnxruntime"),
            "numpy": metadata.version("numpy"),
            "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        }
        | ({"time": f"{slow} times slower than the computer's"} if slow != "1" else {})
        | {name: text for name, text in (("operator", plan.operator), ("device_serial", plan.serial)) if text}
        | {f"bus_{name}": value for name, value in transport.obtained.items()},
    }
    attachments = [Attachment("bench.toml", "application/toml", bench.text.encode())]
    topics: list[str] = []
    if run_type is RunType.EXPERIMENT:
        assert policy is not None
        records["emb.run"] |= {
            "policy_sha256": policy.sha256,
            "policy_kind": policy.contract.kind,
            "policy_provenance": json.dumps(dict(policy.contract.provenance), sort_keys=True),
        }
        if plan.stop_condition is not None:
            records["emb.run"]["stop_when"] = plan.stop_condition.text
        topics = ["/estimate"] if estimated(bench) else []
        attachments.append(Attachment("policy.onnx", "application/octet-stream", policy.data))
    if lines:
        records["emb.preflight"] = {
            line.what: f"{line.verdict}: {line.found} (expected {line.expected})" for line in lines
        }
    if drive is not None:
        mapping = drive.mapping
        lost = ", ".join(mapping.lost)
        records["emb.drive"] = {"name": mapping.name, "lost": lost, "sha256": mapping.sha256, "bus": drive.bus}
        attachments += [
            Attachment("drive.toml", "application/toml", mapping.text.encode()),
            Attachment("drive.dbc", "text/plain", mapping.dbc_text.encode()),
        ]
    truth = transport.truth
    if truth is not None:
        records["emb.truth"] = {name: str(value) for name, value in truth.items()}
    return LogHeader(
        start_ns=clock.now_ns(),
        wall_offset_ns=clock.wall_offset_ns(),
        simulated=truth is not None,
        dbc=plan.layout.text,
        messages=plan.layout.known,
        metadata=records,
        attachments=tuple(attachments),
        topics=topics,
        drive_bus=drive.bus if drive is not None else "",
    )


def log_bytes(plan: Plan, duration: float) -> int:
    """Size of a log of so many seconds, with its attachments [bytes]."""
    carried = len(plan.bench.text) + len(plan.layout.text)
    rate = LOG_RATE
    if plan.policy is not None:
        carried += len(plan.policy.data)
        rate += ESTIMATE_RATE
    return carried + round(rate * duration * 1e-3 / plan.bench.timing.sample_time)


def trailer(
    outcome: Outcome | None, obtained: Mapping[str, str], watchdog: WatchdogResult | None = None
) -> dict[str, str]:
    """Trailer of the log: the outcome, None where the loop gave none, with real-time settings and watchdog."""
    settings = {f"rt_{name}": value for name, value in obtained.items()}
    if watchdog is not None:
        settings |= watchdog.trailer()
    if outcome is None:
        return {"exit_reason": Fault.INTERNAL.name, "detail": "the run ended before the loop did", **settings}
    entries = {"exit_reason": outcome.fault.name if outcome.fault else "DONE", "detail": outcome.detail}
    entries |= {name: _entry(value) for name, value in facts(outcome).items() if value is not None}
    return entries | settings


def _entry(value: object) -> str:
    if isinstance(value, Mapping):
        return json.dumps(value)
    return value if isinstance(value, str) else repr(value)


def facts(outcome: Outcome) -> dict[str, Any]:
    """Facts of an outcome that the log's trailer and the document have; None for one that there is not."""
    judged = outcome.unexplained <= outcome.allowed < math.inf
    return {
        **asdict(outcome.counters),
        "rejections": dict(outcome.rejections),
        "bus_error_classes": dict(outcome.bus_errors),
        "model_fits": outcome.model_fits,
        "unexplained": outcome.unexplained if judged else None,  # by any one brake [rad/s]
        "response": outcome.response or None,  # how late the velocity follows the commands, once proven
        "unexplained_allowed": outcome.allowed if judged else None,
        "goal_reached": outcome.goal_reached,
        "home": outcome.home,
        "node_at_rest": outcome.node_at_rest,
        "node_stop_reason": None if outcome.node_stop_reason is None else outcome.node_stop_reason.name,
    }


def log_facts(log: RecorderResult) -> dict[str, Any]:
    """Facts of a log for a document."""
    values = {f"log_{name}": value for name, value in log._asdict().items()}
    return {"log": str(values.pop("log_path")), **values}


def document(plan: Plan, iface: str, ran: RunResult) -> dict[str, Any]:
    """A run's outcome as plain data."""
    outcome, fault, policy = ran.outcome, ran.outcome.fault, plan.policy
    assert policy is not None
    is_experiment = ran.run_type is RunType.EXPERIMENT
    # An estimate relies on the response: before it is proven, a run that ended says nothing about the brake.
    beyond = outside(plan.bench, outcome.estimate) if fault is None or outcome.response else {}
    exit_code = EXIT_OUTSIDE if plan.strict and beyond and ran.exit_code == EXIT_DONE else ran.exit_code
    result = result_facts(fault, exit_code, outcome.detail)
    if fault is None and not ran.log.complete:
        result |= {"result": LOG_INCOMPLETE, "cause": "the log is not whole", "detail": ran.log.error}
        result |= {"advice": "brake and node worked as they should; repeat the run for its data"}
    return {
        **result,
        "purpose": str(ran.run_type),
        "stage": str(plan.stage),
        "limit": plan.limit,
        "iface": iface,
        "bench": plan.bench.name,
        "policy_kind": policy.contract.kind if is_experiment else None,
        "policy_sha256": policy.sha256 if is_experiment else None,
        "steps": ran.steps,
        "duration_s": outcome.duration_ns * 1e-9,
        **facts(outcome),
        "estimate": (found := estimate.by_name(outcome.estimate, plan.bench.systematic)),
        "total": estimate.total(estimate.shares(found), plan.bench.systematic),
        "outside": beyond,
        "goal_s": outcome.goal_ns * 1e-9 if outcome.goal_reached else None,
        "end_angle": outcome.end_angle,
        "end_velocity": outcome.end_velocity,
        "node_state": outcome.node_state.name if outcome.node_state is not None else None,
        "last_angle": outcome.last_angle,
        "preflight": [line.document() for line in ran.lines],
        "realtime": ran.realtime,
        "watchdog": None if ran.watchdog is None else asdict(ran.watchdog),
        **log_facts(ran.log),
        "homing": {},
    }


def outside(bench: Bench, numbers: Sequence[float]) -> dict[str, tuple[float, float, float, str]]:
    """Estimates at or beyond the border of the ranges for which the limits hold: value, range, and the ranges' name.

    The estimator does not go beyond the ranges itself.
    """
    name = bench.shield.ranges
    ranges = bench.range_set(name)
    found = {}
    for parameter, found_value in estimate.by_name(numbers, bench.systematic).items():
        value, low, high = found_value["value"], getattr(ranges.low, parameter), getattr(ranges.high, parameter)
        if not low * (1.0 + BORDER) < value < high * (1.0 - BORDER):
            found[parameter] = (value, low, high, name)
    return found


def refusal(err: EmbError, iface: str) -> dict[str, Any]:
    """The outcome of a run that was refused before anything was sent, as plain data."""
    refused = err if isinstance(err, RefusedError) else None
    fault = Fault.BUS_LOST if isinstance(err, BusError) else refused.fault if refused else None
    lines = refused.lines if refused else ()
    found = result_facts(fault, err.exit_code, str(err)) | ({} if fault else {"result": "REFUSED"})
    empty = {"iface": iface, "home": False, "log": None, "homing": {}}
    return found | empty | {"preflight": [line.document() for line in lines]}


def text(s: Mapping[str, Any], details: bool = False) -> str:
    """A :func:`document` for a person: the answer and what was unusual; every count with ``details``."""
    where = "home" if s["home"] else "NOT HOME"
    where = f"precise after {s['goal_s']:.3f} s, then {where}" if s["goal_reached"] else where
    completed = s["result"] == "done" and s["purpose"] == RunType.EXPERIMENT
    done = f"done, OUTSIDE THE RANGES ({', '.join(s['outside'])})" if s["outside"] else "done"
    lines = [f"{done}: {s['answered']} of {s['steps']} samples answered, {where}"]
    if s["result"] != "done":
        where = " on the way home" if s["purpose"] == RunType.HOMING else ""
        why = f"{s['cause']}: {s['detail']}" if s["detail"] else s["cause"]
        ended = "NOT RECORDED" if s["result"] == LOG_INCOMPLETE else "STOPPED"
        lines = [f"{ended}{where} ({s['result']}): {why}", f"  → {s['advice']}"]
    lines += [
        f"  OUTSIDE    {name} = {plain(value, 4)} {s['estimate'][name]['unit']} is at or beyond a border of "
        f"ranges.{ranges} ({plain(low, 4)} to {plain(high, 4)}): the limits were not guaranteed; find the cause, "
        "or widen the range"
        for name, (value, low, high, ranges) in s["outside"].items()
    ]
    lines += [f"  way home   {name} the experiment: {brief(way)}" for name, way in s["homing"].items()]
    if s["stage"] != "full":
        lines.append(f"  stage      {s['stage']}, at most {s['limit']:g} A")
    if s["policy_kind"]:
        lines.append(f"  policy     {s['policy_kind']}, sha256 {s['policy_sha256'][:12]}")
    if s["pairs"]:
        lines += _brake(s)
    if s["pairs"] and (details or s["result"] != "done" or s["unanswered"] or s["missed"] or s["rejected"]):
        lines += _counts(s)
    if completed and (details or s["unexplained"] is None):
        lines.append(f"  motion     {_motion(s)}")
    if completed and s["limit"] > 0.0:
        lines.append(f"  response   {s['response'] or 'NOT PROVEN: too little motion, so the speed stayed low'}")
    lines += _unusual(s)
    if s["estimate"] and (details or s["result"] in ("done", LOG_INCOMPLETE)):
        lines += estimate.words(s["estimate"], s["total"], fits=s["model_fits"])
    missing = "" if s["log_complete"] else f", INCOMPLETE: {s['log_error']}"
    lines.append(f"log: {s['log']} ({s['log_messages']} messages, {s['log_bytes'] / 1024:.0f} KiB{missing})")
    if completed and s["limit"] > 0.0:
        lines.append(f"next: emb-replay estimate {s['log']}   (tests the model, gives the total)")
    return "\n".join(lines)


def _unusual(s: Mapping[str, Any]) -> list[str]:
    """Lines on what an undisturbed run does not have."""
    lines = []
    if s["bus_errors"]:
        classes = ", ".join(f"{name} ({count})" for name, count in s["bus_error_classes"].items())
        lines.append(f"  bus errors {s['bus_errors']} reports: {classes}")
    lines += [
        f"  rejected   {name}: {', '.join(f'{why} ({count})' for why, count in reasons.items())}"
        for name, reasons in s["rejections"].items()
    ]
    if lacking := [name for name, value in s["realtime"].items() if value.startswith("not obtained")]:
        lines.append(f"  real time  NOT OBTAINED: {', '.join(lacking)}; --json says why, --no-rt does not ask")
    if (watchdog := s["watchdog"]) and (watchdog["tripped"] or watchdog["error"]):
        lines.append(
            f"  watchdog   {watchdog['tripped'] or 'did not trip'}, {watchdog['frames']} stop frames"
            f"{': ' + watchdog['error'] if watchdog['error'] else ''}"
        )
    return lines


def brief(s: Mapping[str, Any]) -> str:
    """A :func:`document` or a :func:`refusal`, of an experiment or of a way home, in one line."""
    if s["result"] != "done":
        return ", ".join(filter(None, (f"{s['result']}: {s['detail'] or s['cause']}", s["log"])))
    ways = "".join(f", a way home {name}" for name in s["homing"])
    whole = "" if s["log_complete"] else ", log INCOMPLETE"
    where = "home" if s["home"] else "not home"
    return f"done: {s['answered']} of {s['steps']} answered, {where}{ways}, {s['log']}{whole}"


def result_facts(fault: Fault | None, exit_code: int, detail: str) -> dict[str, Any]:
    """Result of a run for a document."""
    return {
        "result": "done" if fault is None else fault.name,
        "exit_code": exit_code,
        "cause": FAULTS[fault].cause if fault else "",
        "detail": detail,
        "advice": advice_on(fault) if fault else "",
    }


def _brake(s: Mapping[str, Any]) -> list[str]:
    return [
        f"  brake      {s['angle_min']:.2f} to {s['angle_max']:.2f} rad, top speed {s['top_speed']:.1f} rad/s, "
        f"top current {s['top_current']:.2f} A",
        f"  end        {s['end_angle']:.3f} rad, {s['end_velocity']:.1f} rad/s; after the stop "
        f"{s['last_angle']:.3f} rad, {'at rest' if s['node_at_rest'] else 'still stopping'}, node {s['node_state']}"
        f"{_stop_reason(s['node_stop_reason'])}",
    ]


def _counts(s: Mapping[str, Any]) -> list[str]:
    return [
        f"  commands   {s['answered']} sent, {s['confirmed']} frames seen on the bus, {s['limited']} limited by the "
        f"shield, {s['returning']} returning home, {s['clipped']} clipped, {s['not_obeyed']} not obeyed",
        f"  samples    {s['pairs']} pairs, {s['unanswered']} without a command (send buffer full: {s['not_taken']}, "
        f"braked by the node: {s['left']}), {s['missed']} periods missed, {s['rejected']} frames rejected, "
        f"{s['dropped']} dropped by the kernel",
    ]


def _motion(s: Mapping[str, Any]) -> str:
    if s["unexplained"] is None:
        return "not judged: too little motion, or the bench declares a lag or frames older than two samples"
    return f"unexplained velocity {s['unexplained']:.0f} rad/s, limit {s['unexplained_allowed']:.0f} rad/s"


def _stop_reason(name: str | None) -> str:
    return " (stop reason not reported)" if name is None else f" (stop reason {name})"


def heard_document(heard: BusStatistics) -> dict[str, Any]:
    """Bus statistics as plain data."""
    fields = asdict(heard)
    for name in ("status", "sample"):
        if (record := getattr(heard, name)) is not None:
            fields[name] = {key: getattr(value, "name", value) for key, value in record._asdict().items()}
    return fields


def listen_document(
    plan: Plan,
    iface: str,
    heard: BusStatistics,
    lines: Sequence[CheckResult],
    refused: RefusedError | None,
    log: RecorderResult,
) -> dict[str, Any]:
    """Result of ``--read-only`` as plain data; ``refused`` says why a run could not begin."""
    complete = EXIT_DONE if log.complete else EXIT_LOG
    fault, detail, exit_code = (refused.fault, str(refused), refused.exit_code) if refused else (None, "", complete)
    result = {"result": "REFUSED"} if refused and fault is None else {}
    return {
        **result_facts(fault, exit_code, detail),
        **result,
        "purpose": str(RunType.LISTEN_ONLY),
        "stage": str(plan.stage),
        "iface": iface,
        "bench": plan.bench.name,
        "heard": heard_document(heard),
        "preflight": [line.document() for line in lines],
        **log_facts(log),
    }


def listen_text(s: Mapping[str, Any], lines: Sequence[CheckResult]) -> str:
    """A :func:`listen_document` for a person, with its pre-flight."""
    heard = s["heard"]
    begin = f"a run could NOT begin ({s['result']}): {s['detail']}" if s["detail"] else "a run could begin"
    said = [begin, table(lines), f"  listened for {heard['duration']:.3f} s"]
    for name, count in heard["frames"].items():
        rejected = sum(heard["rejections"].get(name, {}).values())
        rate = heard["rates"].get(name, 0.0)
        said.append(f"    {name:<13} {count:8} frames, {rate:7.1f} per second, {rejected} rejected")
    if heard["others"]:
        said.append(f"    others        {heard['others']:8} frames")
    missing = "" if s["log_complete"] else f", INCOMPLETE: {s['log_error']}"
    said.append(f"  log       {s['log']} ({s['log_messages']} messages{missing})")
    return "\n".join(said)
