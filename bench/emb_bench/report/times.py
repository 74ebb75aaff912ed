"""How punctual a run was."""

from __future__ import annotations

from typing import Any

import numpy as np

from emb_bench.figures import COLOURS, GREY, svg
from emb_bench.report.content import Run
from emb_bench.report.figures import WIDE
from emb_bench.report.numbers import seconds
from emb_bench.report.page import Child, Section, facts, picture, table, tag
from emb_bench.timing import INTERVALS, QUANTILES, Timing, quantiles


def timing(run: Run, name: str) -> Section | None:
    """Intervals of the loop, missed periods, the node's clock; ``name`` is what the section is linked by."""
    t = run.timing
    if t is None or not len(t.response):
        return None
    obeyed = "not known" if t.not_obeyed is None else f"{t.not_obeyed} answers, by the node's own account"
    said: list[tuple[str, Child]] = [
        ("periods missed", f"{t.missed}, no sample came"),
        ("unanswered", f"{t.unanswered} samples"),
        ("not obeyed", obeyed),
        ("least time to spare", seconds(float(t.slack.min()))),
    ]
    if t.clock is not None:
        drift = f"{1e6 * t.clock.drift:+.3g}".replace("-", "−")
        said.append(("node's clock", f"slow by {drift} ppm; arrivals scatter by {seconds(t.clock.jitter)}"))
    rows = []
    for key, words in INTERVALS.items():
        values = t.interval(key)
        if len(values) and key != "slack":
            rows.append([words, str(len(values)), *map(seconds, quantiles(values).values())])
    names = {50.0: "median", 100.0: "largest"}
    head = ["interval", "count", *(names.get(q, f"{q:g} %") for q in QUANTILES)]
    return Section(
        "Timing",
        tag("p", "Time was simulated: these times say nothing of any computer or bus.", cls="care")
        if t.simulated
        else None,
        facts(said),
        table(head, rows, "Times of the loop, by the stamps in the log"),
        None
        if t.simulated
        else picture(
            _draw(t),
            "Time from a sensor sample to its command over the run and as a histogram, and a histogram of the periods",
            "From a sample's arrival until the bus had taken its answer, over the run and as a histogram; and from one "
            "sample's arrival to the next one's. Counts are on a logarithmic scale, so that single ones show.",
        ),
        name=name,
    )


def _draw(t: Timing) -> bytes:
    def draw(axes: Any) -> None:
        response, period = 1e6 * t.response, 1e6 * t.period
        middle = float(np.median(period)) if len(period) else 0.0
        axes[0, 0].plot(1e3 * t.times, response, ".", color=COLOURS[0], markersize=3)
        axes[0, 0].set_xlabel("time [ms]")
        axes[0, 0].set_ylabel("sensor to command [µs]")
        axes[0, 0].set_ylim(0.0, 1.08 * float(response.max()) or 1.0)
        for axis, values, label, colour in (
            (axes[0, 1], response, "sensor to command [µs]", COLOURS[0]),
            (axes[0, 2], period - middle, f"sample to sample less {middle:.0f} µs [µs]", COLOURS[2]),
        ):
            if len(values):
                axis.hist(values, bins=40, color=colour, log=True)
                axis.axvline(float(np.median(values)), color=GREY, linewidth=0.9, linestyle=(0, (5, 3)))
            axis.set_xlabel(label)
            axis.set_ylabel("count")

    return svg(draw, 1, 3, (WIDE, 2.6))
