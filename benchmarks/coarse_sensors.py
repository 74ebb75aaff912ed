"""Coarse encoders and slow observers: are the intervals true where the errors are not white?

    python benchmarks/coarse_sensors.py [--draws 40] [--seed 1] [--method oem]

Each record is of a random brake within ±50 %, with a random excitation, from ``benchmarks.independent_simulator``. Its
angle is rounded to the counts of an encoder, its velocity measured or derived by an observer from what the encoder
shows. The bench file states as noise of the angle what both make together, √(σ² + step²/12), and the observer's
bandwidth. Reported are, each with its 95 % interval (Clopper and Pearson 1934),

- how often the model is said to fit;
- how often the 95 % intervals of the four parameters hold the truth, and the largest error in stated deviations.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import Brake, brake_of, simulate
from benchmarks.intervals import share
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.records import EstimationProblem, with_systematic
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench


class Sensors(NamedTuple):
    """Angle and velocity as a bench has them."""

    counts: int  # Of the encoder per revolution; 0 for one that does not round
    noise: float  # Of the angle before it is rounded [rad]
    observer: float = 0.0  # Bandwidth of the observer [rad/s]; 0 where the velocity is measured


CASES: Mapping[str, Sensors] = {
    "4096 counts, noise of 1 mrad": Sensors(4096, 1e-3),
    "4096 counts, noise of 0.1 mrad": Sensors(4096, 1e-4),
    "1024 counts, noise of 0.1 mrad": Sensors(1024, 1e-4),
    "observer of 300 rad/s": Sensors(0, 1e-3, 300.0),
    "observer of 100 rad/s": Sensors(0, 1e-3, 100.0),
    "observer of 300 rad/s, 4096 counts, noise of 0.1 mrad": Sensors(4096, 1e-4, 300.0),
}
"""Sensors by what they are called."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="intervals with coarse encoders and slow observers")
    parser.add_argument("--draws", type=int, default=40, help="records of each case (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first record (default: %(default)s)")
    parser.add_argument("--method", choices=("oem", "pem", "ensemble"), default="oem", help="default: %(default)s")
    parser.add_argument("--systematic", choices=("bench", "none"), default="none", help="default: %(default)s")
    parser.add_argument("--case", type=int, help="number of the only case")
    args = parser.parse_args()
    shipped = load_bench()
    for n, (name, sensors) in enumerate(CASES.items()):
        if args.case not in (None, n):
            continue
        step = 2.0 * math.pi / sensors.counts if sensors.counts else 0.0
        moved = replace(shipped, noise=replace(shipped.noise, angle=sensors.noise))
        stated = replace(shipped, noise=replace(shipped.noise, angle=math.hypot(sensors.noise, step / math.sqrt(12.0))))
        plant = shipped.plant("observer" if sensors.observer else "exact")
        plant = replace(plant, instruments=plant.instruments._replace(observer_bandwidth=sensors.observer))
        fits, farthest, covered, alarms = 0, 0.0, list[NDArray[np.bool_]](), set[str]()
        seeds = range(args.seed + n * args.draws, args.seed + (n + 1) * args.draws)
        for seed in seeds:
            rng = np.random.default_rng(seed)
            brake = Brake(**{**vars(brake_of(shipped, plant, rng.uniform(0.5, 1.5, 4))), "encoder_step": step})
            record = simulate(brake, moved, rng, f"seed {seed}")
            asked = EstimationProblem(PARAMETER_NAMES)
            asked = with_systematic(asked, stated, plant) if args.systematic == "bench" else asked
            e = run_method(args.method, stated, plant, [record], asked)
            truths = np.array([brake.k_m, brake.k_1, brake.t_c, brake.f_v])
            low, high = e.intervals()[:4].T
            covered.append((low <= truths) & (truths <= high))
            farthest = max(farthest, float(np.max(np.abs(e.values[:4] / truths - 1.0) / e.deviations()[:4])))
            fits += e.validation.fits
            alarms.update(alarm[:110] for alarm in e.validation.alarms[:1])
        held = np.array(covered)
        print(f"{name}: seeds {seeds[0]} to {seeds[-1]}, method {args.method}, --systematic {args.systematic}")
        print("  fits:             ", share(fits, args.draws))
        print("  intervals cover:  ", share(int(held.sum()), held.size), np.round(held.mean(axis=0), 3))
        print(f"  largest error:     {farthest:.1f} deviations")
        for alarm in sorted(alarms)[:5]:
            print("   ", alarm)


if __name__ == "__main__":
    main()
