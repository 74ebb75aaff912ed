"""``emb-replay info``: what a run was."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.log import RunLog, read_log
from emb_runtime.e2e import NO_COUNTER
from emb_runtime.errors import EXIT_DONE
from emb_runtime.records import Reason, RunState
from emb_runtime.terminal import as_json, show

QUANTILES = (50.0, 90.0, 99.0, 99.9, 100.0)


def add_parser(commands: Any, epilog: str) -> None:
    """Add the command ``info`` to those of ``emb-replay``."""
    p = commands.add_parser(
        "info",
        help="what the run was: identity, counts, timing, completeness",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Tell of a log; gives the exit code.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is no log, or too damaged.
    """
    document = info_document(read_log(args.log))
    show(as_json(document) if args.json else info_text(document))
    return EXIT_DONE


def info_document(log: RunLog) -> dict[str, Any]:
    """What the run was."""
    begins = [int(table["publish_time"].min()) for table in log.tables.values() if len(table["publish_time"])]
    ends = [int(table["publish_time"].max()) for table in log.tables.values() if len(table["publish_time"])]
    document: dict[str, Any] = {
        "log": str(log.path),
        "complete": log.complete,
        "missing": log.missing,
        "exit_reason": log.exit_reason,
        "duration": (max(ends) - min(begins)) * 1e-9,
        "metadata": {name: dict(record) for name, record in log.metadata.items()},
        "attachments": {name: len(data) for name, data in log.attachments.items()},
        "messages": log.counts,
        "events": [{"time": event.time_ns, "code": event.code, "text": event.text} for event in log.events],
    }
    cycles = log.cycles
    active = (cycles["state"] == RunState.ACTIVE) & (cycles["step"] >= 0)
    answered = active & (cycles["command_counter"] != NO_COUNTER)
    reasons = cycles["reasons"][active]
    document["cycles"] = {
        "recorded": len(active),
        "active": int(active.sum()),
        "answered": int(answered.sum()),
        "missed_periods": int(cycles["missed"][active].sum()),
        "unanswered": int(((reasons & Reason.MISSED) != 0).sum()),
        "clipped": int(((reasons & Reason.CLIPPED) != 0).sum()),
        "limited": int(((reasons & Reason.LIMITED) != 0).sum()),
        "returning": int(((reasons & Reason.RETURNING) != 0).sum()),
    }
    if active.any():
        document["largest"] = {
            "angle_min": float(cycles["angle"][active].min()),
            "angle_max": float(cycles["angle"][active].max()),
            "speed": float(np.abs(cycles["velocity"][active]).max()),
            "current": float(np.abs(cycles["sent_current"][answered]).max(initial=0.0)),
        }
    if answered.any():
        document["sensor_to_command"] = _delays(cycles["receive_time_ns"][answered], cycles["send_time_ns"][answered])
    return document


def _delays(begin_ns: Any, end_ns: Any) -> dict[str, float]:
    values = np.percentile((end_ns - begin_ns) * 1e-9, QUANTILES)
    return {f"p{quantile:g}": float(value) for quantile, value in zip(QUANTILES, values, strict=True)}


def info_text(document: dict[str, Any]) -> str:
    """The same for a person."""
    lines = [f"WARNING: {document['missing']}"] if document["missing"] else []
    lines += [
        f"log          {document['log']} ({'complete' if document['complete'] else 'NOT complete'})",
        f"exit         {document['exit_reason']}",
        f"duration     {document['duration']:.3f} s",
    ]
    c = document["cycles"]
    lines.append(
        f"cycles       {c['active']} active, {c['answered']} answered, {c['unanswered']} unanswered, "
        f"{c['missed_periods']} periods missed"
    )
    lines.append(f"commands     {c['clipped']} clipped, {c['limited']} limited, {c['returning']} returning home")
    if largest := document.get("largest"):
        lines.append(
            f"largest      angle {largest['angle_min']:.3f} to {largest['angle_max']:.3f} rad, "
            f"speed {largest['speed']:.1f} rad/s, current {largest['current']:.3f} A"
        )
    if delays := document.get("sensor_to_command"):
        simulated = " (simulated time)" if "emb.truth" in document["metadata"] else ""
        lines.append(
            "sensor to command  "
            + ", ".join(f"{name} {1e6 * value:.0f} us" for name, value in delays.items())
            + simulated
        )
    lines += ["", "messages"] + [f"  {topic:24}{count:10}" for topic, count in document["messages"].items()]
    lines += ["", "attachments"] + [f"  {name:24}{size:10} bytes" for name, size in document["attachments"].items()]
    for name, record in document["metadata"].items():
        lines += ["", name] + [f"  {key:24} {value}" for key, value in record.items()]
    lines += ["", "events"] + [f"  {event['code']:24} {event['text']}" for event in document["events"]]
    return "\n".join(lines)
