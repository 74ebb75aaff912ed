"""The figures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.figures import COLOURS, GREY, drawn
from emb_runtime.config.bench import Limits
from studies.thesis.training.trainings import Training
from studies.thesis.training.trajectories import Floats, Trajectories

MILLISECONDS = "time [ms]"
MILLION = "million environment steps"
RISKY = 75.0  # Threshold of the risky state [rad] (eq. 5.14).
DECADES = 100.0  # Largest step reward, as a multiple of the usual one, from which on they need a logarithmic axis
DPI = 110  # Few enough for files that a repository can keep
WINDOW = 0.05  # Share of a training that its curve is averaged over


@dataclass(frozen=True)
class Picture:
    """Destination of a figure."""

    path: Path  # The PNG
    note: str = ""  # Text under the title: the reason that the figure does not count; empty if it does


@dataclass(frozen=True)
class Plan:
    """Ways home, as they were planned and as they were, over T instants of N experiments."""

    times: Floats  # [s], shape [T]
    planned: Floats  # Angle [rad] and velocity [rad/s], shape [T, N, 2]
    taken: Floats  # Angle and velocity as they were, NaN after an experiment has left the limits, shape [T, N, 2]


def plot_trajectories(
    picture: Picture, title: str, runs: Mapping[str, Trajectories], limits: Limits, reward: str
) -> None:
    """Current, angle, velocity and step reward over time, a colour for each experiment.

    Args:
        picture: where to.
        title: above it.
        runs: by what the legend calls those with one experiment; several are called by their brakes.
        limits: drawn as lines.
        reward: label of the last panel, which shows ``runs.reward``.
    """
    with _drawn(picture, title, 2, 2, (8.0, 5.0), sharex=True) as axes:
        (current, angle), (velocity, step) = axes
        colours = iter(COLOURS * 10)
        for name, run in runs.items():
            for i, brake in enumerate(run.brakes):
                colour = next(colours)
                label = name if len(run.brakes) == 1 else brake
                current.plot(run.current[:, i], color=colour, linewidth=0.8)
                angle.plot(run.x[:, i, 0], color=colour, label=label)
                velocity.plot(run.x[:, i, 1], color=colour)
                step.plot(run.reward[:, i], color=colour, linewidth=0.8, marker=".", markevery=[-1])
        for axis, label, lines in (
            (current, "current [A]", (-limits.current, limits.current)),
            (angle, "angle [rad]", limits.angle),
            (velocity, "velocity [rad/s]", (-limits.velocity, limits.velocity)),
        ):
            axis.set_ylabel(label)
            for line in lines:
                axis.axhline(line, color=GREY, linewidth=0.8, linestyle="--", label="limit" if line > 0.0 else None)
        angle.axhline(RISKY, color=GREY, linewidth=0.8, linestyle=":", label="risky state (eq. 5.14)")
        step.set_ylabel(reward)
        step.axhline(0.0, color=GREY, linewidth=0.8)
        sizes = np.abs(np.concatenate([run.reward.ravel() for run in runs.values()]))
        usual, largest = np.nanquantile(sizes, (0.5, 1.0))
        if largest > DECADES * usual > 0.0:
            step.set_yscale("symlog", linthresh=10.0 ** np.ceil(np.log10(usual)))
        for axis in (velocity, step):
            axis.set_xlabel(MILLISECONDS)
        _legend_below(angle, 4)


def plot_curves(picture: Picture, title: str, trainings: Sequence[Training], printed: str) -> None:
    """Return over steps: each training, and with several of them their mean and its standard error."""
    with _drawn(picture, title, 1, 1, (7.0, 3.8)) as axes:
        axis = axes[0][0]
        steps = trainings[0].steps / 1e6
        curves = np.array([smoothed(t.curve) for t in trainings])
        for number, (training, curve) in enumerate(zip(trainings, curves, strict=True)):
            if len(trainings) == 1:
                axis.plot(steps, training.curve, color=COLOURS[4], linewidth=0.6, label="each iteration")
                axis.plot(steps, curve, color=COLOURS[0], linewidth=1.4, label="moving average")
            else:
                label = f"each of {len(trainings)} seeds, moving average" if number == 0 else None
                axis.plot(steps, curve, color=COLOURS[0], linewidth=0.7, label=label)
        if len(trainings) > 1:
            mean, error = curves.mean(0), curves.std(0, ddof=1) / np.sqrt(len(curves))
            axis.plot(steps, mean, color=COLOURS[1], linewidth=1.8, label="mean")
            axis.fill_between(steps, mean - error, mean + error, color=COLOURS[1], alpha=0.25, label="standard error")
        axis.set_xlabel(MILLION)
        axis.set_ylabel("return of an experiment")
        axis.set_title(printed, color=GREY)
        _legend_below(axis, 3)


def plot_returns(picture: Picture, title: str, values: Floats, returns: Mapping[str, Floats], mark: float) -> None:
    """Returns over the grid of f_v.

    Args:
        picture: where to.
        title: above it.
        values: of f_v, shape [G].
        returns: by agent, each of shape [G].
        mark: the nominal value.
    """
    with _drawn(picture, title, 1, 1, (7.0, 3.8)) as axes:
        axis = axes[0][0]
        for (name, each), colour in zip(returns.items(), COLOURS, strict=False):
            axis.plot(values, each, marker="o", markersize=3.0, color=colour, label=f"{name} initialisation")
        axis.axvline(mark, color=GREY, linestyle="--", linewidth=0.8, label="nominal value")
        axis.set_xlabel("f_v [N m s/rad]")
        axis.set_ylabel("return of an experiment")
        _legend_below(axis, 3)


def plot_plan(picture: Picture, title: str, plan: Plan, limits: Limits) -> None:
    """Quintic ways home, a colour for each experiment: dashed as they were planned, solid as they were."""
    with _drawn(picture, title, 1, 2, (8.0, 3.6)) as axes:
        angle, velocity = axes[0]
        for i, colour in zip(range(plan.planned.shape[1]), COLOURS * 10, strict=False):
            for number, axis in enumerate((angle, velocity)):
                first = i == 0 and axis is angle
                for values, style, label in ((plan.planned, "--", "planned"), (plan.taken, "-", "taken")):
                    axis.plot(
                        1e3 * plan.times,
                        values[:, i, number],
                        style,
                        color=colour,
                        linewidth=1.0,
                        label=label if first else None,
                    )
        angle.set_ylabel("angle [rad]")
        velocity.set_ylabel("velocity [rad/s]")
        velocity.axhline(-limits.velocity, color=GREY, linestyle=":", linewidth=1.0)
        angle.axhline(limits.angle[0], color=GREY, linestyle=":", linewidth=1.0, label="limit")
        for axis in (angle, velocity):
            axis.set_xlabel(MILLISECONDS)
        _legend_below(angle, 3)


def plot_bars(
    picture: Picture, title: str, columns: Sequence[str], rows: Sequence[str], printed: Floats, ours: Floats
) -> None:
    """A table as bars: printed values, and ours with a point for each seed.

    Args:
        picture: where to.
        title: above it.
        columns: a panel for each, C of them.
        rows: R of them.
        printed: shape [C, R].
        ours: shape [C, R, seeds].
    """
    with _drawn(picture, title, 1, len(columns), (9.0, 3.4)) as axes:
        for axis, name, theirs, mine in zip(axes[0], columns, printed, ours, strict=True):
            axis.set_axisbelow(True)
            at, mean = np.arange(len(theirs)), mine.mean(axis=1)
            axis.bar(at - 0.2, theirs, 0.38, color=GREY, label="printed in the thesis")
            axis.bar(at + 0.2, mean, 0.38, color=COLOURS[0], label="here, mean" if mine.shape[1] > 1 else "here")
            if mine.shape[1] > 1:
                for seed in range(mine.shape[1]):
                    label = "each seed" if seed == 0 else None
                    axis.plot(at + 0.2, mine[:, seed], "o", color=COLOURS[1], markersize=3.0, label=label)
            axis.axhline(0.0, color=GREY, linewidth=0.8)
            axis.set_xticks(at, rows)
            axis.set_ylabel(name)
        _legend_below(axes[0][0], 3)


def smoothed(curve: Floats) -> Floats:
    """Mean over a window around each point, shorter at the ends."""
    half = int(0.5 * WINDOW * len(curve))
    return np.array([curve[max(0, i - half) : i + half + 1].mean() for i in range(len(curve))])


@contextmanager
def _drawn(
    picture: Picture, title: str, rows: int, columns: int, size: tuple[float, float], **shared: Any
) -> Iterator[Any]:
    """Axes of a figure with this title, and with a note under it."""
    said = f"{title}\n{picture.note}" if picture.note else title
    with drawn(picture.path, rows, columns, said, size, dpi=DPI, **shared) as axes:
        yield axes


def _legend_below(axis: Any, columns: int) -> None:
    """Draws the legend of an axis under the whole figure, where it hides nothing."""
    handles, labels = axis.get_legend_handles_labels()
    axis.figure.legend(handles, labels, loc="outside lower center", ncols=columns)
