"""The experiment in a log: the applied current of each period, and the sample at its end.

The node's time stamps give the number of a period. The applied current is the one that the node reports at the period's
end. The report is exact, also if commands act late: the node obeys and reports currents in the steps of the CAN signal.
A mapped drive reports coarsely: there the applied current is the command on its bus, if the report agrees.

``/cycle`` has one record for each sample in control, with the sample and the command sent. Two things come from the
node's messages: the counter of the obeyed command, and the samples before the experiment.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.config.plants import LONGEST_DELAY
from emb_bench.experiment.experiment import REST_SIGMAS, Booleans, Experiment, Floats, Integers, Lack, Quality
from emb_bench.logs.log import RunLog, Table, once
from emb_runtime.can.e2e import COUNTER_MODULUS, NO_COUNTER
from emb_runtime.can.messages import CHARGE, Layout
from emb_runtime.can.receiver import Reception, fresh_ns
from emb_runtime.drives.mapping import Mapping, Measured
from emb_runtime.errors import LogError
from emb_runtime.records import CycleRecord, Frame, NodeState, RunState, SensorSample
from emb_runtime.safety.shield import damped_current

REST_SAMPLES = 50  # Most samples before the experiment from which the position at rest is taken

SPARSEST = 1000  # Most periods for each control cycle in a log; a log that claims more contradicts itself
LONGEST = 10_000_000  # Most periods of an experiment: it is taken into memory
UNKNOWN = -1  # Counter of a missing command

_MEASURED = {"angle": "Angle", "velocity": "Velocity", "applied_current": "AppliedCurrent"}
"""Columns that come from signals of the node's messages."""
_FRAME = ("id", "data", "is_extended", "is_rtr", "is_error")
_RECENT = COUNTER_MODULUS  # Of the node's messages before a control cycle, those among which a counter is unique
_DELAYS = range(LONGEST_DELAY + 1)  # Samples by which commands may act late


@dataclass(frozen=True, eq=False, repr=False)
class Recording(RunLog):
    """A recording that others made, in place of the log of a run: it has no messages but its experiment."""

    experiment: Experiment
    is_recording = True
    exit_reason = "DONE"


def read_experiment(log: RunLog, bench: Bench | None = None, name: str = "") -> Experiment:
    """The experiment in a log; ``bench`` is used where the log carries no bench file.

    Raises:
        LogError: the log has no experiment, not one complete period of it, or contradicts itself.
    """
    if isinstance(log, Recording):
        found = log.experiment
    elif "bench.toml" in log.attachments or bench is None:
        found = _of_its_bench(log)
    else:
        found = _read(log, bench)
    return replace(found, name=name or log.path.name)


@once
def _of_its_bench(log: RunLog) -> Experiment:
    return _read(log, log.bench)


def _read(log: RunLog, bench: Bench) -> Experiment:
    planned = _planned(log, bench)
    samples = samples_on_grid(log, bench, planned)
    received, within = samples.received, match_tolerance(log.drive, log.layout)
    counted = received[1:]
    by_charge = currents_by_charge(samples, bench, log.layout)
    wrong, squares = zip(*(_disagreements(log, bench, samples, delay, within) for delay in _DELAYS), strict=True)
    # A mapped drive does not report the obeyed command.
    delay = int(np.argmin(wrong if log.drive_files is None else squares))
    periods, lost = len(counted), int((~counted).sum())
    currents = _acted(log, bench, samples, by_charge, delay, within)
    angle, velocity, slack = _start(log, bench)
    reported = counted | np.isfinite(by_charge[1:])
    told = int(np.isfinite(by_charge).sum())
    return Experiment(
        name=log.path.name,
        currents=currents,
        samples=np.stack([samples.angle[1:], samples.velocity[1:]], axis=1),
        angle=angle,
        velocity=velocity,
        slack=slack,
        from_origin=velocity == 0.0 and abs(angle) <= REST_SIGMAS * slack,
        late=samples.late[1:].copy(),  # a view would keep all columns
        assumed=None if reported.all() else np.where(reported, np.nan, currents),
        first=(float(samples.angle[0]), float(samples.velocity[0])),
        quality=Quality(
            planned=planned,
            braked=int((counted & (samples.obeyed[1:] == NO_COUNTER)).sum()),
            command_delay=delay,
            lacks=_lacks(periods, _due(log, periods, planned), lost, told, wrong[delay]),
            within=None if log.drive_files is None else math.nan if log.drive is None else within,
        ),
    )


def _planned(log: RunLog, bench: Bench) -> int:
    steps = log.run.get("steps", "")
    return int(steps) if steps.isdecimal() and len(steps) < 16 else bench.timing.horizon


def _due(log: RunLog, count: int, planned: int) -> int:
    """Periods that the run had to have: all that it had, if it reached its stop condition."""
    over = {"exit_reason": "DONE", "goal_reached": "True"}
    return count if over.items() <= log.end.items() else planned


def _commanded(log: RunLog, samples: Samples, delay: int) -> Floats:
    """Current of the command that acts in each period, ``delay`` samples late [A]; NaN if unknown, shape (n,).

    Before sample 0 a mapped drive has commands of 0 A, as its bus carries them.
    """
    before = np.full(delay, math.nan) if log.drive_files is None else quantised(np.zeros(delay), log.drive)
    return np.concatenate([before, samples.sent])[: len(samples.sent) - 1]


def _disagreements(log: RunLog, bench: Bench, samples: Samples, delay: int, within: float) -> tuple[int, float]:
    """Periods whose report names another command than the one sent for them, or another current than the one to act.

    The current to act is that of the command ``delay`` samples before; with a mapped drive differences up to ``within``
    do not count [A]. Periods without a command in time are not compared.

    Returns:
        Their number, and the mean square of the differences of the currents [A²].
    """
    counted, obeyed = samples.received[1:], samples.obeyed[1:]
    errors = _commanded(log, samples, delay) - samples.applied[1:]
    named = samples.answer[:-1] == obeyed
    agrees = ~(np.abs(errors) > max(within, 1e-9))  # of our node both are the same multiple of one step
    reported = counted & (obeyed != UNKNOWN) & (obeyed != NO_COUNTER)
    errors = errors[counted & np.isfinite(errors)]
    limit = bench.limits.current
    squares = float(np.sum(np.clip(errors, -limit, limit) ** 2)) / max(len(errors), 1)
    return int((reported & ~(named & agrees)).sum()), squares


def _acted(log: RunLog, bench: Bench, samples: Samples, by_charge: Floats, delay: int, within: float) -> Floats:
    """Applied current in each period [A], shape (n,).

    By the report of the sample at its end, else by the charge, else the command, else the node's stop.
    """
    commanded, currents = _commanded(log, samples, delay), samples.applied[1:].copy()
    if within > 0.0:
        near = np.abs(commanded - currents) < within
        currents[near] = commanded[near]
    lost = np.flatnonzero(~samples.received[1:])
    charged = by_charge[lost + 1]
    currents[lost] = np.where(np.isnan(charged), commanded[lost], charged)
    unknown = np.flatnonzero(np.isnan(currents))
    if len(unknown):
        every = samples.velocity
        last = np.maximum.accumulate(np.where(np.isfinite(every), np.arange(len(every)), 0))
        currents[unknown] = _brakes(bench, every[last[unknown]])
    return currents


def _brakes(bench: Bench, velocity: Floats) -> Floats:
    """Current of the node's stop in a period without report and command [A]."""
    if bench.node.stop == "freewheel":
        return np.zeros(len(velocity))
    limit, damping_velocity = bench.limits.current, bench.node.damping_velocity
    return np.nan_to_num([damped_current(v, limit, damping_velocity) for v in velocity.tolist()])


def _start(log: RunLog, bench: Bench) -> tuple[float, float, float]:
    """Angle [rad], velocity [rad/s], and standard deviation of the angle [rad] before the experiment.

    The samples of a resting brake since the node was idle are averaged.
    """
    before: list[SensorSample] = samples_before(log, bench, REST_SAMPLES)
    resting = [sample for sample in before if sample.node_state == NodeState.IDLE] or before
    if not resting:
        return 0.0, 0.0, 0.0
    share = 1.0 / math.sqrt(len(resting))
    if abs(float(np.mean([sample.velocity for sample in resting]))) > REST_SIGMAS * share * bench.noise.velocity:
        return resting[-1].angle, resting[-1].velocity, 0.0
    return float(np.mean([sample.angle for sample in resting])), 0.0, share * bench.noise.angle


def currents_by_charge(samples: Samples, bench: Bench, layout: Layout) -> Floats:
    """Currents of the periods before single lost samples, from the charge of the samples on both sides.

    The step of the reported charge is that of the commands' current over a period: the rounding moves the brake by less
    than a thousandth of the sensors' noise.

    Returns:
        [A], NaN for every other period, shape (n,).
    """
    told = np.full(len(samples.angle), np.nan)
    if len(told) < 3:
        return told
    signal, received = layout.optional[CHARGE].signal("Charge"), samples.received
    wrap = (signal.raw_maximum + 1) * signal.factor
    alone = np.flatnonzero(~received[1:-1] & received[2:] & received[:-2]) + 1
    passed = (samples.charge[alone + 1] - samples.charge[alone - 1] + 0.5 * wrap) % wrap - 0.5 * wrap
    currents = passed / bench.timing.sample_time - samples.applied[alone + 1]
    possible = np.abs(currents) <= bench.limits.current + layout.command.signal("Current").factor
    told[alone] = np.where(possible, currents, np.nan)
    return told


def _lacks(count: int, due: int, lost: int, told: int, disagreements: int) -> dict[Lack, tuple[float, ...]]:
    found: dict[Lack, tuple[float, ...]] = {}
    if count < due:
        found[Lack.ENDS_EARLY] = count, due
    if told:
        found[Lack.LOST_WITH_CHARGE] = lost, told
    elif lost:
        found[Lack.LOST] = (lost,)
    if disagreements:
        found[Lack.CONTRADICTED] = (disagreements,)
    return found


class Samples(NamedTuple):
    """Samples of the experiment, as columns of shape (n,)."""

    angle: Floats  # [rad]
    velocity: Floats  # [rad/s]
    late: Floats  # Lateness after the grid, by the node's stamps [s]
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
    """One sample for each step from 0 to the last of the ``planned`` ones, received or not."""
    steps, buffers = bytearray(), [bytearray() for _ in LOST]  # thousands of small arrays would break up the memory
    for step, samples in control_cycles(log, bench, planned):
        steps += step.tobytes()
        for buffer, values in zip(buffers, samples, strict=True):
            buffer += np.asarray(values).tobytes()
    step = np.frombuffer(steps, np.int64)
    if not len(step) or step[-1] < 1:
        raise LogError(f"{log.path}: not one complete period of the experiment is in it")
    last = min(int(step[-1]), planned)
    inside = slice(None) if last == step[-1] else step <= last
    floats, counters = np.empty((6, last + 1)), np.empty((2, last + 1), np.int8)
    grid: list[Any] = [*floats, *counters]
    for column, lost in zip(grid, LOST, strict=True):
        column[:] = lost
        values = np.frombuffer(buffers.pop(0), column.dtype)
        column[step[inside]] = values[inside]  # of two samples of one step the later one counts
    return Samples(*grid)


def control_cycles(log: RunLog, bench: Bench, planned: int) -> Iterator[tuple[Integers, Samples]]:
    """Step and content of the samples in the control cycles, some at a time; errors as for :func:`samples_on_grid`."""
    layout, period_ns = log.layout, bench.timing.sample_time_ns
    log.require("/cycle", CycleRecord._fields)
    apart_ns = fresh_ns(layout.velocity)
    reports = _Reports(log, layout.velocity.name, "CommandCounter", UNKNOWN, apart_ns)
    charges = _Reports(log, CHARGE, "Charge", math.nan, apart_ns)
    active = last = 0
    origin_ns: Integers | None = None
    for part in log.batches("/cycle", reports.topic, charges.topic):
        obeyed, charge = reports.of_the_cycles(part), charges.of_the_cycles(part)
        inside = in_experiment(part["/cycle"])
        cycles = {name: column[inside] for name, column in part["/cycle"].items()}
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
        on_time = _measured(cycles, layout) & (np.rint(since_ns / period_ns) == steps)
        samples = (
            cycles["angle"],
            cycles["velocity"],
            (since_ns - steps * period_ns) * 1e-9,
            cycles["applied_current"],
            np.where(answered, quantised(cycles["sent_current"], log.drive), np.nan),
            charge[inside],
            _counters(obeyed[inside]),
            _counters(np.where(answered, cycles["command_counter"], UNKNOWN)),
        )
        yield steps[on_time], Samples(*(column[on_time] for column in samples))
    if not active:
        why = log.missing or f"it never became active ({log.exit_reason})"
        raise LogError(f"{log.path}: no experiment in this log: {why}")
    if not reports.found:
        raise LogError(f"{log.path}: the frames of the experiment are missing: the applied currents are not in it")


def _counters(values: NDArray[Any]) -> NDArray[np.int8]:
    """Counters in little memory; impossible ones become the first impossible value."""
    result: NDArray[np.int8] = np.clip(values, UNKNOWN, COUNTER_MODULUS + 1).astype(np.int8)
    return result


def in_experiment(cycles: Table) -> Booleans:
    """Mask of the control cycles that belong to the experiment."""
    inside: Booleans = (cycles["state"] == RunState.ACTIVE) & (cycles["step"] >= 0)
    return inside


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
    """The node's reports about the period before each sample, in a message with the counter of the sample.

    Two messages of a sample are at most ``apart_ns`` apart; ``unknown`` stands where no report came.
    """

    def __init__(self, log: RunLog, message: str, signal: str, unknown: float, apart_ns: int) -> None:
        self.topic = f"/emb/{message}"
        self.columns = ("Counter", signal)
        self._signal, self._unknown, self._apart_ns = signal, unknown, apart_ns
        self.found = False  # True after a report for any of the cycles
        if self.topic in log.topics:
            log.require(self.topic, self.columns)
        self._recent = dict.fromkeys((*self.columns, "publish_time"), np.empty(0, np.int64))

    def of_the_cycles(self, part: dict[str, Table]) -> NDArray[Any]:
        """The reports of each control cycle of a batch."""
        cycles = part["/cycle"]
        told = np.full(len(cycles["step"]), self._unknown)
        if self.topic not in part:
            return told
        reports = {name: np.concatenate([old, part[self.topic][name]]) for name, old in self._recent.items()}
        self._recent = {name: column[-_RECENT:] for name, column in reports.items()}
        before = np.searchsorted(reports["publish_time"], cycles["publish_time"], side="right")  # a file has any order
        remaining = np.arange(len(told))  # nearly always it is the last message before the cycle
        for back in range(1, _RECENT + 1):
            remaining = remaining[before[remaining] >= back]
            if not len(remaining):
                break
            at = before[remaining] - back
            apart_ns = np.abs(cycles["publish_time"][remaining] - reports["publish_time"][at])
            matches = (reports["Counter"][at] == cycles["counter"][remaining]) & (apart_ns <= self._apart_ns)
            told[remaining[matches]] = reports[self._signal][at[matches]]
            self.found |= bool(matches.any())
            remaining = remaining[~matches]
        return told


def samples_before(log: RunLog, bench: Bench, count: int) -> list[SensorSample]:
    """The last samples up to sample 0, ``count`` at most, by the frames before the experiment."""
    layout = log.layout
    frames: deque[Frame] = deque(maxlen=4 * count)
    device_time_ns = 0
    if "/can/rx" in log.topics:
        log.require("/can/rx", _FRAME)
    for part in log.batches("/can/rx", "/cycle"):
        cycles = part["/cycle"]
        first = np.flatnonzero(in_experiment(cycles))[:1]
        if "/can/rx" in part:
            end = int(cycles["publish_time"][first[0]]) if len(first) else None
            frames += _frames(part["/can/rx"], layout, end, 4 * count)
        if len(first):
            step, device_time_ns = (int(cycles[name][first[0]]) for name in ("step", "device_time_ns"))
            device_time_ns -= step * bench.timing.sample_time_ns
            break
    reception = Reception(layout, bench, lambda _frame, _why: None)
    samples = [sample for frame in frames if (sample := reception.add_frame(frame)) is not None]
    wrap_ns = layout.device_time_period_ns
    latest_ns = (wrap_ns + bench.timing.sample_time_ns) // 2  # half a period behind sample 0, in time that wraps
    return [s for s in samples if (s.device_time_ns - device_time_ns + wrap_ns // 2) % wrap_ns <= latest_ns][-count:]


def _frames(received: Table, layout: Layout, end: int | None, count: int) -> list[Frame]:
    """The last frames of samples up to a time in the log."""
    of_samples = np.isin(received["id"], (layout.angle.identifier, layout.velocity.identifier))
    if end is not None:
        of_samples &= received["publish_time"] <= end
    at = np.flatnonzero(of_samples)[-count:]
    rows = (received[name][at].tolist() for name in ("id", "data", "publish_time", "is_extended", "is_rtr", "is_error"))
    return [Frame(*row) for row in zip(*rows, strict=True)]


def step_of(measured: Measured) -> float:
    """Step of a measured signal [SI]; next to nothing for a floating-point number."""
    return measured.field.step(0.0) * abs(measured.factor)


def quantised(currents: Floats, drive: Mapping | None) -> Floats:
    """Currents of commands in the steps of the drive's message; of our node, unchanged [A]."""
    if drive is None or drive.command.field.is_float:
        return currents
    field, factor = drive.command.field, drive.command.factor
    with np.errstate(over="ignore"):  # a damaged log may contain anything
        steps: Floats = np.round((currents * factor - field.offset) / field.scale)
        return (steps * field.scale + field.offset) / factor


def match_tolerance(drive: Mapping | None, layout: Layout) -> float:
    """Largest distance from the report at which a command counts; 0 for our node, which reports exactly [A].

    Two quantisation steps: one between node and drive, one between drive and actuator.
    """
    if drive is None:
        return 0.0
    step = 0.0 if drive.current is None else step_of(drive.current)
    return 2.0 * step + layout.velocity.signal("AppliedCurrent").factor
