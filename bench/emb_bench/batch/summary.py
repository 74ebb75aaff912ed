"""Summary of a campaign: records, their document and their text, with the test whether the runs agree."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.analysis.several_runs import Constancy, Slope, beyond, constancy, slope
from emb_bench.batch.row import NONE, CampaignOptions, Row, unit_of
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.config.bench import Bench
from emb_bench.config.conditions import CONDITIONS
from emb_bench.documents import to_json
from emb_bench.estimate.records import DONE
from emb_bench.numbers import p_value, relative, signed
from emb_bench.report.sentences import INTERVALS
from emb_bench.report.text import Table, listed, wrapped
from emb_runtime.numbers import NOTHING, plain

SHOWN = 3  # Most logs of a kind that are named without ``-v``
OF_AN_ESTIMATE = ("estimate", "low", "high", "between_runs", "repeatability")
CHANGES_WITH = ("start_time", *CONDITIONS)  # Columns that a parameter may change with
HOUR = 3.6e12  # [ns]
TIMES = {"d": 24.0, "h": 1.0, "min": 1.0 / 60.0, "s": 1.0 / 3600.0}  # Units in which time is shown [h]
OVER_RUNS = f"The mean is weighted by information, total and repeatability are medians. {INTERVALS}"


@dataclass(frozen=True)
class ParameterEstimates:
    """Estimates of one parameter in the runs that the model fits and that identify it, SI units."""

    runs: int
    median: float
    total: float  # Median of half the 95 % intervals, of noise, systematic errors and what the records cannot exclude
    repeatability: float  # The same, of the sensors' noise alone
    constancy: Constancy
    over: dict[str, Slope]  # Change with time [1/h] and conditions, by name; those that the logs have
    beyond: tuple[str, ...]  # Logs outside of the control chart's limits


@dataclass(frozen=True)
class ParameterSummary:
    """One parameter over all runs."""

    unit: str
    identified: int  # Number of the runs that identify it
    cramer_rao: float | None  # Median of the bounds by the information at the nominal brake
    relative: bool  # True if the bound is relative to the value
    estimate: ParameterEstimates | None  # None if no run that the model fits identifies it


@dataclass(frozen=True)
class Campaign:
    """Summary of all logs; copies of a log count only in ``logs``, ``evaluated``, ``incomplete`` and ``misfit``."""

    result: str  # Path of the file with the rows
    logs: int
    evaluated: int
    failed: tuple[Row, ...]
    copies: tuple[Row, ...]
    stopped: tuple[Row, ...]
    simulated: int  # Logs of no real machine
    incomplete: int
    misfit: tuple[Row, ...]  # Logs that the model does not fit
    outside: tuple[Row, ...]  # Logs of brakes for which the limits were not guaranteed
    violating: int
    method: str
    models: tuple[str, ...]
    span: float  # Time from the start of the first run to that of the last [h]
    parameters: dict[str, ParameterSummary]


def summarise(rows: Sequence[Row], options: CampaignOptions, result: str, bench: Bench | None = None) -> Campaign:
    """Summary of a campaign; numbers may be infinite."""
    good = [row for row in rows if row["error"] is None]
    counted = counting(rows)
    starts = [row["start_time"] for row in counted if row.get("start_time") is not None]
    return Campaign(
        result=result,
        logs=len(rows),
        evaluated=len(good),
        failed=tuple(row for row in rows if row["error"] is not None),
        copies=tuple(row for row in good if row.get("copy_of") is not None),
        stopped=tuple(row for row in counted if row.get("exit_reason") not in (None, DONE)),
        simulated=sum(bool(row.get("simulated")) for row in good),
        incomplete=sum(not row.get("complete") for row in good),
        misfit=tuple(row for row in good if not row.get("fits", row.get("nominal_fits"))),
        outside=tuple(row for row in counted if row.get("outside")),
        violating=sum(bool(row.get("violations")) for row in good),
        method=options.method,
        models=tuple(sorted({row["model"] for row in good if row.get("model") is not None})),
        span=(max(starts) - min(starts)) / HOUR if starts else 0.0,
        parameters={name: _parameter(counted, name) for name in options.unknowns_on(bench)},
    )


def counting(rows: Sequence[Row]) -> list[Row]:
    """Logs that were evaluated, and each run once."""
    return [row for row in rows if row["error"] is None and row.get("copy_of") is None]


def campaign_document(c: Campaign) -> dict[str, Any]:
    """The summary as plain data; of single logs their names, errors and results."""
    found: dict[str, Any] = to_json(replace(c, failed=(), copies=(), stopped=(), misfit=(), outside=()))
    keys = ("root", "log", "error", "copy_of", "exit_reason", "model", "outside")
    for name in ("failed", "copies", "stopped", "misfit", "outside"):
        found[name] = [{key: row.get(key) for key in keys} for row in getattr(c, name)]
    return found


def mark_copies(rows: Sequence[Row]) -> list[Row]:
    """Mark copies: of several logs of one run a complete one counts before others, then the one with most samples.

    The first counts among equals.
    """
    best: dict[str, Row] = {}
    evaluated = [row for row in rows if row["error"] is None and row.get("beginning") is not None]
    for row in evaluated:
        before = best.setdefault(row["beginning"], row)
        if (row["complete"], row["measured"]) > (before["complete"], before["measured"]):
            best[row["beginning"]] = row
    copies = {id(row): best[row["beginning"]]["log"] for row in evaluated if best[row["beginning"]] is not row}
    return [row | {"copy_of": copies.get(id(row))} for row in rows]


def _parameter(rows: Sequence[Row], name: str) -> ParameterSummary:
    bounds = [row[key] for row in rows if row.get(key := f"{name}_cramer_rao") is not None]
    return ParameterSummary(
        unit=unit_of(name, "SI"),
        identified=sum(bool(row.get(f"{name}_identified")) for row in rows),
        cramer_rao=float(np.median(bounds)) if bounds else None,
        relative=PARAMETERS[name].relative,
        estimate=_estimates([row for row in rows if is_usable(row, name)], name),
    )


def is_usable(row: Row, name: str) -> bool:
    """True if the estimate has a valid deviation: the model explains the record, which identifies the parameter."""
    deviation = row.get(f"{name}_between_runs")
    return bool(row.get("fits") and row[f"{name}_identified"]) and deviation is not None and 0.0 < deviation < math.inf


def columns_of(used: Sequence[Row], name: str) -> dict[str, NDArray[np.float64]]:
    """Columns of a parameter, by name; the deviation between runs in SI units."""
    found = {key: np.array([row.get(f"{name}_{key}") for row in used], np.float64) for key in OF_AN_ESTIMATE}
    if PARAMETERS[name].relative:  # all shares are of the median: a small estimate does not weigh more
        found["between_runs"] *= abs(float(np.median(found["estimate"])))
    return found


def shown_as(key: str, span: float) -> tuple[str, str, float]:
    """Name and unit in which a column of ``CHANGES_WITH`` is shown, and this unit in that of its slope.

    Time is shown in the largest unit of which the ``span`` of the runs [h] has two.
    """
    if key in CONDITIONS:
        return CONDITIONS[key].label, CONDITIONS[key].unit, 1.0
    unit = next((name for name, hours in TIMES.items() if span >= 2.0 * hours), "s")
    return "time", unit, TIMES[unit]


def condition_of(used: Sequence[Row], key: str, begun: int) -> tuple[list[int], list[float]]:
    """Places of the rows that have a column of ``CHANGES_WITH``, and its values; time counts from ``begun`` [ns]."""
    places = [i for i, row in enumerate(used) if row.get(key) is not None]
    if key == "start_time":
        return places, [(used[i][key] - begun) / HOUR for i in places]
    return places, [used[i][key] for i in places]


def _estimates(used: Sequence[Row], name: str) -> ParameterEstimates | None:
    if not used:
        return None
    found = columns_of(used, name)
    values, deviations = found["estimate"], found["between_runs"].tolist()
    over = {}
    for key in CHANGES_WITH:
        places, at = condition_of(used, key, used[0]["start_time"])
        if (one := slope(values[places].tolist(), [deviations[i] for i in places], at)) is not None:
            over[key] = one
    return ParameterEstimates(
        runs=len(used),
        median=float(np.median(values)),
        total=float(np.median(0.5 * (found["high"] - found["low"]))),
        repeatability=float(np.median(found["repeatability"])),
        constancy=constancy(values.tolist(), deviations),
        over=over,
        beyond=tuple(used[i]["log"] for i in beyond(values.tolist(), deviations)),
    )


def campaign_text(c: Campaign, *, verbose: bool = False) -> str:
    """Number of failures, the parameters over all runs, and their agreement; with ``verbose`` each log with a note."""
    most = None if verbose else SHOWN
    lines = []
    if c.failed:
        lines.append(f"{len(c.failed)} of {c.logs} logs FAILED")  # each was named when it did
    if not c.evaluated:
        return "\n".join(lines)
    lines += wrapped(
        f"{c.result}: {c.evaluated} of {c.logs} logs evaluated, {len(c.stopped)} stopped, {c.incomplete} incomplete, "
        f"{len(c.copies)} copies, {c.violating} beyond a limit of the bench, {len(c.misfit)} not explained by the "
        f"model ({', '.join(c.models)})"
    )
    if c.simulated:
        lines.append(f"SIMULATED: {c.simulated} of {c.evaluated} logs are not of a real machine")
    outside = ((row["log"], ", ".join(row["outside"])) for row in c.outside[:most])
    lines += listed("OUTSIDE: ", (f"{log}: {names}: the limits were not guaranteed" for log, names in outside))
    lines += listed("NOTE: ", _notes(c) if verbose else ())
    if len(c.models) > 1:
        lines += wrapped("NOTE: the runs are of different models: use --model, or name the logs of one")
    lines += ["", *parameter_table(c).lines()]
    if c.method != NONE:
        lines += wrapped(OVER_RUNS, 0)
    return "\n".join([*lines, *listed("", [*_agreement(c), *_trend(c)])])


def _agreement(c: Campaign) -> Iterator[str]:
    """Agreement of the runs on each parameter that several identify."""
    tests = {name: p.estimate.constancy for name, p in c.parameters.items() if p.estimate is not None}
    several = {name: test for name, test in tests.items() if test.runs > 1}
    if agreed := [f"{name} ({p_value(test.p_value)})" for name, test in several.items() if test.constant]:
        yield f"the runs agree on {', '.join(agreed)}"
    for name, test in several.items():
        if not test.constant:
            scatter = f"scatter {plain(test.scatter)} times the stated one"
            yield f"{name}: the runs do NOT agree ({p_value(test.p_value)}); {scatter}"


def _trend(c: Campaign) -> Iterator[str]:
    """Significant changes of the parameters with time and conditions, and runs beyond the control limits."""
    for name, p in c.parameters.items():
        if p.estimate is None:
            continue
        for key, one in p.estimate.over.items():
            if one.significant:
                label, unit, unit_size = shown_as(key, c.span)
                change, of = one.slope * unit_size, p.unit
                if p.relative:
                    change, of = 100.0 * change / abs(p.estimate.median), "%"
                yield f"{name} changes with {label}: {signed(change)} {of} per {unit} ({p_value(one.p_value)})"
        if p.estimate.beyond:
            logs = ", ".join(p.estimate.beyond[:SHOWN]) + (" ..." if len(p.estimate.beyond) > SHOWN else "")
            yield f"{name}: beyond the control limits (3 deviations between runs from the median): {logs}"


def _notes(c: Campaign) -> Iterator[str]:
    yield from (f"{row['log']} is a copy of {row['copy_of']}: the run counts once" for row in c.copies)
    unused = "" if c.method == NONE else ", and it is not in the means"
    yield from (f"{row['log']}: the model '{row['model']}' does not fit{unused}" for row in c.misfit)
    yield from (f"{row['log']} was stopped ({row['exit_reason']}) and counts where it identifies" for row in c.stopped)


def parameter_table(c: Campaign) -> Table:
    """Table of the parameters, over all runs."""
    estimated = c.method != NONE
    header = ["parameter", "identified"] + (
        ["mean", "total", "repeatability", "scatter/stated"] if estimated else ["bound"]
    )
    rows = []
    for name, p in c.parameters.items():
        row = [f"{name} [{p.unit}]", f"{p.identified} of {c.evaluated}"]
        if not estimated:
            bound = math.nan if p.cramer_rao is None else p.cramer_rao
            rows.append([*row, relative(bound, 1.0 if p.relative else 0.0)])
            continue
        if p.estimate is None:
            rows.append([*row, *[NOTHING] * 4])
            continue
        mean, size = p.estimate.constancy, p.estimate.median if p.relative else 0.0
        row += [plain(mean.mean, 5), *(relative(half, size) for half in (p.estimate.total, p.estimate.repeatability))]
        rows.append([*row, plain(mean.scatter) if mean.runs > 1 else NOTHING])
    return Table("", header, rows)
