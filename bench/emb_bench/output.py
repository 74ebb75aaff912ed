"""Files that a command makes: refused before a long piece of work, written as a whole, or left as they were."""

from __future__ import annotations

import contextlib
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TextIO

from emb_bench.compiled import on_compiling
from emb_runtime.errors import UsageError


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside ``path`` to write to, which takes its place when all went well, and else is gone.

    Raises:
        UsageError: it cannot be written, or something is there that is no file: a folder, a device, a pipe.
    """
    if path.is_dir():
        raise UsageError(f"{path}: expected a file to write, and it is a folder")
    if path.exists() and not path.is_file():
        raise UsageError(f"{path}: expected a file to write, and it is a device or a pipe: choose another name")
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.touch()
        try:
            yield beside
            beside.replace(path)
        finally:
            with suppress(OSError):
                beside.unlink()
    except OSError as err:
        raise UsageError(f"{path}: the result cannot be written: {err.strerror or err}") from err


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """A file that did not exist, open for writing; it is removed again if writing it fails in any way.

    Raises:
        UsageError: something of that name exists, or it cannot be written.
    """
    try:
        file = path.open("x+b")
    except FileExistsError as err:
        raise UsageError(f"{path}: exists, and nothing is overwritten: choose another name") from err
    except OSError as err:
        raise UsageError(f"{path}: cannot write: {err.strerror}") from err
    try:
        with file:
            yield file
    except OSError as err:
        path.unlink(missing_ok=True)
        raise UsageError(f"{path}: cannot write: {err.strerror or err}") from err
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def make_empty_folder(path: Path) -> None:
    """Make a folder for results.

    Raises:
        UsageError: it holds something already, or cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        if any(path.iterdir()):
            raise UsageError(f"{path}: holds something already: choose a new folder")
    except OSError as err:
        raise UsageError(f"{path}: cannot use this folder: {err.strerror}") from err


@contextmanager
def reported_if_interrupted(command: str) -> Iterator[None]:
    """Say on Ctrl-C that there is no result; the exit code is the entry's."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"{command}: interrupted, nothing written") from None


def say_if_compiling() -> None:
    """Show who waits at a terminal why the first estimate takes longer than all that follow."""
    if not sys.stderr.isatty():
        return
    line = StatusLine(sys.stderr)

    def told(count: int, last: bool) -> None:
        line.say(f"compiling the brake's equations, once: {count} functions", time.monotonic())
        if last:
            line.end()

    on_compiling(told)


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
