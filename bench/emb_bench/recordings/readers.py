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


def read_columns(path: Path, source: Source, names: Sequence[str]) -> dict[str, Column]:
    """Named columns of a file.

    Args:
        path: of the file.
        source: its kind and form.
        names: of columns; ``struct.field`` inside MATLAB structures, ``group/data`` in MATLAB 7.3, ``Message.Signal``
            in CAN logs.

    Raises:
        UsageError: the file cannot be read, is not of its kind, or lacks a column; or a library is missing.
    """
    readers: Mapping[str, Callable[[Path, Source, Sequence[str]], dict[str, Column]]] = {
        "csv": _csv,
        "parquet": _parquet,
        "matlab": _matlab,
        "mdf": _mdf,
        "can": _can,
    }
    try:
        open_regular(path).close()
    except OSError as err:
        raise UsageError(f"{path}: cannot read the recording: {err.strerror}") from err
    found = readers[source.kind](path, source, list(dict.fromkeys(names)))
    for name, column in found.items():
        if not 2 <= len(column.values) <= MOST:
            raise UsageError(f"{path}: {name}: expected 2 to {MOST} values, got {len(column.values)}")
    return found


@contextmanager
def _of_kind(path: Path, kind: str, library: str) -> Iterator[None]:
    """Turns what a library complains about into one line."""
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


def _lacking(path: Path, name: str, known: Sequence[str]) -> UsageError:
    others = ", ".join(known[:NAMED]) + (", ..." if len(known) > NAMED else "")
    return UsageError(f"{path}: no column is called {name!r}; it has: {others or 'none'}")


def _numbers(path: Path, name: str, values: Any) -> Floats:
    try:
        row: Floats = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as err:
        raise UsageError(f"{path}: {name}: expected numbers") from err
    if row.ndim == 2 and 1 in row.shape:
        row = row.ravel()
    if row.ndim != 1:
        raise UsageError(f"{path}: {name}: expected one row of numbers, got an array of shape {row.shape}")
    return row


def _csv(path: Path, source: Source, names: Sequence[str]) -> dict[str, Column]:
    with _of_kind(path, "CSV", "pyarrow"):
        from pyarrow import csv

        table = csv.read_csv(
            path,
            csv.ReadOptions(skip_rows_after_names=source.skip),
            csv.ParseOptions(delimiter=source.delimiter),
            csv.ConvertOptions(decimal_point=source.decimal, null_values=["", "nan", "NaN", "NAN", "null"]),
        )
        return _arrow(path, table, names)


def _parquet(path: Path, source: Source, names: Sequence[str]) -> dict[str, Column]:
    with _of_kind(path, "Parquet", "pyarrow"):
        from pyarrow import parquet

        with parquet.ParquetFile(path) as file:
            known = file.schema_arrow.names
            for name in names:
                if name not in known:
                    raise _lacking(path, name, known)
            return _arrow(path, file.read(columns=list(names)), names)


def _arrow(path: Path, table: Any, names: Sequence[str]) -> dict[str, Column]:
    found = {}
    for name in names:
        places = [i for i, known in enumerate(table.column_names) if known.strip() == name]
        if not places:
            raise _lacking(path, name, table.column_names)
        if len(places) > 1:
            raise UsageError(f"{path}: {len(places)} columns are called {name!r}: expected one")
        column = table.column(places[0])
        if str(column.type).startswith("timestamp"):
            column = column.cast("timestamp[ns]").cast("int64")
            values = (column.to_numpy() - column[0].as_py()) * 1e-9
        else:
            values = column.to_numpy()
        found[name] = Column(_numbers(path, name, values), None)
    return found


def _matlab(path: Path, source: Source, names: Sequence[str]) -> dict[str, Column]:
    with _of_kind(path, "MATLAB", "scipy"):
        from scipy import io

        try:
            content = io.loadmat(path, squeeze_me=True, struct_as_record=False, simplify_cells=True)
        except NotImplementedError:  # version 7.3 is HDF5
            return _hdf5(path, names)
    found = {}
    for name in names:
        value: Any = content
        for part in name.split("."):
            if not isinstance(value, Mapping) or part not in value:
                raise _lacking(path, name, [key for key in content if not key.startswith("__")])
            value = value[part]
        found[name] = Column(_numbers(path, name, value), None)
    return found


def _hdf5(path: Path, names: Sequence[str]) -> dict[str, Column]:
    with _of_kind(path, "MATLAB 7.3", "h5py"):
        import h5py

        found = {}
        with h5py.File(path, "r") as file:
            for name in names:
                place = name.replace(".", "/")
                if not isinstance(file.get(place), h5py.Dataset):
                    raise _lacking(path, name, [key for key in file if not key.startswith("#")])
                found[name] = Column(_numbers(path, name, file[place][()]), None)
        return found


def _mdf(path: Path, source: Source, names: Sequence[str]) -> dict[str, Column]:
    with _of_kind(path, "MDF", "asammdf"):
        from asammdf import MDF

        with MDF(path) as file:
            known = sorted(name for name in file.channels_db if name not in ("time", "t"))
            found = {}
            for name in names:
                if name not in file.channels_db:
                    raise _lacking(path, name, known)
                if len(places := file.channels_db[name]) > 1:
                    raise UsageError(f"{path}: {len(places)} channels are called {name!r}: expected one")
                signal = file.get(name)
                found[name] = Column(_numbers(path, name, signal.samples), _numbers(path, name, signal.timestamps))
            return found


def _can(path: Path, source: Source, names: Sequence[str]) -> dict[str, Column]:
    with _of_kind(path, "a DBC", "cantools"):
        import cantools

        assert source.dbc is not None  # the map was refused
        try:
            bus = cantools.database.load_file(str(source.dbc), strict=False)
        except OSError as err:
            raise UsageError(f"{source.dbc}: cannot read the DBC: {err.strerror}") from err
    wanted = _wanted(path, source, names, bus)
    values: dict[str, list[float]] = {name: [] for name in names}
    times: dict[str, list[float]] = {name: [] for name in names}
    with _of_kind(path, "a CAN log", "python-can"):
        from can.io.player import MESSAGE_READERS

        reader: Any = MESSAGE_READERS[path.suffix.lower() if path.suffix.lower() in KINDS["can"] else ".log"]
        with open_regular(path) as data:  # ours, and closed whatever a reader does
            text = data if path.suffix.lower() == ".blf" else TextIOWrapper(data, "utf-8", "replace")
            for frame in reader(text):
                entry = wanted.get((frame.arbitration_id, frame.is_extended_id))
                if entry is None or frame.is_error_frame or frame.is_remote_frame:
                    continue
                message, signals = entry
                if len(frame.data) < message.length:
                    continue
                decoded = message.decode(bytes(frame.data), decode_choices=False)
                for name, signal in signals:
                    if signal in decoded:  # a multiplexed one is in some frames only
                        values[name].append(float(decoded[signal]))
                        times[name].append(float(frame.timestamp))
    for name in names:
        if not values[name]:
            raise UsageError(f"{path}: no frame has {name}: expected the DBC of this bus, and its log")
    return {name: Column(np.array(values[name]), np.array(times[name])) for name in names}


def _wanted(
    path: Path, source: Source, names: Sequence[str], bus: Any
) -> dict[tuple[int, bool], tuple[Any, list[tuple[str, str]]]]:
    """Messages by identifier, with the columns that they hold."""
    by_name = {message.name: message for message in bus.messages}
    found: dict[tuple[int, bool], tuple[Any, list[tuple[str, str]]]] = {}
    for name in names:
        title, _, signal = name.partition(".")
        message = by_name.get(title)
        if message is None or signal not in (known := [s.name for s in message.signals]):
            choices = sorted(by_name) if message is None else [f"{title}.{s}" for s in known]
            raise UsageError(f"{source.dbc}: no signal is called {name!r}; it has: {', '.join(choices[:NAMED])}")
        key = (message.frame_id, message.is_extended_frame)
        found.setdefault(key, (message, []))[1].append((name, signal))
    return found
