"""``emb-replay info``: what a run was."""

from __future__ import annotations

import argparse
from pathlib import Path

from emb_bench.cli.options import add_output_options, answer
from emb_bench.logs.info import info_document
from emb_bench.logs.log import read_log
from emb_bench.report.info import text
from emb_runtime.errors import EXIT_DONE

HELP = "what the run was: identity, counts, timing, completeness"
DESCRIPTION = None


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    add_output_options(p)


def run(args: argparse.Namespace) -> int:
    """Show the contents of a log; gives the exit code.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is no log, or too damaged.
    """
    document = info_document(read_log(args.log))
    answer(args, lambda: document, lambda all_of_it: text(document, verbose=all_of_it))
    return EXIT_DONE
