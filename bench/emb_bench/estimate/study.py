"""From logs to a verdict: estimate, check, say what is known, what would help and what has changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from emb_bench.estimate.advice import Advice, advise
from emb_bench.estimate.bootstrap import Bootstrap, bootstrap
from emb_bench.estimate.conclusion import Conclusion, conclude
from emb_bench.estimate.drift import Drift, drifts
from emb_bench.estimate.held_out import HeldOut, leave_one_out
from emb_bench.estimate.held_out import held_out as predict
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.profile import Profile, profile
from emb_bench.estimate.records import STARTS, Asked, Estimate, Record, record_of
from emb_bench.estimate.refit import shared
from emb_bench.evaluation import default_model, other_sample_time
from emb_bench.experiment import Experiment, read_experiment
from emb_bench.log import RunLog
from emb_runtime.bench import Bench, BrakeParameters
from emb_runtime.errors import UsageError
from emb_runtime.plants import Plant


@dataclass(frozen=True)
class Wanted:
    """What a study is to find out, and how."""

    asked: Asked
    method: str = "oem"
    """A key of ``records.METHODS``."""
    model: str | None = None
    """Name of a plant of the bench; without, the one that was simulated, or the exact one where logs do not say."""
    starts: int = STARTS
    seed: int = 0
    """Of where searches begin, and of the bootstrap."""
    profiles: bool = False
    draws: int = 0
    """Of the bootstrap over runs; none if 0."""


@dataclass(frozen=True, eq=False)
class Study:
    """Everything that logs said about a brake."""

    estimate: Estimate
    warnings: tuple[str, ...]
    """What to know about the logs before believing a number."""
    model_reason: str
    truth: BrakeParameters | None
    """What was simulated, if that is known and the same in all logs."""
    profiles: tuple[Profile, ...]
    """Of the unknowns that the records share; empty if none were wanted."""
    bootstrap: Bootstrap | None
    held_out: tuple[HeldOut, ...]
    """The logs held out."""
    left_out: tuple[HeldOut, ...]
    """Of several records, each predicted from the others; empty of one."""
    advice: tuple[Advice, ...]
    """Best first; empty if all parameters are told well, or nothing would help."""
    drifts: tuple[Drift, ...]
    conclusions: tuple[Conclusion, ...]

    @property
    def fits(self) -> bool:
        """Whether neither the residuals nor a record that was predicted speak against the model."""
        return self.estimate.misfit.fits and all(h.fits for h in (*self.held_out, *self.left_out))

    @property
    def told(self) -> bool:
        """Whether all parameters of interest are identified."""
        return all(c.told for c in self.conclusions if c.of_interest)


def make_study(
    bench: Bench,
    logs: Sequence[RunLog],
    wanted: Wanted,
    *,
    held_out: Sequence[RunLog] = (),
    last: Mapping[str, Any] | None = None,
) -> Study:
    """Estimate from logs, and everything besides.

    Args:
        bench: noise, sample time, limits, nominal brake.
        logs: of one brake, at least one.
        wanted: what to find out.
        held_out: logs of the same brake that are predicted, not estimated from.
        last: document of an earlier estimate, from :func:`emb_bench.estimate.drift.read_last`.

    Raises:
        UsageError: logs do not go together, or are too few for what is wanted.
        LogError: a log says too little.
    """
    all_logs = [*logs, *held_out]
    for log in all_logs:
        if (its := other_sample_time(log, bench)) is not None:
            raise UsageError(f"{log.path}: expected a sample time of {bench.timing.sample_time:g} s, got {its:g} s")
    name, why = (wanted.model, "asked for") if wanted.model is not None else _model(all_logs)
    plant = bench.plant(name)
    records: list[Record] = []
    warnings: list[str] = []
    for log in all_logs:
        record, said = _read(log, bench, plant)
        records.append(record)
        warnings += [f"{log.path}: {warning}" if len(all_logs) > 1 else warning for warning in said]
    seen, unseen = records[: len(logs)], records[len(logs) :]
    e = run_method(wanted.method, bench, plant, seen, wanted.asked, starts=wanted.starts, seed=wanted.seed)
    profiles = tuple(profile(e, e.labels[i]) for i in shared(e)) if wanted.profiles else ()
    advice = advise(e)
    changes = () if last is None else drifts(e, last)
    return Study(
        estimate=e,
        warnings=tuple(warnings),
        model_reason=why,
        truth=_truth(all_logs),
        profiles=profiles,
        bootstrap=bootstrap(e, draws=wanted.draws, seed=wanted.seed) if wanted.draws else None,
        held_out=tuple(predict(e, record) for record in unseen),
        left_out=leave_one_out(e) if len(seen) > 1 else (),
        advice=advice,
        drifts=changes,
        conclusions=conclude(e, profiles, advice, changes),
    )


def _read(log: RunLog, bench: Bench, plant: Plant) -> tuple[Record, list[str]]:
    """What an estimator needs of a log, and what is missing in it."""
    experiment = read_experiment(log, bench)
    said = [log.missing] if log.missing else []
    return record_of(str(log.path), experiment, bench, plant), [*said, *experiment.missing, *_hidden(experiment)]


def _hidden(experiment: Experiment) -> list[str]:
    """Periods of which neither a report is left nor, as a rule, a command: the sample before them was lost as well."""
    lost = ~experiment.measured
    hidden = int((lost[1:] & lost[:-1]).sum())
    if not hidden:
        return []
    return [
        f"{hidden} periods lie between lost samples: what acted in them is assumed, and may be wrong enough "
        "for the right model not to fit"
    ]


def _model(logs: Sequence[RunLog]) -> tuple[str, str]:
    models = {default_model(log) for log in logs}
    if len({name for name, _ in models}) > 1:
        names = ", ".join(sorted(name for name, _ in models))
        raise UsageError(f"the logs are of different brakes ({names}): say which model to use, with --model")
    return sorted(models)[0]


def _truth(logs: Sequence[RunLog]) -> BrakeParameters | None:
    truths = {log.truth for log in logs}
    return truths.pop() if len(truths) == 1 else None
