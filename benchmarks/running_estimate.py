"""Running estimate with a sensor of the velocity and with an observer: does it fit, do its intervals cover?

    python benchmarks/running_estimate.py [--brakes 5000] [--seed 1]

Plays the speeds that the shipped actor and that of ``--quick`` ask for with the nominal estimate, on random brakes
within ±50 %, in whole experiments behind the shield.
The first row has a sensor of the velocity, the second the same sensor where an observer is declared: what declaring it
costs. The others have declared observers of their least bandwidth and of twice it. A row has the experiments whose
model is said to fit, the parameters inside their 95 % intervals, the level that the running mean of the innovations
passes with 1e-4, and the median deviations. Shares have 95 % intervals (Clopper and Pearson 1934); parameters of one
experiment are not independent, and count as if they were.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.policies import target_speeds
from emb_bench.config.bench import Bench, load_bench
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES, Sensors
from emb_runtime.estimator.estimate import NORMAL_95
from emb_runtime.estimator.kalman import believed, deviations, fits
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train.closed_loop import Batch, Conditions
from emb_train.play import begin_all, fresh_draws

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


def share(part: int, of: int) -> str:
    """A share with its 95 % interval."""
    low, high = stats.binomtest(part, of).proportion_ci(method="exact")
    return f"{part} of {of}, {100 * low:.2f} to {100 * high:.2f} %"


def results(bench: Bench, quick: bool, declared: float, true: float, count: int, seed: int) -> tuple[Floats, Floats]:
    """True relative parameters, and rows of results."""
    exact, ranges = bench.plant("exact"), bench.range_set("pm50")
    plant = replace(exact, name="observed", instruments=exact.instruments._replace(observer_bandwidth=true))
    sensors = Sensors("observer", declared) if declared else Sensors()
    bench = replace(bench, sensors=sensors, plants={**bench.plants, plant.name: plant})
    draws = fresh_draws(ranges, seed, count)
    batch = Batch(bench, ranges, PARAMETER_NAMES, count, plant.name, Conditions(acts="speed", observes="estimate"))
    begin_all(batch, draws)
    out = np.zeros((count, WIDTH))
    for speed in target_speeds(load_policy(shipped_actor_path(quick), bench), bench):
        batch.advance(np.full(count, speed))
        out[batch.experiments.violated, LEFT] = 1.0
    for row, loop in zip(out, batch.experiments.loops, strict=True):
        state = loop.estimate
        relative = believed(batch.setup.model, state)
        row[:FITS] = *relative, *deviations(batch.setup.model, state, relative)
        row[FITS], row[WORST] = fits(state), state.worst
    truths = [[getattr(d.brake, name) / getattr(bench.brake, name) for name in PARAMETER_NAMES] for d in draws]
    return np.array(truths), out


def main() -> None:
    """Print a table for each actor."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--brakes", type=int, default=5000, help="of each row (default: %(default)s)")
    p.add_argument("--seed", type=int, default=1)
    arguments = p.parse_args()
    bench = load_bench()
    for quick in (False, True):
        print(f"\n{shipped_actor_path(quick).name}, {arguments.brakes} brakes each")
        print("| velocity | left limits | fits | covered | of each | level of 1e-4 | largest | median deviations |")
        print("|---" * 8 + "|", flush=True)
        for name, declared, true in CASES:
            truths, r = results(bench, quick, declared, true, arguments.brakes, arguments.seed)
            errors, sigmas = np.abs(r[:, :COUNT] - truths), r[:, COUNT : 2 * COUNT]
            inside, worst = errors <= NORMAL_95 * sigmas, r[:, WORST]
            told = ", ".join(f"{100 * one:.1f}" for one in inside.mean(axis=0))
            medians = ", ".join(f"{one:.2e}" for one in np.median(sigmas, axis=0))
            print(
                f"| {name} | {int(r[:, LEFT].sum())} | {share(int(r[:, FITS].sum()), len(r))} | "
                f"{share(int(inside.sum()), inside.size)} | {told} % | {np.quantile(worst, 1.0 - 1e-4):.2f} | "
                f"{worst.max():.2f} | {medians} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
