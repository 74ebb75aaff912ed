"""Figures of the page: motion and currents of a run, residuals, uncertainty of an estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from emb_bench.analysis.records import LEVEL, Profile
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import quantity
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.records import OUTPUTS
from emb_bench.experiment.experiment import Experiment
from emb_bench.figures import COLOURS, DASHED, GREY, svg
from emb_bench.report.motion import ActiveCycles, Motion, StopSamples
from emb_bench.report.page import Panel
from emb_runtime.numbers import SMALL, SUPERSCRIPT
from emb_runtime.records import Reason

WIDE = 8.6  # Width of a figure that fills the page [inch]
PANEL = 4.4
"""Width of a figure of which two stand side by side [inch]: its text can be read on a telephone and on paper."""
STOP = "#b3260b"  # Colour of the stop of a run
LIGHT = "#8fcdf2"  # Colour of samples below a line that predicts them
_LEGEND: Any = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "handlelength": 1.6, "columnspacing": 1.2}
_BAND = "#dfe9f1"
FAINT = {"color": "#cccccc", "linewidth": 0.8, "zorder": 0}
_DOTTED: Any = {"color": "black", "linewidth": 0.7, "linestyle": (0, (2, 2))}
_SAME = 1e-3  # of the bench's current; the CAN signal has steps


def excitation(motion: Motion, cycles: ActiveCycles) -> Panel:
    """Current as requested by the policy, sent and applied; below, the reasons for their difference over time."""
    limit, period, after = motion.bench.limits.current, motion.bench.timing.sample_time, motion.after
    present = [reason for reason, where in cycles.reasons.items() if where.any()]

    def draw(axes: Any) -> None:
        above = axes[0, 0]
        for value in (-limit, limit):
            above.axhline(value, **DASHED)
        above.axhline(0.0, **FAINT)
        time = 1e3 * cycles.time
        above.step(
            time, cycles.requested, where="post", color=COLOURS[5], label="requested by the policy", linewidth=2.6
        )
        if cycles.reasons[Reason.CLIPPED].any():
            above.step(time, cycles.clipped, where="post", color=COLOURS[4], label="clipped", linewidth=1.6)
        above.step(time, cycles.sent, where="post", color=COLOURS[0], label="sent after the shield", linewidth=1.3)
        if not applied_as_sent(motion) and motion.experiment is not None:
            applied = np.append(motion.experiment.currents, np.nan)
            at = 1e3 * period * np.arange(len(applied))
            above.step(at, applied, where="post", label="applied by the node", **_DOTTED)
        if after is not None:
            above.step(1e3 * after.current[0], after.current[1], where="pre", **_DOTTED)
            _mark_stop(above, cycles, after)
        above.set_ylim(-1.2 * limit, 1.2 * limit)
        above.set_ylabel("current [A]")
        above.legend(ncols=2, **_LEGEND)
        if present:
            below = axes[1, 0]
            for row, reason in enumerate(present):
                spans = [
                    (1e3 * begin, 1e3 * length) for begin, length in _spans(cycles.time, cycles.reasons[reason], period)
                ]
                below.broken_barh(spans, (row - 0.35, 0.7), color=COLOURS[1 + row])
            below.set_yticks(range(len(present)), [str(reason.name).lower() for reason in present])
            below.set_ylim(len(present) - 0.5, -0.5)
            below.grid(visible=False)
        axes[-1, 0].set_xlabel("time [ms]")
        axes[-1, 0].set_xlim(0.0, 1e3 * max(_end(cycles) + period, 0.0 if after is None else after.end))

    ratios = (6, len(present)) if present else (1,)
    drawn = svg(draw, len(ratios), 1, (PANEL, 2.5 + 0.22 * len(present)), sharex=True, height_ratios=ratios)
    return Panel(
        drawn, "Current over time: requested by the policy, clipped, sent and applied, with marks where they differ"
    )


def applied(motion: Motion, experiment: Experiment) -> Panel:
    """Command or current of the machine of a recording, in the unit of its map."""
    shown = quantity(motion.bench.machine, "current")

    def draw(axes: Any) -> None:
        axis = axes[0, 0]
        values = np.append(experiment.currents, np.nan)
        axis.axhline(0.0, **FAINT)
        axis.step(
            1e3 * motion.bench.timing.sample_time * np.arange(len(values)), values, where="post", color=COLOURS[0]
        )
        axis.set_ylabel(f"{shown.name} [{shown.unit}]")
        axis.set_xlabel("time [ms]")

    return Panel(svg(draw, 1, 1, (PANEL, 2.6)), f"{shown.name.capitalize()} that acted over time")


def of_run(motion: Motion) -> list[Panel]:
    """Figures of a run."""
    drawn = angle_and_velocity(motion)
    if motion.cycles is not None:
        drawn.append(excitation(motion, motion.cycles))
    elif motion.experiment is not None:
        drawn.append(applied(motion, motion.experiment))
    return drawn if motion.residuals is None else [*drawn, residuals(motion, motion.residuals)]


def _end(cycles: ActiveCycles) -> float:
    return float(cycles.time.max(initial=0.0))


def _mark_stop(axis: Any, cycles: ActiveCycles, after: StopSamples) -> None:
    """A line where the run was stopped."""
    at = 1e3 * _end(cycles)
    side, shift = ("right", -3) if _end(cycles) > 0.3 * after.end else ("left", 3)
    axis.axvline(at, color=STOP, linewidth=1.4)
    place: Any = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "xytext": (shift, 0)}
    axis.annotate("stopped", (at, 0.7), ha=side, va="bottom", fontsize=8.0, color=STOP, **place)


def applied_as_sent(motion: Motion) -> bool:
    """Returns True if the node applied the sent current in every period; False if either is missing in one."""
    cycles = motion.cycles
    if motion.experiment is None or cycles is None:
        return False
    applied = motion.experiment.currents
    steps = np.rint(cycles.time / motion.bench.timing.sample_time).astype(int)
    sent = np.full(len(applied), np.nan)
    inside = steps < len(applied)
    sent[steps[inside]] = cycles.sent[inside]
    return bool(np.all(np.abs(applied - sent) <= _SAME * motion.bench.limits.current))


def _spans(time: Floats, where: Any, period: float) -> list[tuple[float, float]]:
    """Begin and length of each stretch."""
    spans: list[tuple[float, float]] = []
    for begin in time[where].tolist():
        if spans and begin - sum(spans[-1]) < 0.5 * period:
            spans[-1] = (spans[-1][0], begin + period - spans[-1][0])
        else:
            spans.append((begin, period))
    return spans


def angle_and_velocity(motion: Motion) -> list[Panel]:
    """Measured angle and velocity, the prediction at the estimate, and the bench's limits."""
    limits, period, cycles, after = motion.bench.limits, motion.bench.timing.sample_time, motion.cycles, motion.after
    if motion.experiment is None:
        if cycles is None:
            return []
        time, measured = cycles.time, np.stack([cycles.angle, cycles.velocity], axis=1)
    else:
        measured = motion.experiment.all_samples
        time = period * np.arange(len(measured), dtype=np.float64)
    units = [quantity(motion.bench.machine, name) for name in OUTPUTS]
    driven = motion.bench.machine is None
    borders = (limits.angle, (-limits.velocity, limits.velocity)) if driven else ((0.0, 0.0), (0.0, 0.0))
    last = max(float(time.max(initial=0.0)), period, 0.0 if after is None else after.end)
    panels = []
    for i, name in enumerate(OUTPUTS):

        def draw(axes: Any, i: int = i, name: str = name) -> None:
            axis = axes[0, 0]
            for value in borders[i] if driven else ():
                axis.axhline(value, **DASHED)
            axis.axhline(0.0, **FAINT)
            axis.plot(1e3 * time, measured[:, i], ".", color=LIGHT, markersize=4.5, label="measured")
            seen = measured[np.isfinite(measured[:, i]), i]
            if motion.predicted is not None:
                shown = motion.predicted[:, i]
                at = 1e3 * period * np.arange(1, len(shown) + 1)
                axis.plot(at, shown, color=COLOURS[1], label="predicted", linewidth=0.8)
            if after is not None and cycles is not None:
                when, values = (after.angle, after.velocity)[i]
                axis.plot(1e3 * when, values, ".", color=GREY, markersize=3.0, label="while stopping")
                seen = np.concatenate([seen, values[np.isfinite(values)]])
                _mark_stop(axis, cycles, after)
            # The axis contains all samples, and the limits.
            low, high = borders[i]
            bottom, top = min(low, seen.min(initial=0.0)), max(high, seen.max(initial=0.0))
            axis.set_ylim(bottom - 0.05 * (top - bottom), top + 0.05 * (top - bottom))
            axis.set_ylabel(f"{units[i].name} [{units[i].unit}]")
            axis.legend(ncols=3, markerscale=2.0, **_LEGEND)
            axis.set_xlabel("time [ms]")
            axis.set_xlim(0.0, 1e3 * last)

        predicted = ", and predicted by the model at the estimate" if motion.predicted is not None else ""
        panels.append(Panel(svg(draw, 1, 1, (PANEL, 2.6)), f"{name.capitalize()} over time: measured{predicted}"))
    return panels


def residuals(motion: Motion, errors: Floats) -> Panel:
    """Measured less predicted over time, in standard deviations."""
    time, measured = 1e3 * motion.bench.timing.sample_time * np.arange(1, len(errors) + 1), _measured(errors)

    def draw(axes: Any) -> None:
        axis = axes[0, 0]
        axis.axhspan(-2.0, 2.0, color=_BAND, zorder=0)
        for i, name in measured:
            axis.plot(time, errors[:, i], ".", color=COLOURS[i], markersize=3, label=name)
        axis.set_ylabel("residual [sigma]")
        axis.set_xlabel("time [ms]")
        axis.legend(ncols=2, markerscale=2.0, **_LEGEND)

    names = " and ".join(name for _, name in measured)
    shows = f"Residuals of {names} over time, in standard deviations of their sensors"
    return Panel(svg(draw, 1, 1, (PANEL, 2.6)), shows)


def _measured(errors: Floats) -> list[tuple[int, str]]:
    """Numbers and names of the outputs with any residuals: a velocity that an observer derives has none."""
    return [(i, name) for i, name in enumerate(OUTPUTS) if np.isfinite(errors[:, i]).any()]


# ---- uncertainty of an estimate ----

ACROSS = 4  # Most panels side by side


def axis_unit(e: Estimate, i: int, farthest: float) -> tuple[float, str]:
    """Factor and unit of the axis for distances of an unknown from its estimate, the ``farthest`` given in SI units.

    Relative to the value, or in its unit.
    """
    if not e.unknowns[i].relative:
        unit, power = e.quantities[i].unit, math.floor(math.log10(farthest)) if farthest > 0.0 else 0
        if power > -3:
            return 1.0, unit
        return 10.0**-power, f"10{str(power).translate(SUPERSCRIPT)} {unit.removesuffix('1')}".rstrip()
    factor, unit = (1e6, "ppm") if farthest < SMALL * float(e.scale[i]) else (100.0, "%")
    return factor / float(e.scale[i]), unit


def profiles(found: Sequence[Profile], e: Estimate) -> bytes:
    """Increase of χ² over the distance from the estimate, beside the parabola of the Fisher information."""
    columns, rows = min(len(found), ACROSS), -(-len(found) // ACROSS)

    def draw(axes: Any) -> None:
        for axis in axes.flat[len(found) :]:
            axis.set_visible(False)
        for n, (axis, profile) in enumerate(zip(axes.flat, found, strict=False)):
            i = e.labels.index(profile.label)
            factor, unit = axis_unit(e, i, float(np.abs(profile.values - e.values[i]).max()))
            sigma = float(e.cramer_rao()[i] * e.scale[i]) * factor
            x = (profile.values - e.values[i]) * factor
            axis.axhline(LEVEL, **DASHED)
            if 0.0 < sigma < math.inf:
                along = np.linspace(float(x.min()), float(x.max()), 120)
                axis.plot(along, (along / sigma) ** 2, color=COLOURS[4], linewidth=1.0)
            axis.plot(x, profile.rise, ".-", color=COLOURS[0], markersize=4)
            axis.set_ylim(-0.4, max(8.0, 1.2 * LEVEL))
            if n % ACROSS == 0:
                axis.set_ylabel("increase of chi2")
            axis.set_xlabel(f"{profile.label} [{unit}]")
            axis.locator_params(axis="x", nbins=3)
            axis.ticklabel_format(axis="x", style="plain", useOffset=False)

    return svg(draw, rows, columns, (WIDE, 2.3 * rows))
