"""The figures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.figures import COLOURS, GREY, drawn
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import Bench
from studies.thesis.determinant import Protected, Unprotected
from studies.thesis.oscillator import SWITCH, Input, oscillator
from studies.thesis.two_parameters import Excited

TIME = "time [s]"
LEAST_INCREMENT = 1e-2  # Lower end of the logarithmic axis of the increments


def plot_unprotected(bench: Bench, f: Unprotected, path: Path) -> None:
    """Fig. 4.2."""
    times = _times(bench, len(f.determinants))
    regular = f.ranks == f.ranks[-1]
    negative = (f.determinants_single < 0.0) & regular
    title = f"Fig. 4.2: constant {f.amplitude:g} A, Fisher information of four parameters started at zero"
    with _drawn(path, 3, 2, title) as axes:
        _excitation_panels(axes, bench, f)
        axis = axes[1][1]
        axis.set_title("(d) determinant, around where it is negative")
        span = _around(negative)
        axis.plot(times[span], np.exp(f.log_exact[span]), color=COLOURS[0], label="exact")
        axis.plot(times[span], f.determinants_single[span], color=COLOURS[1], label="single precision")
        deepest = float(-f.determinants_single[negative].min(initial=-1.0))
        axis.set_yscale("symlog", linthresh=10.0 ** math.ceil(math.log10(deepest)))
        axis.axhline(0.0, color=GREY, linewidth=0.8)
        axis.set_ylabel("|M|")
        axis.legend(loc="upper left")
        axis = axes[2][0]
        axis.set_title("(e) its logarithm, where it has one")
        axis.plot(times, _finite(f.log_exact), color=COLOURS[0], linewidth=4.0, alpha=0.35, label="exact")
        axis.plot(times, _log(f.determinants_single), color=COLOURS[1], label="single precision")
        label: str | None = "no logarithm"
        for at in times[negative]:
            axis.axvline(at, ymax=0.05, color="black", linewidth=1.0, label=label)
            label = None
        axis.set_ylabel("log |M|")
        axis.legend(loc="lower right")
        axis = axes[2][1]
        axis.set_title("(f) condition number")
        axis.semilogy(times[regular], f.conditions_single[regular], color=COLOURS[1], label="single precision")
        axis.semilogy(times[regular], f.conditions[regular], color=COLOURS[0], label="double precision")
        axis.set_ylabel("κ(M)")
        axis.legend()


def plot_protected(bench: Bench, f: Unprotected, cured: Protected, path: Path) -> None:
    """Fig. 4.3."""
    times = _times(bench, len(cured.rewards))
    title = f"Fig. 4.3: the same started at ε I, ε = {cured.epsilon:g}, and normalised while it runs"
    with _drawn(path, 3, 2, title) as axes:
        _excitation_panels(axes, bench, f)
        axis = axes[1][1]
        axis.set_title("(d) normalised determinant over its initial one")
        axis.semilogy(times, np.exp(cured.rewards), color=COLOURS[0])
        axis.set_ylabel("|M̄| / |M_init|")
        axis = axes[2][0]
        axis.set_title("(e) logarithm of the determinant")
        axis.plot(times, cured.log_det, color=COLOURS[0], label="log |M|, from the step rewards")
        axis.plot(times, _finite(f.log_exact), "--", color="black", linewidth=0.9, label="exact, without ε I")
        axis.plot(times, cured.log_normalised, color=COLOURS[1], label="log |M̄|, normalised")
        axis.set_ylabel("log |M|")
        axis.legend(loc="lower right")
        axis = axes[2][1]
        axis.set_title("(f) condition number")
        axis.semilogy(times, cured.conditions, color=COLOURS[0])
        axis.set_ylabel("κ(M + ε I)")


def plot_oscillator(bench: Bench, inputs: Sequence[Input], path: Path) -> None:
    """Fig. 5.1."""
    panels = (
        ("(a) prescribed velocity", "x₂ [rad/s]"),
        ("(b) a, sensitivity of the angle", "a [rad]"),
        ("(c) b, sensitivity of the velocity", "b [rad/s]"),
        ("(d) increment of the weighted information", "ΔM per sample"),
    )
    names = ("input 1: constant", f"input 2: stops at {SWITCH:g} s")
    peak = oscillator(bench.brake).peak_time
    title = "Fig. 5.1: the sensitivity to f_v as a mass on a spring, driven by the velocity"
    with _drawn(path, 2, 2, title) as axes:
        for axis, (name, unit) in zip(np.ravel(axes), panels, strict=True):
            axis.set_title(name)
            axis.set_ylabel(unit)
        for driven, colour, name in zip(inputs, COLOURS, names, strict=False):
            times = _times(bench, len(driven.increments))
            starts = times - bench.timing.sample_time
            axes[0][0].step(starts, driven.velocity, where="post", color=colour, label=name)
            axes[0][1].plot(times, driven.s[:, 0], color=colour)
            axes[1][0].plot(times, driven.s[:, 1], color=colour)
            axes[1][1].plot(times, driven.increments, color=colour)
        axes[0][1].axvline(peak, color=GREY, linewidth=0.9, linestyle="--")
        axes[0][1].annotate(
            f"peak, closed form: {peak:.4f} s", (peak, 5.0), xytext=(-4, 0), textcoords="offset points", ha="right"
        )
        axes[0][0].legend(loc="center right")


def plot_two_parameters(bench: Bench, runs: Sequence[Excited], path: Path) -> None:
    """Section 6.1: one column for each excitation."""
    title = "Section 6.1: f_v and k_1 under excitations that keep the limits and return (Euler, weighted)"
    units = ("u [A]", "x₁ [rad]", "a, c [rad]", "b, d [rad/s]", "ΔM per sample")
    with _drawn(path, len(units), len(runs), title, sharey="row") as axes:
        for unit, row in zip(units, axes, strict=True):
            row[0].set_ylabel(unit)
        for column, run in zip(axes.T, runs, strict=True):
            times = _times(bench, len(run.increments))
            column[0].set_title(run.name)
            column[0].step(times - times[0], run.response.currents, where="post", color=GREY, linewidth=0.8)
            column[1].plot(times, run.response.states[1:, 0], color=GREY)
            for i, (name, angle, velocity) in enumerate((("f_v", "a", "b"), ("k_1", "c", "d"))):
                column[2].plot(times, run.s[:, i, 0], color=COLOURS[i], label=f"{angle}: {name}")
                column[3].plot(times, run.s[:, i, 1], color=COLOURS[i], label=f"{velocity}: {name}")
                _log_plot(column[4], times, run.increments[:, i, i], COLOURS[i], f"of {name}")
            _log_plot(column[4], times, np.abs(run.increments[:, 0, 1]), COLOURS[2], "of both, absolute")
        for row, place in zip(axes[2:], ("lower left", "upper left", "upper right"), strict=True):
            row[1].legend(loc=place)
        axes[4][0].set_ylim(bottom=LEAST_INCREMENT)


def _excitation_panels(axes: Any, bench: Bench, f: Unprotected) -> None:
    times = bench.timing.sample_time * np.arange(len(f.states))
    panels = (
        (axes[0][0], "(a) current", "u [A]", np.full(len(times), f.amplitude)),
        (axes[0][1], "(b) angle", "x₁ [rad]", f.states[:, 0]),
        (axes[1][0], "(c) velocity", "x₂ [rad/s]", f.states[:, 1]),
    )
    for axis, title, label, values in panels:
        axis.set_title(title)
        axis.set_ylabel(label)
        axis.plot(times, values, color=COLOURS[0])
    axes[0][0].set_ylim(0.0, 1.5 * f.amplitude)


def _log_plot(axis: Any, times: Floats, values: Floats, colour: str, label: str) -> None:
    positive = np.where(values > 0.0, values, np.nan)
    axis.semilogy(times, positive, color=colour, label=label)


@contextmanager
def _drawn(path: Path, rows: int, columns: int, title: str, sharey: Any = False) -> Iterator[Any]:
    """Axes over time, shape [rows, columns]; written to ``path`` at the end.

    Raises:
        UsageError: matplotlib is missing, or the file cannot be written.
    """
    size = (max(8.0, 2.9 * columns), 2.1 * rows + 0.6)
    with drawn(path, rows, columns, title, size, sharey=sharey) as axes:
        yield axes
        for axis in axes[-1]:
            axis.set_xlabel(TIME)


def _times(bench: Bench, count: int) -> Floats:
    """Times of the samples after each period [s]."""
    return bench.timing.sample_time * np.arange(1.0, count + 1.0)


def _log(determinants: Floats) -> Floats:
    """NaN where there is none, as the naive computation has it."""
    return np.log(determinants, out=np.full_like(determinants, np.nan), where=determinants > 0.0)


def _finite(logs: Floats) -> Floats:
    return np.where(np.isfinite(logs), logs, np.nan)


def _around(flags: Any) -> slice:
    """Span of the flags that are set, and as much again on either side; everything if none is."""
    where = np.flatnonzero(flags)
    if not len(where):
        return slice(0, len(flags))
    width = max(int(where[-1] - where[0]), 10)
    return slice(max(int(where[0]) - width, 0), int(where[-1]) + width)
