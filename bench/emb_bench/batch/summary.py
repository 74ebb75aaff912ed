"""Summary of a campaign, as a document for programs and as text, with the test whether its runs agree."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from emb_bench.batch.row import NONE, Options, Parameter, Row, is_relative, unit_of
from emb_bench.estimate.records import DONE, NORMAL_95
from emb_bench.numbers import NOTHING
from emb_bench.report.table import Table

SHOWN = 20
"""Most failed logs, and most campaigns, in the text; the file has them all."""
DIFFERENT = 0.01
"""Significance level of the test: with a smaller p-value, the number is not the same in all runs."""


@dataclass(frozen=True)
class Constancy:
    """The mean of independent Gaussian measurements, weighted by their information, and the test of homogeneity."""

    runs: int
    mean: float
    deviation: float
    """Standard deviation of the mean, if all runs measured one number."""
    chi2: float
    """Sum of the squared distances from the mean in standard deviations."""
    p_value: float
    """Of a chi2 as large or larger with ``runs`` - 1 degrees of freedom."""

    @property
    def scatter(self) -> float:
        """Birge ratio: observed scatter over that of the stated deviations; 0 for a single run (Birge 1932)."""
        return math.sqrt(self.chi2 / (self.runs - 1)) if self.runs > 1 else 0.0

    @property
    def constant(self) -> bool:
        """Returns True if the test does not reject one number for all runs."""
        return self.p_value >= DIFFERENT


def constancy(values: Sequence[float], deviations: Sequence[float]) -> Constancy:
    """Compare measurements of one number.

    Args:
        values: at least one.
        deviations: their standard deviations, positive and finite. If they are shares of the number, take the same
            number for all: with each one's own value, those that came out small would count too much.
    """
    from scipy.stats import chi2 as distribution

    v, weights = np.asarray(values, dtype=np.float64), np.asarray(deviations, dtype=np.float64) ** -2.0
    mean = float(weights @ v / weights.sum())
    chi2 = float(weights @ (v - mean) ** 2)
    p_value = float(distribution.sf(chi2, len(v) - 1)) if len(v) > 1 else 1.0
    return Constancy(len(v), mean, float(weights.sum() ** -0.5), chi2, p_value)


def document(rows: Sequence[Row], options: Options, result: str) -> dict[str, Any]:
    """Everything about a campaign; numbers may be infinite.

    Args:
        rows: one for each log.
        options: of their evaluation.
        result: path of the file with the rows.
    """
    good = [row for row in rows if row.error is None]
    counted = [row for row in good if row.copy_of is None]
    starts = [row.start_time for row in good if row.start_time is not None]
    return {
        "result": result,
        "logs": len(rows),
        "evaluated": len(good),
        "failed": [{"root": r.root, "log": r.log, "error": r.error} for r in rows if r.error is not None],
        "copies": [{"root": r.root, "log": r.log, "of": r.copy_of} for r in good if r.copy_of is not None],
        "stopped": [{"root": r.root, "log": r.log, "why": r.exit_reason} for r in counted if _stopped(r)],
        "incomplete": sum(not row.complete for row in good),
        "misfit": sum(not _fits(row) for row in good),
        "violating": sum(bool(row.violations) for row in good),
        "start_time": {"first": min(starts), "last": max(starts)} if starts else None,
        "method": options.method,
        "models": sorted({row.model for row in good if row.model is not None}),
        "log_det": _quantiles(row.log_det for row in counted),
        "weighted_log_det": _quantiles(row.weighted_log_det for row in counted),
        "parameters": {name: _parameter(counted, name) for name in (*options.params, *options.nuisances)},
        "campaigns": _campaigns(counted, options),
    }


def mark_copies(rows: Sequence[Row]) -> list[Row]:
    """Mark copies: of several logs of one run, the one with the most samples counts, the first among equals."""
    best: dict[str, Row] = {}
    for row in rows:
        if row.error is None and row.beginning is not None:
            held = best.get(row.beginning)
            if held is None or (row.measured or 0) > (held.measured or 0):
                best[row.beginning] = row
    return [
        replace(row, copy_of=best[row.beginning].log)
        if row.error is None and row.beginning is not None and best[row.beginning] is not row
        else row
        for row in rows
    ]


def _stopped(row: Row) -> bool:
    return row.exit_reason is not None and row.exit_reason != DONE


def _fits(row: Row) -> bool:
    return bool(row.nominal_fits if row.fits is None else row.fits)


def _quantiles(values: Iterable[float | None]) -> dict[str, float] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"median": float(np.median(known)), "lowest": min(known), "highest": max(known)}


def _parameter(rows: Sequence[Row], name: str) -> dict[str, Any]:
    found = [p for row in rows for p in row.parameters if p.name == name]
    said: dict[str, Any] = {
        "unit": unit_of(name, "SI"),
        "told": sum(bool(p.told) for p in found),
        "cramer_rao": _quantiles(p.cramer_rao for p in found),
        "relative": is_relative(name),
    }
    used = _usable(rows, name)
    if used:
        values = np.array([p.estimate for p in used], dtype=np.float64)
        low, high = np.quantile(values, [0.158655, 0.841345])
        errors = np.array([p.error_sigmas for p in used if p.error_sigmas is not None])
        said["estimate"] = {
            "runs": len(used),
            "median": float(np.median(values)),
            "spread": 0.5 * float(high - low),
            "constancy": _as_dict(_constancy(used)),
            "rms_error_sigmas": float(np.sqrt(np.mean(errors**2))) if len(errors) else None,
            "covered": float(np.mean(np.abs(errors) <= NORMAL_95)) if len(errors) else None,
        }
    return said


def _usable(rows: Sequence[Row], name: str) -> list[Parameter]:
    """Estimates with valid deviations: the model explains the record, and the record identifies the parameter."""
    return [
        p
        for row in rows
        if row.fits
        for p in row.parameters
        if p.name == name and p.told and p.deviation is not None and 0.0 < p.deviation < math.inf
    ]


def _constancy(used: Sequence[Parameter]) -> Constancy:
    values = [p.estimate or 0.0 for p in used]
    scale = abs(float(np.median(values))) if used[0].relative else 1.0
    return constancy(values, [scale * (p.deviation or 0.0) for p in used])


def _as_dict(c: Constancy) -> dict[str, Any]:
    return asdict(c) | {"scatter": c.scatter, "constant": c.constant}


def _campaigns(rows: Sequence[Row], options: Options) -> list[dict[str, Any]]:
    """One entry for each folder, the earliest first."""
    folders: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        folders.setdefault((row.root, row.campaign), []).append(row)
    said = []
    for (root, campaign), inside in folders.items():
        means = {}
        for name in (*options.params, *options.nuisances):
            if used := _usable(inside, name):
                means[name] = _as_dict(_constancy(used))
        start = min(row.start_time for row in inside if row.start_time is not None)
        said.append({"root": root, "campaign": campaign, "logs": len(inside), "start_time": start, "means": means})
    return sorted(said, key=lambda one: (one["start_time"], one["root"], one["campaign"]))


def text(d: dict[str, Any]) -> str:
    """A :func:`document` for a person; what went wrong comes first."""
    from emb_bench.report.render import text as rendered

    return rendered("campaign.txt.j2", d=d, parameters=parameter_table(d) if d["evaluated"] else None, shown=SHOWN)


def parameter_table(d: dict[str, Any]) -> Table:
    """Table of the parameters, over all runs."""
    header = ["parameter", "unit", "identified in", "bound"]
    estimated = d["method"] != NONE
    header += ["runs", "median", "spread", "mean", "± 95 %", "chi2/n", "covered"] if estimated else []
    rows = []
    for name, p in d["parameters"].items():
        bound = p["cramer_rao"]["median"]
        row = [name, p["unit"], str(p["told"]), f"{100.0 * bound:.3g} %" if p["relative"] else f"{bound:.3g}"]
        if estimated and (e := p.get("estimate")) is None:
            row += ["0", *[NOTHING] * 6]
        elif estimated:
            c = e["constancy"]
            row += [str(e["runs"]), f"{e['median']:.7g}", f"{e['spread']:.3g}", f"{c['mean']:.7g}"]
            row += [f"{NORMAL_95 * c['deviation']:.3g}", f"{c['scatter'] ** 2:.3g}" if c["runs"] > 1 else NOTHING]
            row.append(NOTHING if e["covered"] is None else f"{100.0 * e['covered']:.0f} %")
        rows.append(row)
    title = "runs: those that the model fits and that identify the parameter; mean: weighted by the information of each"
    return Table(title if estimated else "", header, rows, words=(0, 1))
