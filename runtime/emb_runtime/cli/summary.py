"""The text of a run: templates, filled from its document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from emb_runtime.cli.documents import DONE, LOG_INCOMPLETE
from emb_runtime.cli.preflight import Check, counted, table
from emb_runtime.estimator import estimate
from emb_runtime.numbers import plain
from emb_runtime.records import RunType

Document = Mapping[str, Any]

BRAKE = "{angle_min:.2f} to {angle_max:.2f} rad, top speed {top_speed:.1f} rad/s, top current {top_current:.2f} A"
END = "{end_angle:.3f} rad, {end_velocity:.1f} rad/s; after the stop {last_angle:.3f} rad"
COMMANDS = (
    "{answered} sent, {confirmed} frames seen on the bus, {limited} limited by the shield, {returning} returning "
    "home, {clipped} clipped, {not_obeyed} not obeyed"
)
SAMPLES = (
    "{pairs} pairs, {unanswered} without a command (send buffer full: {not_taken}, braked by the node: {left}), "
    "{missed} periods missed, {rejected} frames rejected, {dropped} dropped by the kernel"
)
MOTION = "unexplained velocity {unexplained:.0f} rad/s, limit {unexplained_allowed:.0f} rad/s"
NOT_JUDGED = "no verdict: too little motion, or the bench declares a lag or frames older than two samples"
NOT_PROVEN = "NOT PROVEN: too little motion, so the speed stayed low"


def run_text(s: Document, details: bool = False) -> str:
    """A :meth:`~emb_runtime.cli.documents.RunResult.document` as text: the answer and what was unusual.

    Every count with ``details``.
    """
    is_done, sampled, watchdog = s["result"] == DONE, s["pairs"] > 0, s["watchdog"]
    completed, is_judged = is_done and s["purpose"] == RunType.EXPERIMENT, s["unexplained"] is not None
    moved = completed and s["limit"] > 0.0
    counts = sampled and (details or not is_done or s["unanswered"] or s["missed"] or s["rejected"])
    rest, reason = "at rest" if s["node_at_rest"] else "still stopping", s["node_stop_reason"] or "not reported"
    lacking = ", ".join(name for name, value in s["realtime"].items() if value.startswith("not obtained"))
    rows = [  # Label, and text; an empty text makes no row
        *(("OUTSIDE", _outside(name, s)) for name in s["outside"]),
        *(("way home", f"{when} the experiment: {brief(way)}") for when, way in s["homing"].items()),
        ("stage", s["stage"] != "full" and f"{s['stage']}, at most {s['limit']:g} A"),
        ("policy", s["policy_kind"] and f"{s['policy_kind']}, sha256 {s['policy_sha256'][:12]}"),
        ("brake", sampled and BRAKE.format_map(s)),
        ("end", sampled and f"{END.format_map(s)}, {rest}, node {s['node_state']} (stop reason {reason})"),
        ("commands", counts and COMMANDS.format_map(s)),
        ("samples", counts and SAMPLES.format_map(s)),
        ("motion", completed and (details or not is_judged) and (MOTION if is_judged else NOT_JUDGED).format_map(s)),
        ("response", moved and (s["response"] or NOT_PROVEN)),
        ("bus errors", s["bus_errors"] and f"{s['bus_errors']} reports: {counted(s['bus_error_classes'])}"),
        *(("rejected", f"{name}: {counted(reasons)}") for name, reasons in s["rejections"].items()),
        ("real time", lacking and f"NOT OBTAINED: {lacking}; --json says why, --no-rt does not ask"),
        ("watchdog", watchdog and (watchdog["tripped"] or watchdog["error"]) and _watchdog(watchdog)),
    ]
    lines = [*_head(s), *(f"  {label:<10} {row}" for label, row in rows if row)]
    if s["estimate"] and (details or s["result"] in (DONE, LOG_INCOMPLETE)):
        lines += estimate.words(s["estimate"], s["total"], fits=s["model_fits"])
    lines.append(f"log: {s['log']} ({s['log_messages']} messages, {s['log_bytes'] / 1024:.0f} KiB{_missing(s)})")
    if moved:
        lines.append(f"next: emb-replay estimate {s['log']}   (tests the model, gives the total)")
    return "\n".join(lines)


def brief(s: Document) -> str:
    """A document of a run, or a :func:`~emb_runtime.cli.documents.refusal`, in one line."""
    if s["result"] != DONE:
        return ", ".join(filter(None, (f"{s['result']}: {s['detail'] or s['cause']}", s["log"])))
    ways = "".join(f", a way home {name}" for name in s["homing"])
    incomplete = "" if s["log_complete"] else ", log INCOMPLETE"
    where = "home" if s["home"] else "not home"
    return f"done: {s['answered']} of {s['steps']} answered, {where}{ways}, {s['log']}{incomplete}"


def listen_text(s: Document, checks: Sequence[Check]) -> str:
    """The document of ``--read-only`` as text, with its pre-flight."""
    bus = s["heard"]
    lines = [
        f"a run could NOT begin ({s['result']}): {s['detail']}" if s["detail"] else "a run could begin",
        table(checks),
        f"  listened for {bus['duration']:.3f} s",
    ]
    for name, count in bus["frames"].items():
        rejected, rate = sum(bus["rejections"].get(name, {}).values()), bus["rates"].get(name, 0.0)
        lines.append(f"    {name:<13} {count:8} frames, {rate:7.1f} per second, {rejected} rejected")
    if bus["others"]:
        lines.append(f"    others        {bus['others']:8} frames")
    lines.append(f"  log       {s['log']} ({s['log_messages']} messages{_missing(s)})")
    return "\n".join(lines)


def _head(s: Document) -> list[str]:
    if s["result"] == DONE:
        where = "home" if s["home"] else "NOT HOME"
        where = f"precise after {s['goal_s']:.3f} s, then {where}" if s["goal_reached"] else where
        done = f"done, OUTSIDE THE RANGES ({', '.join(s['outside'])})" if s["outside"] else "done"
        return [f"{done}: {s['answered']} of {s['steps']} samples answered, {where}"]
    where = " on the way home" if s["purpose"] == RunType.HOMING else ""
    why = f"{s['cause']}: {s['detail']}" if s["detail"] else s["cause"]
    ended = "NOT RECORDED" if s["result"] == LOG_INCOMPLETE else "STOPPED"
    return [f"{ended}{where} ({s['result']}): {why}", f"  → {s['advice']}"]


def _outside(name: str, s: Document) -> str:
    value, low, high, ranges = s["outside"][name]
    return (
        f"{name} = {plain(value, 4)} {s['estimate'][name]['unit']} is at or beyond a border of ranges.{ranges} "
        f"({plain(low, 4)} to {plain(high, 4)}): the limits were not guaranteed; find the cause, or widen the range"
    )


def _watchdog(s: Document) -> str:
    error = f": {s['error']}" if s["error"] else ""
    return f"{s['tripped'] or 'did not trip'}, {s['frames']} stop frames{error}"


def _missing(s: Document) -> str:
    return "" if s["log_complete"] else f", INCOMPLETE: {s['log_error']}"
