"""Chapters 5 and 6: what the thesis says of its trained agents, checked on trainings made again.

Each function takes the trainings and gives the statements of one figure or table: what is printed, in our words; what
came out here; whether the two agree. The thresholds of the verdicts stand in them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from emb_bench.information.symmetric import LAMBDA_MIN, LOG_DET, each
from emb_train.closed_loop import Batch
from emb_train.play import Draw, fresh_draws
from emb_train.rewards import EPSILON, HOME_ANGLE, HOME_VELOCITY, OUTWARD, RISKY_ANGLE, gain, quintic
from studies.thesis.facts import Fact
from studies.thesis.trainings import Floats, Training, Trainings, Trajectories, grid_draws

Statement = tuple[str, str, bool]  # Printed, found, agrees

FIVE = 5  # Random experiments in a figure of the thesis
EVALUATION_SEED = 2024  # Seed of the draws that agents are shown and compared on
CLOSE = 0.2  # Relative tolerance: a printed number agrees if the mean of our seeds is this close to it
EARLY = 0.3  # Share of a training in which the thesis's curves rise rapidly: 3e5 of 1e6 steps
WINDOW = 0.05  # Share of a training that its curve is averaged over
ALONG = 5.0  # Angle from the plan that counts as along it [rad], root mean square over the way
DROP = 0.02  # Share of the smoothed return that counts as a drop: half an experiment (300 steps) of an iteration (8192)
FULL = 450.0  # Velocity that counts as close to the limit of 500 rad/s
HALF_PERIOD = 10  # Steps of half a period of the square wave (6.2.2: 20 ms)
TESTS = 100  # Random parameters of Table 6.2
PENALTY = 1e6  # Penalty of a violation in Table 6.2
PHASES = ("phase 1", "phase 2", "end step")
TABLE_5_1 = {"thesis-trajectory-a": (1.13e7, -1.41e4, 8.05e6), "thesis-trajectory-b": (1.16e7, -4.62e4, 8.66e6)}
TABLE_6_2 = {"thesis-e-optimal-trajectory": (1.05e7, 1.52e14, 56.0), "thesis-e-optimal-hybrid": (1.53e7, 3.69e13, 0.0)}


def fig_5_2(trainings: Trainings) -> list[Statement]:
    """Training curve with fixed parameter initialisation."""
    training = trainings.first("thesis-fixed")
    return [rises_early([training.curve]), drops_at_limits(training.curve, training.violations)]


def fig_5_3(trainings: Trainings) -> list[Statement]:
    """The agent with fixed parameter initialisation, on the nominal brake."""
    training = trainings.first("thesis-fixed")
    only = training.run([Draw(EVALUATION_SEED, training.bench.brake)])
    start, speed, later = among(np.mean, only.current[:10]), mean_speed(only, 20, 150), last_speed(only)
    risky = np.flatnonzero(only.x[:, 0, 0] > RISKY_ANGLE)
    when = float(risky[0]) if len(risky) else math.nan
    return [
        (
            "it begins with the largest current",
            f"{start:.2f} A in the mean of the first 10 ms",
            start > 0.9 * training.bench.limits.current,
        ),
        (
            "from 20 to 150 ms the velocity stays just below 500 rad/s",
            f"{speed:.0f} rad/s in the mean",
            speed > FULL,
        ),
        (
            "around 180 ms the angle passes the risky threshold of 75 rad",
            f"at {when:.0f} ms" if len(risky) else "it never does",
            150.0 <= when <= 210.0,
        ),
        (
            "then the velocity stays around zero until the end",
            f"|velocity| {later:.0f} rad/s in the mean of the last 80 ms",
            later < 50.0,
        ),
    ]


def fig_5_4(trainings: Trainings) -> list[Statement]:
    """The agent with random parameter initialisation, five experiments."""
    runs = five(trainings.first("thesis-random"))
    speed, later = mean_speed(runs, 20, 150), last_speed(runs)
    return [
        (
            "for the first 180 ms it holds the critical velocity, whatever the friction is",
            f"{speed:.0f} rad/s in the mean from 20 to 150 ms",
            speed > FULL,
        ),
        (
            "then it slows down",
            f"|velocity| {later:.0f} rad/s in the mean of the last 80 ms",
            later < min(100.0, 0.5 * speed),  # one that was never fast does not slow down
        ),
        keeps_limits(runs, "it keeps the limits"),
    ]


def fig_5_5(trainings: Trainings) -> list[Statement]:
    """Both initialisations on the grid of f_v."""
    fixed, drawn = trainings.first("thesis-fixed"), trainings.first("thesis-random")
    runs = {"fixed": on_grid(fixed), "random": on_grid(drawn)}
    nominal = fixed.bench.brake.f_v
    values = np.array([d.brake.f_v for d in grid_draws(fixed.bench.range_set("viscous"), "f_v", EVALUATION_SEED)])
    grows = {name: correlation(values, each_.returns) for name, each_ in runs.items()}
    far, low = np.abs(values - nominal) > 0.25 * nominal, values < nominal
    better = float((runs["random"].returns > runs["fixed"].returns)[far].mean())
    negative = int((runs["fixed"].returns[low] < 0.0).sum())
    return [
        (
            "for both agents the return grows with f_v",
            f"correlation {grows['fixed']:z.2f} (fixed) and {grows['random']:z.2f} (random)",
            min(grows.values()) > 0.5,
        ),
        (
            "away from the nominal value the agent with random initialisation is better",
            f"at {100 * better:.0f} % of the values that are more than 25 % away",
            better > 0.5,
        ),
        (
            "at low f_v the agent with fixed initialisation has negative returns: it leaves the limits",
            f"{negative} of {int(low.sum())} values below the nominal one",
            negative > 0,
        ),
        keeps_limits(runs["random"], "the agent with random initialisation keeps the limits"),
    ]


def fig_5_6(trainings: Trainings) -> list[Statement]:
    """The adaptive reward, five experiments."""
    runs = five(trainings.first("thesis-adaptive"))
    end, apart = among(np.mean, runs.x[-1, :, 0]), among(np.std, runs.x[200, :, 0])
    final = among(np.mean, np.abs(runs.x[-1, :, 1]))
    return [
        number(400.0, [mean_speed(runs, 50, 200)], "velocity up to 200 ms (here: from 50 ms on), about [rad/s]"),
        (
            "it does not return: the final angle is about 35 rad",
            f"{end:z.1f} rad in the mean, at {final:.0f} rad/s",
            15.0 < end < 55.0,
        ),
        (
            "the courses are similar whatever the friction is",
            f"at 200 ms the angles differ by {apart:.1f} rad (standard deviation)",
            apart < 10.0,
        ),
        keeps_limits(runs, "it keeps the limits"),
    ]


def fig_5_7(trainings: Trainings) -> list[Statement]:
    """Quintic ways home from where agent B is after 300 ms, and the ways that it takes."""
    training = trainings.first("thesis-trajectory-b")
    limits, (planned, taken) = training.bench.limits, ways_home(training)
    there, smooth = planned.shape[1], "the quintic is a smooth way home that the motor can take: inside the limits"
    if there == 0:
        return [(smooth, f"none of {FIVE} got to 300 ms", False)]
    angle, velocity = planned[:, :, 0], planned[:, :, 1]
    low, high, fastest = float(angle.min()), float(angle.max()), float(np.abs(velocity).max())
    apart = np.sqrt(np.nanmean((taken[:, :, 0] - angle) ** 2, axis=0))
    left = int(np.isnan(taken).any(axis=(0, 2)).sum())
    starts = ", ".join(f"{x:z.1f} rad at {v:z.0f} rad/s" for x, v in planned[0])
    return [
        (
            smooth,
            f"{there} of {FIVE} got to 300 ms and were there at {starts}; their ways stay between {low:z.1f} and "
            f"{high:z.1f} rad, and the fastest has {fastest:.0f} of {limits.velocity:g} rad/s",
            fastest <= limits.velocity and limits.angle[0] <= low and high <= limits.angle[1],
        ),
        (
            "from 300 ms on the agent guides the motor along it, whatever the friction is",
            f"{', '.join(f'{each_:.1f}' for each_ in apart)} rad away from it (root mean square); {left} of {there} "
            "left the limits before the end",
            there == FIVE and left == 0 and float(apart.max()) <= ALONG,
        ),
    ]


def fig_5_8(trainings: Trainings) -> list[Statement]:
    """The trajectory reward, five experiments of agent B."""
    runs = five(trainings.first("thesis-trajectory-b"))
    last, others = among(np.max, runs.reward[-1]), among(np.max, runs.reward[:-1])
    return [
        comes_home(runs, "it returns to rest at the origin, whatever the friction is"),
        (
            "the reward of the last step is much higher than any other",
            f"at most {last:.3g} against {others:.3g}",
            last > 5.0 * abs(others),
        ),
    ]


def table_5_1(trainings: Trainings) -> list[Statement]:
    """Accumulated mean rewards of agents A and B."""
    ours = {name: np.array([phases(t) for t in trainings.all(name)]) for name in TABLE_5_1}
    more, costs = (float((ours["thesis-trajectory-b"] - ours["thesis-trajectory-a"])[:, i].mean()) for i in (2, 1))
    return [
        *(
            number(value, ours[name][:, i].tolist(), f"agent {name[-1].upper()}, {PHASES[i]}:")
            for name, values in TABLE_5_1.items()
            for i, value in enumerate(values)
        ),
        (
            "agent B gives up some of the tracking (phase 2) for more information (end step)",
            f"from A to B the end step changes by {more:.3g} and phase 2 by {costs:.3g}",
            more > 0.0 > costs,
        ),
    ]


def fig_5_9(trainings: Trainings) -> list[Statement]:
    """Training curves of the trajectory reward over seeds."""
    curves = [training.curve for training in trainings.all("thesis-trajectory-b")]
    ends = np.array([smoothed(curve)[-1] for curve in curves])
    if len(curves) == 1:
        return [rises_early(curves)]
    error = float(ends.std(ddof=1) / np.sqrt(len(ends)))
    share = error / abs(float(ends.mean()))
    return [
        rises_early(curves),
        (
            "the standard error between seeds is small",
            f"{error:.2g} at the end, {100 * share:.0f} % of the mean {ends.mean():.3g}",
            share < 0.1,
        ),
    ]


def sec_6_2_1(trainings: Trainings) -> list[Statement]:
    """The step reward of eq. 4.13 as it is, beside method 1."""
    plain, first = (trainings.first(f"thesis-d-optimal-{name}") for name in ("plain", "1"))
    draws = fresh_draws(plain.bench.range_set(plain.config.ranges), EVALUATION_SEED, TESTS)
    runs = [training.run(draws, reward=lambda t: gain(LOG_DET, t, EPSILON)) for training in (plain, first)]
    (own, other), left = (float(run.returns.mean()) for run in runs), int(runs[0].violated.sum())
    late = plain.violations[len(plain.violations) // 2 :]
    return [
        (
            "with the plain step reward the agent does not learn to excite the brake",
            f"log |M| grows by {own:.2f} in the mean of {TESTS} brakes, with method 1 by {other:.2f}",
            own < other - 1.0,
        ),
        (
            "it leaves the limits frequently",
            f"in {left} of {TESTS} experiments of the best agent, and {late.mean():.1f} times an iteration in the "
            "second half of the training",
            left > 0.1 * TESTS or float(late.mean()) > 1.0,
        ),
    ]


def fig_6_1(trainings: Trainings) -> list[Statement]:
    """D-optimal rewards 1 and 2 beside the square wave, judged by the step reward of eq. 4.13."""
    first, second = (trainings.first(f"thesis-d-optimal-{i}") for i in (1, 2))
    draws = fresh_draws(first.bench.range_set(first.config.ranges), EVALUATION_SEED, 1)
    agents = {"method 1": first.agent, "method 2": second.agent, "square wave": square_wave}
    runs = {name: first.run(draws, wanted, lambda t: gain(LOG_DET, t, EPSILON)) for name, wanted in agents.items()}
    gained = {name: float(run.returns[0]) for name, run in runs.items()}
    turns = {name: int((np.diff(np.sign(run.current[:, 0])) != 0).sum()) for name, run in runs.items()}
    return [
        (
            "both agents' currents vary periodically, like a square wave",
            f"their sign changes {turns['method 1']} and {turns['method 2']} times in 300 ms, the square wave's "
            f"{turns['square wave']} times",
            min(turns["method 1"], turns["method 2"]) >= 10,
        ),
        (
            "method 2 gathers more than method 1",
            f"log |M| grows by {gained['method 1']:.2f} with method 1 and {gained['method 2']:.2f} with method 2",
            gained["method 2"] > gained["method 1"],
        ),
        (
            "the square wave gathers more than both",
            f"log |M| grows by {gained['square wave']:.2f}",
            gained["square wave"] > max(gained["method 1"], gained["method 2"]),
        ),
    ]


def fig_6_2(trainings: Trainings) -> list[Statement]:
    """The E-optimal trajectory reward, five experiments."""
    runs = five(trainings.first("thesis-e-optimal-trajectory"))
    speed, end = mean_speed(runs, 20, 150), np.abs(runs.x[-1, :, 0])
    away = int((~(end <= 5.0)).sum())
    return [
        (
            "it runs at high velocity at the start",
            f"{speed:.0f} rad/s in the mean from 20 to 150 ms",
            speed > 300.0,
        ),
        (
            "it does not reach the origin by the end",
            f"{away} of {len(end)} end more than 5 rad away or leave the limits",
            away > 0,
        ),
    ]


def fig_6_3(trainings: Trainings) -> list[Statement]:
    """The E-optimal hybrid reward, five experiments."""
    runs = five(trainings.first("thesis-e-optimal-hybrid"))
    return [
        comes_home(runs, "whatever the state at 450 ms is, it returns to rest at the origin"),
        keeps_limits(runs, "it keeps the limits"),
    ]


def table_6_2(trainings: Trainings) -> list[Statement]:
    """Both E-optimal agents on 100 random parameters."""
    names = ("mean return", "variance of the return", f"violations in {TESTS} experiments")
    ours = {preset: np.array([tested(t) for t in trainings.all(preset)]) for preset in TABLE_6_2}
    trajectory, hybrid = (ours[preset].mean(axis=0) for preset in TABLE_6_2)
    return [
        *(
            number(value, ours[preset][:, i].tolist(), f"{preset.rpartition('-')[2]}, {names[i]}:")
            for preset, values in TABLE_6_2.items()
            for i, value in enumerate(values)
        ),
        (
            "the hybrid's mean return is higher, and fewer of its experiments leave the limits",
            f"{hybrid[0]:.3g} against {trajectory[0]:.3g}, and {hybrid[2]:g} against {trajectory[2]:g} of {TESTS}",
            bool(hybrid[0] > trajectory[0] and hybrid[2] < trajectory[2]),
        ),
    ]


FIGURES: Mapping[str, tuple[str, Callable[[Trainings], list[Statement]]]] = {
    "fig-5.2": ("5.2.2", fig_5_2),
    "fig-5.3": ("5.2.2", fig_5_3),
    "fig-5.4": ("5.2.3", fig_5_4),
    "fig-5.5": ("5.2.3", fig_5_5),
    "fig-5.6": ("5.3.1", fig_5_6),
    "fig-5.7": ("5.3.2", fig_5_7),
    "fig-5.8": ("5.3.2", fig_5_8),
    "table-5.1": ("5.3.2", table_5_1),
    "fig-5.9": ("5.3.2", fig_5_9),
    "sec-6.2.1": ("6.2.1", sec_6_2_1),
    "fig-6.1": ("6.2", fig_6_1),
    "fig-6.2": ("6.3.1", fig_6_2),
    "fig-6.3": ("6.3.2", fig_6_3),
    "table-6.2": ("6.3", table_6_2),
}
"""Section of the thesis and statements by figure or table."""


def agent_facts(figure: str, trainings: Trainings) -> list[Fact]:
    """The statements of one of :data:`FIGURES`, with their verdicts."""
    source, statements = FIGURES[figure]
    return [Fact(figure, source, *statement) for statement in statements(trainings)]


def five(training: Training) -> Trajectories:
    """The agent in five experiments with parameters that were drawn anew."""
    return training.run(fresh_draws(training.bench.range_set(training.config.ranges), EVALUATION_SEED, FIVE))


def on_grid(training: Training) -> Trajectories:
    """The agent on the 40 values of f_v (5.2.3)."""
    return training.run(grid_draws(training.bench.range_set("viscous"), "f_v", EVALUATION_SEED))


def ways_home(training: Training) -> tuple[Floats, Floats]:
    """The quintics of those of five experiments that get so far, and the ways taken, each of shape [T, N, 2]."""
    bench, runs = training.bench, five(training)
    ts, there = bench.timing.sample_time, ~np.isnan(runs.x[OUTWARD + 1, :, 0])
    start, before = runs.x[OUTWARD, there], runs.x[OUTWARD - 1, there]
    times: Floats = ts * np.arange(bench.timing.horizon - OUTWARD + 1, dtype=np.float64)
    ways = quintic(start[:, 0], start[:, 1], (start[:, 1] - before[:, 1]) / ts, float(times[-1]), times[:, None])
    return np.stack(ways, axis=-1), runs.x[OUTWARD:, there]


def phases(training: Training) -> Floats:
    """Mean rewards over the grid of f_v: exploration, way home, last step; shape [3]."""
    rewards = on_grid(training).reward
    parts = (rewards[:OUTWARD], rewards[OUTWARD:-1], rewards[-1:])
    return np.array([np.nansum(part, axis=0).mean() for part in parts])


def tested(training: Training) -> tuple[float, float, float]:
    """Mean and variance of λ_min with the penalty, and violations, over 100 random parameters, always the same."""
    runs = training.run(fresh_draws(training.bench.range_set(training.config.ranges), EVALUATION_SEED, TESTS))
    returns = each(LAMBDA_MIN, runs.last, 0.0) - PENALTY * runs.violated
    return float(returns.mean()), float(returns.var()), float(runs.violated.sum())


def square_wave(batch: Batch) -> Floats:
    """The manual input of 6.2.2: ±6 A with a period of 20 ms."""
    limit = batch.bench.limits.current
    return np.where(batch.experiments.k // HALF_PERIOD % 2 == 0, limit, -limit)


def rises_early(curves: Sequence[Floats]) -> Statement:
    """Check that a training's return rises rapidly at first and slowly later."""
    curve = np.mean([smoothed(c) for c in curves], axis=0)
    at = max(1, round(EARLY * len(curve))) - 1
    gained, early = float(curve[-1] - curve[0]), float(curve[at] - curve[0])
    share = early / gained if gained != 0.0 else 0.0
    return (
        "the return rises rapidly in the first part of the training (3e5 of 1e6 steps) and slowly after that",
        f"{100 * share:z.0f} % of the gain comes in the first {100 * EARLY:.0f} % of the steps; the return goes from "
        f"{curve[0]:.3g} to {curve[-1]:.3g}",
        bool(gained > 0.0 and share > 0.5),
    )


def drops_at_limits(curve: Floats, violations: Floats) -> Statement:
    """Check that the later drops of a training's return come from experiments that left the limits.

    Args:
        curve: return of each iteration, shape [I].
        violations: experiments that left the limits in each, shape [I].
    """
    later = np.arange(len(curve)) >= round(EARLY * len(curve))
    dropped = later & (curve < (1.0 - DROP) * smoothed(curve))
    drops, at_limits = int(dropped.sum()), int((dropped & (violations > 0)).sum())
    return (
        "after that the return drops now and then, and it is because an experiment leaves the limits",
        f"in {drops} of the {int(later.sum())} later iterations the return is more than {100 * DROP:.0f} % below its "
        f"smoothed course; in {at_limits} of these an experiment left the limits",
        at_limits > 0.5 * drops,
    )


def keeps_limits(run: Trajectories, printed: str) -> Statement:
    """Check that no experiment left the limits."""
    left = int(run.violated.sum())
    return printed, f"{left} of {len(run.violated)} left the limits", left == 0


def comes_home(run: Trajectories, printed: str) -> Statement:
    """Check that every experiment ended at rest at the origin."""
    end = np.abs(run.x[-1])
    home = (end[:, 0] <= HOME_ANGLE) & (end[:, 1] <= HOME_VELOCITY) & ~run.violated
    ends = ", ".join(
        "left the limits" if gone else f"{x:z.1f} rad at {v:z.0f} rad/s"
        for (x, v), gone in zip(run.x[-1], run.violated, strict=True)
    )
    within = f"{HOME_ANGLE:g} rad and {HOME_VELOCITY:g} rad/s"
    return printed, f"{int(home.sum())} of {len(home)} within {within} at the end ({ends})", bool(home.all())


def number(printed: float, ours: Sequence[float], what: str) -> Statement:
    """A printed number beside ours, one for each seed; it agrees if their mean is close to it."""
    values = np.array(ours, np.float64)
    mean, agrees = float(values.mean()), abs(float(values.mean()) - printed) <= CLOSE * abs(printed)
    seeds = f" ({len(values)} seeds: {values.min():.3g} to {values.max():.3g})" if len(values) > 1 else ""
    return f"{what} {printed:.3g}", f"{mean:.3g}{seeds}", agrees


def among(how: Callable[[Floats], np.floating], values: Floats) -> float:
    """``how`` (a mean, a maximum) of what belongs to experiments inside the limits; NaN if nothing does."""
    inside = values[~np.isnan(values)]
    return float(how(inside)) if inside.size else math.nan


def correlation(a: Floats, b: Floats) -> float:
    """Correlation of two series; 0 if one of them never changes."""
    return float(np.corrcoef(a, b)[0, 1]) if np.ptp(a) > 0.0 and np.ptp(b) > 0.0 else 0.0


def mean_speed(run: Trajectories, first: int, last: int) -> float:
    """Mean velocity from one step to another [rad/s]."""
    return among(np.mean, run.x[first:last, :, 1])


def last_speed(run: Trajectories) -> float:
    """Mean |velocity| of the last 80 ms [rad/s]."""
    return among(np.mean, np.abs(run.x[-80:, :, 1]))


def smoothed(curve: Floats) -> Floats:
    """Mean over a window around each point, shorter at the ends."""
    half = int(0.5 * WINDOW * len(curve))
    return np.array([curve[max(0, i - half) : i + half + 1].mean() for i in range(len(curve))])
