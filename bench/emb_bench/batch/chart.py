"""A control chart: each parameter of a campaign's runs against time and conditions, with limits from its deviation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.analysis.several_runs import BEYOND, beyond
from emb_bench.batch.row import Row, unit_of
from emb_bench.batch.summary import CHANGES_WITH, Campaign, columns_of, condition_of, counting, is_usable, shown_as
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.figures import COLOURS, DASHED, drawn

Floats = NDArray[np.float64]


def draw_chart(rows: Sequence[Row], c: Campaign, path: Path) -> bool:
    """Draw what is estimated, one row of axes a parameter, one column a condition; False if nothing is.

    As in the summary ``c`` of the rows, copies of a log and runs that the model does not fit are left out.
    """
    over = {name: p.estimate.over for name, p in c.parameters.items() if p.estimate is not None}
    used = {name: [row for row in counting(rows) if is_usable(row, name)] for name in over}
    if not used:
        return False
    shown = [key for key in CHANGES_WITH if any(row.get(key) is not None for found in used.values() for row in found)]
    begun = min(row["start_time"] for found in used.values() for row in found)
    title = f"Control chart; dashed: median ± {BEYOND:g} standard deviations between runs, of each run"
    size = (max(6.5, 0.8 + 3.4 * len(shown)), 0.8 + 1.7 * len(used))
    with drawn(path, len(used), len(shown), title, size, sharex="col", sharey="row") as axes:
        for name, line in zip(used, axes, strict=True):
            of = columns_of(used[name], name)
            for key, axis in zip(shown, line, strict=True):
                (places, at), found = condition_of(used[name], key, begun), over[name].get(key)
                unit_size = shown_as(key, c.span)[2]
                slope = found.slope * unit_size if found is not None and found.significant else None
                _draw(axis, name, np.array(at) / unit_size, of["estimate"], of["between_runs"], places, slope)
        for key, axis in zip(shown, axes[-1], strict=True):
            label, unit, _ = shown_as(key, c.span)
            axis.locator_params(axis="x", nbins=5)
            axis.set_xlabel(f"{label}{' since the first run' if key == 'start_time' else ''} [{unit}]")
    return True


def _draw(
    axis: Any, name: str, at: Floats, values: Floats, deviations: Floats, rows: Sequence[int], slope: float | None
) -> None:
    """One parameter against one condition, which the runs at ``rows`` have; a line where there is a ``slope``."""
    median, out = float(np.median(values)), np.isin(rows, beyond(values.tolist(), deviations.tolist()))
    reference, factor, label = 0.0, 1.0, f"{name} [{unit_of(name, 'SI')}]"
    if PARAMETERS[name].relative:
        reference, factor, label = median, 100.0 / abs(median), f"{name} − median [%]"
    y, limit, order = values[rows], BEYOND * deviations[rows], np.argsort(at, kind="stable")
    for side in (-1.0, 1.0):
        axis.plot(at[order], factor * (median + side * limit[order] - reference), marker="_", **DASHED)
    axis.axhline(factor * (median - reference), **DASHED | {"linestyle": "-"})
    for where, marker, colour in ((~out, "o", COLOURS[0]), (out, "X", COLOURS[1])):
        axis.plot(at[where], factor * (y[where] - reference), marker, color=colour, markersize=4.5)
    if slope is not None:
        weights = deviations[rows] ** -2.0
        ends = np.array([at.min(), at.max()])
        middle = (np.average(at, weights=weights), np.average(y, weights=weights))
        axis.plot(ends, factor * (middle[1] + slope * (ends - middle[0]) - reference), color=COLOURS[2])
    if axis.get_subplotspec().is_first_col():
        axis.set_ylabel(label)
