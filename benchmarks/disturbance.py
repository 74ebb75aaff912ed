"""Brakes that something disturbs: does the prediction error method say that it fits, and are its intervals true?

    python benchmarks/disturbance.py [--draws 50] [--seed 1] [--systematic none|bench]

Each record is of a random brake within ±50 %, with a random excitation and the bench's noise, from
``benchmarks.independent_simulator``, which shares no code with the estimator. What disturbs it is one of ``CASES``; the
estimator is told of none. Reported are, each with its 95 % interval (Clopper and Pearson 1934),

- how often the model is said to fit;
- how often the 95 % intervals of the four parameters hold the truth, and the largest error in stated deviations.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import Brake, Floats, brake_of, simulate
from benchmarks.intervals import share
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.records import EstimationProblem, with_systematic
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench

CASES: Mapping[str, Mapping[str, float]] = {
    "nothing": {},
    "velocity walks, 3 rad/s per root of a second": {"velocity_walk": 3.0},
    "velocity walks, 10 rad/s per root of a second": {"velocity_walk": 10.0},
    "velocity walks, 30 rad/s per root of a second": {"velocity_walk": 30.0},
    "load walks, 1 mN·m per root of a second": {"torque_walk": 1e-3},
    "load walks, 5 mN·m per root of a second": {"torque_walk": 5e-3},
}
"""Disturbances by their names."""


class Outcome(NamedTuple):
    """Answer to one record beside the truth."""

    fits: bool
    covered: NDArray[np.bool_]
    farthest: float
    walk: float
    alarm: str
    seconds: float


def judge(bench: Bench, brake: Brake, seed: int, systematic: bool) -> Outcome:
    """Estimates from one record, and compares what is said with what is true."""
    plant, asked = bench.plant("exact"), EstimationProblem(PARAMETER_NAMES)
    record = simulate(brake, bench, np.random.default_rng(seed), f"seed {seed}")
    asked = with_systematic(asked, bench, plant) if systematic else asked
    begun = time.perf_counter()
    e = run_method("pem", bench, plant, [record], asked, starts=2)
    seconds = time.perf_counter() - begun
    truths = np.array([brake.k_m, brake.k_1, brake.t_c, brake.f_v])
    low, high = e.intervals()[:4].T
    errors: Floats = np.abs(e.values[:4] / truths - 1.0) / e.deviations()[:4]
    alarm = "" if e.validation.fits else e.validation.alarms[0]
    return Outcome(
        e.validation.fits, (low <= truths) & (truths <= high), float(errors.max()), e.process_noise, alarm, seconds
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="the prediction error method on brakes that something disturbs")
    parser.add_argument("--draws", type=int, default=50, help="records of each case (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first record (default: %(default)s)")
    parser.add_argument("--systematic", choices=("bench", "none"), default="none", help="default: %(default)s")
    parser.add_argument("--case", type=int, help="number of the only case")
    args = parser.parse_args()
    bench, plant = load_bench(), load_bench().plant("exact")
    for n, (name, disturbance) in enumerate(CASES.items()):
        if args.case not in (None, n):
            continue
        seeds = range(args.seed + n * args.draws, args.seed + (n + 1) * args.draws)
        outcomes = []
        for seed in seeds:
            factors = np.random.default_rng([seed, 1]).uniform(0.5, 1.5, 4)
            brake = Brake(**{**vars(brake_of(bench, plant, factors)), **disturbance})
            outcomes.append(judge(bench, brake, seed, args.systematic == "bench"))
        covered = np.array([o.covered for o in outcomes])
        print(f"{name}: seeds {seeds[0]} to {seeds[-1]}, --systematic {args.systematic}")
        print("  fits:             ", share(sum(o.fits for o in outcomes), len(outcomes)))
        print("  intervals cover:  ", share(int(covered.sum()), covered.size), np.round(covered.mean(axis=0), 3))
        print(f"  largest error:     {max(o.farthest for o in outcomes):.1f} deviations")
        print(f"  walk:              median {np.median([o.walk for o in outcomes]):.3g} rad/s per root of a second")
        print(f"  seconds:           median {np.median([o.seconds for o in outcomes]):.2f}")
        for alarm in sorted({o.alarm[:110] for o in outcomes if o.alarm})[:5]:
            print("   ", alarm)


if __name__ == "__main__":
    main()
