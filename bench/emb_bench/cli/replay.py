"""``emb-replay``: evaluation of logs. Each command is in a module of its own and described there."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Mapping
from importlib import metadata
from typing import NamedTuple

from emb_runtime.errors import EmbError
from emb_runtime.system.terminal import complain

ANY = {0: "done", 2: "usage: wrong argument, a file that cannot be read or written, a missing library", 130: "Ctrl-C"}
"""Exit codes of every command, and their meanings."""
OF_A_LOG = ANY | {6: "the log is not a log, or too damaged to say anything true from it"}

OF_A_RUN = OF_A_LOG | {2: f"{ANY[2]}, the log of a run that only listened (--read-only)"}


class Command(NamedTuple):
    """One command."""

    module: str  # With ``HELP``, ``DESCRIPTION``, ``add_arguments`` and ``run``; imported where the command is wanted
    codes: Mapping[int, str]  # Meanings of its exit codes


COMMANDS: Mapping[str, Command] = {
    "fim": Command("emb_bench.cli.fim", OF_A_RUN),
    "estimate": Command(
        "emb_bench.cli.estimate",
        OF_A_RUN
        | {
            1: "with --strict: the model does not fit, does not predict a log, or a parameter is not identified",
            6: f"{OF_A_LOG[6]}; or too short for the unknowns",
        },
    ),
    "report": Command(
        "emb_bench.cli.report",
        OF_A_LOG
        | {
            0: "the page is written, from all logs",
            1: "the page is written, but a log took no part in the estimate, too short a one among them (named on "
            "stderr); with --strict: not accepted",
            7: "with --strict: the page is written, and not every criterion can be decided",
            6: "not one log can be used, or one that is held out cannot",
            130: "Ctrl-C: nothing is written",
        },
    ),
    "campaign": Command(
        "emb_bench.cli.campaign",
        OF_A_LOG
        | {
            0: "every log was evaluated",
            1: "some logs failed: they are named, and the others are in the result",
            2: "usage: wrong argument, no log found, a missing library, the result cannot be written",
            6: "every log failed",
            130: "Ctrl-C: no result is written",
        },
    ),
    "info": Command("emb_bench.cli.info", OF_A_LOG),
    "timing": Command(
        "emb_bench.cli.timing",
        OF_A_LOG
        | {
            0: "every run kept to every budget",
            1: "a run did not keep to a budget",
            2: "usage: wrong argument, unreadable file; or nothing to judge by: no [budgets] in the log, simulated "
            "time",
        },
    ),
    "rerun": Command(
        "emb_bench.rerun",
        OF_A_RUN
        | {1: "something came out otherwise: the first differences are printed", 5: "the policy in the log is refused"},
    ),
    "repair": Command(
        "emb_bench.export.repair", OF_A_LOG | {6: "the log is not a log, or not one message in it can be saved"}
    ),
    "export": Command("emb_bench.export.export", OF_A_LOG),
    "import": Command("emb_bench.cli.import_recording", ANY),
    "live": Command(
        "emb_bench.cli.live",
        {0: "ended by Ctrl-C, or the one log is over", 2: ANY[2], 6: "the one log is not a log, or is damaged"},
    ),
}
"""Commands by their names, in the order of ``--help``."""

EVERY = OF_A_LOG | {1: "checked, and it is not as it should be", 5: "a policy is damaged or does not fit the bench"}
"""Exit codes of all commands together."""
CUT = "\nA log that was cut (kill -9, full disk) is read as far as it goes, and what is missing is said.\n"


def epilog(codes: Mapping[int, str]) -> str:
    """The end of a ``--help``."""
    lines = [f"  {code:<4} {said}\n" for code, said in sorted(codes.items())]
    return f"exit codes:\n{''.join(lines)}{CUT if 6 in codes else ''}"


def parser(only: str | None = None) -> argparse.ArgumentParser:
    """The command line.

    Args:
        only: the command that is wanted, where it is known: the others' imports would take longer than many of them.
    """
    p = argparse.ArgumentParser(
        prog="emb-replay",
        description="Evaluate logs of emb-run.",
        epilog=epilog(EVERY) + "\nemb-replay COMMAND --help says what they mean there.\n",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--version", action="version", version=f"emb-replay {metadata.version('emb-excite')}")
    commands = p.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name in COMMANDS if only is None else (only,):
        module, codes = importlib.import_module(COMMANDS[name].module), COMMANDS[name].codes
        command = commands.add_parser(
            name,
            help=module.HELP,
            description=module.DESCRIPTION,
            epilog=epilog(codes),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        module.add_arguments(command)
        command.set_defaults(start=module.run)
    return p


def main(argv: list[str] | None = None) -> int:
    """Entry point of ``emb-replay``."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        args = parser(argv[0] if argv and argv[0] in COMMANDS else None).parse_args(argv)
        return int(args.start(args))
    except EmbError as err:
        return complain("emb-replay", err)


if __name__ == "__main__":
    sys.exit(main())
