"""``emb-replay info``: what a run was."""

from __future__ import annotations

import argparse
from pathlib import Path

from emb_bench.logs.info import info_document
from emb_bench.logs.log import read_log
from emb_bench.report.info import text
from emb_runtime.errors import EXIT_DONE
from emb_runtime.system.terminal import as_json, show

HELP = "what the run was: identity, counts, timing, completeness"
DESCRIPTION = None


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")


def run(args: argparse.Namespace) -> int:
    """Show the contents of a log; gives the exit code.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is no log, or too damaged.
    """
    document = info_document(read_log(args.log))
    show(as_json(document) if args.json else text(document))
    return EXIT_DONE
