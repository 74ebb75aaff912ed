"""The samples of an experiment, from the control cycles in a log.

``/cycle`` has one record for each sample that the loop had in control: what was measured, what was sent for it. Two
things are not in it and come from the node's messages: the command that the node reports as obeyed, and the
samples before the experiment.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.experiment.experiment import Booleans, Floats, Integers
from emb_bench.logs.log import RunLog, Table
from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER
from emb_runtime.can.messages import CHARGE, Layout
from emb_runtime.can.receiver import Reception, fresh_ns
from emb_runtime.drives.mapping import Mapping, Measured
from emb_runtime.errors import LogError
from emb_runtime.records import CycleRecord, Frame, RunState, SensorSample

SPARSEST = 1000  # Most periods for each control cycle in a log; a log that claims more contradicts itself
LONGEST = 10_000_000  # Most periods of an experiment: it is taken into memory
UNKNOWN = -1  # Counter of a command that is not known

_COLUMNS = ("step", "state", "counter", "command_counter", "device_time_ns")
_MEASURED = {"angle": "Angle", "velocity": "Velocity", "applied_current": "AppliedCurrent"}
"""Columns that come from signals of the node's messages."""
_FRAME = ("id", "data", "is_extended", "is_rtr", "is_error")
_RECENT = COUNTER_MODULUS  # Of the node's messages before a control cycle, those among which a counter is unique


class Samples(NamedTuple):
    """Samples of the experiment, as columns of shape (n,)."""

    angle: Floats  # [rad]
    velocity: Floats  # [rad/s]
    late: Floats  # Lateness after the grid, by the node's own stamps [s]
    applied: Floats  # Current that acted in the period before the sample [A]
    sent: Floats  # Current of the command for the sample, as a mapped drive's bus carried it [A]; NaN if none was sent
    charge: Floats  # Integral of the current up to the sample, by the node's report [A·s]; NaN where none came
    obeyed: NDArray[np.int8]
    """Counter of the command that acted in that period, by the node's report; ``UNKNOWN`` where that is missing."""
    answer: NDArray[np.int8]  # Counter of the command that was sent for the sample; ``UNKNOWN`` where none was

    @property
    def received(self) -> Booleans:
        """Mask of the samples that were received, shape (n,)."""
        return np.isfinite(self.angle)


LOST = Samples(math.nan, math.nan, 0.0, math.nan, math.nan, math.nan, UNKNOWN, UNKNOWN)  # type: ignore[arg-type]
"""Values of a sample that was lost."""


def samples_on_grid(log: RunLog, bench: Bench, planned: int) -> Samples:
    """One sample for each step from 0 to the last one, received or not.

    Args:
        log: the log.
        bench: the sample time.
        planned: periods of the experiment; later samples are left out.

    Raises:
        LogError: the log has no experiment, or none of which a whole period is left, or contradicts itself.
    """
    steps, buffers = bytearray(), [bytearray() for _ in LOST]  # thousands of small arrays would break up the memory
    for step, samples in control_cycles(log, bench, planned):
        steps += step.tobytes()
        for buffer, values in zip(buffers, samples, strict=True):
            buffer += np.asarray(values).tobytes()
    step = np.frombuffer(steps, np.int64)
    if not len(step) or step[-1] < 1:
        raise LogError(f"{log.path}: not one whole period of the experiment is left")
    last = min(int(step[-1]), planned)
    chosen = slice(None) if last == step[-1] else step <= last
    floats, counters = np.empty((6, last + 1)), np.empty((2, last + 1), np.int8)
    grid: list[Any] = [*floats, *counters]
    for column, lost in zip(grid, LOST, strict=True):
        column[:] = lost
        values = np.frombuffer(buffers.pop(0), column.dtype)
        column[step[chosen]] = values[chosen]  # of two samples of one step the later one counts
    return Samples(*grid)


def control_cycles(log: RunLog, bench: Bench, planned: int) -> Iterator[tuple[Integers, Samples]]:
    """Step and content of the samples in the control cycles, some at a time; errors as for :func:`samples_on_grid`."""
    layout, period_ns = log.layout, bench.timing.sample_time_ns
    log.require("/cycle", CycleRecord._fields)
    apart_ns = 0 if log.imported else fresh_ns(layout.velocity)
    reports = _Reports(log, layout.velocity.name, "CommandCounter", UNKNOWN, apart_ns)
    charges = _Reports(log, CHARGE, "Charge", math.nan, apart_ns)
    active = last = 0
    origin_ns: Integers | None = None
    columns = {report.topic: report.columns for report in (reports, charges)}
    for part in log.batches({"/cycle": (*_COLUMNS, *_MEASURED, "sent_current"), **columns}):
        obeyed, charge = reports.of_the_cycles(part), charges.of_the_cycles(part)
        chosen = in_experiment(part["/cycle"])
        cycles = {name: column[chosen] for name, column in part["/cycle"].items()}
        steps = cycles["step"]
        if not len(steps):
            continue
        if (np.diff(steps, prepend=last) < 0).any():
            raise LogError(f"{log.path}: the steps of the control cycles go back: this is not one run")
        active, last = active + len(steps), int(steps[-1])
        if active > planned + 1 or last > SPARSEST * active:
            raise LogError(
                f"{log.path}: {active} control cycles of an experiment of {planned} periods claim that it had {last}"
            )
        if last > LONGEST:
            raise LogError(f"{log.path}: expected an experiment of at most {LONGEST} periods, got {last}")
        if origin_ns is None:
            origin_ns = cycles["device_time_ns"][:1] - steps[:1] * period_ns
        since_ns = cycles["device_time_ns"] - origin_ns
        answered = cycles["command_counter"] != NO_COUNTER
        measured = np.isfinite(cycles["angle"]) if log.imported else _measured(cycles, layout)
        on_time = measured & (np.rint(since_ns / period_ns) == steps)
        samples = (
            cycles["angle"],
            cycles["velocity"],
            (since_ns - steps * period_ns) * 1e-9,
            cycles["applied_current"],
            np.where(answered, quantised(cycles["sent_current"], log.drive), np.nan),
            charge[chosen],
            _counters(obeyed[chosen]),
            _counters(np.where(answered, cycles["command_counter"], UNKNOWN)),
        )
        yield steps[on_time], Samples(*(column[on_time] for column in samples))
    if not active:
        why = log.missing or f"it never became active ({log.exit_reason})"
        raise LogError(f"{log.path}: no experiment in this log: {why}")
    if not reports.found and not log.imported:
        raise LogError(f"{log.path}: the frames of the experiment are missing: what acted is not known")


def _counters(values: NDArray[Any]) -> NDArray[np.int8]:
    """Counters in little memory; one that cannot be is the first that cannot be."""
    result: NDArray[np.int8] = np.clip(values, UNKNOWN, COUNTER_MODULUS + 1).astype(np.int8)
    return result


def in_experiment(cycles: Table) -> Booleans:
    """Mask of the control cycles that belong to the experiment."""
    chosen: Booleans = (cycles["state"] == RunState.ACTIVE) & (cycles["step"] >= 0)
    return chosen


def _measured(cycles: Table, layout: Layout) -> Booleans:
    """Mask of the control cycles whose values the node's messages can carry."""
    possible = np.ones(len(cycles["step"]), np.bool_)
    signals = {signal.name: signal for message in (layout.angle, layout.velocity) for signal in message.signals}
    for column, name in _MEASURED.items():
        signal = signals[name]
        values, slack = cycles[column], 0.5 * signal.factor
        possible &= (signal.minimum - slack <= values) & (values <= signal.maximum + slack)
    return possible


class _Reports:
    """The node's reports of what acted before each sample, in a message with the counter of the sample.

    Args:
        log: the log.
        message: its name.
        signal: that reports.
        unknown: where no report came.
        apart_ns: most time between two messages of a sample [ns].
    """

    def __init__(self, log: RunLog, message: str, signal: str, unknown: float, apart_ns: int) -> None:
        self.topic = f"/emb/{message}"
        self.columns = ("Counter", signal)
        self._signal, self._unknown, self._apart_ns = signal, unknown, apart_ns
        self.found = False
        """There was a report for any of the cycles."""
        if self.topic in log.topics:
            log.require(self.topic, self.columns[:1])
            log.require(
                self.topic, self.columns[1:], "a real number" if isinstance(unknown, float) else "a whole number"
            )
        self._recent = dict.fromkeys((*self.columns, "order", "publish_time"), np.empty(0, np.int64))

    def of_the_cycles(self, part: dict[str, Table]) -> NDArray[Any]:
        """The reports of each control cycle of a batch."""
        cycles = part["/cycle"]
        told = np.full(len(cycles["step"]), self._unknown)
        if self.topic not in part:
            return told
        known = {name: np.concatenate([old, part[self.topic][name]]) for name, old in self._recent.items()}
        self._recent = {name: column[-_RECENT:] for name, column in known.items()}
        before = np.searchsorted(known["order"], cycles["order"])
        left = np.arange(len(told))  # nearly always it is the last message before the cycle
        for back in range(1, _RECENT + 1):
            left = left[before[left] >= back]
            if not len(left):
                break
            at = before[left] - back
            apart_ns = np.abs(cycles["publish_time"][left] - known["publish_time"][at])
            fits = (known["Counter"][at] == cycles["counter"][left]) & (apart_ns <= self._apart_ns)
            told[left[fits]] = known[self._signal][at[fits]]
            self.found |= bool(fits.any())
            left = left[~fits]
        return told


def samples_before(log: RunLog, bench: Bench, count: int) -> list[SensorSample]:
    """The last samples up to sample 0 that the runtime took from the frames before the first control cycle.

    Args:
        log: the log.
        bench: limits of plausible samples.
        count: how many, at most.

    Raises:
        LogError: the frames cannot be decoded.
    """
    layout = log.layout
    frames: deque[Frame] = deque(maxlen=4 * count)
    device_time_ns = 0
    if "/can/rx" in log.topics:
        log.require("/can/rx", _FRAME)
    for part in log.batches({"/can/rx": _FRAME, "/cycle": ("step", "state", "device_time_ns")}):
        cycles = part["/cycle"]
        first = np.flatnonzero(in_experiment(cycles))[:1]
        if "/can/rx" in part:
            end = int(cycles["order"][first[0]]) if len(first) else None
            frames += _frames(part["/can/rx"], layout, end, 4 * count)
        if len(first):
            step, device_time_ns = (int(cycles[name][first[0]]) for name in ("step", "device_time_ns"))
            device_time_ns -= step * bench.timing.sample_time_ns
            break
    reception = Reception(layout, bench, lambda _frame, _why: None)
    samples = [sample for frame in frames if (sample := reception.take(frame)) is not None]
    wrap_ns = layout.device_time_period_ns
    latest_ns = (wrap_ns + bench.timing.sample_time_ns) // 2  # half a period behind sample 0, in time that wraps
    return [s for s in samples if (s.device_time_ns - device_time_ns + wrap_ns // 2) % wrap_ns <= latest_ns][-count:]


def _frames(received: Table, layout: Layout, end: int | None, count: int) -> list[Frame]:
    """The last frames of samples before a place in the log's order."""
    chosen = np.isin(received["id"], (layout.angle.identifier, layout.velocity.identifier))
    if end is not None:
        chosen &= received["order"] < end
    at = np.flatnonzero(chosen)[-count:]
    rows = (received[name][at].tolist() for name in ("id", "data", "publish_time", "is_extended", "is_rtr", "is_error"))
    return [Frame(*row) for row in zip(*rows, strict=True)]


def step_of(measured: Measured) -> float:
    """Step of a measured signal [SI]; next to nothing for a floating-point number."""
    return measured.field.step(0.0) * abs(measured.factor)


def quantised(currents: Floats, drive: Mapping | None) -> Floats:
    """Currents of commands as the drive's own message carries them; of our own node, as they are [A]."""
    if drive is None or drive.command.field.is_float:
        return currents
    field, factor = drive.command.field, drive.command.factor
    with np.errstate(over="ignore"):  # a damaged log may say anything
        steps: Floats = np.round((currents * factor - field.offset) / field.scale)
        return (steps * field.scale + field.offset) / factor


def match_tolerance(drive: Mapping | None, layout: Layout) -> float:
    """Distance from the report within which a command acted; 0 for our own node, which reports exactly [A].

    Two quantisation steps: one between node and drive, one between drive and actuator.
    """
    if drive is None:
        return 0.0
    step = 0.0 if drive.current is None else step_of(drive.current)
    return 2.0 * step + layout.velocity.signal("AppliedCurrent").factor
