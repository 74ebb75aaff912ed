"""Summary of a run, its timing beside the budgets of its bench, and its rerun, as text; base install only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from emb_bench.config.bench import COUNTED, QUANTILE_NAMES
from emb_bench.config.conditions import CONDITIONS
from emb_bench.logs.log import RunLog, end_detail
from emb_bench.logs.timing import INTERVALS, BudgetCheck, Timing, check_budgets, quantiles, timing, timing_numbers
from emb_bench.numbers import percent, seconds
from emb_bench.report.text import Table, facts, listed, wrapped
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_USAGE
from emb_runtime.estimator.estimate import words
from emb_runtime.numbers import NOTHING, plain
from emb_runtime.system.terminal import one_line

if TYPE_CHECKING:
    from emb_bench.rerun import Rerun

UNITS = ((1.0, "s"), (1e3, "ms"), (1e6, "µs"))  # Of times, with their factors
SHOWN_DIFFERENCES = 10  # Without --verbose


def info(d: Mapping[str, Any], *, verbose: bool = False) -> str:
    """A :func:`emb_bench.logs.info.info_document` for a person; with ``verbose`` all metadata and events."""
    d = _lines(d)
    c, end = d["cycles"], d["metadata"].get("emb.end", {})
    lines = listed("WARNING: ", [d["missing"]])
    lines += ["SIMULATED: no real machine was driven"] if d["simulated"] else []
    why = f" ({detail})" if (detail := end_detail(end)) else ""
    complete = "complete" if d["complete"] else "NOT complete"
    lines += wrapped(f"{d['log']}: {d['exit_reason']}{why}, {d['duration']:.3f} s, log {complete}")
    cycles = f"{c['active']} active, {c['answered']} answered, {c['unanswered']} unanswered"
    commands = f"{c['clipped']} clipped, {c['limited']} limited, {c['returning']} returning home"
    lines += facts(
        ("cycles", f"{cycles}, {c['missed_periods']} periods missed"),
        ("commands", f"{commands}, {c['left']} braked by the node"),
        ("extremes", _largest(d.get("largest"))),
        *((name.partition("_")[0], _between(name, ends)) for name, ends in d.get("conditions", {}).items()),
        *(("drive lacks", f"{name}: {lost}") for name, lost in d.get("drive_lacks", {}).items()),
        ("response", _delays(d)),
    )
    if estimate := d.get("estimate"):
        lines += ["", *words(estimate, d.get("total", ""), fits=end.get("model_fits") != "False")]
    if not verbose:
        return "\n".join(lines)
    lines += _listed("messages", {topic: f"{count:9}" for topic, count in d["messages"].items()})
    lines += _listed("attachments", {name: f"{size:9} bytes" for name, size in d["attachments"].items()})
    for name, record in d["metadata"].items():
        lines += _listed(name, record)
    return "\n".join([*lines, "", "events", *(f"  {event['code']:24} {event['text']}" for event in d["events"])])


def _delays(d: Mapping[str, Any]) -> str:
    """Time from a sample to the command that answers it."""
    delays = ", ".join(f"{name} {1e6 * value:.0f}" for name, value in d.get("sensor_to_command", {}).items())
    simulated = " (simulated time)" if "emb.truth" in d["metadata"] else ""
    return f"{delays} µs{simulated}" if delays else ""


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
        f"angle {plain(largest['angle_min'], 4)} to {plain(largest['angle_max'], 4)} rad, "
        f"speed {largest['speed']:.1f} rad/s, current {largest['current']:.3f} A"
    )


def _between(name: str, ends: Mapping[str, float]) -> str:
    """A condition's least and largest value, with its unit."""
    return f"{plain(ends['min'], 4)} to {plain(ends['max'], 4)} {CONDITIONS[name].unit}"


def _listed(title: str, entries: Mapping[str, str]) -> list[str]:
    return ["", title, *(f"  {name:24} {text}" for name, text in entries.items())]


class RunTiming(NamedTuple):
    """Timing of one run, and the checks of its budgets."""

    log: RunLog
    timing: Timing
    checks: tuple[BudgetCheck, ...]  # Empty if no budget can be checked
    why_not: str  # Reason that no budget can be checked; empty if one can

    @property
    def exit_code(self) -> int:
        """Exit code of the command for this run alone."""
        if self.why_not:
            return EXIT_USAGE
        return EXIT_DONE if all(check.met for check in self.checks) else EXIT_CHECK_FAILED


def run_timing(log: RunLog) -> RunTiming:
    """Timing of a run, and the budgets of the bench in its log."""
    t = timing(log)
    budgets = log.bench.budgets
    if t.simulated:
        return RunTiming(log, t, (), "the time is simulated")
    if ran := log.metadata.get("emb.run", {}).get("time"):
        return RunTiming(log, t, (), f"the time ran {ran}")
    if budgets is None:
        return RunTiming(log, t, (), "the bench file in the log has no [budgets]")
    checks = tuple(check_budgets(t, budgets))
    return RunTiming(log, t, checks, "" if checks else "the [budgets] of the bench file in the log are empty")


def timing_document(entry: RunTiming) -> dict[str, Any]:
    """Timing and budgets of one run; times in seconds."""
    return {
        "log": str(entry.log.path),
        "missing": entry.log.missing,
        **timing_numbers(entry.timing),
        "budgets": [{**check._asdict(), "met": check.met} for check in entry.checks],
        "not_judged": entry.why_not,
        "met": None if entry.why_not else all(check.met for check in entry.checks),
    }


def timing_text(entry: RunTiming, *, verbose: bool = False) -> str:
    """Verdict on the budgets of a run, and its intervals; with ``verbose`` all budgets."""
    t, missed = entry.timing, [check for check in entry.checks if not check.met]
    if entry.why_not:
        verdict = f"no verdict: {entry.why_not}"
    elif missed:
        verdict = f"NOT MET: {len(missed)} of {len(entry.checks)} budgets ({', '.join(one.name for one in missed)})"
    else:
        verdict = f"met: all {len(entry.checks)} budgets"
    obeyed = "commands not obeyed: not reported" if t.not_obeyed is None else f"{t.not_obeyed} commands not obeyed"
    answers = f"{len(t.response)} answered, {t.unanswered} unanswered, {t.missed} periods missed, {obeyed}"
    lines = listed("WARNING: ", [entry.log.missing])
    lines += [*wrapped(f"{entry.log.path}: {verdict}"), *facts(("samples", f"{t.samples}, {answers}"))]
    if t.simulated:
        return "\n".join(lines)
    rows = [_row(label, list(quantiles(t.interval(name)).values())) for name, label in INTERVALS.items()]
    lines += ["", *Table("", ("", *QUANTILE_NAMES, "unit"), rows, words=(0, len(QUANTILE_NAMES) + 1)).lines()]
    shown = entry.checks if verbose else missed
    rows = [
        [one.name, _check(one, one.budget), _check(one, one.measured), "met" if one.met else "NOT MET"] for one in shown
    ]
    if rows:
        lines += ["", *Table("", ("budget", "at most", "measured", ""), rows, words=(0, 3)).lines()]
    return "\n".join(lines)


def _check(check: BudgetCheck, value: float | None) -> str:
    if value is None:
        return "nothing"
    return percent(value) if check.name in COUNTED else seconds(value)


def _row(label: str, values: list[float]) -> list[str]:
    """Quantiles of an interval, all in the unit that suits the largest."""
    if not values:
        return [label, *[NOTHING] * len(QUANTILE_NAMES), ""]
    factor, unit = next(((f, u) for f, u in UNITS if max(map(abs, values)) * f >= 1.0), UNITS[-1])
    return [label, *(f"{factor * value:.4g}" for value in values), unit]


def rerun_document(again: Rerun) -> dict[str, Any]:
    """A rerun as plain data."""
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


def rerun_text(again: Rerun, *, verbose: bool = False) -> str:
    """A rerun as text; with ``verbose`` every difference."""
    log, shown = again.log, len(again.differences) if verbose else SHOWN_DIFFERENCES
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
        lines.append("outcome      none: the loop diverged from the log at the last difference")
    for difference in again.differences[:shown]:
        where = "" if difference.step is None else f"step {difference.step}, "
        lines.append(f"  {where}{difference.what}: recorded {difference.recorded}, came {difference.came}")
    if len(again.differences) > shown:
        lines.append(f"  and {len(again.differences) - shown} more (-v shows all)")
    if not again.reproduced:
        names = ("tool", "python", "numpy", "onnxruntime", "libc")
        made = ", ".join(f"{name} {log.run[name]}" for name in names if name in log.run)
        lines.append(f"  the log was made with {made}: rounding may differ with others")
    return "\n".join(lines)
