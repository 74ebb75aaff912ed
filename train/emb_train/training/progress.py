"""Display of a running training: a bar on a terminal, plain lines elsewhere, TensorBoard beside either."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol, Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from emb_runtime.errors import UsageError
from emb_train.ppo.ppo import Metrics

PLAIN_INTERVAL = 5.0  # Least time between two plain lines [s]


TENSORBOARD = "tensorboard"  # Folder in a training's directory


class Display(Protocol):
    """Shows iterations as they are done."""

    def __enter__(self) -> Self:
        """Begin to show."""

    def __exit__(self, *_: object) -> None:
        """Leave the terminal as it was."""

    def show(self, metrics: Any) -> None:
        """Show one more iteration."""


class Speed:
    """Steps per second since it was made."""

    def __init__(self, steps: int, clock: Callable[[], float]) -> None:
        """Begin at ``steps``; ``clock`` gives seconds."""
        self._clock = clock
        self._first = steps
        self._start = clock()

    def at(self, steps: int) -> float:
        """Mean speed up to now."""
        return (steps - self._first) / max(self._clock() - self._start, 1e-9)


def describe(metrics: Metrics, speed: float) -> str:
    """One iteration in a line."""
    return (
        f"{speed:,.0f} steps/s · return {metrics.mean_return:.3f} · information {metrics.mean_fim:.3e} · "
        f"violations {metrics.violations} · home {metrics.home}/{metrics.ended}"
    )


Describe = Callable[[Any, float], str]  # The line of an iteration and its speed [steps/s]; the iteration has ``steps``


class Bar:
    """A live bar."""

    def __init__(
        self,
        console: Console,
        done: int,
        total: int,
        clock: Callable[[], float] = time.monotonic,
        describe: Describe = describe,
    ) -> None:
        """Show on ``console`` from ``done`` to ``total`` steps."""
        self._describe = describe
        self._progress = Progress(
            BarColumn(bar_width=24),
            TaskProgressColumn(),
            TextColumn("{task.fields[line]}"),
            TextColumn("ETA"),
            TimeRemainingColumn(),
            console=console,
        )
        self._task = self._progress.add_task("training", total=total, completed=done, line="compiling")
        self._speed = Speed(done, clock)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def show(self, metrics: Any) -> None:
        """Show one more iteration."""
        line = self._describe(metrics, self._speed.at(metrics.steps))
        self._progress.update(self._task, completed=metrics.steps, line=line)


class Lines:
    """A line now and then, for logs."""

    def __init__(
        self,
        out: TextIO,
        done: int,
        total: int,
        clock: Callable[[], float] = time.monotonic,
        describe: Describe = describe,
    ) -> None:
        """Write to ``out`` from ``done`` to ``total`` steps."""
        self._describe = describe
        self._out = out
        self._total = total
        self._clock = clock
        self._speed = Speed(done, clock)
        self._last = -PLAIN_INTERVAL

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._out.flush()

    def show(self, metrics: Any) -> None:
        """Show one more iteration, if the last line is old enough or it is the last one."""
        now = self._clock()
        if now - self._last < PLAIN_INTERVAL and metrics.steps < self._total:
            return
        self._last = now
        speed = self._speed.at(metrics.steps)
        left = max(self._total - metrics.steps, 0) / max(speed, 1e-9)
        line = self._describe(metrics, speed)
        self._out.write(f"{metrics.steps:,}/{self._total:,} steps · {line} · ETA {left:.0f} s\n")
        self._out.flush()


def open_display(out: TextIO, done: int, total: int, describe: Describe = describe) -> Display:
    """A bar if ``out`` is a terminal, else plain lines; ``describe`` gives the line of an iteration."""
    if out.isatty():
        return Bar(Console(file=out), done, total, describe=describe)
    return Lines(out, done, total, describe=describe)


class Board:
    """Writes metrics for TensorBoard beside another display."""

    def __init__(self, beside: Display, directory: Path) -> None:
        """Show on ``beside`` and write to ``directory``.

        Raises:
            UsageError: TensorBoard is not installed.
        """
        require_tensorboard()
        from torch.utils.tensorboard import SummaryWriter

        self._beside = beside
        self._writer = SummaryWriter(str(directory))

    def __enter__(self) -> Self:
        self._beside.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._beside.__exit__()
        self._writer.close()

    def show(self, metrics: Metrics) -> None:
        """Show one more iteration."""
        self._beside.show(metrics)
        for name, value in asdict(metrics).items():
            self._writer.add_scalar(name, value, metrics.steps)


def require_tensorboard() -> None:
    """Check that there is a TensorBoard to write for.

    Raises:
        UsageError: it is not installed.
    """
    try:
        import tensorboard  # type: ignore[import-untyped]  # noqa: F401  # it has no types
    except ImportError as err:
        raise UsageError("--tensorboard needs tensorboard: pip install 'emb-excite[tensorboard]'") from err
