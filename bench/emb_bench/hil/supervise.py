"""Waiting for a command in a kernel: hands on the signals that come, ends it at its time limit."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from types import FrameType
from typing import Protocol

from emb_runtime.system.terminal import mention

EXIT_TIMEOUT = 124  # as timeout(1) has it
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_POLL_S = 0.02
# Standard input ends without a line when emb-hil dies, by kill -9 too.
_SCRIPT = 'read -r _ || { kill -s KILL -- "-$1"; rm -rf -- "$2"; }'


class Child(Protocol):
    """A running command."""

    @property
    def grace(self) -> float:
        """Seconds that it gets to end in after a signal."""

    def poll(self) -> int | None:
        """Move its output on; its exit status as a shell has it (128 + n for signal n), None while it runs."""

    def signal(self, number: int) -> None:
        """Hand it a signal."""

    def kill(self) -> None:
        """End it and everything that it started."""


def supervise(start: Callable[[], Child], timeout_s: float | None) -> int:
    """Start a child and wait for it; its exit status, 124 at the time limit, 128 + n if killed after signal n.

    The first signal is handed on with the child's grace to end in, a second one kills. The time limit is a SIGTERM.
    """
    asked: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        asked.append(number)

    previous = {number: signal.signal(number, note) for number in _SIGNALS}
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    kill_at: float | None = None
    late = False
    handed_on = 0
    child: Child | None = None
    try:
        child = start()
        while (status := child.poll()) is None:
            now = time.monotonic()
            if deadline is not None and now >= deadline and not late:
                late = True
                mention(
                    f"emb-hil: the time limit of {timeout_s:g} s is over, the command ends; exit code {EXIT_TIMEOUT}"
                )
                asked.append(signal.SIGTERM)
            if len(asked) > handed_on:
                kill_at = now if handed_on else now + child.grace
                handed_on = len(asked)
                child.signal(asked[-1])
            if kill_at is not None and now >= kill_at:
                status = 128 + asked[-1]
                break
            time.sleep(_POLL_S)
    finally:
        if child is not None:
            child.kill()
        for number, handler in previous.items():
            signal.signal(number, handler)
    return EXIT_TIMEOUT if late else status


class ParentDeathWatch:
    """A shell that waits for the death of this process, then ends the process group and removes the directory."""

    def __init__(self, group: int, directory: str) -> None:
        self._shell = subprocess.Popen(
            ["/bin/sh", "-c", _SCRIPT, "emb-hil", str(group), directory],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def release(self) -> None:
        """All was ended in order; nothing is left to watch."""
        self._shell.communicate(b"done\n")
