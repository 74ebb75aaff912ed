"""``emb-replay timing``: how punctual runs were, and whether that is within the bench's budgets."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emb_bench.figures import COLOURS, ENDINGS, GREY, drawn, require_place
from emb_bench.logs.log import RunLog, read_log
from emb_bench.logs.timing import INTERVALS, Floats, Timing, Verdict, document, judge, quantiles, timing
from emb_bench.numbers import percent, seconds
from emb_runtime.config.timing_budgets import COUNTED, QUANTILE_NAMES
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_USAGE
from emb_runtime.system.terminal import as_json, show

DESCRIPTION = """\
How long each part of a control cycle took, from the stamps that the run made itself: sample to sample, sample to loop,
deciding, sending, sensor to command, and the time to spare until the answer would have come too late. Judged by the
[budgets] of the bench description inside the log. Simulated time says nothing of a computer and is not judged.
"""

SHOWN = ("period", "age", "decision", "response", "slack")
"""Intervals that get a histogram; sending has a row of the table."""
BINS = 12
INNER = (0.1, 99.9)
"""Quantiles between which a histogram's bins divide evenly [%]; its first and last row have what lies beyond, too."""
WIDTH = 50
"""Characters of the longest bar."""


class Judged(NamedTuple):
    """One run, and what its budgets say of it."""

    log: RunLog
    timing: Timing
    verdicts: tuple[Verdict, ...]
    """Empty where there is nothing to judge by."""
    why_not: str
    """Why there is nothing to judge by; empty where there is something."""

    @property
    def exit_code(self) -> int:
        """As the command's, were this the only run."""
        if self.why_not:
            return EXIT_USAGE
        return EXIT_DONE if all(verdict.met for verdict in self.verdicts) else EXIT_CHECK_FAILED


def add_parser(commands: Any, epilog: str) -> None:
    """Add the command ``timing`` to those of ``emb-replay``."""
    p = commands.add_parser(
        "timing",
        help="how punctual runs were, judged by the bench's budgets",
        description=DESCRIPTION,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="MCAP files of emb-run")
    p.add_argument("--json", action="store_true", help="print JSON, a list of logs; times in seconds")
    p.add_argument("--figure", type=Path, metavar="FILE", help="histograms of all runs together; .png, .svg or .pdf")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Tell how punctual each run was; gives the exit code.

    Raises:
        UsageError: a file cannot be read, or the figure cannot be written.
        LogError: a log is none, or too damaged.
    """
    require_place("--figure", args.figure, ENDINGS)
    found = [judged(read_log(path)) for path in args.logs]
    if args.figure is not None:
        _draw(args.figure, [entry.timing for entry in found])
    if args.json:
        show(as_json({"logs": [_document(entry) for entry in found]}))
    else:
        show("\n\n".join(text(entry) for entry in found))
    codes = {entry.exit_code for entry in found}
    return next(code for code in (EXIT_CHECK_FAILED, EXIT_USAGE, EXIT_DONE) if code in codes)


def judged(log: RunLog) -> Judged:
    """A run's timing beside the budgets of its own bench.

    Raises:
        LogError: the log has no control cycles or no bench.
    """
    t = timing(log)
    budgets = log.bench.budgets
    if t.simulated:
        return Judged(log, t, (), "the time was simulated: it says nothing of any computer or bus")
    if ran := log.metadata.get("emb.run", {}).get("time"):
        return Judged(log, t, (), f"time ran {ran}: it says nothing of any computer or bus")
    if budgets is None:
        return Judged(log, t, (), "the bench description in the log has no [budgets]")
    verdicts = tuple(judge(t, budgets))
    return Judged(log, t, verdicts, "" if verdicts else "the [budgets] of the bench description in the log are empty")


def _document(entry: Judged) -> dict[str, Any]:
    verdicts = [{**verdict._asdict(), "met": verdict.met} for verdict in entry.verdicts]
    return {
        "log": str(entry.log.path),
        "missing": entry.log.missing,
        **document(entry.timing),
        "budgets": verdicts,
        "not_judged": entry.why_not,
        "met": None if entry.why_not else all(verdict.met for verdict in entry.verdicts),
    }


def text(entry: Judged) -> str:
    """The table, the histograms and the verdicts of one run, for a person."""
    t = entry.timing
    lines = [f"WARNING: {entry.log.missing}"] if entry.log.missing else []
    lines += [
        f"log          {entry.log.path}",
        f"samples      {t.samples}, {len(t.response)} answered, {t.unanswered} unanswered, {t.missed} periods missed, "
        + ("commands not obeyed: not known" if t.not_obeyed is None else f"{t.not_obeyed} commands not obeyed"),
        "",
        f"{'':20}" + "".join(f"{name:>10}" for name in QUANTILE_NAMES),
    ]
    for name, said in INTERVALS.items():
        numbers = "".join(f"{seconds(value):>10}" for value in quantiles(t.interval(name)).values())
        lines.append(f"{said:20}{numbers or '   nothing measured'}")
    for name in SHOWN:
        if len(values := t.interval(name)):
            lines += ["", INTERVALS[name], *_bars(values)]
    return "\n".join([*lines, "", *_verdicts(entry)])


def _verdicts(entry: Judged) -> Iterator[str]:
    if entry.why_not:
        yield f"not judged: {entry.why_not}"
        return
    yield f"{'budget':20}{'at most':>10}{'measured':>10}"
    for verdict in entry.verdicts:
        say = percent if verdict.name in COUNTED else seconds
        measured = "nothing" if verdict.measured is None else say(verdict.measured)
        yield f"{verdict.name:20}{say(verdict.budget):>10}{measured:>10}  {'met' if verdict.met else 'NOT MET'}"


def _bars(values: Floats) -> Iterator[str]:
    """A histogram in characters; a row that is not empty has at least one."""
    edges = _edges(values)
    counts = _counts(values, edges)
    for k, count in enumerate(counts):
        bar = "#" * int(np.ceil(WIDTH * count / max(counts)))
        yield f"  {seconds(edges[k]):>10} to {seconds(edges[k + 1]):<10}{count:>8}  {bar}".rstrip()


def _edges(values: Floats) -> Floats:
    """Borders of the bins, even between the :data:`INNER` quantiles; all values in one bin where they are the same."""
    low, high = np.percentile(values, INNER)
    if high <= low:
        return np.array([low, low])
    return np.linspace(low, high, BINS + 1)


def _counts(values: Floats, edges: Floats) -> list[int]:
    """How many values are in each bin; the first and the last take in what lies beyond."""
    place = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return [int(count) for count in np.bincount(place, minlength=len(edges) - 1)]


def _draw(path: Path, timings: list[Timing]) -> None:
    with drawn(path, len(SHOWN), 1, "Timing of the control cycles", (7.0, 9.0)) as axes:
        for axis, colour, name in zip(axes[:, 0], COLOURS, SHOWN, strict=False):
            values = 1e6 * np.concatenate([t.interval(name) for t in timings])
            if len(values):
                axis.hist(values, bins=60, color=colour, log=True)
                axis.axvline(float(np.median(values)), color=GREY, linewidth=0.9, linestyle=(0, (5, 3)))
            axis.set_xlabel(f"{INTERVALS[name]} [µs]")
            axis.set_ylabel("count")
