"""A comparison as a figure: errors of the estimates, information, and violations of the limits."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.figures import COLOURS, GREY, drawn
from studies.comparison.comparison import Comparison

COLUMNS = 3
TINY = 1e-9  # Errors below are drawn as this


def draw(c: Comparison, path: Path) -> None:
    """One panel for each parameter, one for the information, one for the limits; a row for each candidate.

    Args:
        c: with runs on the plant that is the model, or else on the first plant.
        path: the file, whose ending is the format.

    Raises:
        UsageError: matplotlib is missing, or the file cannot be written.
    """
    plant = c.asked.model if c.matched is not None else c.asked.plants[0]
    table, standings, count = c.tables[plant], c.standings[plant], len(c.candidates)
    panels = len(c.asked.params) + 2
    rows = math.ceil(panels / COLUMNS)
    title = f"{c.asked.brakes} brakes of '{c.asked.ranges}' on plant {plant}: dot median, thick half, thin 90 % of runs"
    with drawn(path, rows, COLUMNS, title, (12.0, rows * (1.0 + 0.24 * count)), sharey=True) as axes:
        flat = axes.ravel()
        for j, name in enumerate(c.asked.params):
            errors = [np.maximum(c.errors(plant, i, j)[c.completed(plant, i)].ravel(), TINY) for i in range(count)]
            _ranges(flat[j], errors)
            flat[j].plot([s.parameters[j].bound for s in standings], range(count), "|", color=COLOURS[1], markersize=9)
            flat[j].set_xscale("log")
            flat[j].set_title(f"|relative error| of {name}; bar: median bound")
        told = flat[-2 - (len(flat) - panels)]
        _ranges(told, [table["log_det"][i][c.completed(plant, i)].ravel() for i in range(count)])
        told.set_title("log det of the physical information")
        limits = flat[-1 - (len(flat) - panels)]
        for shift, colour, label, shares in (
            (-0.18, COLOURS[0], "with the shield", [s.stopped for s in standings]),
            (0.18, COLOURS[1], "without", [s.stopped_free for s in standings]),
        ):
            at = np.arange(count) + shift
            values = np.array([100.0 * s.value for s in shares])
            limits.hlines(
                at, [100.0 * s.low for s in shares], [100.0 * s.high for s in shares], color=colour, linewidth=1.0
            )
            limits.plot(values, at, "o", color=colour, markersize=4.0, label=label)
        limits.set_title("brakes on which a run is stopped [%]")
        limits.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=2)
        for spare in flat[panels:]:
            spare.set_axis_off()
        flat[0].set_yticks(range(count), [one.name for one in c.candidates])
        flat[0].set_ylim(count - 0.4, -0.6)


def _ranges(axes: Any, runs: list[Floats]) -> None:
    for i, values in enumerate(runs):
        colour = COLOURS[0] if i == 0 else GREY
        finite = values[np.isfinite(values)]
        if not len(finite):
            continue
        low, first, middle, third, high = np.percentile(finite, [5.0, 25.0, 50.0, 75.0, 95.0])
        axes.hlines(i, low, high, color=colour, linewidth=1.0)
        axes.hlines(i, first, third, color=colour, linewidth=4.0)
        axes.plot([middle], [i], "o", color="white", markeredgecolor=colour, markersize=5.0)
