"""Identity, counts, extremes and completeness of a log."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from emb_bench.logs.estimates import known_errors, last_estimate
from emb_bench.logs.log import RunLog
from emb_bench.logs.timing import in_control, quantiles
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.estimator.estimate import shares, total
from emb_runtime.records import CycleRecord, Reason

_REASONS = {
    "unanswered": Reason.MISSED | Reason.LEFT,
    "left": Reason.LEFT,  # To the node, out of reach of slew or limit
    "clipped": Reason.CLIPPED,
    "limited": Reason.LIMITED,
    "returning": Reason.RETURNING,
}


@dataclass(frozen=True)
class Largest:
    """Extremes in the active cycles, the sample that stopped the run included."""

    angle_min: float  # [rad]
    angle_max: float  # [rad]
    speed: float  # [rad/s]
    current: float  # [A]


@dataclass(frozen=True)
class CycleSummary:
    """Counts, extremes and delays of the control cycles."""

    cycles: Mapping[str, int]
    """Number of those that were ``recorded``; of those of the experiment, or of the way home, itself how many are
    ``active`` and ``answered``, how many ``missed_periods`` lie between them, and how many have each reason."""
    largest: Largest | None  # None without an active cycle
    sensor_to_command: Mapping[str, float]
    """Quantiles of the time from a sample to the command that answers it [s]; empty without an answer."""


def info_document(log: RunLog) -> dict[str, Any]:
    """Identity, counts, timing, events and completeness of a run, as a JSON document."""
    first, last = log.span
    found = cycle_summary(log)
    optional = {
        "estimate": (estimate := last_estimate(log)),
        "total": total(shares(estimate), known_errors(log)),
        "drive_lacks": log.drive_lacks,
        "conditions": {
            name: {"min": float(values.min()), "max": float(values.max())}
            for name, values in log.measured_conditions.items()
        },
        "largest": found.largest and asdict(found.largest),
        "sensor_to_command": found.sensor_to_command,
    }
    return {
        "log": str(log.path),
        "simulated": bool(log.simulated),
        "complete": log.complete,
        "missing": log.missing,
        "exit_reason": log.exit_reason,
        "duration": (last - first) * 1e-9,
        "metadata": {name: dict(record) for name, record in log.metadata.items()},
        "attachments": {name: len(data) for name, data in log.attachments.items()},
        "messages": log.counts,
        "events": [{"time": event.time_ns, "code": event.code, "text": event.text} for event in log.events],
        "cycles": found.cycles,
        **{name: entry for name, entry in optional.items() if entry},
    }


def cycle_summary(log: RunLog) -> CycleSummary:
    """Summary of the control cycles, batch by batch: the part of :func:`info_document` that takes time."""
    log.require("/cycle", CycleRecord._fields)
    counts = dict.fromkeys(("recorded", "active", "answered", "missed_periods", *_REASONS), 0)
    low, high, speed, current = math.inf, -math.inf, 0.0, 0.0
    delays = [np.empty(0, np.int64)]
    for part in log.batches("/cycle"):
        c = part["/cycle"]
        active = in_control(c)
        answered = active & (c["command_counter"] != NO_COUNTER)
        reasons = c["reasons"][active]
        counts["recorded"] += len(active)
        counts["active"] += int(active.sum())
        counts["answered"] += int(answered.sum())
        counts["missed_periods"] += int(c["missed"][active].sum())
        for name, reason in _REASONS.items():
            counts[name] += int(((reasons & reason) != 0).sum())
        if active.any():
            angle = c["angle"][active]
            low, high = float(np.minimum(low, angle.min())), float(np.maximum(high, angle.max()))
            speed = float(np.maximum(speed, np.abs(c["velocity"][active]).max()))
            current = float(np.maximum(current, np.abs(c["sent_current"][answered]).max(initial=0.0)))
        delays.append(c["send_time_ns"][answered] - c["receive_time_ns"][answered])
    largest = None
    if counts["active"]:
        its_low, its_high, its_speed = (_counted(log, name) for name in ("angle_min", "angle_max", "top_speed"))
        largest = Largest(min(low, its_low), max(high, its_high), max(speed, its_speed), current)
    return CycleSummary(counts, largest, quantiles(np.asarray(1e-9 * np.concatenate(delays), np.float64)))


def _counted(log: RunLog, name: str) -> float:
    """A number that the loop counted, with the sample that made it stop; 0 if the log has none."""
    try:
        value = float(log.end.get(name, "0"))
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0
