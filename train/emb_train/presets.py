"""Presets: the trainings that ``emb-train --preset`` knows, read from ``presets.toml``.

``thesis-…`` are those of the thesis, under its conditions and with its hyper-parameters; the others are the project's
own. Names and summaries are read without what needs torch.
"""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

from emb_runtime.errors import UsageError

if TYPE_CHECKING:
    from emb_train.training.configuration import Configuration


@cache
def _file() -> dict[str, Any]:
    return tomllib.loads(resources.files("emb_train").joinpath("presets.toml").read_text(encoding="utf-8"))


def preset_names() -> list[str]:
    """Names of all presets, sorted."""
    return sorted(_file()["preset"])


def preset_summaries() -> dict[str, str]:
    """One line on each preset: what it learns."""
    return {name: _file()["preset"][name]["summary"] for name in preset_names()}


def load_preset(name: str) -> Configuration:
    """The configuration of a preset.

    Raises:
        UsageError: there is no such preset, or a value of it is not possible.
    """
    from emb_train.training.configuration import Configuration

    if name not in preset_names():
        raise UsageError(f"no preset is called '{name}'; there are: {', '.join(preset_names())}")
    record = _file()["preset"][name]
    own = dict(record["ppo"])
    ppo = _file()["hyper_parameters"][own.pop("base")] | own
    return Configuration.from_record({**record, "preset": name, "ppo": ppo}, defaults=True)
