"""Summary of a log as text; needs only the base install."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from emb_bench.logs.log import IMPORT
from emb_bench.numbers import around
from emb_bench.report.text import facts, listed, wrapped
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.system.terminal import one_line


def text(d: Mapping[str, Any], *, verbose: bool = False) -> str:
    """A :func:`emb_bench.logs.info.info_document` for a person; with ``verbose`` all metadata and events."""
    d = _lines(d)
    learnt, imported = d.get("learnt", {}), IMPORT in d["metadata"]
    lines = listed("WARNING: ", [d["missing"]])
    lines += wrapped(
        f"{d['log']}: {d['exit_reason']}{_why(d['metadata'].get('emb.end', {}))}, {d['duration']:.3f} s, log "
        f"{'complete' if d['complete'] else 'NOT complete'}"
    )
    lines += facts(
        *(_recording(d) if imported else _loop(d["cycles"])),
        ("largest", _largest(d.get("largest")) + (", in coordinates of the motor" if imported else "")),
        *(("drive lacks", f"{name}: {lost}") for name, lost in d.get("drive_lacks", {}).items()),
        ("response", _delays(d)),
    )
    if estimate := d.get("estimate"):
        lines += ["", *wrapped("estimated while running; ± is half of the 95 % interval, if the model is right", 0)]
        lines += [
            f"  {name}  {around(q['value'], NORMAL_95 * q['deviation'])} {q['unit']}" for name, q in estimate.items()
        ]
    lines += facts(*(("learnt", f"{name} {low:.4f} to {high:.4f} of nominal") for name, (low, high) in learnt.items()))
    if not verbose:
        return "\n".join(lines)
    lines += _listed("messages", {topic: f"{count:9}" for topic, count in d["messages"].items()})
    lines += _listed("attachments", {name: f"{size:9} bytes" for name, size in d["attachments"].items()})
    for name, record in d["metadata"].items():
        lines += _listed(name, record)
    return "\n".join([*lines, "", "events", *(f"  {event['code']:24} {event['text']}" for event in d["events"])])


def _recording(d: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Samples of an imported recording, and the signals that it lacks."""
    return [("samples", f"{d['cycles']['active']}, of a recording"), *(("lacks", lack) for lack in d.get("lacks", ()))]


def _delays(d: Mapping[str, Any]) -> str:
    """Time from a sample to the command that answers it."""
    delays = d.get("sensor_to_command", {})
    simulated = " (simulated time)" if "emb.truth" in d["metadata"] else ""
    return (
        ", ".join(f"{name} {1e6 * value:.0f}" for name, value in delays.items()) + f" µs{simulated}" if delays else ""
    )


def _loop(c: Mapping[str, int]) -> tuple[tuple[str, str], ...]:
    """Counts of the control loop's cycles."""
    return (
        (
            "cycles",
            f"{c['active']} active, {c['answered']} answered, {c['unanswered']} unanswered, "
            f"{c['missed_periods']} periods missed",
        ),
        (
            "commands",
            f"{c['clipped']} clipped, {c['limited']} limited, {c['returning']} returning home, "
            f"{c['left']} left to the node",
        ),
    )


def _lines(value: Any) -> Any:
    """The document with all its strings as single lines: they come from the log."""
    if isinstance(value, Mapping):
        return {one_line(key): _lines(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_lines(item) for item in value]
    return one_line(value) if isinstance(value, str) else value


def _largest(largest: Mapping[str, float] | None) -> str:
    if largest is None:
        return ""
    return (
        f"angle {largest['angle_min']:.3f} to {largest['angle_max']:.3f} rad, speed {largest['speed']:.1f} rad/s, "
        f"current {largest['current']:.3f} A"
    )


def _listed(title: str, entries: Mapping[str, str]) -> list[str]:
    return ["", title, *(f"  {name:24} {said}" for name, said in entries.items())]


def _why(end: Mapping[str, str]) -> str:
    """Reasons of the loop and of the node."""
    said = [end.get("detail", ""), f"the node's stop reason: {end['node_stop_reason']}" if _stopped(end) else ""]
    return f" ({'; '.join(filter(None, said))})" if any(said) else ""


def _stopped(end: Mapping[str, str]) -> bool:
    return end.get("node_stop_reason", "NONE") not in ("NONE", "NEVER_COMMANDED")
