"""Progress on standard error: one line that is written over on a terminal, else a line now and then."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import TextIO

ON_TERMINAL = 0.2  # Least time between two updates [s]
ELSEWHERE = 10.0  # Least time between two lines, where a line stays [s]


class StatusLine:
    """A line on the present state.

    Args:
        out: where to.
        shown: monotonic time of the last update [s]; without, the first line comes at once.
        prefix: of each line that stays.
    """

    def __init__(self, out: TextIO, shown: float = -math.inf, prefix: str = "") -> None:
        self._out, self._shown, self._prefix = out, shown, prefix
        self._terminal = out.isatty()
        self._clear = "\r\x1b[K" if self._terminal else ""

    def say(self, line: str, now: float) -> None:
        """Shows a line, if the last one is old enough; ``now`` is monotonic time [s]."""
        if now - self._shown >= (ON_TERMINAL if self._terminal else ELSEWHERE):
            self._write(f"{self._clear}{line}" if self._terminal else f"{self._prefix}{line}\n")
            self._shown = now

    def keep(self, line: str) -> None:
        """Writes a line that stays; the next one to say comes at once on a terminal."""
        self._write(f"{self._clear}{line}\n")
        self._shown = -math.inf if self._terminal else self._shown

    def end(self) -> None:
        """Clears a terminal's line."""
        self._write(self._clear)

    def _write(self, text: str) -> None:
        with contextlib.suppress(OSError):  # nobody need read it
            self._out.write(text)
            self._out.flush()


class Progress:
    """Progress of a campaign; failures are reported at once.

    Args:
        out: where to.
        total: logs.
        clock: monotonic time [s].
    """

    def __init__(self, out: TextIO, total: int, clock: Callable[[], float]) -> None:
        self._total, self._clock = total, clock
        self._begun = clock()
        self._line = StatusLine(out, self._begun)
        self._done = self._failed = 0

    def took(self, error: str | None) -> None:
        """Counts one more log.

        Args:
            error: the reason, if it failed.
        """
        self._done += 1
        if error is not None:
            self._failed += 1
            self._line.keep(f"FAILED {error}")
        now = self._clock()
        speed = self._done / max(now - self._begun, 1e-9)
        left = _duration((self._total - self._done) / speed)
        counts = f"{self._done}/{self._total} logs, {self._failed} failed"
        self._line.say(f"{counts}, {speed:.3g} logs/s, {left} left", now)

    def end(self) -> None:
        """Clears a terminal's line."""
        self._line.end()


def _duration(seconds: float) -> str:
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else f"{seconds / 3600.0:.1f} h"
