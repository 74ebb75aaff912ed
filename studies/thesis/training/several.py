"""Chapter 6: two parameters. Each function makes one figure or table and checks the statements about it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from emb_bench.information.symmetric import LAMBDA_MIN, each
from emb_train.envs.batch import Batch
from emb_train.envs.play import fresh_draws
from emb_train.rewards import DeterminantGain
from studies.thesis.training import plots
from studies.thesis.training.plots import Picture
from studies.thesis.training.result import Result, Statement, number, spread
from studies.thesis.training.single import EVALUATION_SEED, comes_home, five, keeps_limits, mean_speed
from studies.thesis.training.trainings import Training, Trainings
from studies.thesis.training.trajectories import Floats, Trajectories, asked, run

HALF_PERIOD = 10  # Steps of half a period of the square wave (6.2.2: 20 ms)
TESTS = 100  # Random parameters of Table 6.2
PENALTY = 1e6  # Penalty of a violation in Table 6.2


def square_wave(batch: Batch) -> Floats:
    """The manual input of 6.2.2: ±6 A with a period of 20 ms."""
    limit = batch.bench.limits.current
    return np.where(batch.k // HALF_PERIOD % 2 == 0, limit, -limit)


def fig_6_1(trainings: Trainings, picture: Picture) -> Result:
    """D-optimal rewards 1 and 2 beside the square wave, judged by the step reward of eq. 4.13."""
    title = "Fig. 6.1: D-optimal methods 1 and 2 beside a square wave"
    first, second = (trainings.first(f"thesis-d-optimal-{i}") for i in (1, 2))
    judge = replace(first.config, reward=DeterminantGain(scale=1.0, alpha=1.0, unsafe=0.0, weight=0.0))
    draws = fresh_draws(first.bench.range_set(judge.ranges), EVALUATION_SEED, 1)
    runs = {
        name: run(judge, first.bench, wanted, draws)
        for name, wanted in (
            ("method 1", asked(first.actor)),
            ("method 2", asked(second.actor)),
            ("square wave", square_wave),
        )
    }
    plots.plot_trajectories(picture, title, runs, first.bench.limits, "step reward, eq. 4.13")
    gained = {name: float(each_.returns[0]) for name, each_ in runs.items()}
    turns = {name: int((np.diff(np.sign(run_.current[:, 0])) != 0).sum()) for name, run_ in runs.items()}
    statements = [
        Statement(
            "both agents' currents vary periodically, like a square wave",
            f"their sign changes {turns['method 1']} and {turns['method 2']} times in 300 ms, the square wave's "
            f"{turns['square wave']} times",
            min(turns["method 1"], turns["method 2"]) >= 10,
            {f"turns_{name.replace(' ', '_')}": count for name, count in turns.items()},
        ),
        Statement(
            "method 2 gathers more than method 1",
            f"log |M| grows by {gained['method 1']:.2f} with method 1 and {gained['method 2']:.2f} with method 2",
            gained["method 2"] > gained["method 1"],
            {"method_1": gained["method 1"], "method_2": gained["method 2"]},
        ),
        Statement(
            "the square wave gathers more than both",
            f"log |M| grows by {gained['square wave']:.2f}",
            gained["square wave"] > max(gained["method 1"], gained["method 2"]),
            {"square_wave": gained["square wave"]},
        ),
    ]
    rows = [(name, f"{value:.2f}", str(int(runs[name].violated.sum()))) for name, value in gained.items()]
    return Result("fig-6.1", title, statements, ("input", "growth of log |M|", "violations"), rows)


def fig_6_2(trainings: Trainings, picture: Picture) -> Result:
    """The E-optimal trajectory reward, five experiments."""
    title = "Fig. 6.2: the agent with the E-optimal trajectory reward, 5 experiments"
    training = trainings.first("thesis-e-optimal-trajectory")
    runs = five(training)
    plots.plot_trajectories(picture, title, {"agent": runs}, training.bench.limits, "step reward, 6.3.1")
    speed, end = mean_speed(runs, 20, 150), np.abs(runs.x[-1, :, 0])
    away = int((~(end <= 5.0)).sum())
    statements = [
        Statement(
            "it runs at high velocity at the start",
            f"{speed:.0f} rad/s in the mean from 20 to 150 ms",
            speed > 300.0,
            {"velocity": speed},
        ),
        Statement(
            "it does not reach the origin by the end",
            f"{away} of {len(end)} end more than 5 rad away or leave the limits",
            away > 0,
            {"away": away},
        ),
    ]
    return Result("fig-6.2", title, statements)


def fig_6_3(trainings: Trainings, picture: Picture) -> Result:
    """The E-optimal hybrid reward, five experiments."""
    title = "Fig. 6.3: the agent with the E-optimal hybrid reward (eq. 6.6), 5 experiments"
    training = trainings.first("thesis-e-optimal-hybrid")
    runs = five(training)
    plots.plot_trajectories(picture, title, {"agent": runs}, training.bench.limits, "step reward, 6.3.2")
    statements = [
        comes_home(runs, "whatever the state at 450 ms is, it returns to rest at the origin"),
        keeps_limits(runs, "it keeps the limits"),
    ]
    return Result("fig-6.3", title, statements)


TABLE_6_2 = {
    "thesis-e-optimal-trajectory": ("Trajectory-based", 1.05e7, 1.52e14, 56.0),
    "thesis-e-optimal-hybrid": ("Hybrid", 1.53e7, 3.69e13, 0.0),
}


def tested(training: Training) -> tuple[float, float, float]:
    """Mean and variance of λ_min with the penalty, and violations, over 100 random parameters, always the same."""
    draws = fresh_draws(training.bench.range_set(training.config.ranges), EVALUATION_SEED, TESTS)
    runs: Trajectories = run(training.config, training.bench, asked(training.actor), draws)
    returns = each(LAMBDA_MIN, runs.last, 0.0) - PENALTY * runs.violated
    return float(returns.mean()), float(returns.var()), float(runs.violated.sum())


def table_6_2(trainings: Trainings, picture: Picture) -> Result:
    """Both E-optimal agents on 100 random parameters."""
    title = "Table 6.2: E-optimal agents on 100 random parameters"
    names = ("mean return", "variance of the return", f"violations in {TESTS} experiments")
    ours = {preset: np.array([tested(t) for t in trainings.all(preset)]) for preset in TABLE_6_2}
    printed = np.array([values for _, *values in TABLE_6_2.values()], np.float64)
    labels = [label for label, *_ in TABLE_6_2.values()]
    plots.plot_bars(picture, title, names, labels, printed.T, np.array(list(ours.values())).transpose(2, 0, 1))
    statements = [
        number(value, ours[preset][:, i].tolist(), f"{label}, {names[i]}:")
        for preset, (label, *values) in TABLE_6_2.items()
        for i, value in enumerate(values)
    ]
    trajectory, hybrid = (ours[preset].mean(axis=0) for preset in TABLE_6_2)
    ratio = float(hybrid[0] / trajectory[0]) if trajectory[0] > 0.0 else math.inf
    statements.append(
        Statement(
            "the hybrid's mean return is higher, and fewer of its experiments leave the limits",
            f"{hybrid[0]:.3g} against {trajectory[0]:.3g}, and {hybrid[2]:g} against {trajectory[2]:g} of {TESTS}",
            bool(hybrid[0] > trajectory[0] and hybrid[2] < trajectory[2]),
            {"ratio": ratio},
        )
    )
    rows = [
        (label, *(f"{v:.3g}" for v in values), *(spread(ours[preset][:, i].tolist()) for i in range(3)))
        for preset, (label, *values) in TABLE_6_2.items()
    ]
    columns = ("agent", *(f"{n}, thesis" for n in names), *(f"{n}, here" for n in names))
    return Result("table-6.2", title, statements, columns, rows)
