"""The first step of this room's commands, see :mod:`emb_runtime.system.entry`."""

from __future__ import annotations

import sys

from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.entry import start


def emb_node() -> int:
    """``emb-node``: Ctrl-C is how it is ended."""
    return start("emb_bench.cli.node", "", EXIT_DONE)


def emb_replay() -> int:
    """``emb-replay``."""
    return start("emb_bench.cli.replay", "emb-replay: interrupted")


def emb_hil() -> int:
    """``emb-hil``."""
    if sys.platform != "linux":
        from emb_runtime.system.terminal import complain

        return complain("emb-hil", UsageError("needs Linux, whose kernels it starts; emb-run --iface sim runs here"))
    return start("emb_bench.hil.cli", "emb-hil: interrupted")


def emb_design() -> int:
    """``emb-design``."""
    return start("emb_bench.cli.design", "emb-design: interrupted, nothing written")


def emb_train() -> int:
    """``emb-train``: here, because its own package imports gymnasium before anything of it can run."""
    return start("emb_train.cli.train", "emb-train: interrupted")
