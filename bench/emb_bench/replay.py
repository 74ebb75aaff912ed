"""``emb-replay``: what logs say. Each command is in a module of its own, and says there what it does."""

from __future__ import annotations

import argparse
import sys
from importlib import metadata

from emb_bench import fim, info, rerun
from emb_bench.campaign import cli as campaign
from emb_bench.compare import cli as compare
from emb_bench.estimate import cli as estimate
from emb_bench.logtools import export, layout, repair
from emb_bench.report import cli as report
from emb_runtime.errors import EmbError
from emb_runtime.terminal import complain

COMMANDS = (fim, estimate, report, campaign, compare, info, rerun, repair, export, layout)
"""Modules with ``add_parser``, in the order of ``--help``."""

EPILOG = """\
exit codes:
  0  done
  1  checked, and it is not as it should be (the command says what it checks)
  2  usage: wrong argument, unreadable log, bench or parameter file
  6  the log is not a log, or too damaged to say anything true from it

A log that was cut (kill -9, full disk) is read as far as it goes, and what is missing is said first.
"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(
        prog="emb-replay",
        description="Evaluate logs of emb-run.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="version", version=f"emb-replay {metadata.version('emb-excite')}")
    commands = p.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in COMMANDS:
        module.add_parser(commands, EPILOG)
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-replay``."""
    args = parser().parse_args(argv)
    try:
        return int(args.run(args))
    except EmbError as err:
        return complain("emb-replay", err)


if __name__ == "__main__":
    sys.exit(main())
