"""Columns of foreign files: CSV, Parquet, MATLAB, MDF and CAN logs. Each library is imported when it is needed."""

from __future__ import annotations

import gc
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.recordings.map_file import KINDS, Source
from emb_runtime.errors import EmbError, UsageError
from emb_runtime.system.input_file import open_regular

Floats = NDArray[np.float64]

MOST = 5_000_000  # Most rows of a recording
NAMED = 12  # Most columns that a message names


class Column(NamedTuple):
    """One column of a recording."""

    values: Floats  # Shape (n,)
    time: Floats | None  # Of each value [s], shape (n,); None where the format has no times of its own


def read_columns(path: Path, kind: str, source: Source, folder: Path, names: Sequence[str]) -> dict[str, Column]:
    """Named columns of a file.

    Args:
        path: of the file.
        kind: of the file, a key of ``KINDS``.
        source: its form.
        folder: that its DBC file is in.
        names: of columns; ``struct.field`` inside MATLAB structures, ``group/data`` in MATLAB 7.3, ``Message.Signal``
            in CAN logs.

    Raises:
        UsageError: the file cannot be read, is not of its kind, or lacks a column; or a library is missing.
    """
    names = list(dict.fromkeys(names))
    readers: Mapping[str, tuple[str, str, Callable[[], Iterator[tuple[str, Any, Any]]]]] = {
        "csv": ("CSV", "pyarrow", lambda: _csv(path, source, names)),
        "parquet": ("Parquet", "pyarrow", lambda: _parquet(path, names)),
        "matlab": ("MATLAB", "scipy and h5py", lambda: _matlab(path, names)),
        "mdf": ("MDF", "asammdf", lambda: _mdf(path, names)),
        "can": ("a CAN log", "python-can", lambda: _can(path, folder / source.dbc, names)),
    }
    title, library, read = readers[kind]
    found = {}
    try:
        open_regular(path).close()
    except OSError as err:
        raise UsageError(f"{path}: cannot read the recording: {err.strerror}") from err
    with _errors_in_one_line(path, title, library):
        for name, values, time in read():
            found[name] = Column(_numbers(path, name, values), None if time is None else _numbers(path, name, time))
    for name, column in found.items():
        if not 2 <= len(column.values) <= MOST:
            raise UsageError(f"{path}: {name}: expected 2 to {MOST} values, got {len(column.values)}")
    return found


@contextmanager
def _errors_in_one_line(path: Path, kind: str, library: str) -> Iterator[None]:
    try:
        yield
    except EmbError:
        raise
    except ImportError as err:
        raise UsageError(f"{path}: reading {kind} needs {library}: pip install 'emb-excite[import]'") from err
    except Exception as err:  # every library has errors of its own, and some raise whatever they meet
        _let_go(err)
        said = " ".join(str(err).split())[:120] or type(err).__name__
        raise UsageError(f"{path}: not readable as {kind}: {said}") from err


def _let_go(err: Exception) -> None:
    """Ends what a library has half made, and with it what that complains about once it is collected."""
    hook, sys.unraisablehook = sys.unraisablehook, lambda _: None
    one: BaseException | None = err
    try:
        while one is not None:
            traceback.clear_frames(one.__traceback__)
            one = one.__context__
        gc.collect()
    finally:
        sys.unraisablehook = hook


def _require_one(path: Path, name: str, places: Sequence[Any], known: Sequence[str]) -> None:
    if not places:
        others = ", ".join(known[:NAMED]) + (", ..." if len(known) > NAMED else "")
        raise UsageError(f"{path}: no column is called {name!r}; it has: {others or 'none'}")
    if len(places) > 1:
        raise UsageError(f"{path}: {len(places)} columns are called {name!r}: expected one")


def _numbers(path: Path, name: str, values: Any) -> Floats:
    try:
        row: Floats = np.squeeze(np.asarray(values, dtype=np.float64))
    except (TypeError, ValueError) as err:
        raise UsageError(f"{path}: {name}: expected numbers") from err
    if row.ndim != 1:
        raise UsageError(f"{path}: {name}: expected one row of numbers, got an array of shape {np.shape(values)}")
    return row


def _csv(path: Path, source: Source, names: Sequence[str]) -> Iterator[tuple[str, Any, Any]]:
    from pyarrow import csv

    table = csv.read_csv(
        path,
        csv.ReadOptions(skip_rows_after_names=source.skip),
        csv.ParseOptions(delimiter="\t" if source.delimiter == "tab" else source.delimiter),
        csv.ConvertOptions(decimal_point=source.decimal, null_values=["", "nan", "NaN", "NAN", "null"]),
    )
    return _arrow(path, table, names)


def _parquet(path: Path, names: Sequence[str]) -> Iterator[tuple[str, Any, Any]]:
    from pyarrow import parquet

    with parquet.ParquetFile(path) as file:
        known = file.schema_arrow.names
        return _arrow(path, file.read(columns=[name for name in known if name.strip() in names]), names, known)


def _arrow(
    path: Path, table: Any, names: Sequence[str], known: Sequence[str] | None = None
) -> Iterator[tuple[str, Any, Any]]:
    for name in names:
        places = [i for i, own in enumerate(table.column_names) if own.strip() == name]
        _require_one(path, name, places, known or table.column_names)
        column = table.column(places[0])
        if str(column.type).startswith("timestamp"):
            column = column.cast("timestamp[ns]").cast("int64")
            yield name, (column.to_numpy() - column[0].as_py()) * 1e-9, None
        else:
            yield name, column.to_numpy(), None


def _matlab(path: Path, names: Sequence[str]) -> Iterator[tuple[str, Any, Any]]:
    from scipy import io

    try:
        content = io.loadmat(path, squeeze_me=True, struct_as_record=False, simplify_cells=True)
    except NotImplementedError:  # version 7.3 is HDF5
        yield from _hdf5(path, names)
        return
    for name in names:
        value: Any = content
        for part in name.split("."):
            found = [value[part]] if isinstance(value, Mapping) and part in value else []
            _require_one(path, name, found, [key for key in content if not key.startswith("__")])
            value = found[0]
        yield name, value, None


def _hdf5(path: Path, names: Sequence[str]) -> Iterator[tuple[str, Any, Any]]:
    import h5py

    with h5py.File(path, "r") as file:
        for name in names:
            place = file.get(name.replace(".", "/"))
            found = [place] if isinstance(place, h5py.Dataset) else []
            _require_one(path, name, found, [key for key in file if not key.startswith("#")])
            yield name, found[0][()], None


def _mdf(path: Path, names: Sequence[str]) -> Iterator[tuple[str, Any, Any]]:
    from asammdf import MDF

    with MDF(path) as file:
        known = sorted(name for name in file.channels_db if name not in ("time", "t"))
        for name in names:
            _require_one(path, name, file.channels_db.get(name, ()), known)
            signal = file.get(name)
            yield name, signal.samples, signal.timestamps


def _can(path: Path, dbc: Path, names: Sequence[str]) -> Iterator[tuple[str, Any, Any]]:
    import cantools
    from can.io.player import MESSAGE_READERS

    with _errors_in_one_line(dbc, "a DBC", "cantools"):
        try:
            bus: Any = cantools.database.load_file(str(dbc), strict=False)
        except OSError as err:
            raise UsageError(f"{dbc}: cannot read the DBC: {err.strerror}") from err
    wanted = _messages(dbc, names, bus)
    rows: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    suffix = path.suffix.lower()
    reader: Any = MESSAGE_READERS[suffix if suffix in KINDS["can"] else ".log"]
    with open_regular(path) as data:  # ours, and closed whatever a reader does
        for frame in reader(data if suffix == ".blf" else TextIOWrapper(data, "utf-8", "replace")):
            message, signals = wanted.get((frame.arbitration_id, frame.is_extended_id), (None, ()))
            if message is None or frame.is_error_frame or frame.is_remote_frame or len(frame.data) < message.length:
                continue
            decoded = message.decode(bytes(frame.data), decode_choices=False)
            for name, signal in signals:
                if signal in decoded:  # a multiplexed one is in some frames only
                    rows[name].append((float(decoded[signal]), float(frame.timestamp)))
    for name in names:
        if not rows[name]:
            raise UsageError(f"{path}: no frame has {name}: expected the DBC of this bus, and its log")
        values, times = zip(*rows[name], strict=True)
        yield name, values, times


def _messages(dbc: Path, names: Sequence[str], bus: Any) -> dict[tuple[int, bool], tuple[Any, list[tuple[str, str]]]]:
    """Messages by identifier, with the columns that they hold and the signals of these."""
    by_name = {f"{message.name}.{signal.name}": message for message in bus.messages for signal in message.signals}
    found: dict[tuple[int, bool], tuple[Any, list[tuple[str, str]]]] = {}
    for name in names:
        message = by_name.get(name)
        if message is None:
            choices = ", ".join(sorted(by_name)[:NAMED])
            raise UsageError(f"{dbc}: no signal is called {name!r}; it has: {choices}")
        key = (message.frame_id, message.is_extended_frame)
        found.setdefault(key, (message, []))[1].append((name, name.partition(".")[2]))
    return found
