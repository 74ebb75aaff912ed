"""Metadata of a run at the head of its log: versions, bench, policy, bus, and what the pre-flight found."""

from __future__ import annotations

import json
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from importlib import metadata

from emb_runtime.can.transport import Transport
from emb_runtime.cli.bus_monitor import planned_load
from emb_runtime.cli.options import Plan
from emb_runtime.cli.preflight import CheckResult
from emb_runtime.config.bench import LEARNING
from emb_runtime.estimator.estimate import Quantity
from emb_runtime.estimator.estimator import estimated
from emb_runtime.log.recorder import Attachment, LogHeader
from emb_runtime.records import RunType
from emb_runtime.system import compiled_core
from emb_runtime.system.clock import Clock

ESTIMATE_RATE = 25_000  # Log rate of each parameter that is estimated [bytes per second]
LEARNT_RATE = 150_000  # Log rate of what the shield learns [bytes per second]
LOG_RATE = 500_000  # Log rate of a run at 1 kHz, with room to spare: measured are 250 to 310 kB [bytes per second]

SLOW_MARK = "EMB_SLOW"  # In the environment where a kernel's time runs slowly: how many times (``emb-hil --slow``)


def header(
    plan: Plan,
    iface: str,
    transport: Transport,
    clock: Clock,
    run_type: RunType,
    lines: Sequence[CheckResult],
    steps: int,
) -> LogHeader:
    """The header of a log.

    Args:
        plan: what is to be run.
        iface: the bus, as it was opened.
        transport: the bus.
        clock: the time on it.
        run_type: of the run.
        lines: its pre-flight.
        steps: samples that it is to answer, at most; 0 where it answers none.
    """
    bench, policy = plan.bench, plan.policy
    slow = os.environ.get(SLOW_MARK)
    mapping = plan.drive.mapping if plan.drive is not None else None
    records = {
        "emb.run": {
            "tool": f"emb-excite {metadata.version('emb-excite')}",
            "command": shlex.join(sys.argv).encode("utf-8", "replace").decode(),
            "iface": iface,
            "purpose": str(run_type),
            "stage": str(plan.stage),
            "limit": repr(plan.limit),
            "steps": str(steps),
            "bench_name": bench.name,
            "bench_hash": bench.identity_hash,
            "dbc_protocol": str(plan.layout.protocol_version),
            "bus_load_worst": f"{planned_load(bench, plan.layout, mapping):.4f}",
            "core": compiled_core.running().text,
            "python": platform.python_version(),
            "onnxruntime": metadata.version("onnxruntime"),
            "numpy": metadata.version("numpy"),
            "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        }
        | ({"time": f"{slow} times slower than the computer's"} if slow else {})
        | {name: text for name, text in (("operator", plan.operator), ("device_serial", plan.serial)) if text}
        | {f"bus_{name}": value for name, value in transport.obtained.items()},
    }
    attachments = [Attachment("bench.toml", "application/toml", bench.text.encode())]
    estimates: Sequence[Quantity] = ()
    if run_type is RunType.EXPERIMENT:
        assert policy is not None
        records["emb.run"] |= {
            "policy_sha256": policy.sha256,
            "policy_kind": policy.contract.kind,
            "policy_provenance": json.dumps(dict(policy.contract.provenance), sort_keys=True),
        }
        if plan.stop_condition is not None:
            records["emb.run"]["stop_when"] = plan.stop_condition.text
        estimates = estimated(bench)
        attachments.append(Attachment("policy.onnx", "application/octet-stream", policy.data))
    if lines:
        records["emb.preflight"] = {
            line.what: f"{line.verdict}: {line.found} (expected {line.expected})" for line in lines
        }
    learns = run_type is RunType.EXPERIMENT and bench.shield.learn
    if learns:
        records["emb.run"] |= {key: str(getattr(bench.shield, key)) for key in LEARNING if key != "learn"}
    if mapping is not None:
        records["emb.drive"] = {"name": mapping.name, "lost": ", ".join(mapping.lost), "sha256": mapping.sha256}
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
        metadata=records,
        attachments=tuple(attachments),
        estimates=estimates,
        learns=learns,
        drive_bus=plan.drive.bus if plan.drive is not None else "",
    )


def log_bytes(plan: Plan, duration: float) -> int:
    """Size of a log of so many seconds, with its attachments [bytes]."""
    carried = len(plan.bench.text) + len(plan.layout.text)
    rate = LOG_RATE + LEARNT_RATE * plan.bench.shield.learn
    if plan.policy is not None:
        carried += len(plan.policy.data)
        rate += ESTIMATE_RATE * len(estimated(plan.bench))
    return carried + round(rate * duration * 1e-3 / plan.bench.timing.sample_time)
