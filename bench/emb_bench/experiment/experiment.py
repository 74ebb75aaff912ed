"""The experiment inside a log: which current acted in which period, and what was measured at its end.

The node's own time stamps say which period is which. What acted is what the node reports at the period's end, which is
exact, also where commands act late: it obeys and reports currents in the steps of the CAN signal. A mapped drive tells
coarsely what acted: there it is the command as its bus carried it, where what was told agrees.

A log is gone through twice: first for how long the experiment is and what is missing of it, then for its periods. Of a
long one nothing is kept from one batch to the next but what the next one needs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from emb_bench.experiment.cycles import UNKNOWN, Samples, samples_before, samples_on_grid
from emb_bench.experiment.drive_steps import carried, told_within
from emb_bench.experiment.info import Booleans, Experiment, ExperimentInfo, Floats, Integers, Piece, Rest
from emb_bench.experiment.model_evaluator import Fit, ModelEvaluator
from emb_bench.logs.log import RunLog
from emb_bench.numbers import in_samples
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Bench, BrakeParameters
from emb_runtime.config.plants import LONGEST_DELAY, Plant
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.shield import damped_current

REST_SAMPLES = 50  # Most samples before the experiment from which the position at rest is taken
REST_SIGMAS = 4.0
"""A mean that lies this near to zero, in its own standard deviations, is taken as zero: the origin, at rest."""

_LEAD = LONGEST_DELAY + 1  # Samples before the first one whose commands may still act


@dataclass(frozen=True, eq=False)
class Recording(ExperimentInfo):
    """The experiment in a log, read anew each time its periods are requested."""

    log: RunLog = field(repr=False)
    bench: Bench = field(repr=False)
    kept: tuple[Samples, ...] | None = field(repr=False)  # All samples, if the log is short
    within: float = field(repr=False)  # A command nearer than this to what was told of its period is what acted [A]

    def on_grid(self) -> Iterator[Samples]:
        """All samples on the grid, some thousand at a time."""
        return samples_on_grid(self.log, self.bench, self.planned) if self.kept is None else iter(self.kept)

    def pieces(self) -> Iterator[Piece]:
        """All periods in their order, some thousand at a time."""
        sent, last = _before(self.log), math.nan
        for samples in self.on_grid():
            history = np.concatenate([sent, samples.sent])
            sent = history[-_LEAD:]
            commanded = history[_LEAD - 1 - self.command_delay :][: len(samples.step)]
            told = currents_by_charge(samples, self.bench, self.log.layout)
            applied = np.where(np.abs(commanded - samples.applied) < self.within, commanded, samples.applied)
            currents = np.where(samples.received, applied, np.where(np.isnan(told), commanded, told))
            velocity = _last_received(samples.velocity, last)
            unknown = np.flatnonzero(np.isnan(currents))
            currents[unknown] = _brakes(self.bench, velocity[unknown])
            last = float(velocity[-1])
            reported = samples.received | np.isfinite(told)
            columns: tuple[Any, ...] = currents, samples.received, samples.angle, samples.velocity
            columns += samples.device_time_ns, reported
            periods = samples.step >= 1  # what ends at sample 0 is no period
            if periods.any():
                yield Piece(*(column[periods] for column in columns))


def open_experiment(log: RunLog, bench: Bench | None = None) -> Recording:
    """Find the experiment in a log of any length.

    Args:
        log: the log.
        bench: used where the log carries no bench file.

    Raises:
        LogError: the log has no experiment, or none of which a whole period is left, or contradicts itself.
    """
    bench = log.bench if "bench.toml" in log.attachments or bench is None else bench
    planned = _planned(log, bench)
    kept = tuple(samples_on_grid(log, bench, planned)) if log.contents.is_short else None
    received = braked = last = told = 0
    within = told_within(log.drive, log.layout)
    wrong = np.zeros(LONGEST_DELAY + 1, np.int64)
    squares, compared = np.zeros((2, LONGEST_DELAY + 1))
    answer, sent = np.full(_LEAD, UNKNOWN), _before(log)
    for samples in kept or samples_on_grid(log, bench, planned):
        answer, sent = np.concatenate([answer, samples.answer]), np.concatenate([sent, samples.sent])
        counted = samples.received & (samples.step >= 1)
        received += int(counted.sum())
        told += int(np.isfinite(currents_by_charge(samples, bench, log.layout)).sum())
        braked += int((counted & (samples.obeyed == NO_COUNTER)).sum())
        errors = _errors(samples, sent)
        wrong += _disagreements(samples, counted, answer, errors, within)
        squares += np.nansum(np.clip(errors[:, counted], -bench.limits.current, bench.limits.current) ** 2, axis=1)
        compared += np.isfinite(errors[:, counted]).sum(axis=1)
        answer, sent, last = answer[-_LEAD:], sent[-_LEAD:], int(samples.step[-1])
    # A mapped drive does not say which command it obeys.
    delay = int(np.argmin(wrong if log.drive_files is None else squares / np.maximum(compared, 1.0)))
    return Recording(
        planned=planned,
        periods=last,
        samples=received,
        braked=braked,
        before=_first(log, bench, planned, kept)
        if log.imported
        else _rest(samples_before(log, bench, REST_SAMPLES), bench),
        command_delay=delay,
        missing=(*log.lacks, *_missing(last, _due(log, last, planned), last - received, told, int(wrong[delay]))),
        notes=_notes(log, delay, within),
        log=log,
        bench=bench,
        kept=kept,
        within=within,
    )


def read_experiment(log: RunLog, bench: Bench | None = None) -> Experiment:
    """Find the experiment in a log, and take all of it into memory: 33 bytes for each period.

    Args:
        log: the log.
        bench: used where the log carries no bench file.

    Raises:
        LogError: the log has no experiment, or none of which a whole period is left, or contradicts itself.
    """
    found = open_experiment(log, bench)
    first = next(found.on_grid())
    currents, measured, angle, velocity, device_time_ns, reported = map(
        np.concatenate, zip(*found.pieces(), strict=True)
    )
    return Experiment(
        **{entry.name: getattr(found, entry.name) for entry in fields(ExperimentInfo)},
        currents=currents,
        measured=measured,
        angle=np.concatenate([first.angle[:1], angle]),
        velocity=np.concatenate([first.velocity[:1], velocity]),
        device_time_ns=np.concatenate([first.device_time_ns[:1], device_time_ns]),
        reported=reported,
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
    evaluator = ModelEvaluator(bench, plant, theta, x0, periods=experiment.periods)
    for piece in experiment.pieces():
        evaluator.take(piece)
    return evaluator.fit


def _planned(log: RunLog, bench: Bench) -> int:
    steps = log.run.get("steps", "")
    return int(steps) if steps.isdecimal() and len(steps) < 16 else bench.timing.horizon


def _last_received(velocity: Floats, before: float) -> Floats:
    """The last velocity that was received before each sample, and before the one that follows, shape (n + 1,)."""
    every = np.concatenate([[before], velocity])
    index = np.maximum.accumulate(np.where(np.isfinite(every), np.arange(len(every)), 0))
    result: Floats = every[index]
    return result


def _brakes(bench: Bench, velocity: Floats) -> Floats:
    """Current of the node's own stop in a period without report and without known command [A]."""
    if bench.node.stop == "freewheel":
        return np.zeros(len(velocity))
    limit, damping_velocity = bench.limits.current, bench.node.damping_velocity
    return np.nan_to_num([damped_current(v, limit, damping_velocity) for v in velocity.tolist()])


def _first(log: RunLog, bench: Bench, planned: int, kept: tuple[Samples, ...] | None) -> Rest:
    """State at the first sample of an imported recording, of which nothing is known before."""
    first = next(iter(kept or samples_on_grid(log, bench, planned)))
    return Rest(float(first.angle[0]), float(first.velocity[0]), 0.0)


def _rest(before: list[SensorSample], bench: Bench) -> Rest:
    """State before the experiment. A resting brake has rested since the node was idle: its samples are averaged."""
    resting = [sample for sample in before if sample.node_state == NodeState.IDLE] or before
    if not resting:
        return Rest(0.0, 0.0, 0.0)
    slack = REST_SIGMAS / math.sqrt(len(resting))
    if abs(float(np.mean([sample.velocity for sample in resting]))) > slack * bench.noise.velocity:
        return Rest(resting[-1].angle, resting[-1].velocity, 0.0)
    return Rest(float(np.mean([sample.angle for sample in resting])), 0.0, slack * bench.noise.angle)


def _before(log: RunLog) -> Floats:
    """Currents of the commands before sample 0: a mapped drive has 0 A, as its bus carries it [A], shape (_LEAD,)."""
    return np.full(_LEAD, math.nan) if log.drive_files is None else carried(np.zeros(_LEAD), log.drive)


def _errors(samples: Samples, sent: Floats) -> Floats:
    """Currents of the commands of some periods before, less what was told [A], shape (LONGEST_DELAY + 1, n).

    Args:
        samples: samples on the grid, n of them.
        sent: currents of the commands that were sent for them, and for the ``_LEAD`` samples before [A].
    """
    commanded = [sent[_LEAD - 1 - delay :][: len(samples.step)] for delay in range(LONGEST_DELAY + 1)]
    return np.stack(commanded) - samples.applied


def _disagreements(samples: Samples, counted: Booleans, answer: Integers, errors: Floats, within: float) -> Integers:
    """Periods whose report does not name the command that was sent for them, or another current than the one to act.

    That is the command of some periods before. What the node does where there was none is its own affair.

    Args:
        samples: samples on the grid.
        counted: those that are reports of a period.
        answer: counters of the commands that were sent for them, and for the ``_LEAD`` samples before.
        errors: from :func:`_errors` [A].
        within: distance that is no disagreement, of a mapped drive [A].

    Returns:
        Their number, for each delay from none to the longest, shape (LONGEST_DELAY + 1,).
    """
    reported = counted & (samples.obeyed != UNKNOWN) & (samples.obeyed != NO_COUNTER)
    named = answer[_LEAD - 1 :][: len(samples.step)] == samples.obeyed
    agrees = ~(np.abs(errors) > max(within, 1e-9))  # of our own node both currents are the same multiple of one step
    wrong: Integers = (reported & ~(named & agrees)).sum(axis=1)
    return wrong


def _due(log: RunLog, count: int, planned: int) -> int:
    """Periods that the run had to have: all that it had, where it was over because enough was known."""
    over = {"exit_reason": "DONE", "goal_reached": "True"}
    return count if over.items() <= log.end.items() else planned


def currents_by_charge(samples: Samples, bench: Bench, layout: Layout) -> Floats:
    """Currents of the periods before single lost samples, from the charge of the samples on both sides.

    The charge is reported in steps of the current over a period, so that such a current is known to the step that
    commands have: the rounding moves the brake by less than a thousandth of the sensors' noise.

    Args:
        samples: on the grid, shape (n,).
        bench: sample time, and the limit of what can have acted.
        layout: the bus layout, which says where the charge wraps.

    Returns:
        [A], NaN for every other period, shape (n,).
    """
    told = np.full(len(samples.step), np.nan)
    if layout.charge is None or len(told) < 3:
        return told
    signal, received = layout.charge.signal("Charge"), samples.received
    wrap = (signal.raw_maximum + 1) * signal.step
    passed = (samples.charge[2:] - samples.charge[:-2] + 0.5 * wrap) % wrap - 0.5 * wrap
    currents = passed / bench.timing.sample_time - samples.applied[2:]
    alone = ~received[1:-1] & received[2:] & received[:-2]
    possible = np.abs(currents) <= bench.limits.current + layout.command.signal("Current").factor
    told[1:-1] = np.where(alone & possible, currents, np.nan)
    return told


def _notes(log: RunLog, late: int, within: float) -> tuple[str, ...]:
    if log.drive_files is None:
        return ()
    if log.drive is None:
        return ("the drive's mapping is not readable: what acted is taken to be what the drive told",)
    return (
        f"what acted is taken to be the command as its bus carried it, {in_samples(late)} late, where what the drive "
        f"told lies within {within:.3g} A of it, and elsewhere what the drive told",
    )


def _missing(count: int, planned: int, lost: int, told: int, disagreements: int) -> list[str]:
    missing = []
    if count < planned:
        missing.append(f"the experiment ends after {count} of {planned} samples")
    if lost:
        missing.append(
            f"{lost} samples were lost: they count for no information, and what acted in the periods before them was "
            "not reported" + (f"; of {told} periods the charge tells it" if told else "")
        )
    if disagreements:
        missing.append(f"in {disagreements} periods the node reports another current than the command says")
    return missing
