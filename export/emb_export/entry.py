"""The first step of this room's command, see :mod:`emb_runtime.system.entry`."""

from __future__ import annotations

from emb_runtime.system.entry import start


def emb_export() -> int:
    """``emb-export``."""
    return start("emb_export.export", "emb-export: interrupted, nothing written")
