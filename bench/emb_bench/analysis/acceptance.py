"""Acceptance test of a brake: criteria from a small file, each passed, failed, or not decided by the record.

A quantity with an interval passes if the whole 95 % interval lies inside the limits, fails if it lies outside, and is
not decided if it straddles a limit: then a more informative record decides it. Nothing that rests on the model is
decided where the model does not fit.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from emb_bench.analysis.drift import Drift, comparable
from emb_bench.analysis.study import Study
from emb_bench.brake.parameters import OF_A_RECORD, PARAMETERS, SI, UNITS
from emb_bench.estimate.records import DONE, NORMAL_95
from emb_bench.numbers import amount, between, plain, share, share_between
from emb_runtime.config.validation import Rules, Table, shown
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import read_text

LONGEST = 2**20  # Size limit of the file [bytes]
RULES = Rules(UsageError, 200, 1e-30)
SHARED = tuple(name for name in PARAMETERS if name not in OF_A_RECORD)  # Unknowns that a tolerance can be stated for


class Result(StrEnum):
    """Result of a criterion, or of all together."""

    PASS = "pass"
    FAIL = "fail"
    CANNOT_TELL = "cannot tell"


@dataclass(frozen=True)
class Tolerance:
    """Limits of one parameter."""

    name: str
    interval: tuple[float, float] | None = None
    """Lowest and highest allowed value, SI units; None where ``relative`` is given."""
    relative: float = 0.0  # Largest allowed deviation from the reference, as a share of it
    reference: float | None = None  # SI units; None for the bench file's nominal value


@dataclass(frozen=True)
class Criteria:
    """Content of an acceptance file."""

    source: str  # Name of the file
    text: str  # The file as it was read
    model_fit: bool = True  # The model has to fit the records, and to predict what it was not fitted to
    parameters: tuple[Tolerance, ...] = ()
    drift: Mapping[str, float] = field(default_factory=dict)
    """Largest allowed change since an earlier estimate, by parameter: relative, or in the parameter's unit."""
    missed: float | None = None  # Largest allowed share of periods without a sample in time, of each run
    lost: float | None = None  # Largest allowed share of samples that are not in the log, of each run


@dataclass(frozen=True)
class Criterion:
    """One criterion and its result."""

    name: str
    required: str
    found: str
    result: Result
    why: str = ""  # Reason that it failed or cannot be decided; empty if it passed


@dataclass(frozen=True)
class RunFacts:
    """Facts about one run that the criteria judge."""

    name: str
    exit_reason: str
    complete: bool  # True if the log is
    missing: str  # Parts of the log that are missing
    missed: float | None  # Share of periods without a sample in time; None if it was not measured
    lost: float | None  # Share of the samples that are not in the log; None without an experiment


@dataclass(frozen=True)
class Acceptance:
    """All criteria with their results."""

    criteria: Criteria
    results: tuple[Criterion, ...]

    @property
    def result(self) -> Result:
        """The whole: failed if one criterion is, else not decided if one is not."""
        found = {one.result for one in self.results}
        return next((r for r in (Result.FAIL, Result.CANNOT_TELL) if r in found), Result.PASS)

    def of(self, result: Result) -> tuple[Criterion, ...]:
        """The criteria with a result."""
        return tuple(one for one in self.results if one.result == result)

    def document(self) -> dict[str, Any]:
        """JSON document."""
        return {
            "file": self.criteria.source,
            "result": self.result.value,
            "criteria": [
                {
                    "name": one.name,
                    "required": one.required,
                    "found": one.found,
                    "result": one.result.value,
                    "why": one.why,
                }
                for one in self.results
            ],
        }


def read_criteria(path: Path) -> Criteria:
    """Criteria from a TOML file, see ``docs/reference/acceptance.md``.

    Raises:
        UsageError: the file cannot be read, or does not have the form.
    """
    source = f"--acceptance {path}"
    try:
        text = read_text(path, LONGEST)
        content = tomllib.loads(text)
    except OSError as err:
        raise UsageError(f"{source}: {err.strerror}") from err
    except (ValueError, RecursionError) as err:
        raise UsageError(f"{source}: expected TOML: {err}") from err
    document = Table(source, "", content, RULES)
    table = document.table("acceptance")
    document.nothing_else()
    names = table.names()
    model_fit = table.get("model_fit") if "model_fit" in names else True
    if not isinstance(model_fit, bool):
        raise table.fail("model_fit", f"expected true or false, got {shown(model_fit)}")
    tolerances = _tolerances(table.table("parameters")) if "parameters" in names else ()
    drift = _drift(table.table("drift")) if "drift" in names else {}
    missed = lost = None
    if "budgets" in names:
        budgets = table.table("budgets")
        missed, lost = (
            budgets.number(name, lambda x: 0.0 <= x <= 1.0, "a share from 0 to 1") if name in budgets.names() else None
            for name in ("missed", "lost")
        )
        budgets.nothing_else(("missed", "lost"))
    table.nothing_else(("model_fit", "parameters", "drift", "budgets"))
    return Criteria(path.name, text, model_fit, tolerances, drift, missed, lost)


def _tolerances(table: Table) -> tuple[Tolerance, ...]:
    found = []
    for name in table.names():
        if name not in SHARED:
            raise table.fail(name, f"expected one of {', '.join(SHARED)}")
        entry = table.table(name)
        keys = entry.names()
        if ("interval" in keys) == ("relative" in keys):
            raise table.fail(name, "expected either interval = [low, high] or relative")
        if "interval" in keys:
            found.append(Tolerance(name, entry.number_pair("interval")))
        elif name in UNITS:
            raise table.fail(name, "expected interval = [low, high]: it has no size that could be shared")
        else:
            relative = entry.number("relative", lambda x: x > 0.0, "a positive share")
            positive = "a positive number"
            reference = entry.number("reference", lambda x: x > 0.0, positive) if "reference" in keys else None
            found.append(Tolerance(name, None, relative, reference))
        entry.nothing_else(("interval", "relative", "reference"))
    return tuple(found)


def _drift(table: Table) -> dict[str, float]:
    for name in table.names():
        if name not in SHARED:
            raise table.fail(name, f"expected one of {', '.join(SHARED)}")
    return {name: table.number(name, lambda x: x > 0.0, "a positive number") for name in table.names()}


def judge(
    criteria: Criteria,
    runs: Sequence[RunFacts],
    left_out: Sequence[str],
    study: Study | None,
    why_no_study: str = "",
    last: Mapping[str, Any] | None = None,
) -> Acceptance:
    """Results of all criteria. That each run came to its end and its log is whole is always one of them.

    Args:
        criteria: what is required.
        runs: all that were given and could be read.
        left_out: reason for each log that takes no part, beginning with its name.
        study: the estimate; None if there is none.
        why_no_study: reason for that.
        last: document of an earlier estimate.
    """
    results = [_completed(run, len(runs) > 1) for run in runs]
    results += [Criterion("all logs used", "yes", "no", Result.FAIL, words) for words in left_out]
    doubt = _doubt(study, why_no_study)
    if criteria.model_fit:
        results.append(_model_fit(study, doubt))
    results += [_tolerated(one, study, doubt) for one in criteria.parameters]
    drifts = {} if study is None else {drift.name: drift for drift in study.drifts}
    earlier = "" if study is None or last is None else comparable(study.estimate, last)
    for name, most in criteria.drift.items():
        results.append(_drifted(name, most, drifts.get(name), doubt or earlier, given=last is not None))
    for run in runs:
        of = f", {run.name}" if len(runs) > 1 else ""
        if criteria.missed is not None:
            results.append(_counted(f"missed periods{of}", criteria.missed, run.missed))
        if criteria.lost is not None:
            results.append(_counted(f"lost samples{of}", criteria.lost, run.lost))
    return Acceptance(criteria, tuple(results))


def _doubt(study: Study | None, why_no_study: str) -> str:
    """Reason that no number of the estimate decides anything; empty if they may."""
    if study is None:
        return f"no estimate: {why_no_study}"
    if study.holds:
        return ""
    if study.biased:
        return "recursive least squares is biased: use --method oem"
    return "the model does not fit" if not study.model_fits else "the model does not predict all records"


def _completed(run: RunFacts, several: bool) -> Criterion:
    name = f"completed, {run.name}" if several else "run completed"
    required = "ran to its planned end, log complete"
    if run.exit_reason != DONE:
        return Criterion(name, required, run.exit_reason, Result.FAIL, f"the run was stopped: {run.exit_reason}")
    if not run.complete:
        return Criterion(name, required, "log NOT complete", Result.FAIL, run.missing)
    return Criterion(name, required, "yes", Result.PASS)


def _model_fit(study: Study | None, doubt: str) -> Criterion:
    name, required = "model fit", "residuals are noise"
    if study is None or study.biased:
        return Criterion(name, required, "not judged", Result.CANNOT_TELL, doubt)
    found = f"chi2/n {plain(study.estimate.validation.ratio)}"
    return Criterion(name, required, found, Result.FAIL if doubt else Result.PASS, doubt)


def _tolerated(tolerance: Tolerance, study: Study | None, doubt: str) -> Criterion:
    name, unit = tolerance.name, SI[tolerance.name]
    if tolerance.interval is not None:
        low, high = tolerance.interval
        required = f"{plain(low, 6)} to {plain(high, 6)} {unit}"
    else:
        nominal = "nominal" if tolerance.reference is None else "the reference"
        reference = tolerance.reference
        if reference is None and study is not None:
            reference = float(getattr(study.estimate.bench.brake, name))
        about = nominal if reference is None else f"{nominal} {plain(reference, 6)} {unit}"
        required = f"{about} ± {share(tolerance.relative, 3)}"
        low, high = (math.nan if reference is None else reference * (1.0 + s * tolerance.relative) for s in (-1.0, 1.0))
    found = None if study is None else next((c for c in study.conclusions if c.label == name), None)
    if found is None:
        return Criterion(name, required, "not estimated", Result.CANNOT_TELL, doubt or "it was not estimated")
    value = amount(found.value, found.interval, found.unit)
    return Criterion(name, required, value, *_inside(found.interval, (low, high), doubt or found.why_not))


def _drifted(name: str, most: float, drift: Drift | None, doubt: str, *, given: bool) -> Criterion:
    unit = f" {UNITS[name]}" if name in UNITS else ""
    label, required = f"drift of {name}", f"at most ± {plain(most) if unit else share(most, 3)}{unit}"
    if drift is None:
        why_not = "it is not in both estimates" if given else "no earlier estimate was given (--last)"
        return Criterion(label, required, "not compared", Result.CANNOT_TELL, doubt or why_not)
    size = abs(drift.last) if drift.relative else 1.0
    half = NORMAL_95 * math.hypot(drift.last_deviation, drift.deviation) / size
    ends = (drift.relative_change - half, drift.relative_change + half)
    change = share_between(*ends) if drift.relative else f"{between(*ends)}{unit}"
    return Criterion(label, required, change, *_inside(ends, (-most, most), doubt))


def _inside(interval: tuple[float, float], limits: tuple[float, float], doubt: str) -> tuple[Result, str]:
    if doubt:
        return Result.CANNOT_TELL, doubt
    if limits[0] <= interval[0] and interval[1] <= limits[1]:
        return Result.PASS, ""
    if interval[1] < limits[0] or interval[0] > limits[1]:
        return Result.FAIL, "the whole 95 % interval is outside the limits"
    return Result.CANNOT_TELL, "the 95 % interval straddles a limit"


def _counted(name: str, most: float, found: float | None) -> Criterion:
    required = f"at most {share(most, 3)}"
    if found is None:
        return Criterion(name, required, "not measured", Result.CANNOT_TELL, "the log does not say")
    result = Result.PASS if found <= most else Result.FAIL
    return Criterion(name, required, share(found, 3), result, "" if found <= most else "over the budget")
