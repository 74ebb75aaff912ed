"""Command lines from records of options (:mod:`emb_bench.options`), and the form of an answer.

An option that is not typed is not passed on, so that each default stands in its record only.
"""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from emb_bench.options import Options, help_of
from emb_bench.report.text import show
from emb_runtime.system.terminal import json_document

Record = TypeVar("Record", bound=Options)


def summary(text: str | None) -> str:
    """First sentence of a docstring, as a line of ``--help``."""
    return (text or "").partition("\n\n")[0].replace("\n    ", " ").rstrip(".")


def description(text: str | None) -> str:
    """A docstring before its arguments, as paragraphs of ``--help``."""
    before = textwrap.dedent(f"    {text or ''}".partition("Args:\n")[0])
    return f"{before.strip()}\n"


def add(p: argparse.ArgumentParser, record: type[Options]) -> None:
    """Add the options of a record to a command line."""
    for one in fields(record):
        if (row := help_of(one)) is None:
            continue
        form: dict[str, Any] = {"dest": one.name, "default": argparse.SUPPRESS, "help": row.text.replace("%", "%%")}
        if isinstance(one.default, bool):
            form["action"] = "store_false" if one.default else "store_true"
        elif row.choices:
            form["choices"] = row.choices
        else:
            form |= {"type": row.kind, "metavar": row.metavar}
        p.add_argument(f"--{'no-' if one.default is True else ''}{one.name.replace('_', '-')}", **form)


def given(args: argparse.Namespace, record: type[Record]) -> Record:
    """The record of the options that were typed."""
    names = {one.name for one in fields(record)}
    return record(**{name: value for name, value in vars(args).items() if name in names})


def add_output_options(p: argparse.ArgumentParser) -> None:
    """Add ``--json``, ``--verbose`` and ``--quiet``."""
    group = p.add_mutually_exclusive_group()
    group.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    group.add_argument("-v", "--verbose", action="store_true", help="print the details behind the answer, too")
    group.add_argument("-q", "--quiet", action="store_true", help="print the verdict only")


def print_answer(args: argparse.Namespace, document: Callable[[], Any], text: Callable[[bool], str]) -> None:
    """Print a result as the options of :func:`add_output_options` say; ``text`` takes True if it is to be verbose."""
    if args.json:
        show(json_document(document()))
        return
    lines = text(args.verbose)
    show(_verdict(lines) if args.quiet else lines)


def _verdict(text: str) -> str:
    """Warnings and the first line behind them, each in one line."""
    lines: list[str] = []
    for line in text.splitlines():
        if line.startswith("    ") and lines:
            lines[-1] += f" {line.strip()}"
        elif lines and not lines[-1].startswith(("WARNING", "NOTE", "OUTSIDE", "SIMULATED")):
            break
        else:
            lines.append(line)
    return "\n".join(lines)
