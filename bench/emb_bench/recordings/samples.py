"""Samples of an imported recording on a grid, in our units, and what the recording lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emb_bench.recordings.map_file import MEASURED_UNITS, OWN_TIMES, RecordingMap, Signal
from emb_bench.recordings.readers import Column, Floats
from emb_bench.sim.instruments import MEMORY, observe, observer_noise, settle
from emb_runtime.config.plants import Instruments
from emb_runtime.config.units import FORCE, LENGTH, SPEED
from emb_runtime.errors import UsageError

SLOWEST, FASTEST = 300.0, 2000.0  # Bandwidths of the observer that derives a velocity [rad/s]
FEWEST = 20  # Fewest samples of a recording
LONGEST = 1_000_000  # Most periods of a recording

Integers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Recorded:
    """A recording in our units: samples y_0..y_n, lost ones left out, and the current of each period before one."""

    sample_time: float  # [s]
    step: Integers  # Periods since the first sample, ascending, shape (m,)
    time: Floats  # Since the first sample, by the recording's own stamps [s], shape (m,)
    angle: Floats  # [rad], shape (m,)
    velocity: Floats  # [rad/s], shape (m,)
    applied: Floats  # Current in the period before each sample [A], shape (m,)
    commanded: Floats  # Current commanded from each sample on [A], shape (m,); NaN where that is not known
    noise: tuple[float, float]  # Standard deviations of angle [rad] and velocity [rad/s]
    bandwidth: float  # Of the observer that made the velocity [rad/s]; 0 if it was measured
    lacks: tuple[str, ...]  # Descriptions of the parts of a log of ours that the recording does not have


def recorded(columns: Mapping[str, Column], wanted: RecordingMap, kind: str, source: str) -> Recorded:
    """Puts columns on a grid.

    Args:
        columns: by their names.
        wanted: the map.
        kind: of the file.
        source: what to call the file in messages.

    Raises:
        UsageError: times run backwards or columns differ in length; too few samples, or too many.
    """
    given, timing = wanted.signals.given, wanted.timing
    clock = columns[timing.column].values * wanted.time_unit if timing.column else None
    signals = {name: _signal(columns, signal, name, wanted, clock, source) for name, signal in given.items()}
    times, angles = signals["angle"]
    t_s = timing.sample_time or float(np.median(np.diff(times)))
    if not 1e-4 <= t_s <= 0.1:
        raise UsageError(
            f"{source}: expected a sample time from 0.0001 to 0.1 s, got {t_s:g} s: see [timing] in the map"
        )
    origin = times[0]
    step, index = _on_grid(times - origin, t_s)
    if len(step) < FEWEST or step[-1] > LONGEST:
        raise UsageError(
            f"{source}: expected {FEWEST} to {LONGEST} samples, got {len(step)} over {times[-1] - origin:g} s: see "
            "[timing] in the map"
        )
    angle = angles[index]
    bandwidth = 0.0 if "velocity" in signals else min(max(SLOWEST, 0.5 / t_s), FASTEST)
    angle_noise = given["angle"].noise * _factor("angle", given["angle"], wanted)
    if bandwidth:
        velocity = _derived(step, angle, t_s, bandwidth)
        velocity_noise = observer_noise(bandwidth, t_s, angle_noise)
    else:
        velocity = _nearest(*signals["velocity"], origin + step * t_s, t_s)
        velocity_noise = given["velocity"].noise * _factor("velocity", given["velocity"], wanted)
    held = "command" not in given or given["command"].between != "linear"
    applied, commanded = _currents(signals, origin, step, t_s, held)
    known = np.isfinite(velocity) & np.isfinite(applied)
    if int(known.sum()) < FEWEST:
        raise UsageError(f"{source}: velocity and current cover {int(known.sum())} samples, expected at least {FEWEST}")
    first = int(np.argmax(known))
    chosen = np.flatnonzero(known)
    step = step - step[first]
    time = times[index] - times[index][first]
    return Recorded(
        sample_time=t_s,
        step=step[chosen],
        time=time[chosen],
        angle=angle[chosen],
        velocity=velocity[chosen],
        applied=applied[chosen],
        commanded=commanded[chosen],
        noise=(angle_noise, velocity_noise),
        bandwidth=bandwidth,
        lacks=_lacks(wanted, kind, bandwidth, int(step[chosen][-1]) + 1 - len(chosen)),
    )


def _factor(name: str, signal: Signal, wanted: RecordingMap) -> float:
    """Factor from the unit of a signal to ours."""
    factor = MEASURED_UNITS[name][signal.unit]
    if signal.unit in (*LENGTH, *SPEED):
        factor /= wanted.machine.travel
    return factor * wanted.machine.travel if signal.unit in FORCE else factor


def _signal(
    columns: Mapping[str, Column],
    signal: Signal,
    name: str,
    wanted: RecordingMap,
    clock: Floats | None,
    source: str,
) -> tuple[Floats, Floats]:
    """Times [s] and values in our units of what was recorded of a signal."""
    column = columns[signal.column]
    values = (column.values - signal.offset) * signal.scale * signal.sign * _factor(name, signal, wanted)
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


def _currents(
    signals: Mapping[str, tuple[Floats, Floats]], origin: float, step: Integers, t_s: float, held: bool
) -> tuple[Floats, Floats]:
    """Current of the period before each sample, and what was commanded from it on [A]."""
    at = np.asarray(origin + step * t_s, dtype=np.float64)
    commanded = np.full(len(step), np.nan)
    if "command" in signals:
        commanded = _means(*signals["command"], at, at + t_s, held)
    if "current" in signals:
        times, values = signals["current"]
        covered = (at - t_s >= times[0] - 0.5 * t_s) & (at <= times[-1] + 0.5 * t_s)
        return np.where(covered, _means(times, values, at - t_s, at, False), np.nan), commanded
    return _means(*signals["command"], at - t_s, at, held), commanded


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
    """Velocity that a tracking observer makes of the angles; through lost ones it goes on along a line [rad/s]."""
    memory = np.zeros(MEMORY)
    settle(Instruments(), memory, float(angle[0]))
    instruments = Instruments(observer_bandwidth=bandwidth)
    every = np.interp(np.arange(step[-1] + 1), step, angle)
    velocity = np.array([observe(instruments, memory, t_s, y1) for y1 in every.tolist()])
    result: Floats = velocity[step]
    return result


def _lacks(wanted: RecordingMap, kind: str, bandwidth: float, lost: int) -> tuple[str, ...]:
    said = ["the recording has no counters, answers or states: a repeated, late or lost command cannot be told"]
    if bandwidth:
        said.append(
            f"the recording has no velocity: an observer ({bandwidth:g} rad/s) derives one from the angles, which has "
            "no weight in an estimate"
        )
    if wanted.signals.current is None:
        said.append("the recording has no measured current: what acted is taken to be what was commanded")
    if wanted.signals.command is None:
        said.append("the recording has no commands: what acted is the mean of the measured current over each period")
    if not wanted.timing.column and kind not in OWN_TIMES:
        said.append("the recording has no times: its rows are taken to be one sample time apart")
    if kind == "can":
        said.append("the times are those of the receiver, jitter of the bus included")
    if not lost:
        return tuple(said)
    return (*said, f"{lost} samples are lost: what acted in the periods before them is not known to have acted")
