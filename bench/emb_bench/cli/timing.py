"""``emb-replay timing``: how punctual runs were, and whether that is within the bench's budgets."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from emb_bench.cli.options import add_output_options, answer
from emb_bench.figures import COLOURS, ENDINGS, GREY, drawn, require_place
from emb_bench.logs.log import read_log
from emb_bench.logs.timing import INTERVALS, Timing
from emb_bench.report.timing import SHOWN, document, run_timing, text
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE, EXIT_USAGE

HELP = "how punctual runs were, judged by the bench's budgets"
DESCRIPTION = """\
How long each part of a control cycle took, from the stamps that the run made itself: sample to sample, sample to loop,
deciding, sending, sensor to command, and the time to spare until the answer would have come too late. Judged by the
[budgets] of the bench description inside the log. Simulated time says nothing of a computer and is not judged.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="MCAP files of emb-run")
    add_output_options(p)
    p.add_argument("--plot", type=Path, metavar="FILE", help="histograms of all runs together; .png, .svg or .pdf")


def run(args: argparse.Namespace) -> int:
    """Show how punctual each run was; gives the exit code.

    Raises:
        UsageError: a file cannot be read, or the figure cannot be written.
        LogError: a log is none, or too damaged.
    """
    require_place("--plot", args.plot, ENDINGS)
    found = [run_timing(read_log(path)) for path in args.logs]
    if args.plot is not None:
        _draw(args.plot, [entry.timing for entry in found])
    answer(
        args,
        lambda: {"logs": [document(entry) for entry in found]},
        lambda all_of_it: "\n\n".join(text(entry, verbose=all_of_it) for entry in found),
    )
    codes = {entry.exit_code for entry in found}
    return next(code for code in (EXIT_CHECK_FAILED, EXIT_USAGE, EXIT_DONE) if code in codes)


def _draw(path: Path, timings: list[Timing]) -> None:
    with drawn(path, len(SHOWN), 1, "Timing of the control cycles", (7.0, 9.0)) as axes:
        for axis, colour, name in zip(axes[:, 0], COLOURS, SHOWN, strict=False):
            values = 1e6 * np.concatenate([t.interval(name) for t in timings])
            if len(values):
                axis.hist(values, bins=60, color=colour, log=True)
                axis.axvline(float(np.median(values)), color=GREY, linewidth=0.9, linestyle=(0, (5, 3)))
            axis.set_xlabel(f"{INTERVALS[name]} [µs]")
            axis.set_ylabel("count")
