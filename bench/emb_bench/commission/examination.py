"""Examination of a commissioning's logs: noise, clock, latency, signs, and parameters with their intervals."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from emb_bench.analysis.conclusion import noise_deviations
from emb_bench.analysis.model_choice import fit_from
from emb_bench.analysis.model_growth import grow_model
from emb_bench.brake.parameters import FEATURES, least
from emb_bench.commission.records import CurrentCheck, FirstMove, Identification, Velocity
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, Instruments, Mechanics, Plant
from emb_bench.estimate.derived_velocity import derived
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import NORMAL_95, EstimationProblem
from emb_bench.experiment.experiment import Booleans, Experiment, Floats
from emb_bench.experiment.from_log import read_experiment, step_of
from emb_bench.logs.log import RunLog, read_log
from emb_bench.report.sentences import alarms
from emb_runtime.config.bench import PARAMETER_NAMES, Noise
from emb_runtime.drives.mapping import Mapping as DriveMapping
from emb_runtime.errors import LogError

LONGEST = 2  # Samples by which measurements may come late, at most, that are looked for
FEWEST = 300  # Least number of samples at rest for an estimate of the noise
STARTS = 3  # Local searches of a model
MOVING = 6.0  # Standard deviations of the velocity from which on the brake moves
SMOOTHED = 10  # Samples of a mean in which a motion shows, and noise counts a third
QUIET_ANGLE, QUIET_VELOCITY = 1e-5, 1e-2
"""Least standard deviations that are taken, of the order of the wire's rounding [rad, rad/s]."""
MARGIN = 0.94  # Written bandwidth of an observer, over the least one that cannot be excluded
LAGS_NO_LESS = 3.0  # Bandwidth times sample time beyond which no observer lags less
UNIFORM = math.sqrt(1.0 / 12.0)  # Standard deviation of an error that may be anything within a step, in steps


def completed(path: Path) -> RunLog | None:
    """The complete log of a run that came to its planned end, and that has samples enough if it listened; or None."""
    try:
        log = read_log(path)
    except LogError:
        return None
    listened = json.loads(log.end.get("heard", "null"))
    is_done = log.complete and log.exit_reason == "DONE"
    return log if is_done and (listened is None or listened.get("scatter", {}).get("pairs", 0) >= FEWEST) else None


def noise_at_rest(log: RunLog, sheet: Bench) -> Noise:
    """Noise of the samples while the brake rests, as the run that listened has it, standard deviations.

    A drive's signal in steps that are coarser than the noise does not show it: that counts as the data sheet's.
    """
    scatter = json.loads(log.end["heard"])["scatter"]
    angle, velocity = max(scatter["angle"], QUIET_ANGLE), max(scatter["velocity"], QUIET_VELOCITY)
    angle_step, velocity_step = _steps(log.drive)
    return Noise(
        sheet.noise.angle if angle_step > sheet.noise.angle else angle,
        sheet.noise.velocity if velocity_step > sheet.noise.velocity else velocity,
    )


def _steps(drive: DriveMapping | None) -> tuple[float, float]:
    """Steps of a mapped drive's angle [rad] and velocity [rad/s]; none of our node's."""
    return (0.0, 0.0) if drive is None else (step_of(drive.angle), step_of(drive.velocity))


def current(log: RunLog) -> CurrentCheck:
    """Scale and latency of the current, and how far the brake moved."""
    experiment = read_experiment(log)
    late = experiment.quality.command_delay
    commands, reports = np.asarray(log.cycles["sent_current"]), np.asarray(log.cycles["applied_current"])
    sent, applied = commands[: len(commands) - 1 - late], reports[1 + late :]
    both = np.isfinite(sent) & np.isfinite(applied)
    power = float(sent[both] @ sent[both])
    if power == 0.0:
        raise LogError(f"{log.path}: expected commands and reports of a current, got none")
    angles = experiment.all_samples[:, 0]
    angles = angles[np.isfinite(angles)]
    smoothed = np.convolve(angles, np.full(SMOOTHED, 1.0 / SMOOTHED), "valid")
    moved = float(np.max(np.abs(smoothed - np.mean(angles[: 2 * SMOOTHED]))))
    is_known = log.drive_files is None or late > 0
    return CurrentCheck(late, late + (0 if is_known else 1), float(sent[both] @ applied[both]) / power, moved)


def first_move(log: RunLog, noise: Noise) -> FirstMove:
    """Currents at which the brake began to move, and the scale of the angle against the velocity."""
    experiment, t_s = read_experiment(log), log.bench.timing.sample_time
    angle, velocity = experiment.all_samples.T
    seen = np.isfinite(angle) & np.isfinite(velocity)
    moving = seen & (np.abs(velocity) > MOVING * noise.velocity)
    before = np.concatenate([[0.0], experiment.currents])[: len(moving)]
    up, down = moving & (before > 0.0), moving & (before < 0.0)
    velocity = np.where(seen, velocity, 0.0)
    travelled = np.diff(angle)
    shown = 0.5 * t_s * (velocity[1:] + velocity[:-1])
    used = np.isfinite(travelled) & (moving[1:] | moving[:-1])
    # Over stretches of the same direction noise averages out; each sample's share has the sign of its motion.
    signs = np.sign(shown[used])
    walked = float(np.sum(np.abs(shown[used])))
    scale = float(np.sum(travelled[used] * signs)) / walked if walked > 0.0 else math.nan
    return FirstMove(_first(np.abs(before), up), _first(np.abs(before), down), scale)


def _first(currents: Floats, mask: Booleans) -> float:
    at = np.flatnonzero(mask)
    return float(currents[at[0]]) if len(at) else math.nan


# --- identification -------------------------------------------------------------------------------------------------


def identify(logs: Sequence[RunLog], sheet: Bench, noise: Noise, before: Identification | None) -> Identification:
    """Parameters from experiments, searched from the model that was found ``before``.

    The intervals allow for the systematic errors that the bench file does not exclude, but for those of J and of the
    angle's scale, which the shield shares: with them the parameters move the brake as it was measured.
    """
    experiments = [read_experiment(log) for log in logs]
    velocity = velocity_of(experiments, sheet.timing.sample_time)
    bench = replace(sheet, noise=noise_in_motion(noise, logs[0].drive), sensors=velocity.sensors)
    best = _best(bench, experiments, before, velocity.bandwidth)
    problem = with_systematic(best.question, bench, best.plant)
    e = fit_from(Problem(bench, best.plant, problem, best.experiments), best).finished() if problem.systematic else best
    names = [unknown.name for unknown in e.unknowns]
    half = NORMAL_95 * e.between_runs() * e.scale
    ends = np.maximum(e.values - half, list(map(least, names))), e.values + half
    shares = NORMAL_95 * noise_deviations(e), NORMAL_95 * e.deviations()
    rows = dict(zip(names, np.stack([e.values, *ends, *shares], axis=1).tolist(), strict=True))
    lag = rows.get("current_lag", (0.0, 0.0, 0.0))[1:3]
    return Identification(
        values={name: rows[name][0] for name in PARAMETER_NAMES},
        intervals={name: tuple(rows[name][1:3]) for name in PARAMETER_NAMES},
        halves={name: tuple(rows[name][3:]) for name in PARAMETER_NAMES},
        model=best.plant.name,
        fits=best.validation.fits and e.validation.fits,  # an offset explains a wrong model of a small motion
        ratio=e.validation.ratio,
        command_delay=max(one.quality.command_delay for one in experiments),
        measurement_delay=e.plant.instruments.measurement_delay,
        current_lag=(max(0.0, lag[0]), max(0.0, lag[1])),
        features={name: row[0] for name, row in rows.items() if name in FEATURES and name != "current_lag"},
        noise=_residuals(e, bench.noise),
        velocity=velocity,
        objections=tuple(alarms(e) or alarms(best)),
    )


def velocity_of(experiments: Sequence[Experiment], t_s: float) -> Velocity:
    """Origin of the velocity in experiments with this sample time [s], the largest experiment last."""
    found = derived(experiments[::-1], t_s)
    if found is None:
        return Velocity()
    least = min(MARGIN * found.least, LAGS_NO_LESS / t_s)
    return Velocity(found.bandwidth, least, found.bandwidth if found.is_known else math.inf)


def _best(
    bench: Bench, experiments: Sequence[Experiment], before: Identification | None, observer_bandwidth: float
) -> Estimate:
    """Estimate by the model that explains the experiments best: the one before, a plain one, one that has grown.

    Of a velocity that is an observer's the angles alone are explained. A delay of the measurements that the data sheet
    excludes counts only where it explains everything.
    """
    lags = ("current_lag",) if bench.shield.current_lag > 0.0 else ()
    starts = ("x1_0",) if any(one.x0() != (0.0, 0.0) for one in experiments) else ()  # of a few samples at rest
    most = bench.shield.frame_age[1] - max(one.quality.command_delay for one in experiments)

    def fit(late: int, features: Mapping[str, float], name: str) -> Estimate:
        mechanics = Mechanics(**cast(dict[str, Any], features))
        plant = Plant(name, mechanics, Instruments(measurement_delay=late, observer_bandwidth=observer_bandwidth))
        prior = bench.range_set(bench.shield.ranges)
        problem = EstimationProblem(PARAMETER_NAMES, (*features, *lags, *starts), prior)
        return method_of("oem")(bench, plant, problem, starts=STARTS).fit([one.seen_by(plant) for one in experiments])

    def misfit(e: Estimate) -> tuple[bool, bool, float]:
        is_excluded = e.plant.instruments.measurement_delay > max(most, 0)
        return not e.validation.fits, is_excluded, e.validation.ratio

    found = []
    if before is not None:
        name = before.model if before.features else DEFAULT_PLANT
        found.append(fit(before.measurement_delay, before.features, name))
    if not (found and found[0].validation.fits):
        found += [fit(late, {}, DEFAULT_PLANT) for late in range(LONGEST + 1)]
    best = min(found, key=misfit)
    if best.validation.fits or len(experiments) == 1:  # a single one does not tell features apart
        return best
    return grow_model(bench, best.plant, best.experiments, best.question, starts=1, seed=0)


def _residuals(e: Estimate, noise: Noise) -> Noise:
    """Standard deviations of the residuals, of the samples in the slower half of the motion."""
    both = np.concatenate(e.residuals)
    speed = np.abs(np.concatenate([experiment.samples[:, 1] for experiment in e.experiments]))
    slow = both[speed <= np.nanmedian(speed)]
    count = np.maximum(np.isfinite(slow).sum(axis=0), 1)  # none of a velocity that an observer derives
    angle, velocity = np.sqrt(np.nansum(slow**2, axis=0) / count).tolist()
    return Noise(angle * noise.angle, velocity * noise.velocity)


def noise_in_motion(at_rest: Noise, drive: DriveMapping | None) -> Noise:
    """Noise of a moving brake's samples: a mapped drive's steps add to it."""
    angle_step, velocity_step = _steps(drive)
    return Noise(math.hypot(at_rest.angle, UNIFORM * angle_step), math.hypot(at_rest.velocity, UNIFORM * velocity_step))
