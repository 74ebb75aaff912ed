"""The answer of a command: JSON for a program, or text of a length that the user chooses."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

from emb_bench.report.text import show
from emb_runtime.system.terminal import as_json


def add_output_options(p: argparse.ArgumentParser) -> None:
    """Add ``--json``, ``--verbose`` and ``--quiet``."""
    group = p.add_mutually_exclusive_group()
    group.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    group.add_argument("-v", "--verbose", action="store_true", help="print the details behind the answer, too")
    group.add_argument("-q", "--quiet", action="store_true", help="print the verdict only")


def answer(args: argparse.Namespace, document: Callable[[], Any], text: Callable[[bool], str]) -> None:
    """Print a result as the options ask for it.

    Args:
        args: with the options of :func:`add_output_options`.
        document: gives the JSON document.
        text: gives the text; its argument is True if it is to be verbose.
    """
    if args.json:
        show(as_json(document()))
        return
    said = text(args.verbose)
    show(_verdict(said) if args.quiet else said)


def _verdict(text: str) -> str:
    """Warnings and the first line behind them, each in one line."""
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith("    ") and lines:
            lines[-1] += f" {line.strip()}"
        elif lines and not lines[-1].startswith(("WARNING", "NOTE")):
            break
        else:
            lines.append(line)
    return "\n".join(lines)
