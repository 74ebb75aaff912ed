"""The child's side of :mod:`emb_runtime.system.child_process`: its document, its answers, and who ends it."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
from collections.abc import Mapping
from typing import Any

from emb_runtime.system import signals


def leave_ending_to_parent() -> None:
    """Ignore the signals that end a run: the runtime decides when it is over."""
    for number in signals.ENDING:
        signal.signal(number, signal.SIG_IGN)


def read_document(fd: int) -> dict[str, Any]:
    """Read what the parent has written for this process, from the memory that it has passed as a file descriptor."""
    gc.freeze()  # or Python searches all that was imported for garbage before it ends
    with os.fdopen(fd, "rb") as memory:
        memory.seek(0)
        document: dict[str, Any] = json.loads(memory.read())
    return document


def answer(document: Mapping[str, Any]) -> None:
    """Write one line of JSON to the parent; one that is gone hears nothing."""
    with contextlib.suppress(OSError):
        os.write(1, json.dumps(dict(document)).encode() + b"\n")
