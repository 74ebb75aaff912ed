"""One log to one row: the same function in this process, in another one, and on another machine."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from emb_bench.batch.row import NONE, CampaignOptions, Row, Source, failed
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.expected import of_information
from emb_bench.estimate.records import EstimationProblem
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.information.evaluation import Evaluation, check_sample_time, default_model, evaluate
from emb_bench.logs.info import cycle_summary
from emb_bench.logs.log import RunLog, read_log, require_driven
from emb_bench.report.caveats import caveats
from emb_bench.report.information import lacks, warnings
from emb_bench.report.sentences import alarms
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import EmbError, UsageError
from emb_runtime.system.input_file import open_regular
from emb_runtime.system.terminal import escaped

FIRST = 50  # Samples whose noise distinguishes a run from any other


def evaluate_one(source: Source, options: CampaignOptions, bench: Bench | None = None) -> Row:
    """Evaluate one log with a bench; without one, with the bench inside the log.

    An error becomes the row's ``error``; the columns computed before it are kept. The bench is passed by its content,
    as another machine does not have the file.
    """
    row = failed(source, "")
    try:
        for found in _steps(source, options, bench):
            row |= found
    except EmbError as err:
        return row | {"error": failed(source, str(err))["error"]}
    except Exception as err:  # one log must not end the campaign, even by an error of the program
        return row | {"error": failed(source, f"{source.path}: {type(err).__name__}: {err}")["error"]}
    return row | {"error": None}


def _steps(source: Source, options: CampaignOptions, given: Bench | None) -> Iterator[Row]:
    """Fields of the row, in steps up to the first error."""
    if source.trouble:
        raise UsageError(f"{source.path}: {source.trouble}")
    with suppress(OSError), open_regular(source.path) as file:
        yield {"sha256": hashlib.file_digest(file, "sha256").hexdigest()}
    log = read_log(source.path)
    yield _of_the_run(log)
    require_driven(log)
    bench = given or log.bench
    check_sample_time(log, bench)
    plant = bench.model(options.model or default_model(log)[0])
    question = options.question(bench)
    experiment = read_experiment(log, bench, source.path)
    yield _of_the_experiment(log, experiment, bench) | {"model": plant.name}
    import numba  # noqa: F401  # evaluate uses numba if it is loaded, which is faster for many logs

    (evaluation,) = evaluate(log, experiment, bench, [plant], question, "nominal", bench.brake)
    yield _of_the_information(evaluation)
    with suppress(EmbError):  # of unknowns that the model cannot estimate
        interval = of_information(evaluation)
        yield {"T": interval.of_comparison, "I": interval.of_repeatability}
    if options.method == NONE:
        return
    from emb_bench.estimate.methods import method_of

    problem = with_systematic(EstimationProblem(**vars(question)), bench, plant)
    method = method_of(options.method)(bench, plant, problem, starts=options.starts, seed=options.seed)
    yield _of_the_estimate(method.fit([experiment.seen_by(plant)]), log.truth)


def _of_the_run(log: RunLog) -> Row:
    found, policy = cycle_summary(log), log.run.get("policy_sha256")
    cycles, largest = found.cycles, found.largest
    return {
        "start_time": log.span[0],
        **log.conditions,
        "simulated": bool(log.simulated),
        "exit_reason": escaped(log.exit_reason),
        "complete": log.complete,
        "missing": escaped(log.missing),
        "policy_sha256": None if policy is None else escaped(policy),
        "angle_min": largest and largest.angle_min,
        "angle_max": largest and largest.angle_max,
        "speed_max": largest and largest.speed,
        "current_max": largest and largest.current,
        "limited": cycles["limited"],
        "returning": cycles["returning"],
        "clipped": cycles["clipped"],
        "missed": cycles["missed_periods"],
    }


def _of_the_experiment(log: RunLog, experiment: Experiment, bench: Bench) -> Row:
    missing = [log.missing] if log.missing else []
    missing += lacks(experiment)
    (low, high), speed = bench.limits.angle, bench.limits.velocity
    angle, velocity = experiment.samples.T
    beyond = int(((angle < low) | (angle > high) | (np.abs(velocity) > speed)).sum())
    return {
        "beginning": _beginning(experiment),
        "complete": not missing and log.complete,
        "missing": escaped("; ".join(missing)),
        "planned": experiment.quality.planned,
        "periods": experiment.periods,
        "measured": int(experiment.measured.sum()),
        "command_delay": experiment.quality.command_delay,
        "bench_name": escaped(bench.name),
        "bench_hash": bench.identity_hash,
        "violations": beyond,
    }


def _beginning(experiment: Experiment) -> str | None:
    """Hash of the first samples, equal in each copy of a log, also in a cut one; None for samples without noise."""
    samples = np.ascontiguousarray(experiment.samples[:FIRST].T)
    seen = samples[:, ~np.isnan(samples).any(axis=0)]
    if not (seen != seen[:, :1]).any():
        return None
    return hashlib.sha256(samples.tobytes()).hexdigest()


def _of_the_information(e: Evaluation) -> Row:
    physical = e.fisher("physical")
    criteria, bounds = physical.criteria(), physical.cramer_rao()
    identified = {finding.name: finding.identified for finding in e.identifiability().findings}
    stated = {e.log.missing, *lacks(e.experiment)}
    found: Row = {
        "warnings": tuple(escaped(warning) for warning in warnings(e) if warning not in stated),
        "nominal_fits": e.fit.fits,
        "nominal_angle_sigmas": e.fit.angle,
        "nominal_velocity_sigmas": e.fit.velocity,
        "log_det": criteria.log_det,
        "lambda_min": criteria.lambda_min,
        "trace_inverse": criteria.trace_inverse,
    }
    for name in e.question.names:
        true = _true(e.log.truth, name)
        found |= _of(name, identified=identified.get(name), cramer_rao=bounds[name], true=true)
    return found


def _of(name: str, **values: Any) -> Row:
    """Columns of a parameter."""
    return {f"{name}_{key}": value for key, value in values.items()}


def _of_the_estimate(e: Estimate, truth: BrakeParameters | None) -> Row:
    from emb_bench.analysis.conclusion import conclude
    from emb_bench.analysis.profile import profiles

    conclusions = conclude(e, profiles(e, of_all=False), ())
    found: Row = {
        "fits": e.validation.fits,
        "chi2_per_freedom": e.validation.ratio,
        "alarms": alarms(e),
        "caveats": tuple(caveats(e)),
        "outside": tuple(conclusion.label for conclusion in conclusions if conclusion.outside is not None),
    }
    deviations, between = e.deviations(), e.between_runs()
    for i, conclusion in zip(e.requested(), conclusions, strict=True):
        name = e.unknowns[i].name
        value, low, high, noise = conclusion.value, *conclusion.interval, conclusion.repeatability
        true = _true(truth, name)
        deviation = float(deviations[i])
        scale = deviation * (abs(value) if PARAMETERS[name].relative else 1.0)
        error = None if true is None or not 0.0 < scale < math.inf else (value - true) / scale
        found |= _of(
            name,
            identified=conclusion.identified,
            estimate=value,
            low=low,
            high=high,
            deviation=deviation,
            between_runs=float(between[i]),
            repeatability=noise,
            error_sigmas=error,
        )
    return found


def _true(truth: BrakeParameters | None, name: str) -> float | None:
    return None if truth is None else getattr(truth, name, None)
