"""Summary of a campaign: records, their document and their text, with the test whether the runs agree."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from emb_bench.analysis.constancy import Constancy, constancy
from emb_bench.analysis.random_walk import RandomWalk, random_walk
from emb_bench.batch.row import NONE, Options, Parameter, Row, is_relative, unit_of
from emb_bench.estimate.records import DONE, NORMAL_95
from emb_bench.numbers import NOTHING
from emb_bench.report.text import Table

SHOWN = 20  # Most failed logs, and most campaigns, in the text; the file has them all


@dataclass(frozen=True)
class Quantiles:
    """Median and extremes of a number over the runs."""

    median: float
    lowest: float
    highest: float


@dataclass(frozen=True)
class ParameterEstimates:
    """Estimates of one parameter in the runs that the model fits and that identify it, SI units."""

    runs: int
    median: float
    spread: float  # Half the distance between the quantiles that one standard deviation of a Gaussian reaches
    constancy: Constancy
    rms_error_sigmas: float | None  # Root mean square error in standard deviations; None if no run was simulated
    covered: float | None  # Share of the simulated runs whose 95 % interval holds the true value


@dataclass(frozen=True, eq=False)
class Trend:
    """One parameter over the runs that the model fits and that identify it, in their order; SI units."""

    start_times: tuple[int, ...]  # Of the runs [ns]
    values: tuple[float, ...]  # Of each run alone
    deviations: tuple[float, ...]
    walk: RandomWalk  # The parameter as all the runs together have it, if it walks at random between them

    @property
    def last(self) -> tuple[float, float]:
        """Value in the last run and half its 95 % interval."""
        return float(self.walk.values[-1]), NORMAL_95 * float(self.walk.deviations[-1])


@dataclass(frozen=True)
class ParameterSummary:
    """One parameter over all runs."""

    unit: str
    identified: int  # Number of the runs that identify it
    cramer_rao: Quantiles | None
    relative: bool  # True if the bound is relative to the value
    estimate: ParameterEstimates | None  # None if no run that the model fits identifies it
    trend: Trend | None  # None for few runs


@dataclass(frozen=True)
class Folder:
    """The runs of one folder."""

    root: str
    campaign: str
    logs: int
    start_time: int | None  # Of the earliest run [ns]; None if none has a date
    means: dict[str, Constancy]  # Means of the parameters that a run identifies


@dataclass(frozen=True)
class Campaign:
    """Summary of all logs; copies of a log count only in ``logs``, ``evaluated``, ``incomplete`` and ``misfit``."""

    result: str  # Path of the file with the rows
    logs: int
    evaluated: int
    failed: tuple[Row, ...]
    copies: tuple[Row, ...]
    stopped: tuple[Row, ...]
    incomplete: int
    misfit: tuple[Row, ...]  # Logs that the model does not fit
    violating: int
    start_time: tuple[int, int] | None  # Of the first and of the last run [ns]; None if none has a date
    method: str
    models: tuple[str, ...]
    log_det: Quantiles | None
    weighted_log_det: Quantiles | None
    parameters: dict[str, ParameterSummary]
    campaigns: tuple[Folder, ...]  # The earliest first


def summarise(rows: Sequence[Row], options: Options, result: str) -> Campaign:
    """Summary of a campaign; numbers may be infinite.

    Args:
        rows: one for each log.
        options: of their evaluation.
        result: path of the file with the rows.
    """
    good = [row for row in rows if row.error is None]
    counted = [row for row in good if row.copy_of is None]
    starts = [row.start_time for row in good if row.start_time is not None]
    return Campaign(
        result=result,
        logs=len(rows),
        evaluated=len(good),
        failed=tuple(row for row in rows if row.error is not None),
        copies=tuple(row for row in good if row.copy_of is not None),
        stopped=tuple(row for row in counted if row.exit_reason not in (None, DONE)),
        incomplete=sum(not row.complete for row in good),
        misfit=tuple(row for row in good if not _fits(row)),
        violating=sum(bool(row.violations) for row in good),
        start_time=(min(starts), max(starts)) if starts else None,
        method=options.method,
        models=tuple(sorted({row.model for row in good if row.model is not None})),
        log_det=_quantiles(row.log_det for row in counted),
        weighted_log_det=_quantiles(row.weighted_log_det for row in counted),
        parameters={name: _parameter(counted, name) for name in options.names},
        campaigns=_folders(counted, options),
    )


def document(c: Campaign) -> dict[str, Any]:
    """The summary as plain data."""
    found = asdict(c) | {
        "failed": [{"root": row.root, "log": row.log, "error": row.error} for row in c.failed],
        "copies": [{"root": row.root, "log": row.log, "of": row.copy_of} for row in c.copies],
        "stopped": [{"root": row.root, "log": row.log, "why": row.exit_reason} for row in c.stopped],
        "misfit": len(c.misfit),
        "misfits": [{"root": row.root, "log": row.log, "model": row.model} for row in c.misfit],
        "start_time": c.start_time and dict(zip(("first", "last"), c.start_time, strict=True)),
        "campaigns": [asdict(folder) for folder in c.campaigns],
    }
    for name, entry in found["parameters"].items():
        entry["trend"] = _trend_document(c.parameters[name].trend)
        if entry["estimate"] is None:
            del entry["estimate"]
    return found


def _trend_document(trend: Trend | None) -> dict[str, Any] | None:
    if trend is None:
        return None
    return {
        "walk_per_root_hour": trend.walk.walk,
        "runs": [
            {"start_time": start, "value": value, "interval": list(ends)}
            for start, value, ends in zip(
                trend.start_times, trend.walk.values.tolist(), trend.walk.ends.tolist(), strict=True
            )
        ],
    }


def mark_copies(rows: Sequence[Row]) -> list[Row]:
    """Mark copies: of several logs of one run a complete one counts before others, then the one with most samples.

    The first counts among equals.
    """
    best: dict[str, Row] = {}
    for row in rows:
        if row.error is None and row.beginning is not None:
            held = best.get(row.beginning)
            if held is None or (bool(row.complete), row.measured or 0) > (bool(held.complete), held.measured or 0):
                best[row.beginning] = row
    return [
        replace(row, copy_of=best[row.beginning].log)
        if row.error is None and row.beginning is not None and best[row.beginning] is not row
        else row
        for row in rows
    ]


def _fits(row: Row) -> bool:
    return bool(row.nominal_fits if row.fits is None else row.fits)


def _quantiles(values: Iterable[float | None]) -> Quantiles | None:
    known = [value for value in values if value is not None]
    return Quantiles(float(np.median(known)), min(known), max(known)) if known else None


def _parameter(rows: Sequence[Row], name: str) -> ParameterSummary:
    found = [p for row in rows for p in row.parameters if p.name == name]
    return ParameterSummary(
        unit=unit_of(name, "SI"),
        identified=sum(bool(p.identified) for p in found),
        cramer_rao=_quantiles(p.cramer_rao for p in found),
        relative=is_relative(name),
        estimate=_estimates(_usable(rows, name)),
        trend=_trend(rows, name),
    )


def _trend(rows: Sequence[Row], name: str) -> Trend | None:
    timed = sorted((row for row in rows if row.start_time is not None), key=lambda row: row.start_time or 0)
    found = [(row.start_time or 0, p) for row in timed for p in _usable([row], name)]
    if not found:
        return None
    starts, used = tuple(start for start, _ in found), [p for _, p in found]
    values, deviations = tuple(p.estimate or 0.0 for p in used), _deviations(used)
    walk = random_walk([(start - starts[0]) * 1e-9 / 3600.0 for start in starts], values, deviations)
    return None if walk is None else Trend(starts, values, tuple(deviations), walk)


def _estimates(used: Sequence[Parameter]) -> ParameterEstimates | None:
    if not used:
        return None
    values = np.array([p.estimate for p in used], dtype=np.float64)
    low, high = np.quantile(values, [0.158655, 0.841345])
    errors = np.array([p.error_sigmas for p in used if p.error_sigmas is not None])
    return ParameterEstimates(
        runs=len(used),
        median=float(np.median(values)),
        spread=0.5 * float(high - low),
        constancy=_constancy(used),
        rms_error_sigmas=float(np.sqrt(np.mean(errors**2))) if len(errors) else None,
        covered=float(np.mean(np.abs(errors) <= NORMAL_95)) if len(errors) else None,
    )


def _usable(rows: Sequence[Row], name: str) -> list[Parameter]:
    """Estimates with valid deviations: the model explains the record, and the record identifies the parameter."""
    return [
        p
        for row in rows
        if row.fits
        for p in row.parameters
        if p.name == name and p.identified and p.deviation is not None and 0.0 < p.deviation < math.inf
    ]


def _constancy(used: Sequence[Parameter]) -> Constancy:
    return constancy([p.estimate or 0.0 for p in used], _deviations(used))


def _deviations(used: Sequence[Parameter]) -> list[float]:
    """Standard deviations in SI units; shares are of one number, so that what came out small weighs no more."""
    scale = abs(float(np.median([p.estimate or 0.0 for p in used]))) if used[0].relative else 1.0
    return [scale * (p.deviation or 0.0) for p in used]


def _folders(rows: Sequence[Row], options: Options) -> tuple[Folder, ...]:
    inside: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        inside.setdefault((row.root, row.campaign), []).append(row)
    found = []
    for (root, campaign), its in inside.items():
        means = {name: _constancy(used) for name in options.names if (used := _usable(its, name))}
        start = min((row.start_time for row in its if row.start_time is not None), default=None)
        found.append(Folder(root, campaign, len(its), start, means))
    return tuple(sorted(found, key=lambda one: (one.start_time or 0, one.root, one.campaign)))


def text(c: Campaign) -> str:
    """The summary for a person; what went wrong comes first."""
    from emb_bench.report.render import text as rendered

    return rendered("campaign.txt.j2", c=c, parameters=parameter_table(c) if c.evaluated else None, shown=SHOWN)


def parameter_table(c: Campaign) -> Table:
    """Table of the parameters, over all runs."""
    header = ["parameter", "identified", "bound"]
    estimated = c.method != NONE
    header += ["runs", "median", "spread", "mean", "± 95 %", "chi2/n", "covered"] if estimated else []
    rows = []
    for name, p in c.parameters.items():
        bound = math.nan if p.cramer_rao is None else p.cramer_rao.median
        row = [f"{name} [{p.unit}]", str(p.identified), f"{100.0 * bound:.3g} %" if p.relative else f"{bound:.3g}"]
        if estimated and (e := p.estimate) is None:
            row += ["0", *[NOTHING] * 6]
        elif estimated and e is not None:
            mean, runs = e.constancy, e.constancy.runs
            row += [str(e.runs), f"{e.median:.6g}", f"{e.spread:.2g}", f"{mean.mean:.7g}"]
            row += [f"{NORMAL_95 * mean.deviation:.2g}", f"{mean.scatter**2:.3g}" if runs > 1 else NOTHING]
            row.append(NOTHING if e.covered is None else f"{100.0 * e.covered:.0f} %")
        rows.append(row)
    title = (
        "identified: in so many logs; runs: those that the model fits and that identify the parameter; "
        "mean: weighted by the information of each"
    )
    return Table(title if estimated else "", header, rows)
