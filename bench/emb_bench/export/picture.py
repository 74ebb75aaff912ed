"""A picture of a run: motion, currents, why currents were changed, states and safety events."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.figures import COLOURS, GREY, drawn
from emb_bench.logs.log import RunLog
from emb_runtime.errors import LogError, UsageError
from emb_runtime.records import NodeState, Reason, RunState

ROWS = 5  # Axes of a picture, one above the other
CURRENTS = (  # field, label, colour, width, period after or before the sample; what is drawn last lies on top
    ("policy_current", "requested", COLOURS[4], 3.5, "post"),
    ("clipped_current", "clipped", COLOURS[5], 1.5, "post"),
    ("sent_current", "sent", COLOURS[0], 1.0, "post"),
    ("applied_current", "applied", COLOURS[1], 0.7, "pre"),
)


def draw_run(log: RunLog, path: Path) -> str:
    """Draw angle, velocity, currents, reasons and states over the time since the log began; describes the content."""
    _require_cycles(log)
    title = f"{log.path.name}: {log.exit_reason}" + ("" if log.complete else " (the log is NOT complete)")
    with drawn(path, ROWS, 1, title, (8.0, 9.5), sharex=True) as grid:
        draw_on(log, grid[:, 0])
    count = len(log.cycles["publish_time"])
    return f"a picture of {count} {'cycle' if count == 1 else 'cycles'}"


def draw_on(log: RunLog, axes: Sequence[Any]) -> None:
    """Draw a run on ``ROWS`` axes of matplotlib: angle, velocity, currents, reasons, states."""
    _require_cycles(log)
    cycles = log.cycles
    if len(axes) != ROWS:
        raise UsageError(f"a run is drawn on {ROWS} axes, got {len(axes)}")
    zero, _ = log.span
    time = (cycles["publish_time"] - zero) / 1e9
    angle, velocity, current, reasons, states = axes
    for axis, name, unit in ((angle, "angle", "rad"), (velocity, "velocity", "rad/s")):
        lines = broken(time, cycles["missed"]), broken(cycles[name], cycles["missed"])
        axis.plot(*lines, ".-", color=COLOURS[0], linewidth=1.0, markersize=1.5)
        axis.set_ylabel(f"{name} [{unit}]")
    for name, label, colour, width, where in CURRENTS:
        current.step(time, cycles[name], where=where, label=label, color=colour, linewidth=width)
    current.set_ylabel("current [A]")
    current.legend(loc="lower right", bbox_to_anchor=(1.0, 0.96), ncols=4)  # above the axes, where no curve is
    _reasons(reasons, time, cycles["reasons"])
    _states(states, time, cycles)
    for event in log.events:
        for axis in axes:
            axis.axvline((event.time_ns - zero) / 1e9, color=GREY, linewidth=0.6, linestyle=":")
    states.set_xlabel("time since the log began [s]; dotted: safety events")


def _require_cycles(log: RunLog) -> None:
    if not len(log.cycles["publish_time"]):
        raise LogError(f"{log.path}: not one control cycle is in this log")


def broken(values: NDArray[np.float64], missed: NDArray[Any]) -> NDArray[np.float64]:
    """The values with NaN where periods were missed, so that no line is drawn through what was not measured."""
    return np.insert(values, np.flatnonzero(missed), np.nan)


def _reasons(axes: Any, time: Any, values: Any) -> None:
    """A mark in each cycle in which the current was changed, one row per reason."""
    names = [reason for reason in Reason if reason]
    for row, reason in enumerate(names):
        where = (values & int(reason)) != 0
        axes.plot(time[where], np.full(int(where.sum()), row), "|", color=COLOURS[row], markersize=7.0)
    axes.set_yticks(range(len(names)), [str(reason.name).lower() for reason in names])
    axes.set_ylim(-0.6, len(names) - 0.4)
    axes.invert_yaxis()
    axes.set_ylabel("current changed")


def _states(axes: Any, time: Any, cycles: Any) -> None:
    """The run's state, and the node's above it."""
    names = [f"run {state.name.lower()}" for state in RunState] + [f"node {state.name.lower()}" for state in NodeState]
    axes.step(time, cycles["state"], where="post", color=COLOURS[0])
    axes.step(time, cycles["node_state"] + len(RunState), where="post", color=COLOURS[1])
    axes.set_yticks(range(len(names)), names, fontsize=7.0)
    axes.set_ylabel("state")
