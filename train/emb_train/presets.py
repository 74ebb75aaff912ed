"""Presets, tasks and packaged references by name, with a line on each for ``--help``: read without torch.

Presets are the trainings of ``emb-train ppo``, in ``presets.toml``: ``thesis-…`` under the thesis's conditions and with
its hyper-parameters, the others the project's own.
"""

from __future__ import annotations

import textwrap
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

from emb_runtime.errors import UsageError, near

FILES = resources.files("emb_train")
WIDTH = 118  # Of a help text's lines
TASKS: Mapping[str, str] = {
    "viscous": "f_v in 1e-5..5e-5, the others known, weighted",
    "viscous-stiffness": "k_1 and f_v of Table 6.1, the others known, weighted E",
    "four-d": "k_m, k_1, T_c, f_v within 50 %, D",
    "four-e": "k_m, k_1, T_c, f_v within 50 %, E",
    "four-a": "k_m, k_1, T_c, f_v within 50 %, A",
    "four-t": "k_m, k_1, T_c, f_v within 50 %, T: the interval between runs that an estimate will have",
    "four-time": "k_m, k_1, T_c, f_v within 50 %, until 95 % of each are within 1.2 %",
}
"""Tasks that a reference is learned for."""


@cache
def _file() -> dict[str, Any]:
    return tomllib.loads(FILES.joinpath("presets.toml").read_text(encoding="utf-8"))


def preset_summaries() -> dict[str, str]:
    """A line on each preset, by name: what it learns."""
    return {name: record["summary"] for name, record in sorted(_file()["preset"].items())}


def preset_record(name: str) -> dict[str, Any]:
    """The table of a preset, with its hyper-parameters.

    Raises:
        UsageError: there is no such preset.
    """
    presets = _file()["preset"]
    if name not in presets:
        there = f"there are: {', '.join(sorted(presets))}{near(name, presets)}"
        raise UsageError(f"no preset is called '{name}'; {there}")
    own = dict(presets[name]["ppo"])
    return {**presets[name], "preset": name, "ppo": _file()["hyper_parameters"][own.pop("base")] | own}


def reference_names() -> list[str]:
    """Names of the references that are part of the package."""
    return sorted(file.name.removesuffix(".json") for file in FILES.joinpath("references").iterdir())


def listed(entries: Mapping[str, str]) -> str:
    """Names and what they mean, in lines of a help text."""
    column = max(map(len, entries)) + 4
    lines = [f"  {name:<{column - 2}}{meaning}" for name, meaning in entries.items()]
    return "\n".join(textwrap.fill(line, WIDTH, subsequent_indent=" " * column) for line in lines)


def wrapped(names: list[str]) -> str:
    """Names side by side, in lines of a help text."""
    return textwrap.fill(", ".join(names), WIDTH, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
