"""The experiment inside a log: which current acted in which period, and what was measured at its end.

The node's own time stamps say which period is which. What acted is what the node reports at the period's end, which is
exact, also where commands act late: it obeys and reports currents in the steps of the CAN signal. The frames are taken
as the run took them (:mod:`emb_bench.experiment.decoded`), so that a sample is one here exactly if it was one there.

A log is gone through twice: first for where the experiment begins, how long it is and what is missing of it, then for
its periods. Of a long one nothing is kept from one batch to the next but what the next one needs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np

from emb_bench.experiment.decoded import RECENT, Samples, Taken, replayed
from emb_bench.experiment.info import PIECE, Booleans, Experiment, ExperimentInfo, Floats, Integers, Piece, Rest
from emb_bench.experiment.model_evaluator import Fit, Passage, later
from emb_bench.logs.log import RunLog
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.config.bench import Bench, BrakeParameters
from emb_runtime.config.plants import LONGEST_DELAY, Plant
from emb_runtime.errors import LogError
from emb_runtime.records import CycleRecord, NodeState, RunState
from emb_runtime.safety.shield import damped_current

__all__ = [
    "Experiment",
    "ExperimentInfo",
    "Fit",
    "Piece",
    "Recording",
    "Rest",
    "fit",
    "later",
    "open_experiment",
    "read_experiment",
]

REST_SAMPLES = 50
"""Most samples before the experiment that say where the brake rested."""
REST_SIGMAS = 4.0
"""A mean that lies this near to zero, in its own standard deviations, is taken as zero: the origin, at rest."""
SPARSEST = 1000
"""Periods for each control cycle in the log: one that claims more says what no damage explains."""

_LEAD = LONGEST_DELAY + 1
"""Samples before the first one whose commands may still act."""
_STEP, _STATE, _WHEN = "step", "state", "receive_time_ns"


class _Grid(NamedTuple):
    """Where the experiment lies in time."""

    origin_ns: int
    """Device time of sample 0 [ns]."""
    period_ns: int
    periods: int

    def steps(self, samples: Samples) -> Integers:
        """Which sample of the grid each one is: none of them before the one before it."""
        result: Integers = np.rint((samples.device_time_ns - self.origin_ns) / self.period_ns).astype(np.int64)
        return result


class _Rows(NamedTuple):
    """Samples of the grid that follow each other, whether received or not, and what answered each of them."""

    first: int
    """Step of the first of them."""
    seen: Booleans
    angle: Floats
    velocity: Floats
    device_time_ns: Integers
    applied: Floats
    reported: Integers
    """Counter of the command that acted before the sample, as the node reports."""
    answer: Integers
    """Counter of the command that answers the sample; -1 if none does."""
    asked: Floats
    """Its current [A]; NaN if none does."""


@dataclass(frozen=True, eq=False)
class Recording(ExperimentInfo):
    """The experiment in a log, read anew each time its periods are asked for."""

    log: RunLog = field(repr=False)
    bench: Bench = field(repr=False)
    grid: _Grid
    kept: tuple[_Rows, ...] | None = field(repr=False)
    """All samples on the grid, if that is not much."""
    start: tuple[float, float]
    """Angle and velocity measured at sample 0, NaN if it was lost."""
    start_time_ns: int
    """The node's own time of it since where the grid has it."""

    def pieces(self) -> Iterator[Piece]:
        """All periods in their order, at most ``PIECE`` at a time."""
        asked, last = np.full(_LEAD, np.nan), math.nan
        for rows in self.kept or _rows(self.grid, replayed(self.log, self.bench)):
            reach = np.concatenate([asked, rows.asked])
            asked = reach[-_LEAD:]
            begin = max(0, 1 - rows.first)  # what ends at sample 0 or before is no period
            acts = reach[_LEAD - 1 - self.command_delay :][: len(rows.seen)]
            currents = np.where(rows.seen, rows.applied, acts)
            own = np.flatnonzero(np.isnan(currents))
            velocity = np.where(np.arange(len(rows.seen)) + rows.first >= 0, rows.velocity, np.nan)
            if len(own):
                currents[own] = _brakes(self.bench, _last_seen(velocity, last)[own])
            last = float(_last_seen(velocity, last)[-1])
            columns: Any = (currents, rows.seen, rows.angle, rows.velocity, rows.device_time_ns)
            if begin < len(rows.seen):
                yield Piece(*(column[begin:] for column in columns))


def open_experiment(log: RunLog, bench: Bench | None = None) -> Recording:
    """Find the experiment in a log of any length.

    Args:
        log: the log.
        bench: used where the log carries no bench file.

    Raises:
        LogError: the log has no experiment, or none of which a whole period is left, or contradicts itself.
    """
    bench = log.bench if "bench.toml" in log.attachments or bench is None else bench
    taken = tuple(replayed(log, bench)) if log.contents.is_short else None
    planned = _planned(log, bench)
    grid = _grid(log, bench, planned, taken or replayed(log, bench))
    seen = braked = 0
    wrong = np.zeros(LONGEST_DELAY + 1, np.int64)
    answer, asked = np.full(_LEAD, -1), np.full(_LEAD, np.nan)
    start, start_time_ns = (math.nan, math.nan), 0
    rest = _Before(grid)
    kept = None if taken is None else tuple(_rows(grid, rest.watched(taken)))
    for rows in kept or _rows(grid, rest.watched(replayed(log, bench))):
        answer, asked = np.concatenate([answer, rows.answer]), np.concatenate([asked, rows.asked])
        counted = rows.seen & (np.arange(len(rows.seen)) + rows.first >= 1)
        seen += int(counted.sum())
        braked += int((counted & (rows.reported == NO_COUNTER)).sum())
        wrong += _disagreements(rows, counted, answer, asked)
        answer, asked = answer[-_LEAD:], asked[-_LEAD:]
        if 0 <= -rows.first < len(rows.seen) and rows.seen[-rows.first]:
            start = (float(rows.angle[-rows.first]), float(rows.velocity[-rows.first]))
            start_time_ns = int(rows.device_time_ns[-rows.first])
    delay = int(np.argmin(wrong))
    return Recording(
        planned=planned,
        periods=grid.periods,
        samples=seen,
        braked=braked,
        before=_rest(rest.samples, bench),
        command_delay=delay,
        missing=tuple(_missing(grid.periods, _due(log, grid.periods, planned), grid.periods - seen, int(wrong[delay]))),
        log=log,
        bench=bench,
        grid=grid,
        kept=kept,
        start=start,
        start_time_ns=start_time_ns,
    )


def read_experiment(log: RunLog, bench: Bench | None = None) -> Experiment:
    """Find the experiment in a log, and take all of it into memory: 34 bytes for each period.

    Args:
        log: the log.
        bench: used where the log carries no bench file.

    Raises:
        LogError: the log has no experiment, or none of which a whole period is left, or contradicts itself.
    """
    found = open_experiment(log, bench)
    currents, measured, angle, velocity, device_time_ns = map(np.concatenate, zip(*found.pieces(), strict=True))
    return Experiment(
        **{entry.name: getattr(found, entry.name) for entry in fields(ExperimentInfo)},
        currents=currents,
        known=measured.copy(),
        measured=measured,
        angle=np.concatenate([[found.start[0]], angle]),
        velocity=np.concatenate([[found.start[1]], velocity]),
        device_time_ns=np.concatenate([[found.start_time_ns], device_time_ns]),
    )


def fit(experiment: ExperimentInfo, bench: Bench, theta: BrakeParameters, plant: Plant) -> Fit:
    """Compare what was measured with what a plant's instruments would show of it under the same currents.

    Args:
        experiment: what acted and what was measured.
        bench: its noise and sample time.
        theta: the brake's parameters.
        plant: how it moves, and what lies between it and the bus.
    """
    x0 = experiment.x0(plant.instruments.encoder_offset)
    passage = Passage(bench, plant, theta, x0, periods=experiment.periods)
    for piece in experiment.pieces():
        passage.take(piece)
    return passage.fit


def _planned(log: RunLog, bench: Bench) -> int:
    said = log.run.get("steps", "")
    return int(said) if said.isdecimal() and len(said) < 16 else bench.timing.horizon


def _grid(log: RunLog, bench: Bench, planned: int, taken: Iterable[Taken]) -> _Grid:
    """Find the experiment in the control cycles, and sample 0 through the first cycle whose sample is left."""
    log.require("/cycle", CycleRecord._fields)
    parts = log.batches({"/cycle": (_STEP, _STATE, _WHEN)})
    active = count = 0
    samples, origin_ns, last = Samples.none(), None, 0
    period_ns, recent = bench.timing.sample_time_ns, iter(taken)
    for part in parts:
        cycles = part["/cycle"]
        chosen = (cycles[_STATE] == RunState.ACTIVE) & (cycles[_STEP] >= 0)
        steps, when = cycles[_STEP][chosen], cycles[_WHEN][chosen]
        if origin_ns is None:
            new = next(recent).samples
            # The frames of a batch's first cycle may be in the batch before.
            origin_ns = _origin(Samples.joined(samples, new), steps, when, period_ns)
            samples = new
        if len(steps):
            if (np.diff(steps, prepend=last) < 0).any():
                raise LogError(f"{log.path}: the steps of the control cycles go back: this is not one run")
            last = int(steps[-1])
            active, count = active + len(steps), last
    if not active:
        raise LogError(
            f"{log.path}: no experiment in this log: {log.missing or f'it never became active ({log.exit_reason})'}"
        )
    if count < 1:
        raise LogError(f"{log.path}: not one whole period of the experiment is left")
    if active > planned + 1 or count > SPARSEST * active:
        raise LogError(
            f"{log.path}: {active} control cycles of an experiment of {planned} periods claim that it had {count}"
        )
    if origin_ns is None:
        raise LogError(f"{log.path}: the frames of the experiment are missing: what acted is not known")
    # The closing sample lies beyond the last period where the one that was due had been lost.
    return _Grid(origin_ns, period_ns, min(count, planned))


def _origin(samples: Samples, steps: Integers, when: Integers, period_ns: int) -> int | None:
    """Device time of sample 0 [ns], from the first cycle whose sample is among these."""
    for k in np.flatnonzero(np.isin(when, samples.receive_time_ns))[:1].tolist():
        sample = np.flatnonzero(samples.receive_time_ns == when[k])[-1]
        return int(samples.device_time_ns[sample]) - int(steps[k]) * period_ns
    return None


class _Before:
    """Keeps the last samples up to sample 0 while all of them pass."""

    def __init__(self, grid: _Grid) -> None:
        self._grid = grid
        self.samples = Samples.none()

    def watched(self, taken: Iterable[Taken]) -> Iterator[Taken]:
        """The same, looked at."""
        for each in taken:
            early = each.samples.part(self._grid.steps(each.samples) <= 0)
            if len(early.counter):
                self.samples = Samples.joined(self.samples, early).part(slice(-REST_SAMPLES, None))
            yield each


def _rows(grid: _Grid, taken: Iterable[Taken]) -> Iterator[_Rows]:
    """The samples on the grid from step ``-_LEAD`` to the last one, at most ``PIECE`` at a time.

    A sample is given out when no command can answer it any more.
    """
    held, answer, asked = Samples.none(), np.empty(0, np.int64), np.empty(0)
    first, step = 0, -_LEAD
    for samples, commands in taken:
        held = Samples.joined(held, samples)
        new = len(samples.counter)
        answer, asked = np.concatenate([answer, np.full(new, -1)]), np.concatenate([asked, np.full(new, np.nan)])
        which = commands.answered - first
        answer[which], asked[which] = commands.counter, commands.current
        steps = grid.steps(held)
        if len(steps) <= RECENT:
            continue
        # Of two samples of one step the later one counts, so that both have to be there.
        end = min(int(steps[-RECENT]), grid.periods + 1)
        yield from _spread(grid, step, end, steps, held, answer, asked)
        step, given = max(step, end), int(np.searchsorted(steps, steps[-RECENT]))
        held, answer, asked, first = held.part(slice(given, None)), answer[given:], asked[given:], first + given
    yield from _spread(grid, step, grid.periods + 1, grid.steps(held), held, answer, asked)


def _spread(
    grid: _Grid, begin: int, end: int, steps: Integers, held: Samples, answer: Integers, asked: Floats
) -> Iterator[_Rows]:
    """Samples of the steps from ``begin`` up to ``end``."""
    for first in range(begin, end, PIECE):
        size = min(PIECE, end - first)
        low, high = np.searchsorted(steps, [first, first + size])
        part, at, replies = held.part(slice(low, high)), steps[low:high] - first, answer[low:high] >= 0
        nan = np.full(size, np.nan)
        rows = _Rows(
            first,
            np.zeros(size, np.bool_),
            nan,
            nan.copy(),
            np.arange(first, first + size) * grid.period_ns,
            nan.copy(),
            np.full(size, NO_COUNTER),
            np.full(size, -1),
            nan.copy(),
        )
        rows.seen[at] = True
        rows.angle[at], rows.velocity[at], rows.applied[at] = part.angle, part.velocity, part.applied_current
        rows.device_time_ns[at], rows.reported[at] = part.device_time_ns - grid.origin_ns, part.command_counter
        rows.answer[at[replies]], rows.asked[at[replies]] = answer[low:high][replies], asked[low:high][replies]
        yield rows


def _last_seen(velocity: Floats, before: float) -> Floats:
    """For each sample the last velocity that was seen before it, and one more for what follows."""
    every = np.concatenate([[before], velocity])
    index = np.maximum.accumulate(np.where(np.isfinite(every), np.arange(len(every)), 0))
    result: Floats = every[index]
    return result


def _brakes(bench: Bench, velocity: Floats) -> Floats:
    """What the node does by itself in a period whose report is missing, and for which no command is known."""
    if bench.node.stop == "freewheel":
        return np.zeros(len(velocity))
    limit, damping_velocity = bench.limits.current, bench.node.damping_velocity
    return np.nan_to_num([damped_current(v, limit, damping_velocity) for v in velocity.tolist()])


def _rest(before: Samples, bench: Bench) -> Rest:
    """Where the brake was. One that rests has rested since the node was idle, so its samples are averaged."""
    idle = before.node_state == NodeState.IDLE
    rest = before.part(idle) if idle.any() else before
    if not len(rest.counter):
        return Rest(0.0, 0.0, 0.0)
    slack = REST_SIGMAS / math.sqrt(len(rest.counter))
    if abs(float(np.mean(rest.velocity))) > slack * bench.noise.velocity:
        return Rest(float(rest.angle[-1]), float(rest.velocity[-1]), 0.0)
    return Rest(float(np.mean(rest.angle)), 0.0, slack * bench.noise.angle)


def _disagreements(rows: _Rows, counted: Booleans, answer: Integers, asked: Floats) -> Integers:
    """Periods whose report does not name the command that was sent for them, or another current than the one to act.

    That is the command of some periods before. What the node does where there was none is its own affair.

    Args:
        rows: samples.
        counted: those that are reports of a period.
        answer: counters of the commands that answered them, and of the ``_LEAD`` ones before.
        asked: their currents [A].

    Returns:
        How many, for each delay from none to the longest, shape (LONGEST_DELAY + 1,).
    """
    size = len(rows.seen)
    reported = counted & (rows.reported != NO_COUNTER)
    obeyed = answer[_LEAD - 1 :][:size] == rows.reported
    wrong = np.zeros(LONGEST_DELAY + 1, np.int64)
    for delay in range(LONGEST_DELAY + 1):
        acts = asked[_LEAD - 1 - delay :][:size]
        # Both currents are the same multiple of one step.
        agrees = np.isnan(acts) | (np.abs(acts - rows.applied) <= 1e-9)
        wrong[delay] = (reported & ~(obeyed & agrees)).sum()
    return wrong


def _due(log: RunLog, count: int, planned: int) -> int:
    """Periods that the run had to have: all that it had, where it was over because enough was known."""
    over = {"exit_reason": "DONE", "goal_reached": "True"}
    return count if over.items() <= log.end.items() else planned


def _missing(count: int, planned: int, lost: int, disagreements: int) -> list[str]:
    missing = []
    if count < planned:
        missing.append(f"the experiment ends after {count} of {planned} samples")
    if lost:
        missing.append(
            f"{lost} samples were lost: they count for no information, and what acted in the periods before them is "
            "taken from the commands, or from the node's braking where there was none"
        )
    if disagreements:
        missing.append(f"in {disagreements} periods the node reports another current than the command says")
    return missing
