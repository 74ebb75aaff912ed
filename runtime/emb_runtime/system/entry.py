"""The commands' first step: a Ctrl-C while the imports take their time is no traceback."""

from __future__ import annotations

import importlib
import os
import signal

from emb_runtime.errors import EXIT_SAFETY_STOP


def start(module: str, interrupted: int, message: str = "") -> int:
    """Run the ``main`` of a module.

    Args:
        module: where it is; imported here.
        interrupted: exit code for a Ctrl-C that nobody has taken.
        message: what to say of it, if anything.

    Returns:
        The exit code.
    """
    for descriptor in (0, 1, 2):  # a closed one would be given to the next file, and lost to a child's own
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    pressed: list[int] = []
    before = signal.getsignal(signal.SIGINT)
    try:
        if before is signal.default_int_handler:  # its exception may leave an import as another one
            signal.signal(signal.SIGINT, lambda number, _frame: pressed.append(number))
        try:
            loaded = importlib.import_module(module)
        finally:
            signal.signal(signal.SIGINT, before)
        if not pressed:
            return int(loaded.main())
    except KeyboardInterrupt:
        pass
    if message:
        from emb_runtime.system.terminal import (
            mention,  # whatever is imported before the handler is set can be interrupted
        )

        mention(message)
    return interrupted


def emb_run() -> int:
    """``emb-run``: before anything is opened, an interruption is the same stop as later."""
    message = "emb-run: stopped by the operator while it started; nothing was opened"
    return start("emb_runtime.cli.main", EXIT_SAFETY_STOP, message)
