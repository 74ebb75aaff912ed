"""Study of logs: estimate, model validation, conclusions and drift."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.analysis.conclusion import Conclusion, conclude
from emb_bench.analysis.drift import Drift, Earlier, drifts
from emb_bench.analysis.held_out import HeldOut, leave_one_out
from emb_bench.analysis.model_choice import ModelChoice, choose_model
from emb_bench.analysis.profile import Profile, profiles
from emb_bench.analysis.several_runs import Differing, apart
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import least
from emb_bench.config.bench import Bench
from emb_bench.config.plants import DEFAULT_PLANT, EVERY, Plant
from emb_bench.documents import ByName
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.intervals import bounded, union
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.output_error import SAME
from emb_bench.estimate.records import DONE, STARTS, End, EstimationProblem, Suspect, Unknown
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.figures import for_notebook
from emb_bench.information.evaluation import check_sample_time, default_model
from emb_bench.logs.log import RunLog, end_detail
from emb_bench.numbers import amount
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError, needs
from emb_runtime.safety.state_machine import FAULTS, Fault

SHOWN = 3  # Most suspected effects that are named


class ModelStanding(StrEnum):
    """Verdict of the tests on the model."""

    FITS = "fits"
    BIASED_METHOD = "not judged by a method that is biased"
    DOES_NOT_FIT = "DOES NOT FIT"
    DOES_NOT_PREDICT = "DOES NOT PREDICT"


@dataclass(frozen=True)
class Stop:
    """End of a run for another reason than completion."""

    log: str  # Name of the log
    reason: str
    detail: str
    periods: int  # Of the experiment that are in the log
    planned: int
    cause: str  # What the reason means; empty if it is no fault of a run
    advice: str

    @property
    def aborted(self) -> bool:
        """Returns True if the experiment itself was cut short."""
        return self.periods < self.planned


@dataclass(frozen=True)
class StudyOptions:
    """Method and extent of a study."""

    asked: EstimationProblem
    method: str = "oem"  # A key of ``records.METHODS``
    model: str | None = None
    """Name of a plant of the bench, or ``all`` for the one that explains the logs best; without, the one that was
    simulated, or the exact one where logs name none."""
    starts: int = STARTS
    seed: int = 0  # Seed of the starting points of searches
    profiles: bool = False
    """True for profiles of all shared unknowns, False for only those whose verdict may depend on one."""
    systematic: bool = True  # True to estimate the bench's systematic errors along

    def problem(self, bench: Bench, plant: Plant) -> EstimationProblem:
        """The unknowns of a plant, with the systematic errors that it can have where they are estimated too."""
        return with_systematic(self.asked, bench, plant) if self.systematic else self.asked


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Result of a study: the estimate from logs of one brake, its checks and the conclusions."""

    estimate: Estimate
    logs: tuple[RunLog, ...]  # In the order of the estimate's records
    options: StudyOptions
    last: Earlier | None  # Estimate that this one is compared with
    profiles: tuple[Profile, ...]
    """Profiles of the unknowns that the records share: all, or those whose verdict may depend on one."""
    left_out: tuple[HeldOut, ...]  # Prediction of each record from the others; empty for a single record
    drifts: tuple[Drift, ...]
    conclusions: tuple[Conclusion, ...]
    choice: ModelChoice | None = None  # Models that were compared; None if one was given
    apart: tuple[Differing, ...] = ()  # Parameters in which logs differ that each fit alone; empty if they fit together

    def __repr__(self) -> str:
        """Verdict and values in one line."""
        values = ", ".join(f"{name} = {value}" for name, value, _ in self._cells)
        return f"<Study of {', '.join(self.names)}: {self._verdict}; ± total (95 %, k=2): {values}>"

    def _repr_html_(self) -> str:
        """Verdict and values as a table of a notebook."""
        rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in self._cells)
        head = "<tr><th></th><th>value &pm; total (95 %, k=2)</th><th></th></tr>"
        return f"<p>{escape(self._verdict)}</p><table>{head}{rows}</table>"

    def summary(self) -> str:
        """Verdict, then a line for each parameter: value ± total (95 %, k=2), and whether it is identified."""
        return "\n".join([self._verdict, *(f"  {name} = {value}  {standing}" for name, value, standing in self._cells)])

    @property
    def _verdict(self) -> str:
        return f"model '{self.estimate.plant.name}' {self.standing}"

    @property
    def _cells(self) -> list[tuple[str, str, str]]:
        return [(c.label, amount(c.value, c.interval, c.unit), c.standing) for c in self.conclusions]

    def __getitem__(self, label: str) -> Conclusion:
        """Conclusion on a parameter, by its label."""
        return self.params[label]

    def __contains__(self, label: object) -> bool:
        return label in self.params

    def __iter__(self) -> Iterator[Conclusion]:
        return iter(self.conclusions)

    def __len__(self) -> int:
        return len(self.conclusions)

    @property
    def params(self) -> dict[str, Conclusion]:
        """Conclusions on the parameters by their labels: ``params["f_v"].value``, ``.interval``, ``.unit``."""
        return ByName({c.label: c for c in self.conclusions})

    parameters = params  # As the JSON of an estimate calls them

    @property
    def covariance(self) -> Floats:
        """Covariance of the values by all that the total has, in their units, in the order of ``params``."""
        e, wanted = self.estimate, self.estimate.wanted()
        covariance: Floats = (e.covariance() * np.outer(e.scale, e.scale))[np.ix_(wanted, wanted)]
        return covariance

    @property
    def correlation(self) -> Floats:
        """Correlations by the covariance; an error of J, with which all torques scale, makes them large."""
        covariance = self.covariance
        deviations = np.sqrt(np.diag(covariance))
        with np.errstate(invalid="ignore"):  # inf of what is not identified
            correlation: Floats = covariance / np.outer(deviations, deviations)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    @property
    def residuals(self) -> tuple[Floats, ...]:
        """Measured less predicted angle and velocity of each run, in standard deviations, NaN where lost; (n, 2)."""
        return self.estimate.residuals

    def to_dict(self) -> dict[str, dict[str, Any]]:
        """Value, ends of the 95 % interval, unit and repeatability of each parameter, by its label."""
        return {
            c.label: {"value": c.value, "low": c.interval[0], "high": c.interval[1], "unit": c.unit,
                      "repeatability": c.repeatability, "identified": c.identified}
            for c in self.conclusions
        }  # fmt: skip

    def plot(self) -> Any:
        """A figure of matplotlib: total interval and repeatability of each parameter, relative to its value."""
        figure, axes = for_notebook(1, (7.0, 1.0 + 0.5 * len(self)))
        for row, c in enumerate(self):
            low, high = (100.0 * (end / c.value - 1.0) for end in c.interval)
            half = 100.0 * c.repeatability / abs(c.value)
            axes.plot([low, high], [row, row], color="tab:blue", label="total, 95 %" if row == 0 else None)
            axes.plot([-half, half], [row, row], color="tab:orange", linewidth=5, label="" if row else "repeatability")
        axes.set_yticks(range(len(self)), [f"{c.label} = {amount(c.value, c.interval, c.unit)}" for c in self])
        axes.invert_yaxis()
        axes.set_xlabel("difference from the estimate [%]")
        axes.legend()
        return figure

    def to_dataframe(self) -> Any:
        """A pandas frame with a row for each parameter, the columns those of :meth:`to_dict`."""
        rows = [{"name": label, **row} for label, row in self.to_dict().items()]
        with needs("a frame", "notebook"):
            import pandas  # noqa: F401
            import pyarrow as pa

            return pa.Table.from_pylist(rows).to_pandas().set_index("name")

    @property
    def names(self) -> list[str]:
        """Names to show for the logs."""
        return file_names([log.path for log in self.logs])

    @property
    def truth(self) -> BrakeParameters | None:
        """Parameters of the simulated brake, if known and the same in all logs."""
        truths = {log.truth for log in self.logs}
        return truths.pop() if len(truths) == 1 else None

    @property
    def stopped(self) -> list[Stop]:
        """Ends of the runs that were stopped."""
        ends = map(stop_of, self.logs, self.estimate.records, self.names)
        return [stop for stop in ends if stop is not None]

    @property
    def model_fits(self) -> bool:
        """Returns True if the residual tests do not reject the model."""
        return self.estimate.validation.fits

    @property
    def predicts(self) -> bool:
        """Returns True if no prediction of a record rejects the model."""
        return all(h.fits for h in self.left_out)

    @property
    def holds(self) -> bool:
        """Returns True if the model fits and predicts."""
        return self.model_fits and self.predicts

    @property
    def identified(self) -> bool:
        """Returns True if all parameters of interest are identified."""
        return not self.unidentified

    @property
    def biased(self) -> bool:
        """Returns True if the tests fail for recursive least squares, whose bias is no evidence against the model."""
        return self.estimate.method == "rls" and not self.holds

    @property
    def standing(self) -> ModelStanding:
        """Verdict of the tests on the model."""
        if self.biased:
            return ModelStanding.BIASED_METHOD
        if not self.model_fits:
            return ModelStanding.DOES_NOT_FIT
        return ModelStanding.FITS if self.predicts else ModelStanding.DOES_NOT_PREDICT

    @property
    def aborted(self) -> bool:
        """Returns True if no experiment came to its planned end: a cause is to be found before any value is used."""
        return len(self.stopped) == len(self.logs) and all(stop.aborted for stop in self.stopped)

    @property
    def outside(self) -> tuple[Conclusion, ...]:
        """Parameters outside of the ranges for which the shield guarantees the limits."""
        return tuple(c for c in self.conclusions if c.outside is not None)

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Parameters of interest that are not identified."""
        return tuple(c.label for c in self.conclusions if c.of_interest and not c.identified)

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Effects that the model lacks, as the residuals suggest; the most suspicious ones first."""
        return self.estimate.validation.suspected[:SHOWN]

    @property
    def minima(self) -> list[list[End]]:
        """Local searches by the minimum where they ended, best first; none where chi2 is not that of the samples."""
        groups: list[list[End]] = []
        for end in self.estimate.ends if self.estimate.method != "rls" else ():
            if groups and end.cost - groups[-1][0].cost <= SAME:
                groups[-1].append(end)
            else:
                groups.append([end])
        return groups


def make_study(bench: Bench, logs: Sequence[RunLog], wanted: StudyOptions, *, last: Earlier | None = None) -> Study:
    """Estimates from logs, checks the model and draws the conclusions.

    Raises:
        UsageError: logs do not go together, one run is given twice, or they are too few for the options.
        LogError: a log lacks what an estimate needs.
    """
    for log in logs:
        check_sample_time(log, bench)
    if wanted.model == EVERY and wanted.method != "oem":
        raise UsageError(f"--model {EVERY} compares models by output error: expected --method oem, got {wanted.method}")
    plant = begun_with(bench, logs, wanted)
    names = file_names([log.path for log in logs])
    experiments = [read_experiment(log, bench, name) for log, name in zip(logs, names, strict=True)]

    def records_of(plant: Plant) -> list[Experiment]:
        return [own.seen_by(plant) for own in experiments]

    _check_different(experiments)
    choice = None
    if wanted.model == EVERY:
        choice = choose_model(
            bench,
            [bench.model(name) for name in bench.plants],
            records_of,
            wanted.problem(bench, plant),
            starts=wanted.starts,
            seed=wanted.seed,
        )
        e = choice.best.estimate
    else:
        asked = wanted.problem(bench, plant)
        e = method_of(wanted.method)(bench, plant, asked, starts=wanted.starts, seed=wanted.seed).fit(records_of(plant))
    # The likelihood of a whole recording is none of windows.
    found = profiles(e, of_all=wanted.profiles) if wanted.method != "windows" else ()
    changes = () if last is None else drifts(e, last)
    left_out = leave_one_out(e) if len(logs) > 1 else ()
    return Study(
        estimate=e,
        logs=tuple(logs),
        options=wanted,
        last=last,
        profiles=found,
        left_out=left_out,
        drifts=changes,
        conclusions=covering(
            conclude(e, found, changes, predicts=all(h.fits for h in left_out)),
            [e.unknowns[i] for i in e.wanted()],
            choice,
        ),
        choice=choice,
        apart=apart(e) if wanted.method == "oem" else (),
    )


def begun_with(bench: Bench, logs: Sequence[RunLog], wanted: StudyOptions) -> Plant:
    """The plant that a study of logs begins with: the one that was asked for, or that of the logs."""
    if wanted.model is not None:
        return bench.model(DEFAULT_PLANT if wanted.model == EVERY else wanted.model)
    models = sorted({default_model(log)[0] for log in logs})
    if len(models) > 1:
        raise UsageError(
            f"the logs are of different brakes ({', '.join(models)}): say which model to use, with --model"
        )
    return bench.model(models[0])


def covering(
    conclusions: Sequence[Conclusion], unknowns: Sequence[Unknown], choice: ModelChoice | None
) -> tuple[Conclusion, ...]:
    """Conclusions whose intervals cover all models that the records do not tell apart."""
    if choice is None or len(choice.left_over) < 2:
        return tuple(conclusions)
    return tuple(
        replace(c, interval=bounded(union(c.interval, choice.interval(unknown)), c.value, least(unknown.name)))
        for c, unknown in zip(conclusions, unknowns, strict=True)
    )


def _check_different(records: Sequence[Experiment]) -> None:
    """Refuse a run that is given twice, whatever its files are called and however much of it each of them holds.

    Two runs never have the same noise; counted twice one would halve its variance, and predict itself.
    """
    for i, record in enumerate(records):
        for other in records[:i]:
            n = min(len(record.samples), len(other.samples))
            same = np.array_equal(record.samples[:n], other.samples[:n], equal_nan=True)
            if same and (record.measured[:n] & (record.samples[:n] != record.samples[0]).any(axis=1)).any():
                raise UsageError(f"{record.name}: the same samples as in {other.name}: expected each run once")


def file_names(paths: Sequence[Path]) -> list[str]:
    """Names to show for files: the file name where it is unique, else the path."""
    counts = Counter(path.name for path in paths)
    return [path.name if counts[path.name] == 1 else str(path) for path in paths]


def stop_of(log: RunLog, experiment: Experiment | None, name: str) -> Stop | None:
    """End of a run that was stopped; None if the log has no other reason for its end than completion."""
    if log.end.get("exit_reason", DONE) == DONE:
        return None
    reason = log.exit_reason
    periods, planned = (0, 0) if experiment is None else (experiment.periods, experiment.planned)
    fault = FAULTS[Fault[reason]] if reason in Fault.__members__ else None
    cause, advice = ("", "") if fault is None else (fault.cause, fault.advice)
    return Stop(name, reason, end_detail(log.end), periods, planned, cause, advice)
