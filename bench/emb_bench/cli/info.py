"""``emb-replay info``: what a run was."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from emb_bench.logs.info import info_document
from emb_bench.logs.log import read_log
from emb_bench.report.info import text
from emb_runtime.errors import EXIT_DONE
from emb_runtime.system.terminal import as_json, show


def add_parser(commands: Any, epilog: str) -> None:
    """Add the command ``info`` to those of ``emb-replay``."""
    p = commands.add_parser(
        "info",
        help="what the run was: identity, counts, timing, completeness",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    p.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Show the contents of a log; gives the exit code.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is no log, or too damaged.
    """
    document = info_document(read_log(args.log))
    show(as_json(document) if args.json else text(document))
    return EXIT_DONE
