"""The commands' first step: a Ctrl-C while the imports take their time is no traceback."""

from __future__ import annotations

import importlib

from emb_runtime.errors import EXIT_SAFETY_STOP


def start(module: str, interrupted: int) -> int:
    """Run the ``main`` of a module.

    Args:
        module: where it is; imported here.
        interrupted: exit code for a Ctrl-C that nobody has taken.

    Returns:
        The exit code.
    """
    try:
        return int(importlib.import_module(module).main())
    except KeyboardInterrupt:
        return interrupted


def emb_run() -> int:
    """``emb-run``: before anything is opened, an interruption is the same stop as later."""
    return start("emb_runtime.run", EXIT_SAFETY_STOP)
