"""Presets by name, with a line on each for ``--help``: read without torch.

They are the trainings of ``emb-train ppo``, in ``presets.toml``: ``thesis-…`` under the thesis's conditions and with
its hyper-parameters, the others with those of this project.
"""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Any

from emb_runtime.errors import UsageError, near

FILES = resources.files("emb_train")
DEFAULT_PRESET = "interval"


@cache
def _file() -> dict[str, Any]:
    return tomllib.loads(FILES.joinpath("presets.toml").read_text(encoding="utf-8"))


def preset_summaries() -> dict[str, str]:
    """A line on each preset, by name: what it learns."""
    return {name: record["summary"] for name, record in sorted(_file()["preset"].items())}


def preset_record(name: str) -> dict[str, Any]:
    """The table of a preset, with its hyper-parameters, as a copy.

    Raises:
        UsageError: there is no such preset.
    """
    presets = _file()["preset"]
    if name not in presets:
        there = f"there are: {', '.join(sorted(presets))}{near(name, presets)}"
        raise UsageError(f"no preset is called '{name}'; {there}")
    record = copy.deepcopy(presets[name])
    base = copy.deepcopy(_file()["hyper_parameters"][record["ppo"].pop("base")])
    return {**record, "preset": name, "ppo": base | record["ppo"]}


def listed(entries: Mapping[str, str]) -> str:
    """Names and what they mean, in lines of a help text."""
    column = max(map(len, entries))
    return "\n".join(f"  {name:<{column}}  {meaning}" for name, meaning in entries.items())
