"""The first step of this room's commands, see :mod:`emb_runtime.system.entry`."""

from __future__ import annotations

from emb_runtime.errors import EXIT_DONE, EXIT_INTERRUPTED
from emb_runtime.system.entry import start


def emb_node() -> int:
    """``emb-node``: Ctrl-C is how it is ended."""
    return start("emb_bench.cli.node", EXIT_DONE)


def emb_replay() -> int:
    """``emb-replay``."""
    return start("emb_bench.cli.replay", EXIT_INTERRUPTED)


def emb_hil() -> int:
    """``emb-hil``."""
    return start("emb_bench.hil.cli", EXIT_INTERRUPTED)


def emb_design() -> int:
    """``emb-design``."""
    return start("emb_bench.cli.design", EXIT_INTERRUPTED)


def emb_train() -> int:
    """``emb-train``: here, because its own package imports gymnasium before anything of it can run."""
    return start("emb_train.cli.train", EXIT_INTERRUPTED)
