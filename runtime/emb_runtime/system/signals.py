"""Signals that ask for an end: those of them that this operating system has, and processes started in spite of one."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals with which an operator ends a run."""


@contextmanager
def waiting(numbers: Sequence[signal.Signals]) -> Iterator[None]:
    """While this lasts no handler interrupts, and a process that is started is not ended; what came is raised after it.

    Blocking them does not do it alone: another thread, that of a library, would take one, and Python then calls its
    handler in the main thread. The process, however, inherits what is blocked: else a signal that is sent to every
    process of a run would end this one while it boots.
    """
    came: list[int] = []
    with ExitStack() as undo:
        undo.callback(lambda: [*map(signal.raise_signal, came)])
        if threading.current_thread() is threading.main_thread():  # Python calls handlers nowhere else
            for number in numbers:
                handler = signal.getsignal(number)
                if callable(handler):
                    undo.callback(signal.signal, number, handler)
                    signal.signal(number, lambda which, _frame: came.append(which))
        if hasattr(signal, "pthread_sigmask"):
            before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
            undo.callback(signal.pthread_sigmask, signal.SIG_SETMASK, before)
        yield
