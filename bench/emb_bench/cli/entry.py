"""Entry points of this package's commands, see :mod:`emb_runtime.system.entry`."""

from __future__ import annotations

import gc
import os
import sys

from emb_bench import ONE_THREAD
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.entry import run_command

GARBAGE = 100_000  # New objects after which Python collects garbage


def emb_node() -> int:
    """The simulated brake as a node on a CAN bus; Ctrl-C ends it normally."""
    return run_command("emb_bench.cli.node", "", EXIT_DONE)


def emb_replay() -> int:
    """Evaluation of logs: estimate, report, Fisher information, export."""
    return run_command("emb_bench.cli.replay", "emb-replay: interrupted", prepare=_for_short_work)


def _for_short_work() -> None:
    """One thread, unless the environment sets another number, and few garbage collections.

    Starting threads takes longer than solving the small matrices of one log, and imports leave no garbage.
    """
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
    gc.set_threshold(GARBAGE, *gc.get_threshold()[1:])


def emb_commission() -> int:
    """An unknown brake, from a data sheet to a bench file."""
    message = "emb-commission: interrupted while a log was examined; the same command continues from there"
    return run_command("emb_bench.cli.commission", message, prepare=_for_short_work)


def emb_hil() -> int:
    """A command where vcan0 exists, if necessary in a User-Mode Linux kernel."""
    if sys.platform != "linux":
        from emb_runtime.system.terminal import complain

        return complain("emb-hil", UsageError("needs Linux, whose kernels it starts; emb-run --iface sim runs here"))
    return run_command("emb_bench.hil.cli", "emb-hil: interrupted")


def emb_design() -> int:
    """The current sequence with most information about known parameters."""
    return run_command("emb_bench.cli.design", "emb-design: interrupted, nothing written")
