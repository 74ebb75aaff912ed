"""Content of a report, from the logs: the runs, the files left out and the study."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from emb_bench.analysis.drift import Earlier
from emb_bench.analysis.study import Stop, Study, StudyOptions, begun_with, make_study, stop_of
from emb_bench.config.bench import Bench
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.prediction import too_few
from emb_bench.estimate.records import DONE
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.logs import timing
from emb_bench.logs.info import cycle_summary
from emb_bench.logs.log import RunLog
from emb_bench.logs.timing import Timing
from emb_bench.report import sentences as say
from emb_bench.report.acceptance import Acceptance, Criteria, Result, RunFacts, judge
from emb_runtime.errors import LogError
from emb_runtime.records import Reason
from emb_runtime.system.input_file import open_regular

REASONS = {
    Reason.CLIPPED: "beyond the bench's current",
    Reason.LIMITED: "kept inside the limits by the shield",
    Reason.RETURNING: "the shield returns home",
    Reason.MISSED: "no sample in time, nothing sent",
    Reason.LEFT: "the needed current is beyond slew or limit: the node brakes",
}
"""Reasons for which the sent current differs from the one that the policy requested, in words."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run."""

    log: RunLog
    bench: Bench  # Bench that the report is made with
    experiment: Experiment | None
    why_not: str  # Reason that the log is not used for an estimate; empty if it is
    timing: Timing | None  # None if the log has no control cycles
    residuals: NDArray[np.float64] | None = None
    """In standard deviations, NaN where lost, shape (n, 2); none without an estimate."""
    predicted: NDArray[np.float64] | None = None
    """Angle [rad] and velocity [rad/s] that the model predicts at the estimate, shape (n, 2)."""
    alone: Study | None = None
    """Study of this run by itself, where there are several; None if there is one, or it has no part in the estimate."""

    @cached_property
    def log_sha256(self) -> str:
        """SHA-256 of the log's file."""
        try:
            with open_regular(self.log.path) as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as err:
            raise LogError(f"{self.log.path}: {err.strerror}") from err

    @cached_property
    def cycles(self) -> ActiveCycles | None:
        """Cycles of the control loop; None if the log has none, as a recording of others."""
        try:
            cycles = ActiveCycles(self)
        except LogError:
            return None
        return cycles if len(cycles.time) else None

    @cached_property
    def after(self) -> StopSamples | None:
        """The samples after the last cycle of a stopped run; None if it was not stopped, or its log has none."""
        return stop_samples(self)

    @property
    def stop(self) -> Stop | None:
        """Its end, if the run was stopped."""
        return stop_of(self.log, self.experiment, self.name)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.log.path.name

    @property
    def done(self) -> bool:
        """Returns True if the run was completed."""
        return self.log.exit_reason == DONE

    @property
    def source(self) -> str:
        """Machine that was driven: a simulated one, or the bench on its interface; or a recording of others."""
        if self.log.is_recording:
            return "recording of another machine"
        return self.log.simulated or f"bench on {self.log.run.get('iface', 'an unknown interface')}"

    @property
    def began(self) -> str:
        """Begin of the run in UTC, by the clock of the computer that recorded it; empty if the log has none."""
        first, _ = self.log.span
        if not 0 < first < 2**62:
            return ""
        return datetime.fromtimestamp(first // 1_000_000_000, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


@dataclass(frozen=True, eq=False, repr=False)
class Content:
    """Content of a report."""

    runs: tuple[Run, ...]
    left_out: tuple[tuple[Path, str], ...]  # Files that could not be used at all, and why
    study: Study | None
    why_not: str  # Reason that there is no estimate; empty if there is one
    made_by: str  # Name and version of the tool that made the report
    acceptance: Acceptance | None = None  # Results of the acceptance criteria; None if none were given

    def __repr__(self) -> str:
        """The verdict in one line."""
        return f"<Report on {', '.join(run.name for run in self.reported)}: {self.verdict}>"

    @property
    def estimated(self) -> tuple[Run, ...]:
        """The runs of the estimate, in the order of its records."""
        return tuple(run for run in self.runs if not run.why_not)

    @property
    def reported(self) -> tuple[Run, ...]:
        """The runs that the page is about: those of the estimate, or all where there is none."""
        return self.estimated or self.runs

    @property
    def verdict(self) -> str:
        """The report in one line: why a run was stopped, whether the brake was accepted, or whether the model fits.

        Before it the sentence that the machine was none.
        """
        return " ".join(filter(None, (self.simulated, self._verdict)))

    @property
    def simulated(self) -> str:
        """That the values are not those of a real machine; empty if no log says so."""
        return say.simulated([run.log for run in self.reported], [run.name for run in self.reported])

    @property
    def _verdict(self) -> str:
        if self.stops:
            more = f", and {len(self.stops) - 1} more" if len(self.stops) > 1 else ""
            return f"{'NOT ACCEPTED. ' if self.acceptance else ''}{say.stopped(self.stops[0])}{more}"
        if self.acceptance is not None:
            return self.acceptance.verdict
        if self.study is None:
            return f"NO ESTIMATE: {self.why_not}"
        return say.ONLY_ALONE if self.study.apart else say.headline(self.study)

    @property
    def tone(self) -> str:
        """Colour of the verdict: ``good``, ``bad`` or ``care``."""
        if self.stops or self.outside:
            return "bad"
        if self.acceptance is not None:
            passed = "care" if self.simulated else "good"
            return {Result.PASS: passed, Result.FAIL: "bad", Result.CANNOT_TELL: "care"}[self.acceptance.result]
        if self.study is None:
            return "care"
        if not self.study.holds:
            return "bad"
        good = self.study.identified and all(run.log.complete for run in self.reported) and not self.simulated
        return "good" if good else "care"

    @property
    def without_part(self) -> list[str]:
        """Reason for each log that was given and not used, beginning with its name."""
        return [
            *(f"{path.name}: left out: {why}" for path, why in self.left_out),
            *(f"{run.name}: not used in the estimate: {run.why_not}" for run in self.runs if run.why_not),
        ]

    @property
    def number(self) -> str:
        """Number of the report: the same logs have the same."""
        return hashlib.sha256("".join(run.log_sha256 for run in self.runs).encode()).hexdigest()[:10].upper()

    @property
    def stops(self) -> list[Stop]:
        """Ends of the runs that were stopped, those without an estimate included."""
        return [run.stop for run in self.runs if run.stop is not None]

    @property
    def outside(self) -> list[tuple[str, Study]]:
        """Studies, of single runs if there are several, of a brake for which the limits were not guaranteed."""
        alone = [(run.name, run.alone) for run in self.runs if run.alone is not None]
        studies = alone or ([] if self.study is None else [(self.reported[0].name, self.study)])
        return [(name, study) for name, study in studies if study.outside]

    @property
    def shown(self) -> Study | None:
        """The study, if its values are to be used: not if every experiment was cut short."""
        return None if self.study is not None and self.study.aborted else self.study


def gather(
    bench: Bench,
    logs: Sequence[RunLog],
    left_out: Sequence[tuple[Path, str]],
    wanted: StudyOptions,
    made_by: str,
    *,
    last: Earlier | None = None,
    criteria: Criteria | None = None,
) -> Content:
    """Estimates from the logs that have an experiment, and states for each other log why it is not used."""
    experiments = [_experiment(log, bench, wanted) for log in logs]
    used = [log for log, (_, why_not) in zip(logs, experiments, strict=True) if not why_not]
    study = make_study(bench, used, wanted, last=last) if used else None
    single = replace(wanted, profiles=False)
    runs = []
    for log, (experiment, why_not) in zip(logs, experiments, strict=True):
        number = None if why_not else used.index(log)
        run = _run(log, bench, experiment, why_not, study, number)
        runs.append(run if why_not or len(used) == 1 else replace(run, alone=make_study(bench, [log], single)))
    why_not = "" if used else "; ".join(f"{run.name}: {run.why_not}" if len(runs) > 1 else run.why_not for run in runs)
    content = Content(tuple(runs), tuple(left_out), study, why_not, made_by)
    if criteria is None:
        return content
    facts = [_facts(run) for run in runs]
    return replace(content, acceptance=judge(criteria, facts, content.without_part, study, why_not, last))


def _facts(run: Run) -> RunFacts:
    x = run.experiment
    return RunFacts(
        name=run.name,
        exit_reason=run.log.exit_reason,
        complete=run.log.complete,
        missing=run.log.missing,
        missed=None if run.timing is None else run.timing.share("missed"),
        lost=None if x is None or x.planned == 0 else 1.0 - int(x.measured.sum()) / max(len(x.measured), 1),
    )


def _experiment(log: RunLog, bench: Bench, wanted: StudyOptions) -> tuple[Experiment | None, str]:
    """The experiment, and why nothing can be estimated from it; empty if something can."""
    try:
        experiment = read_experiment(log, bench)
    except LogError as err:
        return None, str(err).removeprefix(f"{log.path}: ")
    plant = begun_with(bench, [log], wanted)
    return experiment, too_few(plant, wanted.problem(bench, plant), int(experiment.measured.sum()), 1)


def _timing(log: RunLog) -> Timing | None:
    try:
        return timing.timing(log)
    except LogError:
        return None


def _run(
    log: RunLog, bench: Bench, experiment: Experiment | None, why_not: str, study: Study | None, number: int | None
) -> Run:
    punctual = _timing(log)
    if study is None or number is None:
        return Run(log, bench, experiment, why_not, punctual)
    e = study.estimate
    # With a start for each window there is no prediction of the whole run.
    predicted = None if e.method == "windows" else _predicted(e, number)
    return Run(log, bench, experiment, why_not, punctual, e.residuals[number], predicted)


def _predicted(e: Estimate, number: int) -> NDArray[np.float64]:
    return e.problem.motion(e.z, number).samples


@dataclass(frozen=True)
class StopSamples:
    """Samples after the last cycle of a run, while it was stopped and until the recording ended; each over its time."""

    angle: tuple[NDArray[np.float64], NDArray[np.float64]]  # Time since the run began [s] and angle [rad]
    velocity: tuple[NDArray[np.float64], NDArray[np.float64]]  # Time [s] and velocity [rad/s]
    current: tuple[NDArray[np.float64], NDArray[np.float64]]  # Time [s] and current that the node applied [A]

    @property
    def end(self) -> float:
        """Time of the last one [s]."""
        return max((float(time[-1]) for time, _ in (self.angle, self.velocity, self.current) if len(time)), default=0.0)


def stop_samples(run: Run) -> StopSamples | None:
    """See :attr:`Run.after`."""
    if run.stop is None:
        return None
    try:
        cycles = run.log.cycles
        active = timing.in_control(cycles)
        if not active.any():
            return None
        last, step = int(cycles["publish_time"][active][-1]), float(cycles["step"][active][-1])

        def after(message: str, signal: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            table = run.log.signals(message)
            where = table["publish_time"] > last
            time = step * run.bench.timing.sample_time + 1e-9 * (table["publish_time"][where] - last)
            return time, np.asarray(table[signal][where], dtype=np.float64)

        found = StopSamples(
            after("EMB_Angle", "Angle"), after("EMB_Velocity", "Velocity"), after("EMB_Velocity", "AppliedCurrent")
        )
    except (LogError, KeyError, TypeError, ValueError):
        return None  # a log without these messages, or with others of their names
    return found if found.end > 0.0 else None


class ActiveCycles:
    """The cycles of an experiment as columns, in order; n of them."""

    def __init__(self, run: Run) -> None:
        """Take them from the log."""
        cycles = run.log.cycles
        active = timing.in_control(cycles)
        self.time: NDArray[np.float64] = cycles["step"][active] * run.bench.timing.sample_time
        """Time since the run began [s]."""
        self.wanted, self.clipped, self.sent = (
            cycles[f"{name}_current"][active] for name in ("policy", "clipped", "sent")
        )
        """Currents [A], NaN where there was none."""
        self.angle, self.velocity = cycles["angle"][active], cycles["velocity"][active]
        """Angle [rad] and velocity [rad/s] in the samples that the loop received."""
        reasons = cycles["reasons"][active]
        self.reasons = {reason: (reasons & reason) != 0 for reason in REASONS}
        """Mask of the cycles in which each reason held."""
        self.largest = cycle_summary(run.log).largest
        """Extremes of angle, speed and current, as the command ``info`` gives them."""
