"""Trend of the parameters over several runs of one brake, each run evaluated by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.analysis.several_runs import Constancy, constancy
from emb_bench.analysis.study import StudiedRun, Study, verdict
from emb_bench.brake.parameters import UNITS
from emb_bench.estimate.records import DONE, NORMAL_95
from emb_bench.figures import COLOURS, svg
from emb_bench.numbers import percent
from emb_bench.report.figures import FAINT, PANEL
from emb_bench.report.page import Panel
from emb_bench.report.text import Cell, Table
from emb_runtime.numbers import NOTHING, SMALL, around, plain

_KINDS = (
    (True, "o", COLOURS[0], "± total"),
    (False, "x", COLOURS[1], "model does not fit, or not identified"),
)


@dataclass(frozen=True, eq=False)
class Trend:
    """One parameter over r runs, as a distance from a reference."""

    label: str
    less: str  # Reference of the distances, the median of the usable runs; empty for a parameter that is not relative
    unit: str  # Of the distances: ppm or % of the reference, or the parameter's unit
    values: NDArray[np.float64]  # Distances, shape (r,)
    ends: NDArray[np.float64]  # 95 % intervals without errors that the runs share, shape (r, 2)
    usable: NDArray[np.bool_]  # True where the model holds and the run identifies the parameter, shape (r,)
    agreement: Constancy | None  # Test whether the usable runs measured one number; None for fewer than two


def trends(runs: Sequence[StudiedRun]) -> list[Trend]:
    """Trends of the parameters of interest."""
    studies = [run.alone for run in runs if run.alone is not None]
    return [_trend(studies, c.label) for c in studies[0].conclusions if c.of_interest]


def _trend(studies: Sequence[Study], label: str) -> Trend:
    found = [study[label] for study in studies]
    usable = np.array([c.identified and verdict(study).holds for c, study in zip(found, studies, strict=True)])
    values, half = np.array([c.value for c in found]), np.array([_half(study, label) for study in studies])
    ends = np.stack([values - half, values + half], axis=1)
    reference = 0.0 if label in UNITS else float(np.median(values[usable] if usable.any() else values))
    factor, unit = 1.0, found[0].unit
    if reference != 0.0:
        seen = ends[np.isfinite(ends)]
        largest = float(np.abs(seen / reference - 1.0).max(initial=0.0))
        factor, unit = (1e6 / reference, "ppm") if largest < SMALL else (100.0 / reference, "%")
    counted = usable & np.isfinite(half) & (half > 0.0)
    several = int(counted.sum()) > 1
    agreement = constancy(values[counted].tolist(), (half[counted] / NORMAL_95).tolist()) if several else None
    less = f"{label} minus {plain(reference, 6)} {found[0].unit}" if reference else ""
    return Trend(label, less, unit, factor * (values - reference), factor * (ends - reference), usable, agreement)


def _half(study: Study, label: str) -> float:
    """Half of the 95 % interval without the errors that all runs share."""
    e = study.estimate
    i = e.labels.index(label)
    return NORMAL_95 * float(e.between_runs()[i] * e.scale[i])


def panels(found: Sequence[Trend]) -> list[Panel]:
    """One figure of each trend."""
    return [
        Panel(
            svg(partial(_draw, trend), 1, 1, (PANEL, 2.4)),
            f"{trend.label} of each run evaluated alone, with totals (95 %, k=2)",
        )
        for trend in found
    ]


def _draw(trend: Trend, axes: Any) -> None:
    axis, number = axes[0, 0], np.arange(1, len(trend.values) + 1)
    axis.axhline(0.0, **FAINT)
    for usable, marker, colour, label in _KINDS:
        where = trend.usable == usable
        if where.any():
            y = trend.values[where]
            bars = np.abs(trend.ends[where] - y[:, None]).T
            bars[~np.isfinite(bars)] = 0.0
            shown = {"color": colour, "capsize": 2.5, "markersize": 4.5, "linewidth": 1.1}
            axis.errorbar(number[where], y, bars, fmt=marker, label=label, **shown)
    axis.set_xlim(0.5, len(number) + 0.5)
    axis.locator_params(axis="x", integer=True, nbins=8)
    axis.set_xlabel("run")
    axis.set_ylabel(f"{trend.label} [{trend.unit}]")
    axis.set_title(trend.less or trend.label)
    if not trend.usable.all():
        axis.legend(ncols=2, loc="best", fontsize=7.5)


def table(runs: Sequence[StudiedRun], found: Sequence[Trend]) -> Table:
    """One row for each run, those without an estimate included."""
    rows, at = [], 0
    for n, run in enumerate(runs, 1):
        lost = NOTHING if run.lost is None else percent(run.lost)
        outcome = Cell(run.log.exit_reason, "" if run.log.exit_reason == DONE else "bad")
        row: list[str] = [f"{n}: {run.name}", run.log.began.removesuffix(" UTC") or "not recorded", outcome, lost]
        if run.alone is None:
            rows.append([*row, Cell("no estimate", "care"), *[NOTHING] * len(found)])
            continue
        holds = verdict(run.alone).holds
        row.append(Cell("yes", "good") if holds else Cell("NO", "bad"))
        for trend in found:
            low, high = trend.ends[at]
            shown = around(float(trend.values[at]), 0.5 * float(high - low))
            row.append(shown if trend.usable[at] or not holds else Cell(f"{shown} (not identified)", "care"))
        rows.append(row)
        at += 1
    less = ", ".join(trend.less for trend in found if trend.less)
    title = f"Each run alone; ± total (95 %, k=2) without errors that the runs share; {less}".removesuffix("; ")
    header = ["run", "recorded [UTC]", "ended", "lost", "fits", *(f"{trend.label} [{trend.unit}]" for trend in found)]
    return Table(title, header, rows, words=(0, 1, 2, 4))
