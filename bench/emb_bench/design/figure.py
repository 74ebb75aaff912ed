"""A design as a picture: what is driven, what moves, what is learned when."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.brake.parameters import UNITS
from emb_bench.design.report import Report
from emb_bench.figures import COLOURS, DASHED, GREY, drawn
from emb_bench.information.identifiability import Spectrum
from emb_runtime.config.bench import BrakeParameters


def draw(report: Report, path: Path) -> None:
    """Write the figure; the ending of the name is the format.

    Raises:
        UsageError: matplotlib is missing, or the file cannot be written.
    """
    with drawn(path, 5, 1, _title(report), (8.0, 9.0), sharex=True) as axes:
        _motion(axes[:3, 0], report)
        _information(axes[3:, 0], report)
        axes[-1, 0].set_xlabel("time [ms]")


def _title(report: Report) -> str:
    p, criterion = report.problem, report.criterion
    value = criterion.value(report.found.best.phi)
    of = ", ".join(p.params[i] for i in criterion.wanted)
    return f"{criterion.name}-optimal for {of} on the {p.plant.name} brake: {criterion.label} = {value:.6g}"


def _motion(axes: Any, report: Report) -> None:
    columns, limits = report.columns(), report.bench.limits
    time = 1e3 * columns["time"]
    panels = (
        ("current", "current [A]", (-limits.current, limits.current)),
        ("velocity", "velocity [rad/s]", (-limits.velocity, limits.velocity)),
        ("angle", "angle [rad]", limits.angle),
    )
    for axis, (name, label, border) in zip(axes, panels, strict=True):
        for value in border:
            axis.axhline(value, **DASHED)
        axis.axhline(0.0, color="#cccccc", linewidth=0.8)
        if name == "current":
            axis.step(time, columns[name], where="post", color=COLOURS[0], linewidth=1.1)
        else:
            axis.plot(time, columns[name], color=COLOURS[0])
        axis.set_ylabel(label)
        margin = 0.06 * (border[1] - border[0])
        axis.set_ylim(border[0] - margin, border[1] + margin)
    axes[0].set_title("dashed: limits", color=GREY, fontsize=8.0)
    axes[0].set_xlim(0.0, time[-1])


def _information(axes: Any, report: Report) -> None:
    history, criterion, params = report.information(), report.criterion, report.problem.params
    time = 1e3 * report.problem.sample_time * np.arange(1, len(history) + 1)
    deviations = np.full((len(history), len(params)), np.nan)
    for k, matrix in enumerate(history):
        spectrum = Spectrum(matrix)
        if not spectrum.singular:
            deviations[k] = np.sqrt(np.diag(spectrum.inverse()))
    known = np.isfinite(deviations).all(axis=1)
    axes[0].plot(time[known], [criterion.value(float(criterion.phi(m))) for m in history[known]], color=COLOURS[0])
    axes[0].set_ylabel(criterion.label.replace("log det of the Schur complement", "log det (Schur)"))
    if criterion.name in ("A", "E"):
        axes[0].set_yscale("log")
    for i, name in enumerate(params):
        unit = UNITS.get(name)
        scale = 1.0 if unit else 100.0
        symbol = f"${name}$" if name in BrakeParameters._fields else name
        label = f"{symbol} [{unit}]" if unit else symbol
        axes[1].plot(time[known], scale * deviations[known, i], color=COLOURS[i % len(COLOURS)], label=label)
    axes[1].set_yscale("log")
    top = 1e2 if known.any() else 1.0
    least = float(np.nanmin(100.0 * deviations)) if known.any() else 0.1
    axes[1].set_ylim(0.5 * least, max(top, 2.0 * least))
    axes[1].set_ylabel("Cramér-Rao bound [%]" if report.kind == "physical" else "weighted deviation [%]")
    axes[1].legend(ncols=len(params), loc="upper right")
