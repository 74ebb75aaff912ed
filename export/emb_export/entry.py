"""The first step of this room's command, see :mod:`emb_runtime.entry`."""

from __future__ import annotations

from emb_bench.entry import EXIT_INTERRUPTED
from emb_runtime.entry import start


def emb_export() -> int:
    """``emb-export``."""
    return start("emb_export.export", EXIT_INTERRUPTED)
