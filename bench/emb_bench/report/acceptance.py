"""Acceptance test of a brake: criteria from a small file, each passed, failed, or not decided by the record.

A quantity passes if all of its 95 % interval lies inside the limits, and fails if all of it lies outside. If the
interval straddles a limit, the criterion is not decided: it needs a more informative record. Criteria that depend on
the model are not decided if the model does not fit.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from xml.etree import ElementTree

import msgspec

from emb_bench.analysis.drift import Drift
from emb_bench.analysis.study import Code, Result, StudiedRun, Study, verdict
from emb_bench.brake.parameters import OF_AN_EXPERIMENT, PARAMETERS, SI, UNITS
from emb_bench.estimate.records import DONE, NORMAL_95
from emb_bench.numbers import amount, share, share_between
from emb_bench.report.information import doubts
from emb_bench.report.sentences import other_model
from emb_runtime.config.typed import FieldError, read
from emb_runtime.errors import UsageError
from emb_runtime.numbers import between, plain
from emb_runtime.system.input_file import read_text

LONGEST = 2**20  # Size limit of the file [bytes]
NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")  # Characters that XML cannot have
SHARED = tuple(name for name in PARAMETERS if name not in OF_AN_EXPERIMENT)  # A tolerance can be stated for these
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class Tolerance(msgspec.Struct, frozen=True):
    """Limits of one parameter: an interval, or a share of a reference."""

    interval: tuple[float, float] | None = None  # Lowest and highest allowed value, SI units
    relative: Positive | None = None  # Largest allowed deviation from the reference, as a share of it
    reference: Positive | None = None  # SI units; None for the bench file's nominal value

    def __post_init__(self) -> None:
        """Refuse both forms, neither, and an interval upside down."""
        if (self.interval is None) == (self.relative is None):
            raise FieldError("interval", "expected either interval = [low, high] or relative")
        if self.interval is not None and not self.interval[0] < self.interval[1]:
            raise FieldError("interval", f"expected the lower end first, got {list(self.interval)}")
        if self.interval is not None and self.reference is not None:
            raise FieldError("reference", "expected it with relative only")


class Budgets(msgspec.Struct, frozen=True):
    """Largest allowed shares of each run; None where there is no budget."""

    missed: Share | None = None  # Of periods without a sample in time
    lost: Share | None = None  # Of samples that are not in the log


class Criteria(msgspec.Struct, frozen=True):
    """Content of an acceptance file."""

    model_fit: bool = True  # The model has to fit the records, and to predict held-out ones
    parameters: dict[str, Tolerance] = {}
    drift: dict[str, Positive] = {}
    """Largest allowed change since an earlier estimate, by parameter: relative, or in the parameter's unit."""
    budgets: Budgets = Budgets()

    def __post_init__(self) -> None:
        """Refuse unknowns that a brake does not have, and a relative tolerance of one with a unit."""
        for place, names in (("parameters", self.parameters), ("drift", self.drift)):
            for name in names:
                if name not in SHARED:
                    raise FieldError(place, f"'{name}': expected some of {', '.join(SHARED)}")
        for name, one in self.parameters.items():
            if one.interval is None and name in UNITS:
                raise FieldError(f"parameters.{name}", "expected interval = [low, high]: it has no size to share")


@dataclass(frozen=True)
class Criterion:
    """One criterion and its result."""

    name: str
    required: str
    found: str
    result: Result
    why: str = ""  # Reason that it failed or cannot be decided; empty if it passed


@dataclass(frozen=True)
class Acceptance:
    """All criteria with their results."""

    source: str  # Name of the acceptance file
    results: tuple[Criterion, ...]

    @property
    def result(self) -> Result:
        """Overall result: the worst one, failed before not decided before passed."""
        found = {one.result for one in self.results}
        return next((r for r in (Result.FAIL, Result.CANNOT_TELL) if r in found), Result.PASS)

    def of(self, result: Result) -> tuple[Criterion, ...]:
        """The criteria with a result."""
        return tuple(one for one in self.results if one.result == result)

    @property
    def verdict(self) -> str:
        """Overall result in one line, with the criteria that decided it."""
        count, of_result = len(self.results), self.of(self.result)
        names = ", ".join(one.name for one in of_result)
        if self.result == Result.FAIL:
            return f"NOT ACCEPTED: {len(of_result)} of {count} criteria failed: {names}"
        if self.result == Result.CANNOT_TELL:
            return f"CANNOT TELL: {len(of_result)} of {count} criteria not decided: {names}"
        return f"ACCEPTED: {'the one criterion' if count == 1 else f'all {count} criteria'} passed"

    def document(self) -> dict[str, Any]:
        """JSON document."""
        return {"file": self.source, "result": self.result, "criteria": self.results}


class _File(msgspec.Struct, frozen=True):
    acceptance: Criteria


def read_criteria(path: Path) -> Criteria:
    """Criteria from a TOML file, see ``docs/reference/acceptance.md``.

    Raises:
        UsageError: the file cannot be read, or does not have the form.
    """
    source = f"--acceptance {path}"
    try:
        content = tomllib.loads(read_text(path, LONGEST))
    except OSError as err:
        raise UsageError(f"{source}: {err.strerror}") from err
    except (ValueError, RecursionError) as err:
        raise UsageError(f"{source}: expected TOML: {err}") from err
    return read(_File, content, source, UsageError).acceptance


def accept(criteria: Criteria, source: str, study: Study, without_part: Sequence[str]) -> Acceptance:
    """Results of all criteria; the first ones are always that each run came to its end with a complete log.

    ``source`` is the name of their file; ``without_part`` has the reason for each log that is not used.
    """
    runs, several = study.runs, len(study.runs) > 1
    results = [_completed(run, several) for run in runs]
    results += [Criterion("all logs used", "yes", "no", Result.FAIL, words) for words in without_part]
    doubt = _doubt(study)
    if criteria.model_fit:
        results.append(_model_fit(study, doubt))
    results += [_tolerated(name, one, study, doubt) for name, one in criteria.parameters.items()]
    changes = {drift.name: drift for drift in study.checks.drifts}
    why = "" if study.joint is None else other_model(study.joint, study.last)
    earlier = f"the change may be the model's: {why}" if why else ""
    for name, most in criteria.drift.items():
        results.append(_drifted(name, most, changes.get(name), doubt or earlier, given=study.last is not None))
    for run in runs:
        of = f", {run.name}" if several else ""
        if criteria.budgets.missed is not None:
            missed = None if run.timing is None else run.timing.share("missed")
            results.append(_counted(f"missed periods{of}", criteria.budgets.missed, missed))
        if criteria.budgets.lost is not None:
            results.append(_counted(f"lost samples{of}", criteria.budgets.lost, run.lost))
    return Acceptance(source, tuple(results))


def _doubt(study: Study) -> str:
    """Reason that the numbers of the estimate decide nothing; empty if they do."""
    return {
        Code.NO_ESTIMATE: f"no estimate: {study.why_not}",
        Code.BIASED_METHOD: "recursive least squares is biased: use --method oem",
        Code.DOES_NOT_FIT: "the model does not fit",
        Code.DOES_NOT_PREDICT: "the model does not predict all records",
    }.get(verdict(study).model, "")


def _completed(run: StudiedRun, several: bool) -> Criterion:
    name, log = f"completed, {run.name}" if several else "run completed", run.log
    required = "ran to its planned end, log complete"
    if (reason := log.exit_reason) != DONE:
        return Criterion(name, required, reason, Result.FAIL, f"the run was stopped: {reason}")
    if not log.complete:
        return Criterion(name, required, "log NOT complete", Result.FAIL, log.missing)
    return Criterion(name, required, "yes", Result.PASS)


def _model_fit(study: Study, doubt: str) -> Criterion:
    name, required = "model fit", "residuals are noise"
    if verdict(study).model in (Code.NO_ESTIMATE, Code.BIASED_METHOD):
        return Criterion(name, required, "no verdict", Result.CANNOT_TELL, doubt)
    found = f"chi2/n {plain(study.estimate.validation.ratio)}"
    return Criterion(name, required, found, Result.FAIL if doubt else Result.PASS, doubt)


def _tolerated(name: str, tolerance: Tolerance, study: Study, doubt: str) -> Criterion:
    unit, relative = SI[name], tolerance.relative or 0.0
    if tolerance.interval is not None:
        low, high = tolerance.interval
        required = f"{plain(low, 6)} to {plain(high, 6)} {unit}"
    else:
        nominal = "nominal" if tolerance.reference is None else "the reference"
        reference = tolerance.reference
        if reference is None and study.joint is not None:
            reference = float(getattr(study.joint.bench.brake, name))
        about = nominal if reference is None else f"{nominal} {plain(reference, 6)} {unit}"
        required = f"{about} ± {share(relative, 3)}"
        low, high = (math.nan if reference is None else reference * (1.0 + s * relative) for s in (-1.0, 1.0))
    found = next((c for c in study.conclusions if c.label == name), None)
    if found is None:
        return Criterion(name, required, "not estimated", Result.CANNOT_TELL, doubt or "it was not estimated")
    value = amount(found.value, found.interval, found.unit)
    return Criterion(name, required, value, *_inside(found.interval, (low, high), doubt or doubts(found.finding)))


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
        return Result.FAIL, "all of the 95 % interval is outside the limits"
    return Result.CANNOT_TELL, "the 95 % interval straddles a limit"


def _counted(name: str, most: float, found: float | None) -> Criterion:
    required = f"at most {share(most, 3)}"
    if found is None:
        return Criterion(name, required, "not measured", Result.CANNOT_TELL, "not in the log")
    result = Result.PASS if found <= most else Result.FAIL
    return Criterion(name, required, share(found, 3), result, "" if found <= most else "over the budget")


def junit(found: Acceptance) -> str:
    """The results as JUnit XML for a test management system: one test case for each criterion."""
    results = [(one, one.result) for one in found.results]
    failed, skipped = (sum(result is kind for _, result in results) for kind in (Result.FAIL, Result.CANNOT_TELL))
    counts = {"tests": str(len(results)), "failures": str(failed), "skipped": str(skipped)}
    suite = ElementTree.Element("testsuite", {"name": found.source, **counts})
    for one, result in results:
        case = ElementTree.SubElement(suite, "testcase", {"classname": found.source, "name": one.name})
        message = f"required {one.required}; found {one.found}"
        if result is not Result.PASS:
            kind = "failure" if result is Result.FAIL else "skipped"
            ElementTree.SubElement(case, kind, {"message": one.why}).text = message
        else:
            ElementTree.SubElement(case, "system-out").text = message
    return NOT_XML.sub("\ufffd", ElementTree.tostring(suite, encoding="unicode", xml_declaration=True)) + "\n"
