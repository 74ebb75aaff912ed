"""Running estimate with a sensor of the velocity and with an observer: does it fit, do its intervals cover?

    python benchmarks/running_estimate.py [--brakes 5000] [--seed 1]

Plays the shipped actor and that of ``--quick`` on random brakes within ±50 %, in whole experiments behind the shield.
The first row has a sensor of the velocity, the second the same sensor where an observer is declared: what declaring it
costs. The others have declared observers of their least bandwidth and of twice it. A row has the experiments whose
model is said to fit, the parameters inside their 95 % intervals, the level that the running mean of the innovations
passes with 1e-4, and the median deviations. Shares have 95 % intervals (Clopper and Pearson 1934); parameters of one
experiment are not independent, and count as if they were.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import stats

from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench, load_bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES, Sensors
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.estimator.kalman import Model, believed, deviations, fits, follow, start
from emb_runtime.estimator.speed_loop import Scale
from emb_train.closed_loop import Experiments, Setup, advance_one
from emb_train.play import fresh_draws
from emb_train.reference import Box, stored, wanted_current
from emb_train.trial import Trials

ACTORS = ("four-d-exact-quadratic", "four-time-exact-quadratic")
COUNT = len(PARAMETER_NAMES)
FITS, WORST, LEFT, WIDTH = 2 * COUNT, 2 * COUNT + 1, 2 * COUNT + 2, 2 * COUNT + 3  # After values and deviations
CASES = (
    ("sensor", 0.0, 0.0),
    ("sensor, observer of 1520 declared", 1520.0, 0.0),
    ("observer of 1520", 1520.0, 1520.0),
    ("observer of 3040, 1520 declared", 1520.0, 3040.0),
    ("observer of 800", 800.0, 800.0),
    ("observer of 1600, 800 declared", 800.0, 1600.0),
)
"""Name, declared and true bandwidth [rad/s]; 0 for a sensor."""


def fly(
    setup: Setup, model: Model, scale: Scale, box: Box, experiments: Experiments, table: Floats, out: Floats
) -> None:
    """N experiments with an estimator each; a row of results of each goes to ``out``, relative to the nominal brake."""
    reference = np.zeros(table.shape[0])
    for i in range(out.shape[0]):
        state = start(model)
        for _ in range(setup.rules.horizon):
            y, u = experiments.y, experiments.applied[i]
            state = follow(model, state, y[i, 0], y[i, 1], float(experiments.k[i]), u)
            advance_one(setup, experiments, i, wanted_current(model, state, scale, box, table, reference))
            if experiments.violated[i]:
                out[i, LEFT] = 1.0
                break
        values, known = believed(model, state), deviations(model, state)
        for j in range(COUNT):
            out[i, j], out[i, COUNT + j] = values[j], known[j]
        out[i, FITS], out[i, WORST] = fits(state), state.worst


def share(part: int, of: int) -> str:
    """A share with its 95 % interval."""
    low, high = stats.binomtest(part, of).proportion_ci(method="exact")
    return f"{part} of {of}, {100 * low:.2f} to {100 * high:.2f} %"


def results(bench: Bench, actor: str, declared: float, true: float, count: int, seed: int) -> tuple[Floats, Floats]:
    """True relative parameters, and rows of results."""
    sensors = Sensors("observer", declared) if declared else Sensors()
    bench, kept = replace(bench, sensors=sensors), stored(actor)
    draws = fresh_draws(bench.range_set("pm50"), seed, count)
    trials = Trials(bench, bench.range_set("pm50"), PARAMETER_NAMES, draws)
    instruments = trials.setup.instruments._replace(observer_bandwidth=true)
    out = np.zeros((count, WIDTH))
    arguments: tuple[Any, ...] = (
        trials.setup._replace(instruments=instruments),
        trials.model,
        kept.scale(bench),
        trials.box,
        trials.experiments,
        kept.array(),
        out,
    )
    compiled(fly)(*arguments)
    truths = [[getattr(d.brake, name) / getattr(bench.brake, name) for name in PARAMETER_NAMES] for d in draws]
    return np.array(truths), out


def main() -> None:
    """Print a table for each actor."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--brakes", type=int, default=5000, help="of each row (default: %(default)s)")
    p.add_argument("--seed", type=int, default=1)
    arguments = p.parse_args()
    bench = load_bench()
    for actor in ACTORS:
        print(f"\n{actor}, {arguments.brakes} brakes each")
        print("| velocity | left limits | fits | covered | of each | level of 1e-4 | largest | median deviations |")
        print("|---" * 8 + "|", flush=True)
        for name, declared, true in CASES:
            truths, r = results(bench, actor, declared, true, arguments.brakes, arguments.seed)
            errors, known = np.abs(r[:, :COUNT] - truths), r[:, COUNT : 2 * COUNT]
            inside, worst = errors <= NORMAL_95 * known, r[:, WORST]
            told = ", ".join(f"{100 * one:.1f}" for one in inside.mean(axis=0))
            medians = ", ".join(f"{one:.2e}" for one in np.median(known, axis=0))
            print(
                f"| {name} | {int(r[:, LEFT].sum())} | {share(int(r[:, FITS].sum()), len(r))} | "
                f"{share(int(inside.sum()), inside.size)} | {told} % | {np.quantile(worst, 1.0 - 1e-4):.2f} | "
                f"{worst.max():.2f} | {medians} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
