"""Names for command lines and their ``--help``, read without importing torch."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from importlib import resources

WIDTH = 118  # Of a help text's lines


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
