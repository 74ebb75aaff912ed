"""Time that a shield that learns takes per cycle on this computer: hearing the sample, and having the law for it.

    python benchmarks/learning_time.py [--samples 10000]
    EMB_CORE=compiled python benchmarks/learning_time.py       # after python -m tools.compile_core

The learner of the loop, in both currencies, on the shipped bench's nominal brake under currents that lead it through
its range again and again; a law is kept for some cycles, as in a run. Exit code 0 if the medians are at most 40 us, and
5 us on the compiled core.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

import numpy as np

from emb_bench.brake.motion import Floats, advance, no_sensitivity, rest
from emb_runtime.config.bench import load_bench
from emb_runtime.learning.learner import WAYS, Learner
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.shield import NO_PAST, shield
from emb_runtime.safety.shield_design import make_law
from emb_runtime.system import compiled_core

LIMITS = {False: 40e-6, True: 5e-6}  # Limits of the median [s], without and with the compiled core
QUANTILES = (50.0, 90.0, 99.0, 99.9)


def main() -> int:
    """Measure and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--samples", type=int, default=10_000, metavar="N", help="of each currency (default: %(default)d)")
    args = p.parse_args()
    core = compiled_core.running()
    print(f"core: {core.text}\n{'':34}" + "".join(f"{q:9g} %" for q in QUANTILES))
    met = True
    for currency in WAYS:
        hearing, asking = _times(currency, args.samples)
        for said, values in (("hearing", hearing), ("asking", asking), ("both", hearing + asking)):
            print(
                f"{currency + ', ' + said:34}" + "".join(f"{1e6 * v:8.2f} us" for v in np.percentile(values, QUANTILES))
            )
        met &= bool(np.median(hearing + asking) <= LIMITS[core.compiled])
    print(f"limit of the median {1e6 * LIMITS[core.compiled]:g} us: {'met' if met else 'NOT MET'}")
    return 0 if met else 1


def _times(currency: str, samples: int) -> tuple[Floats, Floats]:
    bench = load_bench()
    bench = replace(bench, shield=replace(bench.shield, learn=currency))
    learner = Learner(bench, make_law(bench))
    mechanics, (chosen, none) = bench.plant("exact").mechanics, no_sensitivity([])
    dice, x, u = np.random.default_rng(0), rest(), 0.0
    times = np.zeros((samples, 2))
    for n in range(samples):
        noise = dice.normal(size=2)
        angle, velocity = float(x[0] + bench.noise.angle * noise[0]), float(x[1] + bench.noise.velocity * noise[1])
        sample = SensorSample(0, angle, velocity, 0, 0, u, 15, NodeState.ACTIVE)
        step = n % bench.timing.horizon
        begin = time.perf_counter_ns()
        learner.begin(sample) if step == 0 else learner.hear(sample, 1)
        heard = time.perf_counter_ns()
        law, middle_angle, middle_velocity = learner.question(sample)
        times[n] = heard - begin, time.perf_counter_ns() - heard
        wanted = 6.0 if step % 250 < 180 else -6.0
        u, _ = shield(law, middle_angle, middle_velocity, wanted, NO_PAST, step)
        x = rest() if step == bench.timing.horizon - 1 else x
        advance(mechanics, bench.brake, x, u, bench.timing.sample_time, chosen, none)
    return 1e-9 * times[:, 0], 1e-9 * times[:, 1]


if __name__ == "__main__":
    sys.exit(main())
