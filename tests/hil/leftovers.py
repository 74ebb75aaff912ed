"""What emb-hil left behind on the host."""

from __future__ import annotations

import os
import time
from pathlib import Path


def processes_of(state: Path) -> list[int]:
    """Living processes with ``state`` in their command line; ended ones that wait for their parent have none."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = entry.read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if os.fsencode(state) in command:
            found.append(int(entry.parent.name))
    return found


def assert_nothing_left(state: Path) -> None:
    until = time.monotonic() + 20
    while processes_of(state) or any(state.iterdir()):
        assert time.monotonic() < until, (processes_of(state), list(state.iterdir()))
        time.sleep(0.05)
