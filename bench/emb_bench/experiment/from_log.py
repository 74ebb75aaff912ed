"""The experiment inside a log: which current acted in which period, and what was measured at its end.

The node's own time stamps say which period is which. What acted is what the node reports at the period's end, which is
exact, also where commands act late: it obeys and reports currents in the steps of the CAN signal. A mapped drive
reports coarsely what acted: there it is the command as its bus carried it, where the report agrees.
"""

from __future__ import annotations

import math

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import LONGEST_DELAY
from emb_bench.experiment.cycles import UNKNOWN, Samples, match_tolerance, quantised, samples_before, samples_on_grid
from emb_bench.experiment.experiment import REST_SIGMAS, Experiment, Floats
from emb_bench.logs.log import RunLog
from emb_bench.numbers import in_samples
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import Layout
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.shield import damped_current

REST_SAMPLES = 50  # Most samples before the experiment from which the position at rest is taken

_DELAYS = range(LONGEST_DELAY + 1)  # Samples by which commands may act late


def read_experiment(log: RunLog, bench: Bench | None = None, name: str = "") -> Experiment:
    """The experiment in a log.

    Args:
        log: the log.
        bench: used where the log carries no bench file.
        name: what to call it; without, the log's file name.

    Raises:
        LogError: the log has no experiment, or none of which a whole period is left, or contradicts itself.
    """
    bench = log.bench if "bench.toml" in log.attachments or bench is None else bench
    planned = _planned(log, bench)
    samples = samples_on_grid(log, bench, planned)
    received, within = samples.received, match_tolerance(log.drive, log.layout)
    counted = received[1:]
    by_charge = currents_by_charge(samples, bench, log.layout)
    wrong, squares = zip(*(_disagreements(log, bench, samples, delay, within) for delay in _DELAYS), strict=True)
    # A mapped drive does not say which command it obeys.
    delay = int(np.argmin(wrong if log.drive_files is None else squares))
    periods, lost = len(counted), int((~counted).sum())
    currents = _acted(log, bench, samples, by_charge, delay, within)
    angle, velocity, slack = _start(log, bench, samples)
    reported = counted | np.isfinite(by_charge[1:])
    told = int(np.isfinite(by_charge).sum())
    return Experiment(
        name=name or log.path.name,
        currents=currents,
        samples=np.stack([samples.angle[1:], samples.velocity[1:]], axis=1),
        angle=angle,
        velocity=velocity,
        slack=slack,
        from_origin=velocity == 0.0 and abs(angle) <= REST_SIGMAS * slack,
        late=samples.late[1:].copy(),  # a view would keep all columns
        assumed=None if reported.all() else np.where(reported, np.nan, currents),
        first=(float(samples.angle[0]), float(samples.velocity[0])),
        planned=planned,
        braked=int((counted & (samples.obeyed[1:] == NO_COUNTER)).sum()),
        command_delay=delay,
        missing=(*log.lacks, *_missing(periods, _due(log, periods, planned), lost, told, wrong[delay])),
        notes=_notes(log, delay, within),
    )


def _planned(log: RunLog, bench: Bench) -> int:
    steps = log.run.get("steps", "")
    return int(steps) if steps.isdecimal() and len(steps) < 16 else bench.timing.horizon


def _due(log: RunLog, count: int, planned: int) -> int:
    """Periods that the run had to have: all that it had, where it was over because enough was known."""
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

    The one to act is that of the command of ``delay`` samples before.
    What the node does where no command came in time is its own affair.

    Args:
        log: the log.
        bench: the limit of the current.
        samples: on the grid.
        delay: samples by which commands act late.
        within: distance that is no disagreement, of a mapped drive [A].

    Returns:
        Their number, and the mean square of the differences of the currents [A²].
    """
    counted, obeyed = samples.received[1:], samples.obeyed[1:]
    errors = _commanded(log, samples, delay) - samples.applied[1:]
    named = samples.answer[:-1] == obeyed
    agrees = ~(np.abs(errors) > max(within, 1e-9))  # of our own node both currents are the same multiple of one step
    reported = counted & (obeyed != UNKNOWN) & (obeyed != NO_COUNTER)
    errors = errors[counted & np.isfinite(errors)]
    limit = bench.limits.current
    squares = float(np.sum(np.clip(errors, -limit, limit) ** 2)) / max(len(errors), 1)
    return int((reported & ~(named & agrees)).sum()), squares


def _acted(log: RunLog, bench: Bench, samples: Samples, by_charge: Floats, delay: int, within: float) -> Floats:
    """Current that acted in each period [A], shape (n,).

    By the report of the sample at its end, else by the charge, else the command, else the node's own stop.
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
    """Current of the node's own stop in a period without report and without known command [A]."""
    if bench.node.stop == "freewheel":
        return np.zeros(len(velocity))
    limit, damping_velocity = bench.limits.current, bench.node.damping_velocity
    return np.nan_to_num([damped_current(v, limit, damping_velocity) for v in velocity.tolist()])


def _start(log: RunLog, bench: Bench, samples: Samples) -> tuple[float, float, float]:
    """Angle [rad], velocity [rad/s], and standard deviation of the angle [rad] before the experiment.

    A resting brake has rested since the node was idle: its samples are averaged.
    """
    if log.imported:  # nothing is known before the first sample
        return float(samples.angle[0]), float(samples.velocity[0]), 0.0
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

    The charge is reported in steps of the current over a period, so that such a current is known to the step that
    commands have: the rounding moves the brake by less than a thousandth of the sensors' noise.

    Args:
        samples: on the grid, shape (n,).
        bench: sample time, and the limit of what can have acted.
        layout: the bus layout, which says where the charge wraps.

    Returns:
        [A], NaN for every other period, shape (n,).
    """
    told = np.full(len(samples.angle), np.nan)
    if layout.charge is None or len(told) < 3:
        return told
    signal, received = layout.charge.signal("Charge"), samples.received
    wrap = (signal.raw_maximum + 1) * signal.factor
    alone = np.flatnonzero(~received[1:-1] & received[2:] & received[:-2]) + 1
    passed = (samples.charge[alone + 1] - samples.charge[alone - 1] + 0.5 * wrap) % wrap - 0.5 * wrap
    currents = passed / bench.timing.sample_time - samples.applied[alone + 1]
    possible = np.abs(currents) <= bench.limits.current + layout.command.signal("Current").factor
    told[alone] = np.where(possible, currents, np.nan)
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
