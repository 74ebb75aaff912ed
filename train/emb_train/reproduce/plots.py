"""The figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from emb_bench.figures import COLOURS, GREY, drawn
from emb_runtime.bench import Limits
from emb_train.reproduce.courses import Courses, Floats
from emb_train.reproduce.trainings import Training

MILLISECONDS = "time [ms]"
MILLION = "million environment steps"
RISKY = 75.0
"""Threshold of the risky state [rad] (eq. 5.14)."""
DECADES = 100.0
"""Largest step reward, as a multiple of the usual one, from which on they need a logarithmic axis."""
WINDOW = 0.05
"""Share of a training that its curve is averaged over."""


def plot_courses(
    path: Path, title: str, courses: Mapping[str, Courses], limits: Limits, reward: str = "step reward"
) -> None:
    """Current, angle, velocity and step reward over time, a colour for each experiment.

    Args:
        path: the file.
        title: above it.
        courses: by what the legend calls those with one experiment.
        limits: drawn as lines.
        reward: label of the last panel, which shows ``courses.reward``.
    """
    with drawn(path, 2, 2, title, (9.0, 5.4), sharex=True) as axes:
        (current, angle), (velocity, step) = axes
        colours = iter(COLOURS * 10)
        for name, run in courses.items():
            for i in range(run.x.shape[1]):
                colour = next(colours)
                label = name if run.x.shape[1] == 1 else f"experiment {i + 1}"
                current.plot(run.current[:, i], color=colour, linewidth=0.8)
                angle.plot(run.x[:, i, 0], color=colour, label=label)
                velocity.plot(run.x[:, i, 1], color=colour)
                step.plot(run.reward[:, i], color=colour, linewidth=0.8)
        for axis, label, lines in (
            (current, "current [A]", (-limits.current, limits.current)),
            (angle, "angle [rad]", (*limits.angle, RISKY)),
            (velocity, "velocity [rad/s]", (-limits.velocity, limits.velocity)),
            (step, reward, (0.0,)),
        ):
            axis.set_ylabel(label)
            for line in lines:
                axis.axhline(line, color=GREY, linewidth=0.8, linestyle="--")
        sizes = np.abs(np.concatenate([run.reward.ravel() for run in courses.values()]))
        usual, largest = np.nanquantile(sizes, (0.5, 1.0))
        if largest > DECADES * usual > 0.0:
            step.set_yscale("symlog", linthresh=usual)
        for axis in (velocity, step):
            axis.set_xlabel(MILLISECONDS)
        angle.legend(loc="upper right", ncols=3, fontsize=6.5)


def plot_curves(path: Path, title: str, trainings: Sequence[Training], printed: str) -> None:
    """Return over steps: each training, and with several of them their mean and its standard error."""
    with drawn(path, 1, 1, title, (7.0, 3.6)) as axes:
        axis = axes[0][0]
        steps = trainings[0].steps / 1e6
        curves = np.array([smoothed(t.curve) for t in trainings])
        for training, curve in zip(trainings, curves, strict=True):
            label = f"seed {training.config.seed}" if len(trainings) > 1 else "average"
            if len(trainings) == 1:
                axis.plot(steps, training.curve, color=COLOURS[4], linewidth=0.6, label="each iteration")
            axis.plot(steps, curve, color=COLOURS[0], linewidth=0.7 if len(trainings) > 1 else 1.4, label=label)
        if len(trainings) > 1:
            mean, error = curves.mean(0), curves.std(0, ddof=1) / np.sqrt(len(curves))
            axis.plot(steps, mean, color=COLOURS[1], linewidth=1.8, label="mean")
            axis.fill_between(steps, mean - error, mean + error, color=COLOURS[1], alpha=0.25, label="standard error")
        axis.set_xlabel(MILLION)
        axis.set_ylabel("return")
        axis.set_title(printed, color=GREY)
        axis.legend(loc="lower right")


def plot_returns(path: Path, title: str, values: Floats, returns: Mapping[str, Floats], mark: float) -> None:
    """Returns over the grid of f_v.

    Args:
        path: the file.
        title: above it.
        values: of f_v, shape [G].
        returns: by agent, each of shape [G].
        mark: the nominal value.
    """
    with drawn(path, 1, 1, title, (7.0, 3.6)) as axes:
        axis = axes[0][0]
        for (name, each), colour in zip(returns.items(), COLOURS, strict=False):
            axis.plot(values, each, marker="o", markersize=3.0, color=colour, label=name)
        axis.axvline(mark, color=GREY, linestyle="--", linewidth=0.8, label="nominal value")
        axis.set_xlabel("f_v [N m s/rad]")
        axis.set_ylabel("return of an experiment")
        axis.legend()


def plot_plan(path: Path, title: str, times: Floats, angle: Floats, velocity: Floats, limit: float) -> None:
    """A quintic way home: angle [rad] and velocity [rad/s] over times [s], and the velocity limit."""
    with drawn(path, 1, 2, title, (8.0, 3.2)) as axes:
        for axis, values, label in zip(axes[0], (angle, velocity), ("angle [rad]", "velocity [rad/s]"), strict=True):
            axis.plot(1e3 * times, values, color=COLOURS[0])
            axis.set_xlabel(MILLISECONDS)
            axis.set_ylabel(label)
        axes[0][1].axhline(-limit, color=GREY, linestyle="--", linewidth=0.8)


def plot_bars(
    path: Path, title: str, columns: Sequence[str], rows: Sequence[str], printed: Floats, ours: Floats
) -> None:
    """A table as bars: printed values, and ours with the range of the seeds.

    Args:
        path: the file.
        title: above it.
        columns: a panel for each, C of them.
        rows: R of them.
        printed: shape [C, R].
        ours: shape [C, R, seeds].
    """
    with drawn(path, 1, len(columns), title, (9.0, 3.2)) as axes:
        for axis, name, theirs, mine in zip(axes[0], columns, printed, ours, strict=True):
            at, mean = np.arange(len(theirs)), mine.mean(axis=1)
            axis.bar(at - 0.2, theirs, 0.38, color=GREY, label="printed")
            axis.bar(at + 0.2, mean, 0.38, color=COLOURS[0], label="here")
            for seed in range(mine.shape[1]):
                axis.plot(at + 0.2, mine[:, seed], "o", color=COLOURS[1], markersize=3.0)
            axis.set_xticks(at, rows)
            axis.set_title(name)
        axes[0][0].legend(fontsize=7.0)


def smoothed(curve: Floats) -> Floats:
    """Mean over a window around each point, shorter at the ends."""
    half = int(0.5 * WINDOW * len(curve))
    return np.array([curve[max(0, i - half) : i + half + 1].mean() for i in range(len(curve))])
