"""Options of a command from the function behind it: names, types and defaults by its signature, help by its docstring.

An argument that may be given by keyword only is an option ``--name``, another one stands by itself. An option that is
not typed is not passed on, so that each default stands in the signature only. Every command that answers has the same
options for the form of its answer.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from emb_bench.report.text import show
from emb_runtime.system.terminal import as_json

Function = Callable[..., Any]
METAVARS = {
    "bench": "FILE",
    "last": "FILE",
    "known": "NAME=VALUE±HALF",
    "acceptance": "FILE",
    "junit": "FILE",
    "plot": "FILE",
    "output": "FILE",
    "ray": "ADDRESS",
    "map": "FILE",
    "place": "DIR|LOG",
}
"""Words of ``--help`` for the values of options; without, those of the type."""
LISTS = ("runs", "paths")  # Arguments that may be given several times
HELP_WIDTH = 92  # Columns of a description


def summary(function: Function) -> str:
    """First sentence of a function's docstring, as a line of ``--help``."""
    text = inspect.getdoc(function) or ""
    return text.partition("\n\n")[0].replace("\n", " ").rstrip(".")


def description(function: Function) -> str:
    """Text of a function's docstring before its arguments, as paragraphs of ``--help``."""
    text = (inspect.getdoc(function) or "").partition("Args:\n")[0]
    return "\n".join(textwrap.fill(part, HELP_WIDTH) for part in text.strip().split("\n\n")) + "\n"


def add(p: argparse.ArgumentParser, function: Function, leave_out: Sequence[str] = ()) -> None:
    """Add the arguments of a function to a command line."""
    described = _described(function)
    for name, parameter in inspect.signature(function).parameters.items():
        if name in leave_out or parameter.kind is parameter.VAR_KEYWORD:
            continue
        kind = eval(parameter.annotation, vars(sys.modules[function.__module__]))  # our own source
        told = described[name].rpartition("; without, ")[2] if parameter.default is True else described[name]
        p.add_argument(*_flags(name, parameter), help=told, **_form(name, parameter, kind))


def given(args: argparse.Namespace, function: Function, leave_out: Sequence[str] = ()) -> dict[str, Any]:
    """The arguments of a function that were typed."""
    names = set(inspect.signature(function).parameters) - set(leave_out)
    return {name: value for name, value in vars(args).items() if name in names}


def _flags(name: str, parameter: inspect.Parameter) -> list[str]:
    if name == "output":
        return ["-o", "--output"]
    if parameter.kind is not parameter.KEYWORD_ONLY:
        return [name]
    return [f"--{'no-' if parameter.default is True else ''}{name.replace('_', '-')}"]


def _form(name: str, parameter: inspect.Parameter, kind: Any) -> dict[str, Any]:
    """Keywords of ``add_argument`` for one argument."""
    option = parameter.kind is parameter.KEYWORD_ONLY
    form: dict[str, Any] = {"default": argparse.SUPPRESS}
    form |= {"dest": name} if option else {} if parameter.default is parameter.empty else {"nargs": "?"}
    if name == "output":
        return {"required": True, "type": Path, "metavar": "FILE"}
    if isinstance(parameter.default, bool):
        return {**form, "action": "store_false" if parameter.default else "store_true"}
    parts = (kind,) if get_origin(kind) is Literal else get_args(kind) or (kind,)
    literal = next((part for part in parts if get_origin(part) is Literal), None)
    if literal is not None:
        return {**form, "choices": get_args(literal)}
    if name in LISTS:
        many = {"action": "append"} if option else {"nargs": "+"}
        return {**form, **many, "type": Path, "metavar": "PATH" if name == "paths" else "RUN"}
    for number, word in ((int, "N"), (float, "X")):
        if number in parts:
            return {**form, "type": number, "metavar": word}
    if Path in parts and Mapping[str, float] not in parts:
        return {**form, "type": Path, "metavar": METAVARS.get(name, "RUN")}
    return {**form, "metavar": METAVARS.get(name, "NAMES" if Sequence[str] in parts else name.upper())}


def _described(function: Function) -> dict[str, str]:
    """Descriptions of arguments by name, from the part ``Args:`` of the docstring; as argparse takes them."""
    section = (inspect.getdoc(function) or "").partition("Args:\n")[2].partition("\n\n")[0]
    entries = re.findall(r"^    (\w+): ((?:.|\n(?!    \w+: ))*)", section, re.MULTILINE)
    return {name: " ".join(text.split()).replace("%", "%%").rstrip(".") for name, text in entries}


def add_output_options(p: argparse.ArgumentParser) -> None:
    """Add ``--json``, ``--verbose`` and ``--quiet``."""
    group = p.add_mutually_exclusive_group()
    group.add_argument("--json", action="store_true", help="print JSON; a number that is not finite is null")
    group.add_argument("-v", "--verbose", action="store_true", help="print the details behind the answer, too")
    group.add_argument("-q", "--quiet", action="store_true", help="print the verdict only")


def answer(args: argparse.Namespace, document: Callable[[], Any], text: Callable[[bool], str]) -> None:
    """Print a result as the options of :func:`add_output_options` say; ``text`` takes True if it is to be verbose."""
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
        elif lines and not lines[-1].startswith(("WARNING", "NOTE", "OUTSIDE", "SIMULATED")):
            break
        else:
            lines.append(line)
    return "\n".join(lines)
