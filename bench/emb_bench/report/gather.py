"""From logs to what a report says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from emb_bench.estimate.study import Study, Wanted, make_study
from emb_bench.experiment import Experiment, read_experiment
from emb_bench.log import RunLog
from emb_bench.report.content import Content, LeftOut, Run
from emb_bench.report.growth import growth
from emb_bench.timing import Timing, timing
from emb_runtime.bench import Bench
from emb_runtime.errors import LogError


def gather(
    bench: Bench,
    logs: Sequence[RunLog],
    left_out: Sequence[tuple[Path, str]],
    wanted: Wanted,
    made_by: str,
    *,
    held_out: Sequence[RunLog] = (),
    last: Mapping[str, Any] | None = None,
) -> Content:
    """Estimate from the logs that have an experiment, and say of the others why they have none.

    Args:
        bench: noise, sample time, limits, nominal brake.
        logs: of one brake, at least one.
        left_out: files that are no logs, or too damaged, and why.
        wanted: what to find out.
        made_by: name and version of the tool.
        held_out: logs that are predicted, not estimated from.
        last: document of an earlier estimate.

    Raises:
        UsageError: logs do not go together, or what is wanted cannot be asked.
        LogError: a log that is held out says too little.
    """
    experiments = [_experiment(log, bench, len(wanted.asked.names)) for log in logs]
    used = [log for log, (_, why_not) in zip(logs, experiments, strict=True) if not why_not]
    study = make_study(bench, used, wanted, held_out=held_out, last=last) if used else None
    runs = []
    for log, (experiment, why_not) in zip(logs, experiments, strict=True):
        number = None if why_not else used.index(log)
        runs.append(_run(log, bench, experiment, why_not, study, number))
    why_not = "" if used else "; ".join(f"{run.name}: {run.why_not}" if len(runs) > 1 else run.why_not for run in runs)
    return Content(tuple(runs), tuple(LeftOut(*entry) for entry in left_out), study, why_not, made_by)


def _experiment(log: RunLog, bench: Bench, unknowns: int) -> tuple[Experiment | None, str]:
    """The experiment, and why nothing can be estimated from it; empty if something can."""
    try:
        experiment = read_experiment(log, bench)
    except LogError as err:
        return None, str(err).removeprefix(f"{log.path}: ")
    samples = int(experiment.measured.sum())
    if samples < unknowns:
        return experiment, f"{samples} samples are too few for {unknowns} unknowns"
    return experiment, ""


def _timing(log: RunLog) -> Timing | None:
    try:
        return timing(log)
    except LogError:
        return None


def _run(
    log: RunLog, bench: Bench, experiment: Experiment | None, why_not: str, study: Study | None, number: int | None
) -> Run:
    punctual = _timing(log)
    if study is None or number is None:
        return Run(log, bench, experiment, why_not, punctual)
    e = study.estimate
    return Run(log, bench, experiment, why_not, punctual, e.residuals[number], growth(e, number))
