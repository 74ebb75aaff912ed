"""Output files of a command: checked before a long computation, then replaced as a whole or left unchanged."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from emb_bench.compiled import on_compiling
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import open_regular

_FORMULA = re.compile(r"\s*[=+\-@＝＋－＠]|[\t\r\n]")  # the wide ones count, too
"""Beginnings of a formula (OWASP, CSV injection)."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file beside ``path`` to write to, which takes its place when all went well, and else is gone.

    Results are replaced, logs are not: what is computed can be computed again.

    Raises:
        UsageError: it cannot be written, or what is there is a log, a folder, a device or a pipe.
    """
    try:
        beside = _beside(path)
        try:
            yield beside
            beside.replace(path)
        finally:
            with suppress(OSError):
                beside.unlink()
    except OSError as err:
        raise UsageError(f"{path}: the result cannot be written: {err.strerror or err}") from err


def require_place(option: str, path: Path | None, endings: Sequence[str]) -> None:
    """Refuse before the work a file that an option names and that cannot be written, or whose name ends otherwise."""
    if path is None:
        return
    if path.suffix.lower() not in endings:
        raise UsageError(f"{option} {path}: expected a name that ends in {' or '.join(endings)}")
    if not path.absolute().parent.is_dir():
        raise UsageError(f"{option} {path}: there is no folder {path.absolute().parent}")
    try:
        _beside(path).unlink()
    except UsageError as err:
        raise UsageError(f"{option} {err}") from None
    except OSError as err:
        raise UsageError(f"{option} {path}: cannot be written there: {err.strerror or err}") from err


def _beside(path: Path) -> Path:
    """A new file beside one that may be written."""
    if path.is_dir():
        raise UsageError(f"{path}: expected a file to write, and it is a folder")
    if path.exists() and not path.is_file():
        raise UsageError(f"{path}: expected a file to write, and it is a device or a pipe: choose another name")
    if path.exists() and _is_log(path):
        raise UsageError(f"{path}: a log, and logs are never overwritten: choose another name")
    beside = path.with_name(f".{os.getpid()}-{path.name}")
    beside.touch()
    return beside


def text_cells(column: Any) -> Any:
    """A column of texts for CSV, of which no spreadsheet takes a cell for a formula: an apostrophe stands before it."""
    import pyarrow as pa

    cells = (f"'{text}" if text and _FORMULA.match(text) else text for text in column.to_pylist())
    return pa.array(cells, pa.string())


def _is_log(path: Path) -> bool:
    from mcap.writer import MCAP0_MAGIC

    with open_regular(path) as file:
        return file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC


def make_empty_folder(path: Path) -> None:
    """Make a folder for results."""
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


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[str], None]]:
    """A bar on standard error, if that is a terminal; what it gives advances it by one, with a text beside it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    said = TextColumn("left {task.fields[said]}", markup=False)
    console = Console(stderr=True, markup=False, highlight=False, emoji=False)
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), said)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, said="")
        yield lambda said: bar.update(task, advance=1, said=said)


def say_if_compiling() -> None:
    """Show who waits at a terminal why the first estimate takes longer than all that follow."""
    if not sys.stderr.isatty():
        return
    from rich.console import Console

    status = Console(stderr=True).status("")

    def told(count: int, last: bool) -> None:
        status.update(f"compiling the brake's equations, once: {count} functions")
        if last:
            status.stop()
        else:
            status.start()

    on_compiling(told)
