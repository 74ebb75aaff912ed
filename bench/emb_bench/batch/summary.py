"""What a campaign says as a whole, for a person and for a program."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from emb_bench.batch.constancy import Constancy, constancy
from emb_bench.batch.row import NONE, Options, Parameter, Row, is_relative, unit_of
from emb_bench.estimate.records import DONE, METHODS, NORMAL_95

SHOWN = 20
"""Most failed logs, and most campaigns, in the text; the file has them all."""


def document(rows: Sequence[Row], options: Options, result: str) -> dict[str, Any]:
    """Everything that is said; numbers may be infinite.

    Args:
        rows: one for each log.
        options: what they were asked.
        result: where the rows are.
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
    """Say of each log of a run of which another log holds as much or more that it is a copy; the first one counts."""
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
    """Estimates whose deviations mean what they say: the model explains the record, and the record tells them."""
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
    lines = []
    if d["failed"]:
        lines.append(f"{len(d['failed'])} of {d['logs']} logs FAILED")
        lines += [f"  {one['error']}" for one in d["failed"][:SHOWN]]
        if len(d["failed"]) > SHOWN:
            lines.append(f"  and {len(d['failed']) - SHOWN} more: column 'error' of the result")
        lines.append("")
    lines += [f"result       {d['result']}: {d['logs']} rows"]
    if not d["evaluated"]:
        return "\n".join(lines)
    where = "with the estimated parameters" if d["method"] != NONE else "at the bench's nominal parameters"
    first, last = (_when(d["start_time"][key]) for key in ("first", "last"))
    lines += [
        f"logs         {d['evaluated']} evaluated, {d['incomplete']} of them not complete, {d['violating']} beyond a "
        "limit of the bench",
        f"time         {first} to {last}",
        f"model        {', '.join(d['models'])}; {d['misfit']} logs it does not fit {where}",
        f"method       {METHODS.get(d['method'], 'none')}",
        f"log det M    physical {_range(d['log_det'])}; weighted {_range(d['weighted_log_det'])}",
        "",
        f"{'parameter':11}{'unit':12}{'told in':>8}{'bound':>12}{'runs':>6}{'median':>14}{'spread':>11}"
        f"{'mean':>14}{'sigma':>11}{'chi2/n':>8}{'covered':>9}",
    ]
    lines += [_row(name, p) for name, p in d["parameters"].items()]
    if d["method"] != NONE:
        lines.append("  runs: those that the model fits and that tell the parameter; mean: weighted by what each tells")
    lines += _pooled(d)
    if d["method"] != NONE:
        lines += _verdicts(d["parameters"])
    return "\n".join([*lines, *_by_campaign(d)])


def _pooled(d: dict[str, Any]) -> list[str]:
    """What to know of the runs that the means are of."""
    lines = [f"NOTE: {one['log']} is a copy of {one['of']}: the run counts once" for one in d["copies"]]
    lines += [
        f"NOTE: {one['log']} was stopped ({one['why']}), and counts where it tells a parameter" for one in d["stopped"]
    ]
    if len(d["models"]) > 1:
        lines.append(
            f"NOTE: the means are of runs of different models ({', '.join(d['models'])}): for one of them name its "
            "logs, or say --model"
        )
    return lines


def _row(name: str, p: dict[str, Any]) -> str:
    bound = p["cramer_rao"]["median"]
    shown = f"{100.0 * bound:.3g} %" if p["relative"] else f"{bound:.3g}"
    line = f"{name:11}{p['unit']:12}{p['told']:8}{shown:>12}"
    if "estimate" not in p:
        return line
    e, c = p["estimate"], p["estimate"]["constancy"]
    ratio = f"{c['scatter'] ** 2:.3g}" if c["runs"] > 1 else "-"
    covered = "-" if e["covered"] is None else f"{100.0 * e['covered']:.0f} %"
    return (
        f"{line}{e['runs']:6}{e['median']:14.7g}{e['spread']:11.3g}{c['mean']:14.7g}{c['deviation']:11.3g}"
        f"{ratio:>8}{covered:>9}"
    )


def _verdicts(parameters: dict[str, Any]) -> list[str]:
    """Whether each parameter is one number."""
    lines = []
    for name, p in parameters.items():
        if "estimate" not in p:
            lines.append(f"{name}: no run that the model fits tells it")
        elif (c := p["estimate"]["constancy"])["runs"] > 1:
            lines.append(
                f"{name} may be the same in all runs (p = {c['p_value']:.2g})"
                if c["constant"]
                else f"{name} is NOT the same in all runs (p = {c['p_value']:.2g}): they scatter {c['scatter']:.3g} "
                "times as much as they claim"
            )
    return ["", *lines] if lines else []


def _by_campaign(d: dict[str, Any]) -> list[str]:
    """Weighted means of each folder, where there are several."""
    campaigns = [one for one in d["campaigns"] if one["means"]]
    if len(campaigns) < 2:
        return []
    lines = ["", "weighted means by folder, the earliest first"]
    for one in campaigns[-SHOWN:]:
        means = ", ".join(f"{name} {c['mean']:.6g} ± {c['deviation']:.2g}" for name, c in one["means"].items())
        lines.append(f"  {_when(one['start_time'])}  {one['campaign']} ({one['logs']} logs): {means}")
    if len(campaigns) > SHOWN:
        lines.append(f"  and {len(campaigns) - SHOWN} before: see --json")
    return lines


def _range(q: dict[str, float]) -> str:
    return f"{q['median']:.4g} ({q['lowest']:.4g} to {q['highest']:.4g})"


def _when(time_ns: int) -> str:
    """A date and time in UTC; a clock that was never set may say anything."""
    try:
        return datetime.datetime.fromtimestamp(time_ns // 10**9, datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    except (OverflowError, OSError, ValueError):
        return f"{time_ns} ns"
