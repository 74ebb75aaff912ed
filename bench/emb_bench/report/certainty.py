"""Figures of the uncertainty of an estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from emb_bench.analysis.profile import LEVEL, Profile
from emb_bench.brake.motion import Floats
from emb_bench.estimate.records import Estimate
from emb_bench.figures import COLOURS, DASHED, svg
from emb_bench.report.figures import WIDE
from emb_runtime.config.bench import BrakeParameters

ELLIPSES = 6  # Most unknowns whose ellipses are drawn; more would be too small to read
JOINT_95 = math.sqrt(-2.0 * math.log(0.05))
"""Standard deviations of the ellipse that holds 95 % of a Gaussian in the plane: χ² with two degrees of freedom."""
ACROSS = 4  # Most panels side by side
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
    """Rise of χ² over the distance from the estimate, beside the parabola that the Fisher information stands for."""
    columns, rows = min(len(found), ACROSS), -(-len(found) // ACROSS)

    def draw(axes: Any) -> None:
        for axis in axes.flat[len(found) :]:
            axis.set_visible(False)
        for n, (axis, profile) in enumerate(zip(axes.flat, found, strict=False)):
            i = e.labels.index(profile.label)
            sigma = float(e.cramer_rao()[i]) * (100.0 if e.unknowns[i].relative else e.shown[i].factor)
            x = (profile.values - e.values[i]) * scales(e)[i]
            axis.axhline(LEVEL, **DASHED)
            if 0.0 < sigma < math.inf:
                along = np.linspace(float(x.min()), float(x.max()), 120)
                axis.plot(along, (along / sigma) ** 2, color=COLOURS[4], linewidth=1.0)
            axis.plot(x, profile.rise, ".-", color=COLOURS[0], markersize=4)
            axis.set_ylim(-0.4, max(8.0, 1.2 * LEVEL))
            if n % ACROSS == 0:
                axis.set_ylabel("rise of chi2")
            axis.set_xlabel(f"{profile.label} [{unit(e, i)}]")
            axis.locator_params(axis="x", nbins=3)
            axis.ticklabel_format(axis="x", style="sci", scilimits=_POWERS)

    return svg(draw, rows, columns, (WIDE, 2.3 * rows))
