"""Signals with which an operator ends a command, those of them that this operating system has."""

from __future__ import annotations

import signal

ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class StopRequest:
    """Set by Ctrl-C, SIGTERM and SIGHUP from now on, asked by the loop."""

    def __init__(self) -> None:
        self._requested = False
        for number in ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup asked for that one to be ignored
                signal.signal(number, self._request)

    def __call__(self) -> bool:
        """Returns True if an end is wanted."""
        return self._requested

    def _request(self, _signal: int, _frame: object) -> None:
        self._requested = True
