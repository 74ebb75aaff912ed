"""How far a campaign is, on standard error: one line that is written over on a terminal, else a line now and then."""

from __future__ import annotations

from collections.abc import Callable
from typing import TextIO

ON_TERMINAL = 0.2
"""Least time between two updates [s]."""
ELSEWHERE = 10.0
"""Least time between two lines, where a line stays [s]."""


class Progress:
    """Tells of each log, failures at once.

    Args:
        out: where to.
        total: logs.
        clock: monotonic time [s].
    """

    def __init__(self, out: TextIO, total: int, clock: Callable[[], float]) -> None:
        self._out, self._total, self._clock = out, total, clock
        self._terminal = out.isatty()
        self._begun = self._told = clock()
        self._done = self._failed = 0

    def took(self, error: str | None) -> None:
        """One more log is done.

        Args:
            error: why not, if it failed.
        """
        self._done += 1
        if error is not None:
            self._failed += 1
            self._write(f"{self._clear}FAILED {error}\n")
        now = self._clock()
        if self._terminal and (error is not None or now - self._told >= ON_TERMINAL):
            self._write(f"{self._clear}{self.line(now)}")
            self._told = now
        elif not self._terminal and now - self._told >= ELSEWHERE:
            self._write(f"{self.line(now)}\n")
            self._told = now

    def end(self) -> None:
        """Nothing more comes: a terminal's line goes."""
        self._write(self._clear)

    def line(self, now: float) -> str:
        """The line, at a time [s]."""
        speed = self._done / max(now - self._begun, 1e-9)
        left = (self._total - self._done) / speed if self._done else float("inf")
        return f"{self._done}/{self._total} logs, {self._failed} failed, {speed:.3g} logs/s, {_duration(left)} left"

    @property
    def _clear(self) -> str:
        return "\r\x1b[K" if self._terminal else ""

    def _write(self, text: str) -> None:
        self._out.write(text)
        self._out.flush()


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
