"""Figure of a campaign: each parameter over time, run by run, and its trend."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from emb_bench.batch.summary import Campaign
from emb_bench.estimate.records import NORMAL_95
from emb_bench.figures import COLOURS, drawn

WIDTH, HEIGHT = 8.0, 2.2  # Of one parameter [inch]


def draw(c: Campaign, path: Path) -> None:
    """Draws the parameters that have a trend, each with the 95 % intervals of the runs and of the trend.

    Raises:
        UsageError: matplotlib is missing, or the file cannot be written.
    """
    shown = {name: p for name, p in c.parameters.items() if p.trend is not None}
    title = "Parameters over the campaign, ± 95 %" if shown else "No parameter has enough runs for a trend"
    rows = max(len(shown), 1)
    with drawn(path, rows, 1, title, (WIDTH, HEIGHT * rows), sharex=True) as axes:
        for (name, p), axis in zip(shown.items(), axes[:, 0], strict=False):
            if p.trend is not None:
                times = [datetime.fromtimestamp(start * 1e-9, UTC) for start in p.trend.start_times]
                half = [NORMAL_95 * deviation for deviation in p.trend.deviations]
                low, high = p.trend.walk.ends.T
                axis.fill_between(times, low, high, color=COLOURS[1], alpha=0.25, linewidth=0.0)
                axis.plot(times, p.trend.walk.values, color=COLOURS[1], label="random walk through all runs")
                alone = {"fmt": "o", "color": COLOURS[0], "capsize": 2.5, "markersize": 3.5, "linewidth": 1.0}
                axis.errorbar(times, p.trend.values, half, label="each run alone", **alone)
                axis.set_ylabel(f"{name} [{p.unit}]")
        axes[-1, 0].set_xlabel("time [UTC]")
        if shown:
            axes[0, 0].legend(ncols=2)
        axes[-1, 0].tick_params(axis="x", labelrotation=20.0)
