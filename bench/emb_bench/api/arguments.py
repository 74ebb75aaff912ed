"""Arguments that several functions have: runs, options, values of parameters."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import fields
from numbers import Real
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeGuard, TypeVar
from weakref import finalize

from emb_bench.logs.log import RunLog, read_log, require_driven
from emb_bench.options import Options
from emb_runtime.errors import UsageError, near, needs
from emb_runtime.system.terminal import mention

AnyRun = RunLog | str | Path | Mapping[str, Any]
"""A run: opened, its path, or with a map a table in memory."""
MEANT: Mapping[str, str] = {"plant": "model", "parameters": "params"}
"""Options of one function by the names that others have for them."""
Record = TypeVar("Record", bound=Options)


def options_of(function: str, record: type[Record], options: Record | None, more: Mapping[str, Any]) -> Record:
    """Options of a call: a record of them, or its fields as keywords.

    Raises:
        UsageError: a keyword is no field of the record, there are both, or the record is another function's.
    """
    require_options(function, more, [one.name for one in fields(record)])
    if options is None:
        return record(**more)
    if more:
        raise UsageError(f"{function}: expected a record of options or keywords, got both")
    if isinstance(options, record):
        return options
    raise UsageError(f"{function}: expected {record.__name__}, or its fields as keywords, got {options!r:.60}")


def require_options(function: str, options: Mapping[str, Any], names: Sequence[str]) -> None:
    """Refuse an option that a function does not have."""
    for name in options:
        if name not in names:
            arrays = ", ".join(f"'{name}': {name}" for name, value in options.items() if is_row(value))
            meant = f"; did you mean {MEANT[name]}?" if MEANT.get(name) in names else near(name, names)
            table = f"; arrays are a table: {function}({{{arrays}}}, map='map.toml')" if arrays else ""
            raise UsageError(f"{function} has no option '{name}'{table or meant}")


def is_table(run: Any) -> bool:
    """True for a table of pandas, polars or Arrow, and for arrays by their names."""
    return not isinstance(run, RunLog) and (hasattr(run, "columns") or isinstance(run, Mapping))


def opened(run: Any, map_path: str | Path | None = None) -> RunLog:
    """The log of a run; with a map, a recording of others: a file, or a table."""
    if isinstance(run, RunLog):
        return run
    if is_table(run):
        return _recorded(run, map_path)
    if map_path is None:
        from emb_bench.recordings.map_file import KINDS

        if Path(run).suffix.lower() in KINDS:
            raise UsageError(f"{run}: a recording of others: estimate, fim, report and export read it with --map FILE")
        return read_log(run)
    from emb_bench.recordings.recording import open_recording

    return open_recording(Path(run), Path(map_path))


def _recorded(table: Any, map_path: str | Path | None) -> RunLog:
    """A recording of others in memory, read as the Parquet file that it would be."""
    if map_path is None:
        raise UsageError("a table needs a map file for its columns: map='map.toml'")
    from emb_bench.recordings.map_file import read_map
    from emb_bench.recordings.recording import open_recording

    if (kind := read_map(Path(map_path))[0].file.kind) not in ("", "parquet"):
        raise UsageError(f"{map_path}: [file] kind: expected none for a table in memory, got {kind}")
    with needs("a table", "bench"):
        import pyarrow as pa
        from pyarrow import parquet
    with ExitStack() as stack:
        path = Path(stack.enter_context(TemporaryDirectory()), "table.parquet")
        try:
            parquet.write_table(pa.table(dict(table) if isinstance(table, Mapping) else table), path)
        except (pa.ArrowException, TypeError, ValueError) as err:
            raise UsageError(f"expected columns of numbers, all as long: {' '.join(str(err).split())}") from err
        recording = open_recording(path, Path(map_path))
        finalize(recording, stack.pop_all().close)  # a report identifies its files
    return recording


def driven(run: AnyRun, map_path: str | Path | None) -> RunLog:
    """As :func:`opened`, of a run in which something was driven."""
    log = opened(run, map_path)
    require_driven(log)
    return log


def listed(runs: Any) -> list[Any]:
    """The runs one by one; UsageError if one comes twice, under whatever name, or is none."""
    alone = isinstance(runs, RunLog | str | Path) or is_table(runs) or not isinstance(runs, Iterable)
    found = [runs] if alone else list(runs)
    for run in found:
        if not (isinstance(run, RunLog | str | Path) or is_table(run)):
            raise UsageError(f"expected a run: an opened log, its path, or a table with a map; got {run!r:.40}")
    real = [id(run) if is_table(run) else os.path.realpath(getattr(run, "path", run)) for run in found]
    if twice := [run for n, run in enumerate(found) if real[n] in real[:n]]:
        name = "a table" if is_table(twice[0]) else getattr(twice[0], "path", twice[0])
        raise UsageError(f"{name} comes twice: expected each run once")
    return found


def is_row(run: Any) -> TypeGuard[Sequence[float]]:
    """True for currents: an array, or a sequence of numbers."""
    numbers = isinstance(run, Sequence) and len(run) > 0 and all(isinstance(value, Real) for value in run)
    return numbers or (hasattr(run, "__array__") and not is_table(run))


def say(text: str) -> None:
    """Tell who waits at a terminal what takes the time."""
    if sys.stderr is not None and sys.stderr.isatty():
        mention(f"{text} ...")
