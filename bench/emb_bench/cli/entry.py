"""The first step of this room's commands, see :mod:`emb_runtime.system.entry`."""

from __future__ import annotations

import gc
import os
import sys

from emb_bench import ONE_THREAD
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.entry import start

GARBAGE = 100_000  # New objects after which Python looks for garbage


def emb_node() -> int:
    """``emb-node``: Ctrl-C is how it is ended."""
    return start("emb_bench.cli.node", "", EXIT_DONE)


def emb_replay() -> int:
    """``emb-replay``."""
    return start("emb_bench.cli.replay", "emb-replay: interrupted", prepare=_for_short_work)


def _for_short_work() -> None:
    """One thread unless the caller's environment says another number, and little search for garbage.

    Threads are slower to start than one log's small matrices are to be solved, and imports leave no garbage.
    """
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
    gc.set_threshold(GARBAGE, *gc.get_threshold()[1:])


def emb_commission() -> int:
    """``emb-commission``."""
    message = "emb-commission: interrupted while a log was examined; the same command goes on from there"
    return start("emb_bench.cli.commission", message, prepare=_for_short_work)


def emb_hil() -> int:
    """``emb-hil``."""
    if sys.platform != "linux":
        from emb_runtime.system.terminal import complain

        return complain("emb-hil", UsageError("needs Linux, whose kernels it starts; emb-run --iface sim runs here"))
    return start("emb_bench.hil.cli", "emb-hil: interrupted")


def emb_design() -> int:
    """``emb-design``."""
    return start("emb_bench.cli.design", "emb-design: interrupted, nothing written")
