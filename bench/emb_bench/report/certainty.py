"""Figures of an estimate: its uncertainty, and the minima of the local searches."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from emb_bench.analysis.bootstrap import Bootstrap
from emb_bench.analysis.profile import LEVEL, Profile
from emb_bench.brake.motion import Floats
from emb_bench.estimate.records import End, Estimate
from emb_bench.figures import COLOURS, DASHED, svg
from emb_bench.report.figures import WIDE
from emb_runtime.config.bench import BrakeParameters

ELLIPSES = 6  # Most unknowns whose ellipses are drawn; more would be too small to read
JOINT_95 = math.sqrt(-2.0 * math.log(0.05))
"""Standard deviations of the ellipse that holds 95 % of a Gaussian in the plane: χ² with two degrees of freedom."""
ACROSS = 4  # Most panels side by side
Deviated = Callable[[Floats], Floats]
_POWERS = (-1, 4)  # of ten, beyond which the axis has a common one: its numbers would touch


def scales(e: Estimate) -> Floats:
    """Factors from SI units to those shown: percent of the estimate, or the unknown's own unit; shape (p,)."""
    values = zip(e.unknowns, e.shown, e.values.tolist(), strict=True)
    return np.array([100.0 / abs(value) if u.relative and value else shown.factor for u, shown, value in values])


def unit(e: Estimate, i: int) -> str:
    """The unit that goes with :func:`scales`."""
    return "%" if e.unknowns[i].relative else e.shown[i].unit


def ellipse(covariance: Floats) -> Floats:
    """Border of the region that holds 95 % of a Gaussian at the origin, as 181 points.

    Args:
        covariance: shape (2, 2), positive semidefinite.

    Returns:
        Shape (181, 2).
    """
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * math.pi, 181)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    result: Floats = JOINT_95 * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return result


def drawable(e: Estimate) -> list[int]:
    """The unknowns of which ellipses can be drawn: shared, asked for, with a finite deviation, up to ``ELLIPSES``."""
    deviations = e.deviations()
    return [i for i in e.shared() if i in e.wanted() and math.isfinite(deviations[i]) and deviations[i] > 0.0][
        :ELLIPSES
    ]


def ellipses(e: Estimate, truth: BrakeParameters | None) -> bytes:
    """Confidence ellipses of each pair, around the estimate; a cross where the truth is, if that is known."""
    chosen, scale = drawable(e), scales(e)
    units = np.array([100.0 if u.relative else shown.factor for u, shown in zip(e.unknowns, e.shown, strict=True)])
    spread = e.deviations() * units
    correlation = e.correlation()
    size = len(chosen) - 1

    def draw(axes: Any) -> None:
        for row in range(size):
            for column in range(size):
                axis = axes[row, column]
                if column > row:
                    axis.set_visible(False)
                    continue
                x, y = chosen[column], chosen[row + 1]
                pair = np.array([x, y])
                border = ellipse(correlation[np.ix_(pair, pair)] * np.outer(spread[pair], spread[pair]))
                axis.fill(border[:, 0], border[:, 1], facecolor="#0072B222", edgecolor=COLOURS[0], linewidth=1.1)
                axis.plot(0.0, 0.0, "o", color=COLOURS[0], markersize=3.5)
                if truth is not None and all(hasattr(truth, e.unknowns[i].name) for i in pair):
                    true = np.array([getattr(truth, e.unknowns[i].name) for i in pair])
                    axis.plot(*((true - e.values[pair]) * scale[pair]), "x", color=COLOURS[1], markersize=7, mew=1.8)
                axis.locator_params(axis="y", nbins=4)
                axis.locator_params(axis="x", nbins=3)
                axis.ticklabel_format(style="sci", scilimits=_POWERS)
                if row == size - 1:
                    axis.set_xlabel(f"{e.labels[x]} [{unit(e, x)}]")
                if column == 0:
                    axis.set_ylabel(f"{e.labels[y]} [{unit(e, y)}]")

    return svg(draw, size, size, (WIDE, {1: 3.2, 2: 5.0}.get(size, 0.75 * WIDE)))


def profiles(found: Sequence[Profile], e: Estimate) -> bytes:
    """Rise of χ² over each unknown, beside the parabola that the Fisher information stands for."""

    def draw(axis: Any, n: int, values: Deviated, sigma: float) -> None:
        x = values(found[n].values)
        axis.axhline(LEVEL, **DASHED)
        if 0.0 < sigma < math.inf:
            along = np.linspace(float(x.min()), float(x.max()), 120)
            axis.plot(along, (along / sigma) ** 2, color=COLOURS[4], linewidth=1.0)
        axis.plot(x, found[n].rise, ".-", color=COLOURS[0], markersize=4)
        axis.set_ylim(-0.4, max(8.0, 1.2 * LEVEL))
        if n % ACROSS == 0:
            axis.set_ylabel("rise of chi2")

    return _of_each(e, e.cramer_rao(), [p.label for p in found], 2.3, draw)


def waterfall(ends: Sequence[End]) -> bytes:
    """χ² where each local search ended, best first."""
    cost = np.array([end.cost for end in ends])
    converged = np.array([end.converged for end in ends])

    def draw(axes: Any) -> None:
        axis, number = axes[0, 0], np.arange(1, len(cost) + 1)
        axis.plot(number, cost, color="#cccccc", zorder=1)
        axis.plot(number[converged], cost[converged], "o", color=COLOURS[0], markersize=5, label="converged")
        if not converged.all():
            axis.plot(number[~converged], cost[~converged], "x", color=COLOURS[1], markersize=6, label="gave up")
        if cost.min() > 0.0 and cost.max() > 2.0 * cost.min():
            axis.set_yscale("log")
        else:
            middle, half = 0.5 * (cost.max() + cost.min()), 0.6 * (cost.max() - cost.min())
            axis.set_ylim(middle - max(half, 5.0), middle + max(half, 5.0))
            axis.ticklabel_format(useOffset=False)
        axis.set_xlabel("local search, best first")
        axis.set_ylabel("chi2")
        axis.set_xticks(number)
        axis.legend(loc="upper left")

    return svg(draw, 1, 1, (WIDE, 2.0))


def bootstrap(found: Bootstrap, e: Estimate) -> bytes:
    """Histograms of the bootstrap estimates, and the Gaussian of the estimate's standard deviations."""

    def draw(axis: Any, n: int, values: Deviated, sigma: float) -> None:
        x = values(found.values[:, n])
        counts, _, _ = axis.hist(x, bins="auto", color=COLOURS[4], density=True)
        if 0.0 < sigma < math.inf and counts.size:
            along = np.linspace(min(-4.0 * sigma, x.min()), max(4.0 * sigma, x.max()), 160)
            density = np.exp(-0.5 * (along / sigma) ** 2) / (sigma * math.sqrt(2.0 * math.pi))
            axis.plot(along, density, color=COLOURS[0], linewidth=1.1)
        axis.set_yticks([])

    return _of_each(e, e.deviations(), found.labels, 2.0, draw)


def _of_each(
    e: Estimate,
    deviations: Floats,
    labels: Sequence[str],
    height: float,
    draw: Callable[[Any, int, Deviated, float], None],
) -> bytes:
    """Panels of some unknowns, each over the distance from its estimate; ``height`` of each [inch].

    ``draw`` gets the axis, the number of the unknown, a function from its values to that distance, and its entry of
    ``deviations`` in the same unit.
    """
    columns, rows = min(len(labels), ACROSS), -(-len(labels) // ACROSS)

    def panels(axes: Any) -> None:
        for axis in axes.flat[len(labels) :]:
            axis.set_visible(False)
        for n, (axis, label) in enumerate(zip(axes.flat, labels, strict=False)):
            i = e.labels.index(label)
            sigma = float(deviations[i]) * (100.0 if e.unknowns[i].relative else e.shown[i].factor)
            draw(axis, n, partial(_distance, e, i), sigma)
            axis.set_xlabel(f"{label} [{unit(e, i)}]")
            axis.locator_params(axis="x", nbins=3)
            axis.ticklabel_format(axis="x", style="sci", scilimits=_POWERS)

    return svg(panels, rows, columns, (WIDE, height * rows))


def _distance(e: Estimate, i: int, values: Floats) -> Floats:
    """Values of an unknown less its estimate, in the unit shown."""
    result: Floats = (values - e.values[i]) * scales(e)[i]
    return result
