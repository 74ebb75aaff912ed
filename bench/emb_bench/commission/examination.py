"""Examination of a commissioning's logs: noise, clock, latency, signs, and parameters with their intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from scipy import optimize, stats

from emb_bench.analysis.model_choice import fit_from
from emb_bench.analysis.model_growth import grow_model
from emb_bench.brake.parameters import FEATURES
from emb_bench.commission.records import CurrentCheck, FirstMove, Identification, Rest
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Instruments, Mechanics, Plant
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import NORMAL_95, EstimationProblem, with_systematic
from emb_bench.experiment.experiment import Booleans, Experiment, Floats
from emb_bench.experiment.from_log import read_experiment, step_of
from emb_bench.logs.log import RunLog, read_log
from emb_runtime.config.bench import PARAMETER_NAMES, Noise, Ranges
from emb_runtime.drives.mapping import Mapping as DriveMapping
from emb_runtime.errors import LogError
from emb_runtime.records import RunType

MOST_JITTER = 1e-4  # Largest jitter that is accepted [s]
CERTAIN = 4.0  # Standard errors from which on a jitter is taken for one
LONGEST = 2  # Samples by which measurements may come late, at most, that are looked for
FEWEST = 300  # Samples at rest, at least, that a noise is known by
STARTS = 3  # Local searches of the first model
ROUNDS = 2  # Times that features are looked for: without the jitter of the sampling, and with it
MOVING = 6.0  # Standard deviations of the velocity from which on the brake moves
QUIET_ANGLE, QUIET_VELOCITY = 1e-5, 1e-2
"""Least standard deviations that are taken, of the order of the wire's rounding [rad, rad/s]."""


def ended(log: Path) -> str:
    """Reason why a run ended, ``DONE`` if it was completed; empty for a log that is not whole."""
    try:
        opened = read_log(log)
    except LogError:
        return ""
    short = (
        opened.run.get("purpose") == RunType.LISTEN_ONLY
        and len(opened.signals(opened.layout.angle.name)["Angle"]) < FEWEST
    )
    return opened.exit_reason if opened.complete and not short else ""


def at_rest(log: Path) -> Rest:
    """Noise, period and jitter of the samples while the brake rests."""
    opened = read_log(log)
    layout = opened.layout
    angles, velocities = opened.signals(layout.angle.name), opened.signals(layout.velocity.name)
    angle, velocity = np.asarray(angles["Angle"]), np.asarray(velocities["Velocity"])
    if min(len(angle), len(velocity)) < FEWEST:
        raise LogError(f"{log}: expected at least {FEWEST} samples at rest, got {len(angle)}")
    wrap = layout.device_time_period_ns * 1e-9
    stamps = np.unwrap(np.asarray(angles["DeviceTime"], np.float64), period=wrap)
    steps = np.round(np.diff(stamps) / np.median(np.diff(stamps)))
    grid = np.concatenate([[0.0], np.cumsum(steps)])
    period, start = np.polyfit(grid, stamps, 1)
    found = noise_at_rest(angle, velocity, opened.drive)
    noise = Noise(max(found.angle, QUIET_ANGLE), max(found.velocity, QUIET_VELOCITY))
    return Rest(noise, float(period), float(np.std(stamps - start - period * grid)))


def current(log: Path) -> CurrentCheck:
    """Scale and latency of the current, and how far the brake moved."""
    opened = read_log(log)
    experiment = read_experiment(opened)
    late = experiment.command_delay
    scale, error = _of_commands(opened, late)
    angles = experiment.all_samples[:, 0]
    angles = angles[np.isfinite(angles)]
    moved = float(np.max(np.abs(_smoothed(angles) - np.mean(angles[:20]))))
    return CurrentCheck(late, scale, error, moved, int(opened.drive_files is not None and late == 0))


def first_move(log: Path, noise: Noise) -> FirstMove:
    """Currents at which the brake began to move, and the scale of the angle against the velocity."""
    opened = read_log(log)
    experiment = read_experiment(opened)
    t_s = opened.bench.timing.sample_time
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


def identify(logs: Sequence[Path], sheet: Bench, noise: Noise, before: Identification | None) -> Identification:
    """Parameters from experiments.

    The delay of the measurements and a lag of the current are looked for first, then jitter, then what else the
    residuals ask for, one by one. The intervals allow for the systematic errors that the bench file does not
    exclude.
    """
    opened = [read_log(log) for log in logs]
    noise = noise_in_motion(noise, opened[0].drive)
    bench = replace(sheet, noise=noise)
    prior = bench.range_set(bench.shield.ranges)
    experiments = [read_experiment(log) for log in opened]
    best = _best(_Fits(bench, prior, experiments), before)
    first = _with_systematic(bench, best)
    features = {u.name: float(v) for u, v in zip(first.unknowns, first.values, strict=True) if u.name in FEATURES}
    lag = _interval(first, "current_lag")
    return Identification(
        values={name: float(getattr(first.theta, name)) for name in PARAMETER_NAMES},
        intervals={name: _interval(first, name) for name in PARAMETER_NAMES},
        model=best.plant.name,
        fits=best.validation.fits and first.validation.fits,  # an offset explains a wrong model of a small motion
        ratio=first.validation.ratio,
        command_delay=max(own.command_delay for own in experiments),
        measurement_delay=first.plant.instruments.measurement_delay,
        current_lag=(max(0.0, lag[0]), max(0.0, lag[1])) if all(map(math.isfinite, lag)) else (0.0, 0.0),
        features={name: value for name, value in features.items() if name != "current_lag"},
        jitter=first.plant.instruments.clock_jitter,
        noise=_residuals(first, noise),
        contact=_interval(first, "offset"),
        objections=first.validation.alarms or best.validation.alarms,
    )


def _of_commands(log: RunLog, late: int) -> tuple[float, float]:
    """Scale of the reported current, where commands act late by some samples, and its error [A]."""
    commands, reports = np.asarray(log.cycles["sent_current"]), np.asarray(log.cycles["applied_current"])
    sent, applied = commands[: len(commands) - 1 - late], reports[1 + late :]
    both = np.isfinite(sent) & np.isfinite(applied)
    sent, applied = sent[both], applied[both]
    power = float(sent @ sent)
    if len(sent) < 50 or power == 0.0:
        raise LogError(f"{log.path}: expected commands and reports of a current, got {len(sent)} of them")
    scale = float(sent @ applied) / power
    return scale, float(np.std(applied - scale * sent))


@dataclass(frozen=True)
class _Fits:
    """Estimates of one brake from some experiments, by any model."""

    bench: Bench
    prior: Ranges
    experiments: Sequence[Experiment]

    def fit(
        self,
        late: int = 0,
        features: Mapping[str, float] | None = None,
        jitter: float = 0.0,
        name: str = "exact",
        starts: int = STARTS,
    ) -> Estimate:
        """Estimate by a model with some features, whose measurements come late by some samples."""
        mechanics = Mechanics(**cast(dict[str, Any], features or {}))
        plant = Plant(name, mechanics, Instruments(measurement_delay=late, clock_jitter=jitter))
        records = [own.seen_by(plant) for own in self.experiments]
        lags = ("current_lag",) if self.bench.shield.current_lag > 0.0 else ()
        if any(own.x0() != (0.0, 0.0) for own in self.experiments):  # known by some samples at rest only
            lags = (*lags, "x1_0")
        asked = EstimationProblem(PARAMETER_NAMES, (*(features or {}), *lags), self.prior)
        return method_of("oem")(self.bench, plant, asked, starts=starts).fit(records)


def _best(fits: _Fits, before: Identification | None) -> Estimate:
    """Estimate by the model that explains the experiments best: the one before, a plain one, one that has grown."""
    again = _as_before(fits, before) if before is not None and (before.fits or before.features) else None
    if again is not None and again.validation.fits:
        return again
    best = _plain(fits)
    if not best.validation.fits and len(fits.experiments) > 1:  # a single small one does not tell features apart
        best = _grown(best, fits.prior)
    return min([best, *([] if again is None else [again])], key=lambda e: (not e.validation.fits, e.validation.ratio))


def _as_before(fits: _Fits, before: Identification) -> Estimate:
    """Estimate by the model that was found before; larger experiments may ask for more features."""
    begun = replace(fits, bench=_beginning_at(before.values, fits.bench, fits.prior))
    again = begun.fit(before.measurement_delay, before.features, before.jitter, before.model, 1)
    return _grown(again, fits.prior) if before.features and not again.validation.fits else again


def _plain(fits: _Fits) -> Estimate:
    """Estimate without features; a delay that the data sheet excludes only where it alone explains everything."""
    most = fits.bench.shield.frame_age[1] - max(own.command_delay for own in fits.experiments)
    found = [fits.fit(late) for late in range(max(0, min(most, LONGEST)) + 1)]
    best = min(found, key=lambda e: e.validation.chi2)
    if best.validation.fits:
        return best
    beyond = (fits.fit(late) for late in range(max(most, 0) + 1, LONGEST + 1))
    return next((e for e in beyond if e.validation.fits), best)


def _beginning_at(values: Mapping[str, float], bench: Bench, prior: Ranges) -> Bench:
    """The bench with a nominal brake at which searches begin: values, as far as they lie inside of the ranges."""
    inside = {n: min(max(v, getattr(prior.low, n)), getattr(prior.high, n)) for n, v in values.items()}
    return replace(bench, brake=bench.brake._replace(**inside))


def _grown(e: Estimate, prior: Ranges) -> Estimate:
    """Estimate by the model with what its residuals ask for, the jitter of the sampling among it."""
    for _ in range(ROUNDS):
        bench = _beginning_at({name: float(getattr(e.theta, name)) for name in PARAMETER_NAMES}, e.bench, prior)
        e = grow_model(bench, e.plant, e.records, e.asked, starts=1, seed=0)
        jitter = _jitter(e)
        if e.validation.fits or not 0.0 < jitter <= MOST_JITTER:
            return e
        shaken = replace(e.plant, instruments=e.plant.instruments._replace(clock_jitter=jitter))
        fitted = fit_from(replace(e.problem, plant=shaken), e).finished()
        if not (fitted.validation.fits or fitted.validation.ratio < e.validation.ratio):
            return e
        e = fitted
        if e.validation.fits:
            return e
    return e


def _jitter(e: Estimate) -> float:
    """Jitter of the sampling that explains angles whose residuals grow with the speed; 0 where they do not [s].

    Of an angle taken late by a time of deviation j at the speed v the residual has the variance σ² + j² v².
    """
    speed = np.concatenate([record.samples[:, 1] for record in e.records])
    scale = np.hypot(e.bench.noise.angle, e.plant.instruments.clock_jitter * speed)
    errors = np.concatenate([r[:, 0] for r in e.residuals]) * scale
    used = np.isfinite(errors) & np.isfinite(speed)
    fast, excess = speed[used] ** 2, errors[used] ** 2 - e.bench.noise.angle**2
    share = float(excess @ fast) / float(fast @ fast)
    spread = float(np.sqrt(np.sum((excess - share * fast) ** 2 * fast**2))) / float(fast @ fast)
    return math.sqrt(share) if share > CERTAIN * spread else 0.0


def _with_systematic(bench: Bench, e: Estimate) -> Estimate:
    asked = with_systematic(e.asked, bench, e.plant)
    return fit_from(Problem(bench, e.plant, asked, e.records), e).finished() if asked.systematic else e


def _interval(e: Estimate, name: str) -> tuple[float, float]:
    """Interval of an unknown, over all records that have one of their own [SI]; NaN where it was not estimated.

    The shield shares the bench's errors of J and of the scale of the angle: with them the parameters move the brake as
    it was measured.
    """
    half = NORMAL_95 * e.between_runs() * e.scale
    ends = np.stack([e.values - half, e.values + half], axis=1).tolist()
    rows = [row for unknown, row in zip(e.unknowns, ends, strict=True) if unknown.name == name]
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


UNIFORM = math.sqrt(1.0 / 12.0)  # Standard deviation of an error that may be anything within a step, in steps


def noise_at_rest(angle: Floats, velocity: Floats, drive: DriveMapping | None) -> Noise:
    """Noise of a resting brake's samples, below the steps of a mapped drive."""
    steps = (0.0, 0.0) if drive is None else (step_of(drive.angle), step_of(drive.velocity))
    return Noise(scatter(angle, steps[0]), scatter(velocity, steps[1]))


def noise_in_motion(at_rest: Noise, drive: DriveMapping | None) -> Noise:
    """Noise of a moving brake's samples: a mapped drive's steps add to it."""
    if drive is None:
        return at_rest
    added = UNIFORM * step_of(drive.angle), UNIFORM * step_of(drive.velocity)
    return Noise(math.hypot(at_rest.angle, added[0]), math.hypot(at_rest.velocity, added[1]))


def scatter(values: Floats, step: float) -> float:
    """Most likely standard deviation of a normal noise about a constant, before it was rounded to steps."""
    found = float(np.std(values, ddof=1))
    if found >= step:
        return math.sqrt(found**2 - (UNIFORM * step) ** 2)
    places, counts = np.unique(np.round((values - values[0]) / step), return_counts=True)

    def unlikelihood(at: Floats) -> float:
        below, above = (places - at[0] - 0.5) / math.exp(at[1]), (places - at[0] + 0.5) / math.exp(at[1])
        share = np.maximum(stats.norm.cdf(above) - stats.norm.cdf(below), 1e-300)
        return -float(counts @ np.log(share))

    begin = [float(np.mean(values - values[0])) / step, math.log(0.25)]
    return step * math.exp(float(optimize.minimize(unlikelihood, begin, method="Nelder-Mead").x[1]))
