"""Timing of a run beside its bench's budgets, as a document for programs and as text; base install only."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from emb_bench.logs.log import RunLog
from emb_bench.logs.timing import INTERVALS, BudgetCheck, Floats, Timing, judge, quantiles, timing
from emb_bench.logs.timing import document as timing_document
from emb_bench.numbers import percent, seconds
from emb_bench.report.text import Table, facts
from emb_runtime.config.timing_budgets import COUNTED, QUANTILE_NAMES
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_USAGE, LogError

SHOWN = ("period", "age", "decision", "response", "slack")
"""Intervals that get a histogram; sending has a row of the table."""
BINS = 12
FEWEST = 10  # Fewest values of a histogram
INNER = (0.1, 99.9)
"""Quantiles between which a histogram's bins divide evenly [%]; its first and last row have what lies beyond, too."""
WIDTH = 50  # Characters of the longest bar


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


def text(entry: RunTiming) -> str:
    """The quantiles, the histograms and the budgets of one run, for a person."""
    t = entry.timing
    obeyed = "commands not obeyed: not known" if t.not_obeyed is None else f"{t.not_obeyed} commands not obeyed"
    answers = f"{len(t.response)} answered, {t.unanswered} unanswered, {t.missed} periods missed, {obeyed}"
    lines = [f"WARNING: {entry.log.missing}"] if entry.log.missing else []
    lines += [*facts(("log", str(entry.log.path)), ("samples", f"{t.samples}, {answers}")), ""]
    if t.simulated:
        return "\n".join([*lines, f"not judged: {entry.why_not}"])
    found = {said: [*map(seconds, quantiles(t.interval(name)).values())] for name, said in INTERVALS.items()}
    rows = [[said, *(values or ["nothing"] * len(QUANTILE_NAMES))] for said, values in found.items()]
    lines += Table("", ("", *QUANTILE_NAMES), rows).lines()
    for name in SHOWN:
        if len(values := t.interval(name)) >= FEWEST:
            lines += ["", INTERVALS[name], *_bars(values)]
    if entry.why_not:
        return "\n".join([*lines, "", f"not judged: {entry.why_not}"])
    rows = []
    for check in entry.checks:
        say = percent if check.name in COUNTED else seconds
        measured = "nothing" if check.measured is None else say(check.measured)
        rows.append([check.name, say(check.budget), measured, "met" if check.met else "NOT MET"])
    return "\n".join([*lines, "", *Table("", ("budget", "at most", "measured", ""), rows, words=(0, 3)).lines()])


def _bars(values: Floats) -> Iterator[str]:
    """A histogram in characters, in one row where all values are the same; a row that is not empty has at least one."""
    low, high = np.percentile(values, INNER).tolist()
    counts, edges = np.histogram(np.clip(values, low, high), BINS, (low, high))
    if high <= low:
        counts, edges = np.array([len(values)]), np.array([low, low])
    for k, count in enumerate(counts.tolist()):
        bar = "#" * math.ceil(WIDTH * count / max(counts))
        yield f"  {seconds(edges[k]):>10} to {seconds(edges[k + 1]):<10}{count:>8}  {bar}".rstrip()
