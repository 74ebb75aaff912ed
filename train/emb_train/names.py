"""Names for command lines and their ``--help``, read without importing torch."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from importlib import resources

WIDTH = 118  # Of a help text's lines
TASKS: Mapping[str, str] = {
    "viscous": "f_v in 1e-5..5e-5, the others known, weighted",
    "viscous-stiffness": "k_1 and f_v of Table 6.1, the others known, weighted E",
    "four-d": "k_m, k_1, T_c, f_v within 50 %, D",
    "four-e": "k_m, k_1, T_c, f_v within 50 %, E",
    "four-a": "k_m, k_1, T_c, f_v within 50 %, A",
    "four-time": "k_m, k_1, T_c, f_v within 50 %, until 95 % of each are within 1.2 %",
}
"""Tasks that a reference is learned for, in a line each."""


def reference_names() -> list[str]:
    """Names of the tuned references that are part of the package."""
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
