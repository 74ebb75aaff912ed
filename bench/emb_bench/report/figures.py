"""Figures of one run."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.analysis.growth import Growth
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import angle, command, velocity
from emb_bench.estimate.model_validation import OUTPUTS
from emb_bench.experiment.experiment import Experiment
from emb_bench.figures import COLOURS, DASHED, GREY, log_scale, svg
from emb_bench.logs.timing import Timing
from emb_bench.report.content import ActiveCycles, Run, StopSamples
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.records import Reason

WIDE = 8.6  # Width of a figure that fills the page [inch]
PANEL = 4.4
"""Width of a figure of which two stand side by side [inch]: its text can be read on a telephone and on paper."""
STOP = "#b3260b"  # Colour of the stop of a run
_BAND = "#dfe9f1"
FAINT = {"color": "#cccccc", "linewidth": 0.8, "zorder": 0}
_DOTTED: Any = {"color": "black", "linewidth": 0.7, "linestyle": (0, (2, 2))}
_SAME = 1e-3  # of the bench's current; the CAN signal has steps


class Panel(NamedTuple):
    """One figure of several that stand beside each other."""

    svg: bytes
    shows: str  # Description for who cannot see it


def excitation(run: Run, cycles: ActiveCycles, after: StopSamples | None) -> Panel:
    """Current as requested by the policy, sent and applied; below, the reasons for their difference over time."""
    limit, period = run.bench.limits.current, run.bench.timing.sample_time
    held = [reason for reason, where in cycles.reasons.items() if where.any()]

    def draw(axes: Any) -> None:
        above = axes[0, 0]
        for value in (-limit, limit):
            above.axhline(value, **DASHED)
        above.axhline(0.0, **FAINT)
        time = 1e3 * cycles.time
        above.step(time, cycles.wanted, where="post", color=COLOURS[5], label="wanted by the policy", linewidth=2.6)
        if cycles.reasons[Reason.CLIPPED].any():
            above.step(time, cycles.clipped, where="post", color=COLOURS[4], label="clipped", linewidth=1.6)
        above.step(time, cycles.sent, where="post", color=COLOURS[0], label="sent after the shield", linewidth=1.3)
        if not applied_as_sent(run, cycles) and run.experiment is not None:
            applied = np.append(run.experiment.currents, np.nan)
            at = 1e3 * period * np.arange(len(applied))
            above.step(at, applied, where="post", label="applied by the node", **_DOTTED)
        if after is not None:
            above.step(1e3 * after.current[0], after.current[1], where="pre", **_DOTTED)
            _mark_stop(above, cycles, after)
        above.set_ylim(-1.2 * limit, 1.2 * limit)
        above.set_ylabel("current [A]")
        above.legend(ncols=2, loc="lower left", bbox_to_anchor=(0.0, 1.0), handlelength=1.6, columnspacing=1.2)
        if held:
            below = axes[1, 0]
            for row, reason in enumerate(held):
                spans = [
                    (1e3 * begin, 1e3 * length) for begin, length in _spans(cycles.time, cycles.reasons[reason], period)
                ]
                below.broken_barh(spans, (row - 0.35, 0.7), color=COLOURS[1 + row])
            below.set_yticks(range(len(held)), [str(reason.name).lower() for reason in held])
            below.set_ylim(len(held) - 0.5, -0.5)
            below.grid(visible=False)
        axes[-1, 0].set_xlabel("time [ms]")
        axes[-1, 0].set_xlim(0.0, 1e3 * max(_end(cycles) + period, 0.0 if after is None else after.end))

    ratios = (6, len(held)) if held else (1,)
    drawn = svg(draw, len(ratios), 1, (PANEL, 2.5 + 0.22 * len(held)), sharex=True, height_ratios=ratios)
    return Panel(
        drawn, "Current over time: wanted by the policy, clipped, sent and applied, with marks where they differ"
    )


def applied(run: Run, experiment: Experiment) -> Panel:
    """Command or current that drove the machine of an imported recording, in its own unit."""
    shown = command(run.bench.machine)

    def draw(axes: Any) -> None:
        axis = axes[0, 0]
        values = shown.factor * np.append(experiment.currents, np.nan)
        axis.axhline(0.0, **FAINT)
        axis.step(1e3 * run.bench.timing.sample_time * np.arange(len(values)), values, where="post", color=COLOURS[0])
        axis.set_ylabel(f"{shown.name} [{shown.unit}]")
        axis.set_xlabel("time [ms]")

    return Panel(svg(draw, 1, 1, (PANEL, 2.6)), f"{shown.name.capitalize()} that acted over time")


def _end(cycles: ActiveCycles) -> float:
    return float(cycles.time.max(initial=0.0))


def _mark_stop(axis: Any, cycles: ActiveCycles, after: StopSamples) -> None:
    """A line where the run was stopped."""
    at = 1e3 * _end(cycles)
    side, shift = ("right", -3) if _end(cycles) > 0.3 * after.end else ("left", 3)
    axis.axvline(at, color=STOP, linewidth=1.4)
    place: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "xytext": (shift, 0)}
    axis.annotate("stopped", (at, 0.03), ha=side, va="bottom", fontsize=8.0, color=STOP, **place)


def applied_as_sent(run: Run, cycles: ActiveCycles) -> bool:
    """Returns True if the node applied in every period the current sent for it; False if either is unknown in one."""
    if run.experiment is None:
        return False
    applied = run.experiment.currents
    steps = np.rint(cycles.time / run.bench.timing.sample_time).astype(int)
    sent = np.full(len(applied), np.nan)
    inside = steps < len(applied)
    sent[steps[inside]] = cycles.sent[inside]
    return bool(np.all(np.abs(applied - sent) <= _SAME * run.bench.limits.current))


def _spans(time: Floats, where: Any, period: float) -> list[tuple[float, float]]:
    """Begin and length of each stretch."""
    spans: list[tuple[float, float]] = []
    for begin in time[where].tolist():
        if spans and begin - sum(spans[-1]) < 0.5 * period:
            spans[-1] = (spans[-1][0], begin + period - spans[-1][0])
        else:
            spans.append((begin, period))
    return spans


def motion(run: Run, cycles: ActiveCycles | None, after: StopSamples | None) -> list[Panel]:
    """Measured angle and velocity, and what the model predicts at the estimate, with the bench's limits.

    Args:
        run: with an experiment, or with cycles.
        cycles: of the run; None if it has none.
        after: samples after the last cycle of a stopped run.
    """
    limits, period = run.bench.limits, run.bench.timing.sample_time
    if run.experiment is None:
        assert cycles is not None
        time, measured = cycles.time, np.stack([cycles.angle, cycles.velocity], axis=1)
    else:
        measured = run.experiment.all_samples
        time = period * np.arange(len(measured), dtype=np.float64)
    units = (angle(run.bench.machine), velocity(run.bench.machine))
    factors = np.array([unit.factor for unit in units])
    measured = measured * factors
    driven = run.bench.machine is None
    borders = (limits.angle, (-limits.velocity, limits.velocity)) if driven else ((0.0, 0.0), (0.0, 0.0))
    last = max(float(time.max(initial=0.0)), period, 0.0 if after is None else after.end)
    panels = []
    for i, name in enumerate(OUTPUTS):

        def draw(axes: Any, i: int = i, name: str = name) -> None:
            axis = axes[0, 0]
            for value in borders[i] if driven else ():
                axis.axhline(value, **DASHED)
            axis.axhline(0.0, **FAINT)
            axis.plot(1e3 * time, measured[:, i], ".", color=COLOURS[4], markersize=3.5, label="measured")
            seen = measured[np.isfinite(measured[:, i]), i]
            if run.growth is not None:
                predicted = factors[i] * run.growth.shown[:, i]
                axis.plot(1e3 * run.growth.time, predicted, color=COLOURS[1], label="predicted", linewidth=1)
            if after is not None and cycles is not None:
                when, values = (after.angle, after.velocity)[i]
                axis.plot(1e3 * when, values, ".", color=GREY, markersize=3.0, label="while stopping")
                seen = np.concatenate([seen, values[np.isfinite(values)]])
                _mark_stop(axis, cycles, after)
            # The limits are shown where the brake comes near them, and never at the cost of what it did.
            low, high = borders[i]
            bottom, top = min(low, seen.min(initial=0.0)), max(high, seen.max(initial=0.0))
            axis.set_ylim(bottom - 0.05 * (top - bottom), top + 0.05 * (top - bottom))
            axis.set_ylabel(f"{units[i].name} [{units[i].unit}]")
            axis.legend(ncols=3, loc="lower left", bbox_to_anchor=(0.0, 1.0), handlelength=1.6, columnspacing=1.2)
            axis.set_xlabel("time [ms]")
            axis.set_xlim(0.0, 1e3 * last)

        predicted = ", and predicted by the model at the estimate" if run.growth is not None else ""
        panels.append(Panel(svg(draw, 1, 1, (PANEL, 2.6)), f"{name.capitalize()} over time: measured{predicted}"))
    return panels


def residuals(run: Run, errors: Floats) -> Panel:
    """Measured less predicted over time, in standard deviations.

    Args:
        run: its bench gives the sample time.
        errors: NaN where lost, shape (n, 2).
    """
    time, measured = 1e3 * run.bench.timing.sample_time * np.arange(1, len(errors) + 1), _measured(errors)

    def draw(axes: Any) -> None:
        axis = axes[0, 0]
        axis.axhspan(-2.0, 2.0, color=_BAND, zorder=0)
        for i, name in measured:
            axis.plot(time, errors[:, i], ".", color=COLOURS[i], markersize=3, label=name)
        axis.set_ylabel("residual [sigma]")
        axis.set_xlabel("time [ms]")
        axis.legend(ncols=2, loc="lower left", bbox_to_anchor=(0.0, 1.0), handlelength=1.6, columnspacing=1.2)

    names = " and ".join(name for _, name in measured)
    shows = f"Residuals of {names} over time, in standard deviations of their sensors"
    return Panel(svg(draw, 1, 1, (PANEL, 2.6)), shows)


def _measured(errors: Floats) -> list[tuple[int, str]]:
    """Numbers and names of the outputs with any residuals: a velocity that an observer derives has none."""
    return [(i, name) for i, name in enumerate(OUTPUTS) if np.isfinite(errors[:, i]).any()]


def information(growth: Growth) -> list[Panel]:
    """Log det and Cramér-Rao bounds over time, and the share of each part of the run."""
    time = 1e3 * growth.time

    def over_time(axis: Any) -> None:
        axis.set_xlim(0.0, float(time[-1]))
        axis.set_xlabel("time [ms]")

    def log_det(axes: Any) -> None:
        axes[0, 0].plot(time, np.where(np.isfinite(growth.log_det), growth.log_det, np.nan), color=COLOURS[0])
        axes[0, 0].set_title("log det of the physical information")
        over_time(axes[0, 0])

    def deviations(axes: Any) -> None:
        axis, bounds = axes[0, 0], np.where(np.isfinite(growth.deviations), growth.deviations, np.nan)
        for i, label in enumerate(growth.labels):
            unit, scale = growth.units[i] or "%", 1.0 if growth.units[i] else 100.0
            style = ("-", "--", ":")[i // len(COLOURS) % 3]
            axis.plot(time, scale * bounds[:, i], style, color=COLOURS[i % len(COLOURS)], label=f"{label} [{unit}]")
        if np.isfinite(bounds).any():
            log_scale(axis.yaxis)
            ends = bounds[-1] * [1.0 if unit else 100.0 for unit in growth.units]
            finite = ends[np.isfinite(ends)]
            if len(finite):
                axis.set_ylim(0.5 * float(finite.min()), max(1e2, 2.0 * float(finite.max())))
        axis.set_title("least deviation of an estimate")
        axis.legend(ncols=2 if len(growth.labels) > 3 else 1, loc="upper right")
        over_time(axis)

    return [
        Panel(svg(log_det, 1, 1, (PANEL, 2.5)), "Growth over time of the log det of the information"),
        Panel(svg(deviations, 1, 1, (PANEL, 2.5)), "Cramér-Rao bounds of all unknowns over time"),
        Panel(
            svg(lambda axes: _parts(axes[0, 0], growth), 1, 1, (PANEL, 2.5)),
            "Share of each part of the run in the information on each unknown",
        ),
    ]


def learnt(run: Run, steps: NDArray[np.int64], numbers: Floats) -> list[Panel]:
    """Ranges of the parameters that the shield left as possible over time.

    Args:
        run: its bench gives the sample time.
        steps: see :func:`emb_bench.logs.estimates.learnt_history`.
        numbers: the same.
    """
    time = 1e3 * run.bench.timing.sample_time * steps

    def draw(axes: Any) -> None:
        axis = axes[0, 0]
        for i, name in enumerate(PARAMETER_NAMES):
            low, high = numbers[:, 2 * i], numbers[:, 2 * i + 1]
            axis.fill_between(time, low, high, color=COLOURS[i], alpha=0.25, linewidth=0.0)
            for end, label in ((low, name), (high, "")):
                axis.plot(time, end, color=COLOURS[i], linewidth=1.0, label=label)
        axis.set_title("possible parameters, relative to nominal")
        axis.legend(ncols=4, loc="upper right", columnspacing=0.8, handlelength=1.2)
        axis.set_xlim(0.0, float(time[-1]) or 1.0)
        axis.set_xlabel("time [ms]")

    shows = "Ranges of the four parameters that the shield left as possible, over time"
    return [Panel(svg(draw, 1, 1, (PANEL, 2.7)), shows)]


def _parts(axis: Any, growth: Growth) -> None:
    """A map: parts of the run across, unknowns down, the share in percent."""
    shares = 100.0 * growth.parts.T
    borders = 1e3 * growth.borders
    axis.pcolormesh(borders, np.arange(len(shares) + 1), shares, cmap="Blues", vmin=0.0, vmax=100.0, edgecolors="white")
    middle = 0.5 * (borders[1:] + borders[:-1])
    for row, values in enumerate(shares.tolist()):
        for at, value in zip(middle.tolist(), values, strict=True):
            if value >= 0.5:
                colour = "white" if value > 55.0 else "#1b1f24"
                axis.text(at, row + 0.5, f"{value:.0f}", ha="center", va="center", fontsize=7.5, color=colour)
    axis.set_yticks(np.arange(len(shares)) + 0.5, growth.labels)
    axis.set_ylim(len(shares), 0.0)
    axis.grid(visible=False)
    axis.set_xlabel("time [ms]")
    axis.set_title("share of each part of the run [%]")


def times(t: Timing) -> list[Panel]:
    """Histograms of the times from sample to command and from sample to sample."""
    period = 1e6 * t.period
    middle = float(np.median(period)) if len(period) else 0.0

    def histogram(axes: Any, values: Floats, label: str, colour: str) -> None:
        axis = axes[0, 0]
        axis.hist(values, bins=40, color=colour)
        log_scale(axis.yaxis)
        axis.axvline(float(np.median(values)), **DASHED)
        axis.set_xlabel(label)
        axis.set_ylabel("count")

    panels = []
    for values, label, colour in (
        (1e6 * t.response, "sensor to command [µs]", COLOURS[0]),
        (period - middle, f"sample to sample, minus {middle:.0f} µs [µs]", COLOURS[2]),
    ):
        if len(values):
            drawn = svg(partial(histogram, values=values, label=label, colour=colour), 1, 1, (PANEL, 2.4))
            panels.append(Panel(drawn, f"Histogram of the times from {label.removesuffix(' [µs]')}"))
    return panels
