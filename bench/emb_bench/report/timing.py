"""Timing of a run beside its bench's budgets, as a document for programs and as text; base install only."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from emb_bench.logs.log import RunLog
from emb_bench.logs.timing import INTERVALS, BudgetCheck, Floats, Timing, judge, quantiles, timing
from emb_bench.logs.timing import document as timing_document
from emb_bench.numbers import NOTHING, percent, seconds
from emb_bench.report.text import Table, facts, listed, wrapped
from emb_runtime.config.timing_budgets import COUNTED, QUANTILE_NAMES
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_USAGE, LogError

SHOWN = ("period", "age", "decision", "response", "slack")
"""Intervals that get a histogram; sending has a row of the table."""
BINS = 12
FEWEST = 10  # Fewest values of a histogram
INNER = (0.1, 99.9)
"""Quantiles between which a histogram's bins divide evenly [%]; its first and last row have what lies beyond, too."""
WIDTH = 40  # Characters of the longest bar
UNITS = ((1.0, "s"), (1e3, "ms"), (1e6, "µs"))  # Of times, with their factors


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
    """Timing of a run beside the budgets of its own bench.

    Raises:
        LogError: the log has no control cycles or no bench, or was imported.
    """
    if log.imported:
        raise LogError(f"{log.path}: a recording of others has no loop whose timing could be told")
    t = timing(log)
    budgets = log.bench.budgets
    if t.simulated:
        return RunTiming(log, t, (), "the time was simulated: it says nothing of any computer or bus")
    if ran := log.metadata.get("emb.run", {}).get("time"):
        return RunTiming(log, t, (), f"time ran {ran}: it says nothing of any computer or bus")
    if budgets is None:
        return RunTiming(log, t, (), "the bench description in the log has no [budgets]")
    checks = tuple(judge(t, budgets))
    return RunTiming(log, t, checks, "" if checks else "the [budgets] of the bench description in the log are empty")


def document(entry: RunTiming) -> dict[str, Any]:
    """Timing and budgets of one run; times in seconds."""
    return {
        "log": str(entry.log.path),
        "missing": entry.log.missing,
        **timing_document(entry.timing),
        "budgets": [{**check._asdict(), "met": check.met} for check in entry.checks],
        "not_judged": entry.why_not,
        "met": None if entry.why_not else all(check.met for check in entry.checks),
    }


def text(entry: RunTiming, *, verbose: bool = False) -> str:
    """Verdict on the budgets of a run, and its intervals; with ``verbose`` the histograms."""
    t, missed = entry.timing, [check for check in entry.checks if not check.met]
    if entry.why_not:
        verdict = f"not judged: {entry.why_not}"
    elif missed:
        verdict = f"NOT MET: {len(missed)} of {len(entry.checks)} budgets ({', '.join(one.name for one in missed)})"
    else:
        verdict = f"met: all {len(entry.checks)} budgets"
    obeyed = "commands not obeyed: not known" if t.not_obeyed is None else f"{t.not_obeyed} commands not obeyed"
    answers = f"{len(t.response)} answered, {t.unanswered} unanswered, {t.missed} periods missed, {obeyed}"
    lines = listed("WARNING: ", [entry.log.missing])
    lines += [*wrapped(f"{entry.log.path}: {verdict}"), *facts(("samples", f"{t.samples}, {answers}"))]
    if t.simulated:
        return "\n".join(lines)
    rows = [_row(said, list(quantiles(t.interval(name)).values())) for name, said in INTERVALS.items()]
    lines += ["", *Table("", ("", *QUANTILE_NAMES, "unit"), rows, words=(0, len(QUANTILE_NAMES) + 1)).lines()]
    shown = entry.checks if verbose else missed
    rows = [[check.name, _check(check, check.budget), _check(check, check.measured), _met(check)] for check in shown]
    if rows:
        lines += ["", *Table("", ("budget", "at most", "measured", ""), rows, words=(0, 3)).lines()]
    for name in SHOWN if verbose else ():
        if len(values := t.interval(name)) >= FEWEST:
            lines += ["", INTERVALS[name], *_bars(values)]
    return "\n".join(lines)


def _met(check: BudgetCheck) -> str:
    return "met" if check.met else "NOT MET"


def _check(check: BudgetCheck, value: float | None) -> str:
    if value is None:
        return "nothing"
    return percent(value) if check.name in COUNTED else seconds(value)


def _row(said: str, values: list[float]) -> list[str]:
    """Quantiles of an interval, all in the unit that suits the largest."""
    if not values:
        return [said, *[NOTHING] * len(QUANTILE_NAMES), ""]
    factor, unit = next(((f, u) for f, u in UNITS if max(map(abs, values)) * f >= 1.0), UNITS[-1])
    return [said, *(f"{factor * value:.4g}" for value in values), unit]


def _bars(values: Floats) -> Iterator[str]:
    """A histogram in characters, in one row where all values are the same; a row that is not empty has at least one."""
    low, high = np.percentile(values, INNER).tolist()
    counts, edges = np.histogram(np.clip(values, low, high), BINS, (low, high))
    if high <= low:
        counts, edges = np.array([len(values)]), np.array([low, low])
    for k, count in enumerate(counts.tolist()):
        bar = "#" * math.ceil(WIDTH * count / max(counts))
        yield f"  {1e6 * edges[k]:8.1f} to {1e6 * edges[k + 1]:8.1f} µs {count:8}  {bar}".rstrip()
