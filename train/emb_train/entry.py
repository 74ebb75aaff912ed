"""The first step of this room's command, see :mod:`emb_runtime.system.entry`."""

from __future__ import annotations

from emb_runtime.system.entry import start


def emb_train() -> int:
    """``emb-train``."""
    return start("emb_train.cli", "emb-train: interrupted")
