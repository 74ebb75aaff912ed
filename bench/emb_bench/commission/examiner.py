"""Examiner of a commissioning's logs: noise, clock, latency, signs, and parameters with their intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.analysis.model_choice import fit_from
from emb_bench.analysis.model_growth import grow_model
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import (
    FEATURES,
    Estimate,
    EstimationProblem,
    record_of,
    with_systematic,
)
from emb_bench.experiment.experiment import read_experiment
from emb_bench.experiment.info import Booleans, Experiment, Floats
from emb_bench.logs.log import read_log
from emb_runtime.commission.records import CurrentCheck, FirstMove, Identification, Rest
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Noise, Ranges
from emb_runtime.config.plants import Instruments, Mechanics, Plant
from emb_runtime.errors import LogError

MOST_JITTER = 1e-4
"""Jitter that is believed, at most [s]."""
CERTAIN = 4.0
"""Standard errors from which on a jitter is taken for one."""
LONGEST = 2
"""Samples by which measurements may come late, at most, that are looked for."""
STARTS = 3
"""Local searches of the first model."""
MOVING = 6.0
"""Standard deviations of the velocity from which on the brake moves."""
QUIET_ANGLE, QUIET_VELOCITY = 1e-5, 1e-2
"""Least standard deviations that are taken, of the order of the wire's rounding [rad, rad/s]."""


class LogExaminer:
    """The examiner that reads logs with this package; see :class:`emb_runtime.commission.records.Examiner`."""

    def ended(self, log: Path) -> str:
        """Reason why a run ended; empty for a log that is not whole."""
        try:
            opened = read_log(log)
        except LogError:
            return ""
        return opened.exit_reason if opened.complete else ""

    def rest(self, log: Path) -> Rest:
        """Noise, period and jitter of the samples while the brake rests, and the node's clock."""
        opened = read_log(log)
        layout = opened.layout
        angles, velocities = opened.signals(layout.angle.name), opened.signals(layout.velocity.name)
        angle, velocity = np.asarray(angles["Angle"]), np.asarray(velocities["Velocity"])
        if len(angle) < 100 or len(velocity) < 100:
            raise LogError(f"{log}: expected at least 100 samples at rest, got {len(angle)}")
        wrap = layout.device_time_period_ns * 1e-9
        stamps = np.unwrap(np.asarray(angles["DeviceTime"], np.float64), period=wrap)
        host = np.asarray(angles["publish_time"], np.float64)
        steps = np.round(np.diff(stamps) / np.median(np.diff(stamps)))
        grid = np.concatenate([[0.0], np.cumsum(steps)])
        slope, start = np.polyfit(grid, stamps, 1)
        ratio = float(np.polyfit((host - host[0]) * 1e-9, stamps - stamps[0], 1)[0])
        noise = Noise(
            max(float(np.std(angle, ddof=1)), QUIET_ANGLE), max(float(np.std(velocity, ddof=1)), QUIET_VELOCITY)
        )
        jitter = float(np.std(stamps - start - slope * grid))
        return Rest(noise, float(slope), jitter, ratio, float(np.mean(angle)))

    def current(self, log: Path) -> CurrentCheck:
        """Scale and latency of the current, and how far the brake moved."""
        opened = read_log(log)
        experiment, cycles = read_experiment(opened), opened.cycles
        late = experiment.command_delay
        sent, applied = np.asarray(cycles["sent_current"]), np.asarray(cycles["applied_current"])
        sent, applied = sent[: len(sent) - 1 - late], applied[1 + late :]
        both = np.isfinite(sent) & np.isfinite(applied)
        sent, applied = sent[both], applied[both]
        power = float(sent @ sent)
        if len(sent) < 50 or power == 0.0:
            raise LogError(f"{log}: expected commands and reports of a current, got {len(sent)} of them")
        scale = float(sent @ applied) / power
        angles = experiment.angle[np.isfinite(experiment.angle)]
        moved = float(np.max(np.abs(_smoothed(angles) - np.mean(angles[:20]))))
        return CurrentCheck(late, scale, float(np.std(applied - scale * sent)), moved)

    def first_move(self, log: Path, noise: Noise) -> FirstMove:
        """Currents at which the brake began to move, and the scale of the angle against the velocity."""
        opened = read_log(log)
        experiment = read_experiment(opened)
        t_s = opened.bench.timing.sample_time
        seen = np.isfinite(experiment.angle) & np.isfinite(experiment.velocity)
        moving = seen & (np.abs(experiment.velocity) > MOVING * noise.velocity)
        before = np.concatenate([[0.0], experiment.currents])[: len(moving)]
        up, down = moving & (before > 0.0), moving & (before < 0.0)
        velocity = np.where(seen, experiment.velocity, 0.0)
        travelled = np.diff(experiment.angle)
        shown = 0.5 * t_s * (velocity[1:] + velocity[:-1])
        used = np.isfinite(travelled) & (moving[1:] | moving[:-1])
        # Over stretches of the same direction noise averages out; each sample's share has the sign of its motion.
        signs = np.sign(shown[used])
        walked = float(np.sum(np.abs(shown[used])))
        scale = float(np.sum(travelled[used] * signs)) / walked if walked > 0.0 else math.nan
        return FirstMove(_first(np.abs(before), up), _first(np.abs(before), down), scale)

    def identify(
        self, logs: Sequence[Path], sheet: Bench, noise: Noise, before: Identification | None
    ) -> Identification:
        """Parameters from experiments.

        The delay of the measurements and a lag of the current are looked for first, then jitter, then what else the
        residuals ask for, one by one. The intervals allow for the systematic errors that the bench file does not
        exclude.
        """
        bench = replace(sheet, noise=noise)
        prior = bench.range_set(bench.shield.ranges)
        experiments = [read_experiment(read_log(log)) for log in logs]
        best = _fitted(bench, prior, [log.name for log in logs], experiments, before)
        first = _with_systematic(bench, best)
        features = {u.name: float(v) for u, v in zip(first.unknowns, first.values, strict=True) if u.name in FEATURES}
        lag = _interval(first, "current_lag")
        return Identification(
            values={name: float(getattr(first.theta, name)) for name in PARAMETER_NAMES},
            intervals={name: _interval(first, name) for name in PARAMETER_NAMES},
            model=best.plant.name,
            fits=first.validation.fits,
            ratio=first.validation.ratio,
            command_delay=max(own.command_delay for own in experiments),
            measurement_delay=first.plant.instruments.measurement_delay,
            current_lag=(max(0.0, lag[0]), max(0.0, lag[1])) if all(map(math.isfinite, lag)) else (0.0, 0.0),
            features={name: value for name, value in features.items() if name != "current_lag"},
            jitter=first.plant.instruments.clock_jitter,
            noise=_residuals(first, noise),
            contact=_interval(first, "offset"),
        )


def _fitted(
    bench: Bench,
    prior: Ranges,
    names: Sequence[str],
    experiments: Sequence[Experiment],
    before: Identification | None,
) -> Estimate:
    """Estimate by the model that explains the experiments best."""

    def run(
        mechanics: Mechanics, late: int, jitter: float, name: str, asked: EstimationProblem, starts: int = STARTS
    ) -> Estimate:
        plant = Plant(name, mechanics, Instruments(measurement_delay=late, clock_jitter=jitter))
        records = [record_of(log, own, bench, plant) for log, own in zip(names, experiments, strict=True)]
        return run_method("oem", bench, plant, records, asked, starts=starts)

    features = dict(before.features) if before is not None else {}
    lags = bench.shield.current_lag > 0.0
    asked = EstimationProblem(PARAMETER_NAMES, (*features, *(("current_lag",) if lags else ())), prior)
    mechanics = _with_features(features)
    name = before.model if before is not None else "exact"
    if before is not None and before.fits:
        bench = replace(bench, brake=bench.brake._replace(**before.values))  # the search begins there
        again = run(mechanics, before.measurement_delay, 0.0, name, asked, 1)
        if again.validation.fits:
            return again
    most = bench.shield.frame_age[1] - max(own.command_delay for own in experiments)
    allowed, beyond = list(range(min(most, LONGEST) + 1)), list(range(max(most, 0) + 1, LONGEST + 1))
    if before is not None and features:
        allowed, beyond = [before.measurement_delay], []
    found = [run(mechanics, late, 0.0, name, asked) for late in allowed or [0]]
    best = min(found, key=lambda e: e.validation.chi2)
    if best.validation.fits:
        return best
    for late in beyond:  # that the data sheet excludes is believed only where it explains everything
        e = run(mechanics, late, 0.0, name, asked)
        if e.validation.fits:
            return e
    late = best.plant.instruments.measurement_delay
    if not features and len(experiments) > 1:  # a single small one does not tell features apart
        plant = Plant("exact", mechanics, best.plant.instruments)
        best = grow_model(bench, plant, best.records, asked, starts=STARTS, seed=0).choice.best.estimate
    jitter = _jitter(best)
    if 0.0 < jitter <= MOST_JITTER and not best.validation.fits:
        known = {n: float(getattr(best.plant.mechanics, n)) for n in best.asked.names if n in FEATURES}
        shaken = run(_with_features(known), late, jitter, best.plant.name, best.asked)
        best = shaken if shaken.validation.fits or shaken.validation.ratio < best.validation.ratio else best
    return best


def _with_features(features: Mapping[str, float]) -> Mechanics:
    """Mechanics of a brake that is solved exactly, with features by name."""
    values: dict[str, Any] = dict(features)
    return Mechanics(**values)


def _jitter(e: Estimate) -> float:
    """Jitter of the sampling that explains angles whose residuals grow with the speed; 0 where they do not [s].

    Of an angle taken late by a time of deviation j at the speed v the residual has the variance σ² + j² v².
    """
    errors = np.concatenate([r[:, 0] for r in e.residuals]) * e.bench.noise.angle
    speed = np.concatenate([record.samples[:, 1] for record in e.records])
    used = np.isfinite(errors) & np.isfinite(speed)
    fast, excess = speed[used] ** 2, errors[used] ** 2 - e.bench.noise.angle**2
    share = float(excess @ fast) / float(fast @ fast)
    spread = float(np.sqrt(np.sum((excess - share * fast) ** 2 * fast**2))) / float(fast @ fast)
    return math.sqrt(share) if share > CERTAIN * spread else 0.0


def _with_systematic(bench: Bench, e: Estimate) -> Estimate:
    asked = with_systematic(e.asked, bench, e.plant)
    return fit_from(Problem(bench, e.plant, asked, e.records), e).finished() if asked.systematic else e


def _interval(e: Estimate, name: str) -> tuple[float, float]:
    """Interval of an unknown, over all records that have one of their own [SI]; NaN where it was not estimated."""
    rows = [row for unknown, row in zip(e.unknowns, e.intervals().tolist(), strict=True) if unknown.name == name]
    return (min(low for low, _ in rows), max(high for _, high in rows)) if rows else (math.nan, math.nan)


def _residuals(e: Estimate, noise: Noise) -> Noise:
    """Standard deviations of the residuals, of the samples in the slower half of the motion."""
    both = np.concatenate(e.residuals)
    speed = np.abs(np.concatenate([record.samples[:, 1] for record in e.records]))
    slow = both[speed <= np.nanmedian(speed)]
    angle, velocity = np.sqrt(np.nanmean(slow**2, axis=0)).tolist()
    return Noise(angle * noise.angle, velocity * noise.velocity)


def _smoothed(values: Floats) -> Floats:
    """Means of ten at a time: a motion shows, and noise counts a third."""
    result: Floats = np.convolve(values, np.full(10, 0.1), "valid")
    return result


def _first(currents: Floats, chosen: Booleans) -> float:
    at = np.flatnonzero(chosen)
    return float(currents[at[0]]) if len(at) else math.nan
