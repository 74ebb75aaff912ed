"""Columns of a recording as an experiment in SI units, on a grid of times, and the list of what it lacks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.experiment.experiment import Experiment, Lack, Quality
from emb_bench.recordings.faults import ANGLES, HUGE, TIMES, VALUES, WRAPPED, Series, contradictions, require
from emb_bench.recordings.map_file import TIME, TIMED, Place, RecordingMap, Signal
from emb_bench.recordings.readers import Column, Floats
from emb_bench.sim.instruments import Tracked, observe, observer_noise
from emb_runtime.errors import UsageError

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


def experiment_of(
    columns: Mapping[Place, Column],
    recording_map: RecordingMap,
    kind: str,
    source: str,
    lacks: Mapping[Lack, tuple[float, ...]] = MappingProxyType({}),
) -> Found:
    """Columns, by their places, as an experiment that ``lacks`` this already; messages call the file ``source``.

    Raises:
        UsageError: the columns have faults, see :mod:`emb_bench.recordings.faults`, or are too short.
    """
    given, timing, name = recording_map.signals.given, recording_map.timing, Path(source).name
    source += f" (head in line {lacks[Lack.HEAD][0]})" if Lack.HEAD in lacks else ""
    read = _checked_signals(columns, recording_map, source)
    signals = {
        name: (series.times + given[name].delay, _in_si(series.values, given[name])) for name, series in read.items()
    }
    times, angles = signals["angle"]
    t_s = timing.sample_time or _sample_time(times)
    if not 1e-4 <= t_s <= 0.1:
        units = [unit for unit, seconds in TIME.items() if 1e-4 <= t_s / recording_map.time_unit * seconds <= 0.1]
        hint = f"; with unit = {' or '.join(map(repr, units))} it is" if timing.column and units else ""
        raise UsageError(
            f"{source}: expected a sample time from 0.0001 to 0.1 s, got {t_s:g} s: see [timing] in the map{hint}"
        )
    first = _first(times, t_s)
    times, angles = times[first:], angles[first:]
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
    applied = _applied(signals, grid, t_s, hold="command" not in given or given["command"].between != "linear")
    received = np.isfinite(angle) & np.isfinite(velocity) & np.isfinite(applied)
    if int(received.sum()) < FEWEST:
        raise UsageError(
            f"{source}: velocity and current cover {int(received.sum())} samples, expected at least {FEWEST}"
        )
    span = slice(int(np.argmax(received)), int(np.flatnonzero(received)[-1]) + 1)
    samples = np.where(received[:, None], np.stack([angle, velocity], axis=1), np.nan)[span]
    received, late, currents = received[span], late[span] - late[span.start], applied[span][1:]
    start = float(samples[0, 0]), float(samples[0, 1])
    experiment = Experiment(
        name=name,
        currents=currents,
        samples=samples[1:],
        angle=start[0],
        velocity=start[1],
        slack=0.0,  # the log has no time before the first sample
        from_origin=start == (0.0, 0.0),
        late=late[1:],
        assumed=None if received.all() else np.where(received[1:], np.nan, currents),
        first=start,
        quality=Quality(
            planned=len(currents),
            lacks=_lacks(recording_map, kind, bandwidth, int((~received).sum())) | {**lacks},
            faults=contradictions(samples, currents, t_s, recording_map),
        ),
    )
    return Found(experiment, t_s, (angle_noise, velocity_noise), bandwidth)


def _checked_signals(columns: Mapping[Place, Column], recording_map: RecordingMap, source: str) -> dict[str, Series]:
    """The signals without faults, angles continued over their period; rows that repeat the one before are left out."""
    given, clock = recording_map.signals.given, _clock(columns, recording_map)
    first = recording_map.file.rows[0] if recording_map.file.rows else 1
    repeated: NDArray[np.bool_] = np.zeros(1, np.bool_)
    if clock is not None and len({len(column.values) for column in columns.values()}) == 1:
        table = np.stack([column.values for column in columns.values()])
        repeated = np.append([False], (table[:, 1:] == table[:, :-1]).all(axis=0))
    found = dict[str, Series]()
    for name, signal in given.items():
        values, column_times = columns[signal.place]
        rows = np.arange(len(values))
        time: Floats = np.asarray(rows * recording_map.timing.sample_time if clock is None else clock, np.float64)
        time = time if column_times is None else column_times
        if len(time) != len(values):
            raise UsageError(f"{source}: {signal.column}: {len(values)} values and {len(time)} times: expected as many")
        low, high = signal.range
        valid = np.isfinite(values) & np.isfinite(time) & (low <= values) & (values <= high) & ~repeated
        valid &= ~np.isin(values, signal.special) & (np.abs(time) < HUGE)
        if valid.sum() < FEWEST:
            raise UsageError(f"{source}: {signal.column}: {valid.sum()} values are numbers, expected at least {FEWEST}")
        found[name] = series = Series(
            name=f"{signal.column} ([signals.{name}])",
            rows=rows[valid] + first,
            times=time[valid],
            values=values[valid],
            tick=recording_map.time_unit,
            sample_time=recording_map.timing.sample_time if name == "angle" else 0.0,
            noise=signal.noise / signal.scale,
            wrap=signal.wrap,
        )
        require(TIMES, series, source)
    angle, velocity = found["angle"], found.get("velocity")
    for name, series in found.items():
        if name != "angle":
            require(VALUES, series, source)
    if wrap := given["angle"].wrap:
        require(WRAPPED, angle, source)
        angle = angle._replace(values=np.unwrap(angle.values, period=wrap))
    if velocity is not None:
        factor = given["velocity"].scale * given["velocity"].sign / (given["angle"].scale * given["angle"].sign)
        rates = (np.interp(angle.times, velocity.times, velocity.values) - given["velocity"].offset) * factor
        angle = angle._replace(rates=rates)
    require(ANGLES, angle, source)
    return found | {"angle": angle}


def _clock(columns: Mapping[Place, Column], recording_map: RecordingMap) -> Floats | None:
    """Time of each row [s]; None where the format, or a sample time, says it."""
    timing = recording_map.timing
    if not timing.column:
        return None
    counts = columns[Place(timing.column)].values
    there = np.isfinite(counts)
    if timing.wrap:
        turns = np.cumsum(np.diff(counts[there], prepend=counts[there][:1]) < -0.5 * timing.wrap)
        counts = counts.copy()
        counts[there] += timing.wrap * turns
    seconds = counts * recording_map.time_unit
    if timing.fraction:
        seconds = seconds + columns[Place(timing.fraction)].values * TIME[timing.fraction_unit]
    return seconds


def _in_si(values: Floats, signal: Signal) -> Floats:
    return (values - signal.offset) * signal.scale * signal.sign


def _sample_time(times: Floats) -> float:
    """Distance of samples, of which some may be lost [s]; a single one is as coarse as a time stamp."""
    found, count = float(np.median(np.diff(times))), FEWEST
    while found > 0.0:
        near = times[:count] - times[0]
        found = float(np.polyfit(np.rint(near / found), near, 1)[0])
        if count >= len(times):
            break
        count *= 2
    return round(found, 9)


def _first(times: Floats, t_s: float) -> int:
    """The sample to begin with: the first, unless its stamp is far from the grid of the others."""
    turns = np.exp(2j * np.pi * times / t_s)
    away = np.abs(np.angle(turns * np.conj(turns.sum())))
    return 0 if away[0] < 0.2 * np.pi else int(np.argmin(away[:FEWEST]))


def _on_grid(times: Floats, t_s: float) -> tuple[Integers, Integers]:
    """Steps that have a sample, and which sample is nearest to each."""
    step = np.rint(times / t_s).astype(np.int64)
    away = np.abs(times - step * t_s)
    order = np.lexsort((away, step))
    first = np.concatenate([[True], np.diff(step[order]) > 0])
    return step[order][first], order[first].astype(np.int64)


def _nearest(times: Floats, values: Floats, grid: Floats, t_s: float) -> Floats:
    """The value nearest in time, NaN where there is none within half a period."""
    right = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    index = np.where(grid - times[right - 1] <= times[right] - grid, right - 1, right)
    result: Floats = np.where(np.abs(times[index] - grid) <= 0.5 * t_s, values[index], np.nan)
    return result


def _applied(signals: Mapping[str, tuple[Floats, Floats]], at: Floats, t_s: float, hold: bool) -> Floats:
    """Current of the period before each time [A]; NaN where the current that was measured does not cover it."""
    if "current" not in signals:
        return _means(*signals["command"], at - t_s, at, hold)
    times, values = signals["current"]
    covered = (at - t_s >= times[0] - 0.5 * t_s) & (at <= times[-1] + 0.5 * t_s)
    return np.where(covered, _means(times, values, at - t_s, at, hold=False), np.nan)


def _means(times: Floats, values: Floats, begin: Floats, end: Floats, hold: bool) -> Floats:
    """Mean of a signal between each begin and its end: with zero-order hold (``hold``), or else linear between samples.

    Before the first time and after the last it is as at these.
    """
    times, values = np.concatenate([times, times[-1:] + (end[-1] - begin[-1])]), np.concatenate([values, values[-1:]])
    heights = values[:-1] if hold else 0.5 * (values[:-1] + values[1:])
    slopes = np.zeros(len(values)) if hold else np.append(np.diff(values) / np.maximum(np.diff(times), 1e-12), 0.0)
    areas = np.concatenate([[0.0], np.cumsum(heights * np.diff(times))])

    def area(time: Floats) -> Floats:
        at = np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 1)
        since = time - times[at]
        result: Floats = areas[at] + since * (values[at] + 0.5 * since * np.where(since > 0.0, slopes[at], 0.0))
        return result

    result: Floats = (area(end) - area(begin)) / (end - begin)
    return result


def _derived(step: Integers, angle: Floats, t_s: float, bandwidth: float) -> Floats:
    """Velocity at each step that a tracking observer makes of angles; between them it goes along a line [rad/s]."""
    every = np.interp(np.arange(step[-1] + 1), step, angle).tolist()
    tracked, found = Tracked(every[0], 0.0), []
    for y1 in every:
        tracked = observe(bandwidth, tracked, t_s, y1)
        found.append(tracked.velocity)
    return np.array(found)


def _lacks(recording_map: RecordingMap, kind: str, bandwidth: float, lost: int) -> dict[Lack, tuple[float, ...]]:
    found: dict[Lack, tuple[float, ...]] = {Lack.NO_COUNTERS: ()}
    if bandwidth:
        found[Lack.NO_VELOCITY] = (bandwidth,)
    if recording_map.signals.current is None:
        found[Lack.NO_CURRENT] = ()
    if recording_map.signals.command is None:
        found[Lack.NO_COMMANDS] = ()
    if not recording_map.timing.column and kind not in TIMED:
        found[Lack.NO_TIMES] = ()
    if lost:
        found[Lack.LOST_OF_RECORDING] = (lost,)
    return found
