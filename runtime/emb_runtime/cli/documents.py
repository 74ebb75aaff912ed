"""Runs as plain data: in the header and the trailer of a log, and as the document of ``--json``."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata
from typing import Any

from emb_runtime.can.transport import Transport
from emb_runtime.cli.bus_monitor import BusStatistics, planned_load
from emb_runtime.cli.plan import Plan
from emb_runtime.cli.preflight import SLOW_MARK, Check, RefusedError, advice_on
from emb_runtime.control.result import Outcome
from emb_runtime.errors import EXIT_DONE, EXIT_LOG, EXIT_OUTSIDE, BusError, EmbError
from emb_runtime.estimator import estimate
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.recorder import RecorderResult
from emb_runtime.log.ring_buffer import Attachment, LogHeader
from emb_runtime.records import RunType
from emb_runtime.safety.state_machine import FAULTS, Fault
from emb_runtime.safety.watchdog import WatchdogResult
from emb_runtime.system import compiled_core
from emb_runtime.system.clock import Clock
from emb_runtime.system.terminal import as_json, typed_command, without_folders

ESTIMATE_RATE = 100_000  # Log rate of the estimates [bytes per second]
LOG_RATE = 500_000  # Log rate of a run at 1 kHz, with room to spare: measured are 250 to 310 kB [bytes per second]

BORDER = 1e-6  # Share of a range's end that counts as the end
DONE = "done"  # Result of a run that was completed
REFUSED = "REFUSED"  # Result of one that was refused, for what is no fault
LOG_INCOMPLETE = "LOG_INCOMPLETE"  # Result of one that was completed and not recorded


@dataclass(frozen=True)
class RunResult:
    """Result of a run."""

    plan: Plan
    run_type: RunType
    steps: int  # Samples that it was to answer, at most
    checks: tuple[Check, ...]  # Its pre-flight
    outcome: Outcome
    log: RecorderResult
    watchdog: WatchdogResult | None  # None where there was none
    realtime: dict[str, str]  # Settings that were obtained

    @property
    def estimate(self) -> dict[str, dict[str, Any]]:
        """The last estimate, see :func:`emb_runtime.estimator.estimate.by_name`."""
        return estimate.by_name(self.outcome.estimate, self.plan.bench.systematic)

    @property
    def outside(self) -> dict[str, tuple[float, float, float, str]]:
        """Estimates at or beyond the border of the ranges for which the limits hold: value, range, name of the ranges.

        The estimator does not go beyond the ranges itself. It relies on the response: before that is proven, an
        estimate may be wrong.
        """
        if self.outcome.fault is not None and not self.outcome.response:
            return {}
        name = self.plan.bench.shield.ranges
        ranges = self.plan.bench.range_set(name)
        found = {}
        for parameter, row in self.estimate.items():
            value, low, high = row["value"], getattr(ranges.low, parameter), getattr(ranges.high, parameter)
            if not low * (1.0 + BORDER) < value < high * (1.0 - BORDER):
                found[parameter] = (value, low, high, name)
        return found

    @property
    def exit_code(self) -> int:
        """Exit code for this run."""
        if self.outcome.fault is not None:
            return FAULTS[self.outcome.fault].exit_code
        if not self.log.complete:
            return EXIT_LOG
        return EXIT_OUTSIDE if self.plan.strict and self.outside else EXIT_DONE

    def document(self) -> dict[str, Any]:
        """The run as plain data."""
        plan, outcome = self.plan, self.outcome
        result = result_document(outcome.fault, self.exit_code, outcome.detail)
        if outcome.fault is None and not self.log.complete:
            result |= {"result": LOG_INCOMPLETE, "cause": "the log is not complete", "detail": self.log.error}
            result |= {"advice": "brake and node worked as they should; repeat the run for its data"}
        return {
            **result,
            **plan.document(self.run_type, self.steps),
            "bench": plan.bench.name,
            **outcome.document(),
            "estimate": self.estimate,
            "total": estimate.total(estimate.shares(self.estimate), plan.bench.systematic),
            "outside": self.outside,
            "preflight": [check.document() for check in self.checks],
            "realtime": self.realtime,
            "watchdog": None if self.watchdog is None else asdict(self.watchdog),
            **log_document(self.log),
            "homing": {},
        }


def reading(plan: Plan, statistics: BusStatistics, checks: Sequence[Check], refused: EmbError | None) -> dict[str, Any]:
    """Result of ``--read-only`` as plain data, but for its log; with the error for which a run could not begin."""
    return {
        **_refusal(refused),
        **plan.document(RunType.LISTEN_ONLY, 0),
        "bench": plan.bench.name,
        "heard": statistics.document(),
        "preflight": [check.document() for check in checks],
    }


def refusal(err: EmbError, iface: str) -> dict[str, Any]:
    """A run that was refused before anything was sent, as plain data."""
    checks = [check.document() for check in err.checks] if isinstance(err, RefusedError) else []
    return {**_refusal(err), "iface": iface, "home": False, "log": None, "homing": {}, "preflight": checks}


def _refusal(err: EmbError | None) -> dict[str, Any]:
    """Result of what sent nothing, by its error."""
    fault = Fault.BUS_LOST if isinstance(err, BusError) else err.fault if isinstance(err, RefusedError) else None
    result = result_document(fault, err.exit_code if err else EXIT_DONE, str(err or ""))
    return result | {"result": REFUSED} if err and not fault else result


def result_document(fault: Fault | None, exit_code: int, detail: str) -> dict[str, Any]:
    """Result of a run as plain data."""
    return {
        "result": fault.name if fault else DONE,
        "exit_code": exit_code,
        "cause": FAULTS[fault].cause if fault else "",
        "detail": detail,
        "advice": advice_on(fault) if fault else "",
    }


def log_document(log: RecorderResult) -> dict[str, Any]:
    """A log that was written, as plain data."""
    values = {f"log_{name}": value for name, value in log._asdict().items()}
    return {"log": str(values.pop("log_path")), **values}


# --- the log --------------------------------------------------------------------------------------------------------


def log_entries(document: Mapping[str, Any]) -> dict[str, str]:
    """Plain data as the texts of a log's metadata record, without what there is not."""
    return {
        name: as_json(value) if isinstance(value, dict | list) else value if isinstance(value, str) else repr(value)
        for name, value in document.items()
        if value is not None
    }


def trailer(
    outcome: Outcome | None, obtained: Mapping[str, str], watchdog: WatchdogResult | None = None
) -> dict[str, str]:
    """Trailer of a run's log: its outcome, None where the loop gave none, with real-time settings and watchdog."""
    end: dict[str, Any] = {"exit_reason": Fault.INTERNAL.name, "detail": "the run ended before the loop did"}
    if outcome is not None:
        end = {"exit_reason": outcome.fault.name if outcome.fault else "DONE", "detail": outcome.detail}
        end |= outcome.document()
    settings = {f"rt_{name}": value for name, value in obtained.items()}
    return log_entries(end | settings | (watchdog.trailer() if watchdog is not None else {}))


def header(
    plan: Plan, transport: Transport, clock: Clock, run_type: RunType, checks: Sequence[Check], steps: int
) -> LogHeader:
    """Header of a log: versions, bench, policy, bus, and what the pre-flight found; 0 steps where none is answered."""
    bench, drive, label, truth = plan.bench, plan.drive, plan.label, transport.truth
    slow = os.environ.get(SLOW_MARK, "1")
    run = {
        "tool": f"emb-excite {metadata.version('emb-excite')}",
        "command": typed_command("emb-run", label.typed),
        **plan.document(run_type, steps),
        "iface": without_folders(plan.iface),
        "bench_name": bench.name,
        "bench_hash": bench.identity_hash,
        "velocity": f"{bench.sensors}",
        "dbc_protocol": plan.layout.protocol_version,
        "bus_load_worst": f"{planned_load(bench, plan.layout, drive.mapping if drive is not None else None):.4f}",
        "core": compiled_core.running().text,
        "python": platform.python_version(),
        "onnxruntime": metadata.version("onnxruntime"),
        "numpy": metadata.version("numpy"),
        "libc": " ".join(platform.libc_ver()).strip() or None,  # onnxruntime takes sinh from it
        "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        "time": f"{slow} times slower than the computer's" if slow != "1" else None,
        "operator": label.operator or None,
        "device_serial": label.serial or None,
        **{f"bus_{name}": value for name, value in transport.obtained.items()},
    }
    records: dict[str, Mapping[str, Any]] = {"emb.run": run}
    attachments = [Attachment("bench.toml", "application/toml", bench.text.encode())]
    is_experiment = run_type is RunType.EXPERIMENT and plan.experiment is not None
    if plan.experiment is not None and is_experiment:
        policy, condition = plan.experiment.policy, plan.experiment.stop_condition
        run["policy_provenance"] = json.dumps(dict(policy.contract.provenance), sort_keys=True)
        run["stop_when"] = condition.text if condition is not None else None
        attachments.append(Attachment("policy.onnx", "application/octet-stream", policy.data))
    if checks:
        records["emb.preflight"] = {c.name: f"{c.verdict}: {c.found} (expected {c.expected})" for c in checks}
    if drive is not None:
        mapping = drive.mapping
        lost = ", ".join(mapping.lost)
        records["emb.drive"] = {"name": mapping.name, "lost": lost, "sha256": mapping.sha256, "bus": drive.bus}
        attachments += [
            Attachment("drive.toml", "application/toml", mapping.text.encode()),
            Attachment("drive.dbc", "text/plain", mapping.dbc_text.encode()),
        ]
    if truth is not None:
        records["emb.truth"] = truth
    return LogHeader(
        start_ns=clock.now_ns(),
        wall_offset_ns=clock.wall_offset_ns(),
        simulated=truth is not None,
        dbc=plan.layout.text,
        messages=plan.layout.all_messages,
        metadata={name: log_entries(record) for name, record in records.items()},
        attachments=tuple(attachments),
        topics=["/estimate"] if is_experiment and estimated(bench) else [],
        drive_bus=drive.bus if drive is not None else "",
    )


def log_bytes(plan: Plan, duration: float) -> int:
    """Size of a log of so many seconds, with its attachments [bytes]."""
    carried, rate = len(plan.bench.text) + len(plan.layout.text), LOG_RATE
    if plan.experiment is not None:
        carried += len(plan.experiment.policy.data)
        rate += ESTIMATE_RATE
    return carried + round(rate * duration * 1e-3 / plan.bench.timing.sample_time)
