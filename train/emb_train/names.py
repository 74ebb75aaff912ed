"""What can be named on a command line, for its ``--help``: read without importing what needs torch."""

from __future__ import annotations

import ast
import textwrap
from collections.abc import Mapping
from importlib import resources

WIDTH = 118
"""Of a help text's lines."""


def preset_summaries() -> dict[str, str]:
    """What each preset learns: the ``summary`` that is written out in its module."""
    folder = resources.files("emb_train").joinpath("presets")
    found = {}
    for file in sorted(folder.iterdir(), key=lambda file: file.name):
        if file.name.endswith(".py") and not file.name.startswith("_"):
            words = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
            summaries = [word.value for word in words if isinstance(word, ast.keyword) and word.arg == "summary"]
            found[file.name.removesuffix(".py").replace("_", "-")] = str(ast.literal_eval(summaries[0]))
    return found


def reference_names() -> list[str]:
    """Names of the tuned references of the structured actor that are part of the package."""
    folder = resources.files("emb_train").joinpath("structured", "tuned")
    return sorted(file.name.removesuffix(".json") for file in folder.iterdir() if file.name.endswith(".json"))


def listed(entries: Mapping[str, str]) -> str:
    """Names and what they mean, in lines of a help text."""
    column = max(map(len, entries)) + 4
    lines = [f"  {name:<{column - 2}}{meaning}" for name, meaning in entries.items()]
    return "\n".join(textwrap.fill(line, WIDTH, subsequent_indent=" " * column) for line in lines)


def wrapped(names: list[str]) -> str:
    """Names side by side, in lines of a help text."""
    return textwrap.fill(", ".join(names), WIDTH, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
