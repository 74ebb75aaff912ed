"""Presets: the trainings that ``emb-train ppo`` knows, read from ``presets.toml`` without torch.

``thesis-…`` are those of the thesis, under its conditions and with its hyper-parameters; the others are the project's
own.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import Any

from emb_runtime.errors import UsageError


@cache
def _file() -> dict[str, Any]:
    return tomllib.loads(resources.files("emb_train").joinpath("presets.toml").read_text(encoding="utf-8"))


def preset_summaries() -> dict[str, str]:
    """One line on each preset, by name: what it learns."""
    return {name: record["summary"] for name, record in sorted(_file()["preset"].items())}


def preset_record(name: str) -> dict[str, Any]:
    """The table of a preset, with its hyper-parameters.

    Raises:
        UsageError: there is no such preset.
    """
    presets = _file()["preset"]
    if name not in presets:
        raise UsageError(f"no preset is called '{name}'; there are: {', '.join(sorted(presets))}")
    own = dict(presets[name]["ppo"])
    return {**presets[name], "preset": name, "ppo": _file()["hyper_parameters"][own.pop("base")] | own}
