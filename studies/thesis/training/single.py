"""Chapter 5: one parameter. Each function makes one figure or table and checks the statements about it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from emb_train.envs.play import Draw, fresh_draws, grid_draws
from emb_train.rewards import TrajectoryReturn, quintic
from studies.thesis.training import plots
from studies.thesis.training.plots import Picture
from studies.thesis.training.result import Result, Statement, number, spread
from studies.thesis.training.trainings import Training, Trainings
from studies.thesis.training.trajectories import Floats, Trajectories, asked, run

FIVE = 5  # Random experiments in a figure of the thesis
EVALUATION_SEED = 2024  # Seed of the draws that agents are shown and compared on
EARLY = 0.3  # Share of a training in which the thesis's curves rise rapidly: 3e5 of 1e6 steps
ALONG = 5.0  # Angle from the plan that counts as along it [rad], root mean square over the way
DROP = 0.02  # Share of the smoothed return that counts as a drop: half an experiment (300 steps) of an iteration (8192)
FULL = 450.0  # Velocity that counts as close to the limit of 500 rad/s
HOME = (2.0, 20.0)  # Angle [rad] and velocity [rad/s] that count as being back, as in the trajectory reward


def five(training: Training) -> Trajectories:
    """The agent in five experiments with parameters that were drawn anew."""
    ranges = training.bench.range_set(training.config.ranges)
    draws = fresh_draws(ranges, EVALUATION_SEED, FIVE)
    return run(training.config, training.bench, asked(training.actor), draws)


def on_grid(training: Training) -> Trajectories:
    """The agent on the 40 values of f_v (5.2.3)."""
    draws = grid_draws(training.bench.range_set("viscous"), "f_v", EVALUATION_SEED)
    return run(training.config, training.bench, asked(training.actor), draws)


def rises_early(curves: list[Floats]) -> Statement:
    """Checks that a training's return rises rapidly at first and slowly later."""
    curve = np.mean([plots.smoothed(c) for c in curves], axis=0)
    at = max(1, round(EARLY * len(curve))) - 1
    gained, early = float(curve[-1] - curve[0]), float(curve[at] - curve[0])
    share = early / gained if gained != 0.0 else 0.0
    return Statement(
        "the return rises rapidly in the first part of the training (3e5 of 1e6 steps) and slowly after that",
        f"{100 * share:z.0f} % of the gain comes in the first {100 * EARLY:.0f} % of the steps; the return goes from "
        f"{curve[0]:.3g} to {curve[-1]:.3g}",
        bool(gained > 0.0 and share > 0.5),
        {"share_early": share, "first": float(curve[0]), "last": float(curve[-1])},
    )


def drops_at_limits(curve: Floats, violations: Floats) -> Statement:
    """Checks that the later drops of a training's return come from experiments that left the limits.

    Args:
        curve: return of each iteration, shape [I].
        violations: experiments that left the limits in each, shape [I].
    """
    later = np.arange(len(curve)) >= round(EARLY * len(curve))
    dropped = later & (curve < (1.0 - DROP) * plots.smoothed(curve))
    drops, at_limits = int(dropped.sum()), int((dropped & (violations > 0)).sum())
    return Statement(
        "after that the return drops now and then, and it is because an experiment leaves the limits",
        f"in {drops} of the {int(later.sum())} later iterations the return is more than {100 * DROP:.0f} % below its "
        f"smoothed course; in {at_limits} of these an experiment left the limits",
        at_limits > 0.5 * drops,
        {"drops": drops, "with_violations": at_limits, "iterations": int(later.sum())},
    )


def keeps_limits(run_: Trajectories, printed: str) -> Statement:
    """Checks that no experiment left the limits."""
    left = int(run_.violated.sum())
    return Statement(printed, f"{left} of {len(run_.violated)} left the limits", left == 0, {"violations": left})


def comes_home(run_: Trajectories, printed: str) -> Statement:
    """Checks that every experiment ended at rest at the origin."""
    end = np.abs(run_.x[-1])
    home = (end[:, 0] <= HOME[0]) & (end[:, 1] <= HOME[1]) & ~run_.violated
    ends = ", ".join(
        "left the limits" if gone else f"{x:z.1f} rad at {v:z.0f} rad/s"
        for (x, v), gone in zip(run_.x[-1], run_.violated, strict=True)
    )
    found = f"{int(home.sum())} of {len(home)} within {HOME[0]:g} rad and {HOME[1]:g} rad/s at the end ({ends})"
    return Statement(printed, found, bool(home.all()), {"home": float(home.sum())})


def among(how: Callable[[Floats], np.floating], values: Floats) -> float:
    """``how`` (a mean, a maximum) of what belongs to experiments inside the limits; NaN if nothing does."""
    inside = values[~np.isnan(values)]
    return float(how(inside)) if inside.size else math.nan


def correlation(a: Floats, b: Floats) -> float:
    """Correlation of two series; 0 if one of them never changes."""
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0.0 and np.ptp(b) > 0.0 else 0.0


def mean_speed(run_: Trajectories, first: int, last: int) -> float:
    """Mean velocity from one step to another [rad/s]."""
    return among(np.mean, run_.x[first:last, :, 1])


def last_speed(run_: Trajectories) -> float:
    """Mean |velocity| of the last 80 ms [rad/s]."""
    return among(np.mean, np.abs(run_.x[-80:, :, 1]))


def fig_5_2(trainings: Trainings, picture: Picture) -> Result:
    """Training curve with fixed parameter initialisation."""
    title = "Fig. 5.2: return during training, fixed parameter initialisation"
    training = trainings.first("thesis-fixed")
    plots.plot_curves(picture, title, [training], "thesis: rapid rise to 3e5 steps, then slow, with sudden drops")
    statements = [rises_early([training.curve]), drops_at_limits(training.curve, training.violations)]
    return Result("fig-5.2", title, statements)


def fig_5_3(trainings: Trainings, picture: Picture) -> Result:
    """The agent with fixed parameter initialisation, on the nominal brake."""
    title = "Fig. 5.3: the agent with fixed parameter initialisation"
    training = trainings.first("thesis-fixed")
    bench = training.bench
    only = run(training.config, bench, asked(training.actor), [Draw(EVALUATION_SEED, bench.brake)])
    plots.plot_trajectories(picture, title, {"agent": only}, bench.limits, "step reward, eq. 5.14")
    start, speed, later = among(np.mean, only.current[:10]), mean_speed(only, 20, 150), last_speed(only)
    risky = np.flatnonzero(only.x[:, 0, 0] > plots.RISKY)
    when = float(risky[0]) if len(risky) else math.nan
    statements = [
        Statement(
            "it begins with the largest current",
            f"{start:.2f} A in the mean of the first 10 ms",
            start > 0.9 * bench.limits.current,
            {"current": start},
        ),
        Statement(
            "from 20 to 150 ms the velocity stays just below 500 rad/s",
            f"{speed:.0f} rad/s in the mean",
            speed > FULL,
            {"velocity": speed},
        ),
        Statement(
            "around 180 ms the angle passes the risky threshold of 75 rad",
            f"at {when:.0f} ms" if len(risky) else "it never does",
            150.0 <= when <= 210.0,
            {"milliseconds": when},
        ),
        Statement(
            "then the velocity stays around zero until the end",
            f"|velocity| {later:.0f} rad/s in the mean of the last 80 ms",
            later < 50.0,
            {"speed": later},
        ),
    ]
    return Result("fig-5.3", title, statements)


def fig_5_4(trainings: Trainings, picture: Picture) -> Result:
    """The agent with random parameter initialisation, five experiments."""
    title = "Fig. 5.4: the agent with random parameter initialisation, 5 experiments"
    training = trainings.first("thesis-random")
    runs = five(training)
    plots.plot_trajectories(picture, title, {"agent": runs}, training.bench.limits, "step reward, eq. 5.14")
    speed, later = mean_speed(runs, 20, 150), last_speed(runs)
    statements = [
        Statement(
            "for the first 180 ms it holds the critical velocity, whatever the friction is",
            f"{speed:.0f} rad/s in the mean from 20 to 150 ms",
            speed > FULL,
            {"velocity": speed},
        ),
        Statement(
            "then it slows down",
            f"|velocity| {later:.0f} rad/s in the mean of the last 80 ms",
            later < min(100.0, 0.5 * speed),  # one that was never fast does not slow down
            {"speed": later},
        ),
        keeps_limits(runs, "it keeps the limits"),
    ]
    return Result("fig-5.4", title, statements)


def fig_5_5(trainings: Trainings, picture: Picture) -> Result:
    """Both initialisations on the grid of f_v."""
    title = "Fig. 5.5: return over the range of f_v"
    fixed, drawn = trainings.first("thesis-fixed"), trainings.first("thesis-random")
    runs = {"fixed": on_grid(fixed), "random": on_grid(drawn)}
    nominal = fixed.bench.brake.f_v
    values = np.array([d.brake.f_v for d in grid_draws(fixed.bench.range_set("viscous"), "f_v", EVALUATION_SEED)])
    returns = {name: each.returns for name, each in runs.items()}
    plots.plot_returns(picture, title, values, returns, nominal)
    grows = {name: correlation(values, each) for name, each in returns.items()}
    far = np.abs(values - nominal) > 0.25 * nominal
    better = float((returns["random"] > returns["fixed"])[far].mean())
    low = values < nominal
    negative = int((returns["fixed"][low] < 0.0).sum())
    statements = [
        Statement(
            "for both agents the return grows with f_v",
            f"correlation {grows['fixed']:z.2f} (fixed) and {grows['random']:z.2f} (random)",
            min(grows.values()) > 0.5,
            grows,
        ),
        Statement(
            "away from the nominal value the agent with random initialisation is better",
            f"at {100 * better:.0f} % of the values that are more than 25 % away",
            better > 0.5,
            {"share": better},
        ),
        Statement(
            "at low f_v the agent with fixed initialisation has negative returns: it leaves the limits",
            f"{negative} of {int(low.sum())} values below the nominal one",
            negative > 0,
            {"negative": negative},
        ),
        keeps_limits(runs["random"], "the agent with random initialisation keeps the limits"),
    ]
    return Result("fig-5.5", title, statements)


def fig_5_6(trainings: Trainings, picture: Picture) -> Result:
    """The adaptive reward, five experiments."""
    title = "Fig. 5.6: the agent with the adaptive reward (eq. 5.15), 5 experiments"
    training = trainings.first("thesis-adaptive")
    runs = five(training)
    plots.plot_trajectories(picture, title, {"agent": runs}, training.bench.limits, "step reward, eq. 5.15")
    end, apart = among(np.mean, runs.x[-1, :, 0]), among(np.std, runs.x[200, :, 0])
    final = among(np.mean, np.abs(runs.x[-1, :, 1]))
    statements = [
        number(400.0, [mean_speed(runs, 50, 200)], "velocity up to 200 ms (here: from 50 ms on), about [rad/s]"),
        Statement(
            "it does not return: the final angle is about 35 rad",
            f"{end:z.1f} rad in the mean, at {final:.0f} rad/s",
            15.0 < end < 55.0,
            {"angle": end},
        ),
        Statement(
            "the courses are similar whatever the friction is",
            f"at 200 ms the angles differ by {apart:.1f} rad (standard deviation)",
            apart < 10.0,
            {"deviation": apart},
        ),
        keeps_limits(runs, "it keeps the limits"),
    ]
    return Result("fig-5.6", title, statements)


def fig_5_7(trainings: Trainings, picture: Picture) -> Result:
    """Quintic ways home from where agent B is after 300 ms, and the ways that it takes."""
    title = "Fig. 5.7: the quintic way home (eq. 5.16), and the way that agent B takes"
    training = trainings.first("thesis-trajectory-b")
    plan, limits = planned(training), training.bench.limits
    plots.plot_plan(picture, title, plan, limits)
    there, smooth = plan.planned.shape[1], "the quintic is a smooth way home that the motor can take: inside the limits"
    if there == 0:
        return Result("fig-5.7", title, [Statement(smooth, f"none of {FIVE} got to 300 ms", False, {"planned": 0})])
    angle, velocity = plan.planned[:, :, 0], plan.planned[:, :, 1]
    low, high, fastest = float(angle.min()), float(angle.max()), float(np.abs(velocity).max())
    apart = np.sqrt(np.nanmean((plan.taken[:, :, 0] - angle) ** 2, axis=0))
    left = int(np.isnan(plan.taken).any(axis=(0, 2)).sum())
    starts = ", ".join(f"{x:z.1f} rad at {v:z.0f} rad/s" for x, v in plan.planned[0])
    statements = [
        Statement(
            smooth,
            f"{there} of {FIVE} got to 300 ms and were there at {starts}; their ways stay between {low:z.1f} and "
            f"{high:z.1f} rad, and the fastest has {fastest:.0f} of {limits.velocity:g} rad/s",
            fastest <= limits.velocity and limits.angle[0] <= low and high <= limits.angle[1],
            {"planned": there, "fastest": fastest, "low": low, "high": high},
        ),
        Statement(
            "from 300 ms on the agent guides the motor along it, whatever the friction is",
            f"{', '.join(f'{each:.1f}' for each in apart)} rad away from it (root mean square); {left} of {there} "
            "left the limits before the end",
            there == FIVE and left == 0 and float(apart.max()) <= ALONG,
            {"farthest": float(apart.max()), "left": left},
        ),
    ]
    return Result("fig-5.7", title, statements)


def planned(training: Training) -> plots.Plan:
    """The quintic ways home of an agent with the trajectory reward in those of five experiments that get so far."""
    reward, bench, runs = training.config.reward, training.bench, five(training)
    assert isinstance(reward, TrajectoryReturn)
    ts, at = bench.timing.sample_time, reward.outward
    there = ~np.isnan(runs.x[at + 1, :, 0])
    start, before = runs.x[at, there], runs.x[at - 1, there]
    times: Floats = ts * np.arange(bench.timing.horizon - at + 1, dtype=np.float64)
    ways = quintic(start[:, 0], start[:, 1], (start[:, 1] - before[:, 1]) / ts, float(times[-1]), times[:, None])
    return plots.Plan(times + at * ts, np.stack(ways, axis=-1), runs.x[at:, there])


def fig_5_8(trainings: Trainings, picture: Picture) -> Result:
    """The trajectory reward, five experiments of agent B."""
    title = "Fig. 5.8: the agent with the trajectory reward, 5 experiments"
    training = trainings.first("thesis-trajectory-b")
    runs = five(training)
    plots.plot_trajectories(picture, title, {"agent": runs}, training.bench.limits, "step reward, 5.3.2")
    last, others = among(np.max, runs.reward[-1]), among(np.max, runs.reward[:-1])
    statements = [
        comes_home(runs, "it returns to rest at the origin, whatever the friction is"),
        Statement(
            "the reward of the last step is much higher than any other",
            f"at most {last:.3g} against {others:.3g}",
            last > 5.0 * abs(others),
            {"last": last, "others": others},
        ),
    ]
    return Result("fig-5.8", title, statements)


PHASES = ("phase 1", "phase 2", "end step")
TABLE_5_1 = {"thesis-trajectory-a": (1.13e7, -1.41e4, 8.05e6), "thesis-trajectory-b": (1.16e7, -4.62e4, 8.66e6)}


def phases(training: Training) -> Floats:
    """Mean rewards over the grid of f_v: exploration, way home, last step; shape [3]."""
    reward = training.config.reward
    assert isinstance(reward, TrajectoryReturn)
    each = on_grid(training).reward
    sums = [np.nansum(part, axis=0) for part in (each[: reward.outward], each[reward.outward : -1], each[-1:])]
    return np.array([part.mean() for part in sums])


def table_5_1(trainings: Trainings, picture: Picture) -> Result:
    """Accumulated mean rewards of agents A and B."""
    title = "Table 5.1: accumulated mean rewards on the 40 values of f_v"
    ours = {name: np.array([phases(t) for t in trainings.all(name)]) for name in TABLE_5_1}
    a, b = (ours[name] for name in TABLE_5_1)
    printed = np.array(list(TABLE_5_1.values()))
    plots.plot_bars(picture, title, PHASES, ("agent A", "agent B"), printed.T, np.array([a, b]).transpose(2, 0, 1))
    statements = [
        number(value, ours[name][:, i].tolist(), f"agent {name[-1].upper()}, {PHASES[i]}:")
        for name, values in TABLE_5_1.items()
        for i, value in enumerate(values)
    ]
    more, costs = float((b - a)[:, 2].mean()), float((b - a)[:, 1].mean())
    statements.append(
        Statement(
            "agent B gives up some of the tracking (phase 2) for more information (end step)",
            f"from A to B the end step changes by {more:.3g} and phase 2 by {costs:.3g}",
            more > 0.0 > costs,
            {"end_step": more, "phase_2": costs},
        )
    )
    rows = [
        (
            f"agent {name[-1].upper()}",
            *(f"{v:.3g}" for v in values),
            *(spread(ours[name][:, i].tolist()) for i in range(3)),
        )
        for name, values in TABLE_5_1.items()
    ]
    columns = ("agent", *(f"{p}, thesis" for p in PHASES), *(f"{p}, here" for p in PHASES))
    return Result("table-5.1", title, statements, columns, rows)


def fig_5_9(trainings: Trainings, picture: Picture) -> Result:
    """Training curves of the trajectory reward over seeds."""
    made = trainings.all("thesis-trajectory-b")
    seeds = f"{len(made)} seeds" if len(made) > 1 else "1 seed"
    title = f"Fig. 5.9: return during training with the trajectory reward, {seeds}"
    plots.plot_curves(picture, title, made, "thesis: rapid rise early, slow later, small standard error")
    ends = np.array([plots.smoothed(t.curve)[-1] for t in made])
    error = float(ends.std(ddof=1) / np.sqrt(len(ends))) if len(ends) > 1 else float("nan")
    share = error / abs(float(ends.mean()))
    statements = [rises_early([t.curve for t in made])]
    if len(made) > 1:
        statements.append(
            Statement(
                "the standard error between seeds is small",
                f"{error:.2g} at the end, {100 * share:.0f} % of the mean {ends.mean():.3g}",
                share < 0.1,
                {"standard_error": error, "mean": float(ends.mean())},
            )
        )
    return Result("fig-5.9", title, statements)
