"""Study of runs of one brake: experiments, joint estimate, checks, conclusions, and the verdict on all of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from html import escape
from typing import Any, Literal, NamedTuple

import numpy as np

from emb_bench.analysis.clamping import NEEDED, Clamping, clamping
from emb_bench.analysis.conclusion import Conclusion
from emb_bench.analysis.drift import Drift, Earlier
from emb_bench.analysis.options import EstimateOptions
from emb_bench.analysis.records import Differing, HeldOut, ModelChoice, Profile
from emb_bench.brake.motion import Floats
from emb_bench.documents import ByName
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import DONE, SAME, End
from emb_bench.experiment.experiment import Experiment
from emb_bench.figures import for_notebook
from emb_bench.logs.log import RunLog, end_detail
from emb_bench.logs.timing import Timing, timing
from emb_bench.numbers import amount
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import LogError, needs
from emb_runtime.safety.state_machine import FAULTS, Fault


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
        """Returns True if the experiment was cut short."""
        return self.periods < self.planned


@dataclass(frozen=True, eq=False)
class StudiedRun:
    """One run of a study."""

    log: RunLog
    name: str  # Of the file, or its path if another run has that name
    experiment: Experiment | None  # None if the log has none
    why_not: str = ""  # Reason that it is not in the estimate; empty if it is
    alone: Study | None = None  # Study of this run by itself, where a report has several

    @cached_property
    def timing(self) -> Timing | None:
        """Timing of its loop; None if the log has no control cycles."""
        with suppress(LogError):
            return timing(self.log)
        return None

    @property
    def lost(self) -> float | None:
        """Share of the samples that are not in the log; None without an experiment."""
        x = self.experiment
        return None if x is None or x.quality.planned == 0 else 1.0 - int(x.measured.sum()) / max(len(x.measured), 1)

    @property
    def stop(self) -> Stop | None:
        """Its end; None if the log has no other reason for it than completion."""
        if self.log.end.get("exit_reason", DONE) == DONE:
            return None
        reason, x = self.log.exit_reason, self.experiment
        periods, planned = (0, 0) if x is None else (x.periods, x.quality.planned)
        fault = FAULTS[Fault[reason]] if reason in Fault.__members__ else None
        cause, advice = ("", "") if fault is None else (fault.cause, fault.advice)
        return Stop(self.name, reason, end_detail(self.log.end), periods, planned, cause, advice)


@dataclass(frozen=True)
class Checks:
    """Checks of a joint estimate."""

    profiles: tuple[Profile, ...] = ()
    """Profiles of the shared unknowns: all, or those that :func:`~emb_bench.analysis.profile.profiles` selects."""
    held_out: tuple[HeldOut, ...] = ()  # Prediction of each experiment from the others; empty for a single one
    drifts: tuple[Drift, ...] = ()
    choice: ModelChoice | None = None  # Models that were compared; None if one was given
    apart: tuple[Differing, ...] = ()  # Parameters that differ between runs, each of which fits alone

    @property
    def predicts(self) -> bool:
        """Returns True if no prediction of an experiment rejects the model."""
        return all(prediction.fits for prediction in self.held_out)


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """Runs of one brake, their joint estimate, its checks and the conclusions."""

    runs: tuple[StudiedRun, ...]
    joint: Estimate | None  # Of the used runs, in their order; None in a report without any
    checks: Checks
    conclusions: tuple[Conclusion, ...]
    options: EstimateOptions
    last: Earlier | None = None  # Estimate that this one is compared with

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
        found = verdict(self)
        return "no estimate" if self.joint is None else f"model '{self.joint.plant.name}' {found.standing}"

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
        """Total covariance of the values, in their units, in the order of ``params``."""
        e, index = self.estimate, self.estimate.requested()
        covariance: Floats = (e.covariance() * np.outer(e.scale, e.scale))[np.ix_(index, index)]
        return covariance

    @property
    def correlation(self) -> Floats:
        """Correlations by the covariance; large because an error of J scales all torques."""
        covariance = self.covariance
        deviations = np.sqrt(np.diag(covariance))
        with np.errstate(invalid="ignore"):  # inf of what is not identified
            correlation: Floats = covariance / np.outer(deviations, deviations)
        np.fill_diagonal(correlation, 1.0)
        return correlation

    @property
    def clamping(self) -> Clamping | None:
        """Clamping force, holding current and friction band; None of a wrong model, or where a parameter is missing."""
        is_complete = all(name in self and self[name].identified for name in NEEDED)
        return clamping(self.estimate) if is_complete and verdict(self).holds else None

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
    def estimate(self) -> Estimate:
        """The joint estimate.

        Raises:
            LogError: no run has a part in one.
        """
        if self.joint is None:
            raise LogError(self.why_not)
        return self.joint

    @property
    def why_not(self) -> str:
        """Reason that there is no estimate; empty if there is one."""
        reasons = [f"{run.name}: {run.why_not}" if len(self.runs) > 1 else run.why_not for run in self.runs]
        return "; ".join(reasons) if self.joint is None else ""

    @property
    def used(self) -> tuple[StudiedRun, ...]:
        """The runs of the estimate, in the order of its experiments."""
        return tuple(run for run in self.runs if not run.why_not)

    @property
    def reported(self) -> tuple[StudiedRun, ...]:
        """The runs of the estimate, or all where there is none."""
        return self.used or self.runs

    @property
    def logs(self) -> tuple[RunLog, ...]:
        """The logs of the estimate, in the order of its experiments."""
        return tuple(run.log for run in self.used)

    @property
    def names(self) -> list[str]:
        """Names to show for the runs that are reported."""
        return [run.name for run in self.reported]

    @property
    def truth(self) -> BrakeParameters | None:
        """Parameters of the simulated brake, if all logs have the same."""
        truths = {log.truth for log in self.logs}
        return truths.pop() if len(truths) == 1 else None

    @property
    def side_by_side(self) -> list[Study]:
        """The studies of runs that are each estimated alone; empty where there is a joint estimate, or none."""
        alone = [run.alone for run in self.runs if run.alone is not None]
        return alone if self.joint is None and len(alone) == len(self.runs) else []

    @property
    def stops(self) -> list[Stop]:
        """Ends of the runs that were stopped."""
        return [stop for run in self.runs if (stop := run.stop) is not None]

    @property
    def model_fits(self) -> bool:
        """Returns True if the residual tests do not reject the model."""
        return self.joint is not None and self.joint.validation.fits

    @property
    def outside(self) -> list[tuple[str, Conclusion]]:
        """Names of runs with the parameters outside of the ranges for which the shield guarantees the limits.

        Of the runs alone, if they are estimated alone.
        """
        found = [(run.name, c) for run in self.runs if run.alone is not None for c in run.alone.conclusions]
        found = found or [(self.names[0], c) for c in self.conclusions]
        return [(name, c) for name, c in found if c.outside is not None]

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Parameters of interest that are not identified."""
        return tuple(c.label for c in self.conclusions if c.of_interest and not c.identified)

    @property
    def minima(self) -> list[list[End]]:
        """Local searches by the minimum where they ended, best first; none for least squares, which does not search."""
        groups: list[list[End]] = []
        for end in self.estimate.ends if self.estimate.method != "rls" else ():
            if groups and end.cost - groups[-1][0].cost <= SAME:
                groups[-1].append(end)
            else:
                groups.append([end])
        return groups


# ---- the verdict ----


class Result(StrEnum):
    """Result of an acceptance criterion, or of all together."""

    PASS = "pass"
    FAIL = "fail"
    CANNOT_TELL = "cannot tell"


class Code(StrEnum):
    """Verdict on a study."""

    ABORTED = "every experiment was cut short"
    STOPPED = "a run was stopped"
    REJECTED = "not accepted"
    UNDECIDED = "acceptance not decided"
    ACCEPTED = "accepted"
    NO_ESTIMATE = "no estimate"
    APART = "each run fits alone"
    BIASED_METHOD = "no verdict, as the method is biased"
    DOES_NOT_FIT = "DOES NOT FIT"
    DOES_NOT_PREDICT = "DOES NOT PREDICT"
    NOT_IDENTIFIED = "not all parameters are identified"
    FITS = "fits"


Tone = Literal["good", "care", "bad"]


class Verdict(NamedTuple):
    """Answer to the question whether a study is good."""

    code: Code
    tone: Tone
    model: Code  # Verdict on the model alone

    @property
    def holds(self) -> bool:
        """Returns True if the model fits and predicts."""
        return self.model in (Code.FITS, Code.NOT_IDENTIFIED)

    @property
    def biased(self) -> bool:
        """Returns True if the tests fail for a method whose bias is no evidence against the model."""
        return self.model is Code.BIASED_METHOD

    @property
    def standing(self) -> str:
        """The verdict of the tests on the model."""
        return Code.FITS.value if self.holds else self.model.value


Condition = Callable[["Study", Result | None], bool]
VERDICTS: tuple[tuple[Code, Tone, Condition], ...] = (
    (Code.ABORTED, "bad", lambda s, _: bool(s.used) and all(run.stop and run.stop.aborted for run in s.used)),
    (Code.STOPPED, "bad", lambda s, _: bool(s.stops)),
    (Code.REJECTED, "bad", lambda _, accepted: accepted is Result.FAIL),
    (Code.UNDECIDED, "care", lambda _, accepted: accepted is Result.CANNOT_TELL),
    (Code.ACCEPTED, "good", lambda _, accepted: accepted is Result.PASS),
    (Code.APART, "bad", lambda s, _: bool(s.checks.apart)),
)
"""Verdicts on the runs and on acceptance, the most severe first, with their tones and conditions."""
MODEL_VERDICTS: tuple[tuple[Code, Tone, Condition], ...] = (
    (Code.NO_ESTIMATE, "care", lambda s, _: s.joint is None),
    (Code.BIASED_METHOD, "bad", lambda s, _: s.estimate.method == "rls" and not (s.model_fits and s.checks.predicts)),
    (Code.DOES_NOT_FIT, "bad", lambda s, _: not s.model_fits),
    (Code.DOES_NOT_PREDICT, "bad", lambda s, _: not s.checks.predicts),
    (Code.NOT_IDENTIFIED, "care", lambda s, _: bool(s.unidentified)),
    (Code.FITS, "good", lambda *_: True),
)
"""Verdicts on the model, the most severe first."""


def verdict(study: Study, accepted: Result | None = None) -> Verdict:
    """The most severe verdict that holds; ``accepted`` is the result of acceptance criteria, if there are any.

    The tone is never good for a brake outside of the shield's ranges, a simulated brake or an incomplete log. The
    verdict on runs side by side is the worst one.
    """
    if study.side_by_side:
        found = [verdict(one, accepted) for one in study.side_by_side]
        return min(found, key=lambda one: (list(Code).index(one.code), ("bad", "care", "good").index(one.tone)))
    model, tone = next((code, tone) for code, tone, holds in MODEL_VERDICTS if holds(study, accepted))
    code, tone = next(((code, tone) for code, tone, holds in VERDICTS if holds(study, accepted)), (model, tone))
    if study.outside:
        tone = "bad"
    elif tone == "good" and any(run.log.simulated or not run.log.complete for run in study.reported):
        tone = "care"
    return Verdict(code, tone, model)
