"""From logs to a study, in stages: experiments, problem, estimate, checks, conclusions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from emb_bench.analysis.conclusion import Conclusion, conclude
from emb_bench.analysis.drift import Earlier, drifts, earlier
from emb_bench.analysis.held_out import apart, leave_one_out
from emb_bench.analysis.model_choice import choose_model
from emb_bench.analysis.options import EstimateOptions
from emb_bench.analysis.profile import profiles
from emb_bench.analysis.records import ModelChoice
from emb_bench.analysis.study import Checks, StudiedRun, Study
from emb_bench.brake.parameters import least
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, EVERY, Plant
from emb_bench.estimate.intervals import bounded, union
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.prediction import too_few
from emb_bench.estimate.records import Unknown
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.information.evaluation import check_sample_time, default_model
from emb_bench.logs.log import RunLog
from emb_runtime.errors import LogError, UsageError


def make_study(
    bench: Bench,
    logs: Sequence[RunLog],
    options: EstimateOptions,
    *,
    last: Earlier | None = None,
    for_report: bool = False,
) -> Study:
    """Reads the experiments of logs, estimates from them together, checks the model and draws the conclusions.

    A report also accepts logs without an experiment. Of several runs it has, in addition, a study of each one alone.

    Raises:
        UsageError: logs do not go together, one run is given twice, or they are too few for the options.
        LogError: a log lacks what an estimate needs.
    """
    runs = [_read(bench, log, name, options, for_report) for log, name in zip(logs, _names(logs), strict=True)]
    used = [run for run in runs if not run.why_not]
    _check_different([run.experiment for run in used if run.experiment is not None])
    if not used:
        return Study(tuple(runs), None, Checks(), (), options, last)
    study = _study(bench, runs, options, last)
    if not for_report or len(used) == 1:
        return study
    single = replace(options, profile=False)
    alone = (run if run.why_not else replace(run, alone=_study(bench, [run], single)) for run in runs)
    return replace(study, runs=tuple(alone))


def side_by_side(bench: Bench, logs: Sequence[RunLog], options: EstimateOptions) -> Study:
    """Two runs, each studied alone, the second compared with the first; there is no joint estimate.

    Raises:
        UsageError: there are not two logs, or one run is given twice.
        LogError: a log lacks what an estimate needs.
    """
    runs = [_read(bench, log, name, options, True) for log, name in zip(logs, _names(logs), strict=True)]
    for run in runs:
        if run.why_not:
            raise LogError(f"--compare: {run.name} has no estimate: {run.why_not}")
    _check_different([run.experiment for run in runs if run.experiment is not None])
    first, second = runs
    before = _study(bench, [first], options)
    after = _study(bench, [second], options, earlier(before.estimate, first.name))
    return Study((replace(first, alone=before), replace(second, alone=after)), None, Checks(), (), options)


def _read(bench: Bench, log: RunLog, name: str, options: EstimateOptions, for_report: bool) -> StudiedRun:
    """A run with its experiment; for a report also a run that has too little data for an estimate."""
    if not for_report:
        check_sample_time(log, bench)
        return StudiedRun(log, name, read_experiment(log, bench, name))
    try:
        experiment = read_experiment(log, bench, name)
    except LogError as err:
        return StudiedRun(log, name, None, str(err).removeprefix(f"{log.path}: "))
    check_sample_time(log, bench)
    plant = plant_of(bench, [log], options)
    samples = int(experiment.measured.sum())
    return StudiedRun(log, name, experiment, too_few(plant, options.problem(bench, plant), samples, 1))


def _study(bench: Bench, runs: Sequence[StudiedRun], options: EstimateOptions, last: Earlier | None = None) -> Study:
    """The study of runs, at least one of which is used."""
    used = [run for run in runs if not run.why_not]
    method = options.method_on(bench)
    if options.model == EVERY and method != "oem":
        raise UsageError(f"--model {EVERY} compares models by output error: expected --method oem, got {method}")
    plant, choice = plant_of(bench, [run.log for run in used], options), None

    def experiments_of(plant: Plant) -> list[Experiment]:
        return [run.experiment.seen_by(plant) for run in used if run.experiment is not None]

    if options.model == EVERY:
        plants, question = [bench.model(name) for name in bench.plants], options.problem(bench, plant)
        choice = choose_model(bench, plants, experiments_of, question, starts=options.starts, seed=options.seed)
        e = choice.best.estimate
    else:
        estimator = method_of(method)(
            bench, plant, options.problem(bench, plant), starts=options.starts, seed=options.seed
        )
        e = estimator.fit(experiments_of(plant))
    checks = Checks(
        # A profile's likelihood is that of one simulation, not of windows.
        profiles=profiles(e, of_all=options.profile) if method != "windows" else (),
        held_out=leave_one_out(e) if len(used) > 1 else (),
        drifts=() if last is None else drifts(e, last),
        choice=choice,
        apart=apart(e) if method == "oem" else (),
    )
    conclusions = conclude(e, checks.profiles, checks.drifts, predicts=checks.predicts)
    conclusions = covering(conclusions, [e.unknowns[i] for i in e.requested()], choice)
    return Study(tuple(runs), e, checks, conclusions, options, last)


def plant_of(bench: Bench, logs: Sequence[RunLog], options: EstimateOptions) -> Plant:
    """The first plant of a study: the one of the options, or that of the logs."""
    if options.model is not None:
        return bench.model(DEFAULT_PLANT if options.model == EVERY else options.model)
    models = sorted({default_model(log)[0] for log in logs})
    if len(models) > 1:
        raise UsageError(
            f"the logs are of different brakes ({', '.join(models)}): say which model to use, with --model"
        )
    return bench.model(models[0])


def covering(
    conclusions: Sequence[Conclusion], unknowns: Sequence[Unknown], choice: ModelChoice | None
) -> tuple[Conclusion, ...]:
    """Conclusions with intervals that cover all plausible models."""
    if choice is None or len(choice.plausible) < 2:
        return tuple(conclusions)
    return tuple(
        replace(c, interval=bounded(union(c.interval, choice.interval(unknown)), c.value, least(unknown.name)))
        for c, unknown in zip(conclusions, unknowns, strict=True)
    )


def _check_different(experiments: Sequence[Experiment]) -> None:
    """Refuse a run that is given twice, also by files of other names or lengths: two runs never have the same noise.

    Counted twice, a run would halve its variance and predict itself.
    """
    for i, experiment in enumerate(experiments):
        for other in experiments[:i]:
            n = min(len(experiment.samples), len(other.samples))
            same = np.array_equal(experiment.samples[:n], other.samples[:n], equal_nan=True)
            if same and (experiment.measured[:n] & (experiment.samples[:n] != experiment.samples[0]).any(axis=1)).any():
                raise UsageError(f"{experiment.name}: the same samples as in {other.name}: expected each run once")


def _names(logs: Sequence[RunLog]) -> list[str]:
    """Names to show for logs: the file's where it is unique, else the path."""
    counts = Counter(log.path.name for log in logs)
    return [log.path.name if counts[log.path.name] == 1 else str(log.path) for log in logs]
