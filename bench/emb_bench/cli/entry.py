"""The first step of this room's commands, see :mod:`emb_runtime.system.entry`."""

from __future__ import annotations

import gc
import os
import sys

from emb_bench import ONE_THREAD
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.entry import run_command

GARBAGE = 100_000  # New objects after which Python looks for garbage


def emb_node() -> int:
    """The simulated brake as a node on a CAN bus; Ctrl-C is how it is ended."""
    return run_command("emb_bench.cli.node", "", EXIT_DONE)


def emb_replay() -> int:
    """Evaluation of logs: estimate, report, Fisher information, export."""
    return run_command("emb_bench.cli.replay", "emb-replay: interrupted", prepare=_for_short_work)


def _for_short_work() -> None:
    """One thread unless the caller's environment says another number, and little search for garbage.

    Threads are slower to start than one log's small matrices are to be solved, and imports leave no garbage.
    """
    for name, value in ONE_THREAD.items():
        os.environ.setdefault(name, value)
    gc.set_threshold(GARBAGE, *gc.get_threshold()[1:])


def emb_commission() -> int:
    """An unknown brake, from a data sheet to a bench file."""
    message = "emb-commission: interrupted while a log was examined; the same command goes on from there"
    return run_command("emb_bench.cli.commission", message, prepare=_for_short_work)


def emb_hil() -> int:
    """A command where vcan0 exists, in a kernel under this one if need be."""
    if sys.platform != "linux":
        from emb_runtime.system.terminal import complain

        return complain("emb-hil", UsageError("needs Linux, whose kernels it starts; emb-run --iface sim runs here"))
    return run_command("emb_bench.hil.cli", "emb-hil: interrupted")


def emb_design() -> int:
    """The current sequence with most information about known parameters."""
    return run_command("emb_bench.cli.design", "emb-design: interrupted, nothing written")
