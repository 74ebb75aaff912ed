"""Columns of foreign files (CSV, Parquet, MATLAB, MDF) as an experiment in our units, and what it lacks.

Each library is imported when it is needed.
"""

from __future__ import annotations

import gc
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.plants import Instruments
from emb_bench.experiment.experiment import Experiment, Lack
from emb_bench.recordings.map_file import TIMED, RecordingMap, Signal, Source
from emb_bench.sim.instruments import MEMORY, observe, observer_noise, settle
from emb_runtime.errors import EmbError, UsageError, needs
from emb_runtime.system.input_file import open_regular

Floats = NDArray[np.float64]

MOST = 5_000_000  # Most rows of a recording
NAMED = 12  # Most columns that a message names


class Column(NamedTuple):
    """One column of a recording."""

    values: Floats  # Shape (n,)
    time: Floats | None  # Of each value [s], shape (n,); None where the format has no times of its own


def read_columns(path: Path, kind: str, source: Source, names: Sequence[str]) -> dict[str, Column]:
    """Named columns of a file of a kind; ``struct.field`` inside MATLAB structures."""
    names = list(dict.fromkeys(names))
    readers: Mapping[str, tuple[str, Callable[[], Iterator[tuple[str, Any, Any]]]]] = {
        "csv": ("CSV", lambda: _csv(path, source, names)),
        "parquet": ("Parquet", lambda: _parquet(path, names)),
        "matlab": ("MATLAB", lambda: _matlab(path, names)),
        "mdf": ("MDF", lambda: _mdf(path, names)),
    }
    title, read = readers[kind]
    found = {}
    try:
        open_regular(path).close()
    except OSError as err:
        raise UsageError(f"{path}: cannot read the recording: {err.strerror}") from err
    with _errors_in_one_line(path, title):
        for name, values, time in read():
            found[name] = Column(_numbers(path, name, values), None if time is None else _numbers(path, name, time))
    for name, column in found.items():
        if not 2 <= len(column.values) <= MOST:
            raise UsageError(f"{path}: {name}: expected 2 to {MOST} values, got {len(column.values)}")
    return found


@contextmanager
def _errors_in_one_line(path: Path, kind: str) -> Iterator[None]:
    try:
        with needs(f"{path}: reading {kind}", "mdf"):
            yield
    except EmbError:
        raise
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

    content = io.loadmat(path, squeeze_me=True, struct_as_record=False, simplify_cells=True)
    for name in names:
        value: Any = content
        for part in name.split("."):
            found = [value[part]] if isinstance(value, Mapping) and part in value else []
            _require_one(path, name, found, [key for key in content if not key.startswith("__")])
            value = found[0]
        yield name, value, None


def _mdf(path: Path, names: Sequence[str]) -> Iterator[tuple[str, Any, Any]]:
    from asammdf import MDF

    with MDF(path) as file:
        known = sorted(name for name in file.channels_db if name not in ("time", "t"))
        for name in names:
            _require_one(path, name, file.channels_db.get(name, ()), known)
            signal = file.get(name)
            yield name, signal.samples, signal.timestamps


SLOWEST, FASTEST = 300.0, 2000.0  # Bandwidths of the observer that derives a velocity [rad/s]
FEWEST = 20  # Fewest samples of a recording
LONGEST = 1_000_000  # Most periods of a recording

Integers = NDArray[np.int64]


class Found(NamedTuple):
    """A recording in our units."""

    experiment: Experiment
    sample_time: float  # [s]
    noise: tuple[float, float]  # Standard deviations of angle [rad] and velocity [rad/s]
    bandwidth: float  # Of the observer that made the velocity [rad/s]; 0 if it was measured


def experiment_of(columns: Mapping[str, Column], wanted: RecordingMap, kind: str, source: str) -> Found:
    """Columns, by their names, as an experiment; messages call the file ``source``."""
    given, timing = wanted.signals.given, wanted.timing
    clock = columns[timing.column].values * wanted.time_unit if timing.column else None
    signals = {name: _signal(columns, signal, wanted, clock, source) for name, signal in given.items()}
    times, angles = signals["angle"]
    t_s = timing.sample_time or float(np.median(np.diff(times)))
    if not 1e-4 <= t_s <= 0.1:
        raise UsageError(
            f"{source}: expected a sample time from 0.0001 to 0.1 s, got {t_s:g} s: see [timing] in the map"
        )
    step, index = _on_grid(times - times[0], t_s)
    if len(step) < FEWEST or step[-1] > LONGEST:
        raise UsageError(
            f"{source}: expected {FEWEST} to {LONGEST} samples, got {len(step)} over {times[-1] - times[0]:g} s: see "
            "[timing] in the map"
        )
    grid = times[0] + np.arange(step[-1] + 1) * t_s
    angle, late = np.full(len(grid), np.nan), np.zeros(len(grid))
    angle[step], late[step] = angles[index], times[index] - grid[step]
    bandwidth = 0.0 if "velocity" in signals else min(max(SLOWEST, 0.5 / t_s), FASTEST)
    angle_noise = given["angle"].noise
    if bandwidth:
        velocity = _derived(step, angles[index], t_s, bandwidth)
        velocity_noise = observer_noise(bandwidth, t_s, angle_noise)
    else:
        velocity = _nearest(*signals["velocity"], grid, t_s)
        velocity_noise = given["velocity"].noise
    applied = _applied(signals, grid, t_s, held="command" not in given or given["command"].between != "linear")
    received = np.isfinite(angle) & np.isfinite(velocity) & np.isfinite(applied)
    if int(received.sum()) < FEWEST:
        raise UsageError(
            f"{source}: velocity and current cover {int(received.sum())} samples, expected at least {FEWEST}"
        )
    whole = slice(int(np.argmax(received)), int(np.flatnonzero(received)[-1]) + 1)
    samples = np.where(received[:, None], np.stack([angle, velocity], axis=1), np.nan)[whole]
    received, late, currents = received[whole], late[whole] - late[whole.start], applied[whole][1:]
    first = float(samples[0, 0]), float(samples[0, 1])
    experiment = Experiment(
        name=Path(source).name,
        currents=currents,
        samples=samples[1:],
        angle=first[0],
        velocity=first[1],
        slack=0.0,  # nothing is known before the first sample
        from_origin=first == (0.0, 0.0),
        late=late[1:],
        assumed=None if received.all() else np.where(received[1:], np.nan, currents),
        first=first,
        planned=len(currents),
        lacks=_lacks(wanted, kind, bandwidth, int((~received).sum())),
    )
    return Found(experiment, t_s, (angle_noise, velocity_noise), bandwidth)


def _signal(
    columns: Mapping[str, Column],
    signal: Signal,
    wanted: RecordingMap,
    clock: Floats | None,
    source: str,
) -> tuple[Floats, Floats]:
    """Times [s] and values in our units of what was recorded of a signal."""
    column = columns[signal.column]
    values = (column.values - signal.offset) * signal.scale * signal.sign
    rows = np.asarray(np.arange(len(values)) * wanted.timing.sample_time, dtype=np.float64) if clock is None else clock
    time: Floats = rows if column.time is None else column.time
    if len(time) != len(values):
        raise UsageError(f"{source}: {signal.column}: {len(values)} values and {len(time)} times: expected as many")
    kept = np.isfinite(values) & np.isfinite(time)
    time, values = time[kept], values[kept]
    if len(time) < FEWEST:
        raise UsageError(f"{source}: {signal.column}: {len(time)} values are numbers, expected at least {FEWEST}")
    if (back := np.flatnonzero(np.diff(time) < 0.0)).size:
        raise UsageError(f"{source}: the time runs backwards after row {int(back[0]) + 1}, at {time[back[0]]:g} s")
    return time + signal.delay, values


def _on_grid(times: Floats, t_s: float) -> tuple[Integers, Integers]:
    """Steps that have a sample, and which sample is nearest to each."""
    step = np.rint(times / t_s).astype(np.int64)
    away = np.abs(times - step * t_s)
    order = np.lexsort((away, step))
    first = np.concatenate([[True], np.diff(step[order]) > 0])
    return step[order][first], order[first].astype(np.int64)


def _nearest(times: Floats, values: Floats, wanted: Floats, t_s: float) -> Floats:
    """The value nearest in time, NaN where there is none within half a period."""
    right = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    index = np.where(wanted - times[right - 1] <= times[right] - wanted, right - 1, right)
    result: Floats = np.where(np.abs(times[index] - wanted) <= 0.5 * t_s, values[index], np.nan)
    return result


def _applied(signals: Mapping[str, tuple[Floats, Floats]], at: Floats, t_s: float, held: bool) -> Floats:
    """Current of the period before each time [A]; NaN where the current that was measured does not cover it."""
    if "current" not in signals:
        return _means(*signals["command"], at - t_s, at, held)
    times, values = signals["current"]
    covered = (at - t_s >= times[0] - 0.5 * t_s) & (at <= times[-1] + 0.5 * t_s)
    return np.where(covered, _means(times, values, at - t_s, at, held=False), np.nan)


def _means(times: Floats, values: Floats, begin: Floats, end: Floats, held: bool) -> Floats:
    """Mean from each begin to its end of what is held from each time on, or else goes straight from one to the next.

    Before the first time and after the last it is as at these.
    """
    times, values = np.concatenate([times, times[-1:] + (end[-1] - begin[-1])]), np.concatenate([values, values[-1:]])
    heights = values[:-1] if held else 0.5 * (values[:-1] + values[1:])
    slopes = np.zeros(len(values)) if held else np.append(np.diff(values) / np.maximum(np.diff(times), 1e-12), 0.0)
    areas = np.concatenate([[0.0], np.cumsum(heights * np.diff(times))])

    def area(wanted: Floats) -> Floats:
        at = np.clip(np.searchsorted(times, wanted, side="right") - 1, 0, len(times) - 1)
        since = wanted - times[at]
        result: Floats = areas[at] + since * (values[at] + 0.5 * since * np.where(since > 0.0, slopes[at], 0.0))
        return result

    result: Floats = (area(end) - area(begin)) / (end - begin)
    return result


def _derived(step: Integers, angle: Floats, t_s: float, bandwidth: float) -> Floats:
    """Velocity at each step that a tracking observer makes of angles; between them it goes along a line [rad/s]."""
    memory = np.zeros(MEMORY)
    settle(Instruments(), memory, float(angle[0]))
    instruments = Instruments(observer_bandwidth=bandwidth)
    every = np.interp(np.arange(step[-1] + 1), step, angle)
    return np.array([observe(instruments, memory, t_s, y1) for y1 in every.tolist()])


def _lacks(wanted: RecordingMap, kind: str, bandwidth: float, lost: int) -> dict[Lack, tuple[float, ...]]:
    found: dict[Lack, tuple[float, ...]] = {Lack.NO_COUNTERS: ()}
    if bandwidth:
        found[Lack.NO_VELOCITY] = (bandwidth,)
    if wanted.signals.current is None:
        found[Lack.NO_CURRENT] = ()
    if wanted.signals.command is None:
        found[Lack.NO_COMMANDS] = ()
    if not wanted.timing.column and kind != TIMED:
        found[Lack.NO_TIMES] = ()
    if lost:
        found[Lack.LOST_OF_RECORDING] = (lost,)
    return found
