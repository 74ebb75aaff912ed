"""One module for each experiment that ``emb-train --preset`` knows.

``thesis-…`` are those of the thesis, under its conditions and with its hyper-parameters; ``best-…`` are the project's
own recipes for the same tasks and for four parameters. Modules that begin with an underscore are no presets.
"""

from __future__ import annotations

import importlib
import pkgutil

from emb_runtime.errors import UsageError
from emb_train.training.configuration import Configuration


def preset_names() -> list[str]:
    """Names of all presets: those of the modules here, with hyphens."""
    names = (module.name for module in pkgutil.iter_modules(__path__))
    return sorted(name.replace("_", "-") for name in names if not name.startswith("_"))


def load_preset(name: str) -> Configuration:
    """The configuration of a preset.

    Raises:
        UsageError: there is no such preset.
    """
    if name not in preset_names():
        raise UsageError(f"no preset is called '{name}'; there are: {', '.join(preset_names())}")
    module = importlib.import_module(f"{__name__}.{name.replace('-', '_')}")
    preset = module.PRESET
    assert isinstance(preset, Configuration)
    return preset
