"""Is the plant that was there the one that explains the record best?

    python benchmarks/model_choice.py [--draws 10] [--seed 1] [--errors 0] [--nominal]

Records of every plant of the bench file with random parameters within ±50 % and random excitations, simulated by
``benchmarks.independent_simulator``, to which every plant is fitted as ``emb-replay estimate --model all`` does it,
with the systematic errors estimated along. Reported are how often the right one comes first, by BIC as in that command
and by its held-out score alone; how often it is said not to fit; how often the interval of the answer covers the true
values; and the time of one record. A plant that is the right one but for the encoder's offset is right as well.
``--errors 1`` adds random systematic errors of the size of their priors, ``--errors 0.1`` a tenth of it.
``--nominal`` compares the plants at nominal parameters and fits nothing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import Brake, brake_of, simulate, started
from benchmarks.interval_coverage import share
from emb_bench.analysis.model_choice import choose_model, model_of
from emb_bench.brake.parameters import PARAMETERS
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import DEFAULT_PLANT, Plant
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import STARTS, EstimationProblem
from emb_bench.experiment.experiment import Experiment

GOAL = 0.9  # Share of the records in which the right plant has to come first


class Outcome(NamedTuple):
    """Answer for one record."""

    first: str
    right: bool  # True if the right plant comes first
    predicts: bool  # True if it has the best held-out score
    fits: bool  # True if its residuals pass the tests
    not_excluded: bool  # True if it is among those that the record does not tell apart
    covered: float  # Share of the parameters that the intervals of the mixture cover
    alone: float  # Share that the intervals of the first plant alone cover
    seconds: float


def with_errors(bench: Bench, plant: Plant, brake: Brake, size: float, rng: np.random.Generator) -> Brake:
    """The brake with random systematic errors, of those that the plant can have."""
    errors = {
        name: size * deviation * float(rng.standard_normal())
        for name, deviation in with_systematic(EstimationProblem(), bench, plant).systematic.items()
    }
    return replace(
        brake,
        encoder_offset=brake.encoder_offset + errors["offset"],
        current_offset=errors["current_offset"],
        delay=min(abs(errors.get("delay", 0.0)), PARAMETERS["delay"].high),
        velocity_gain=errors.get("velocity_gain", 0.0),
    )


def fitted(bench: Bench, plant: str, record: Experiment, truth: dict[str, float], seed: int) -> Outcome:
    """All plants fitted."""
    problem = with_systematic(EstimationProblem(), bench, bench.plant(DEFAULT_PLANT))
    right = model_of(bench.plant(plant), problem)
    alike = [name for name, other in bench.plants.items() if model_of(other, problem) == right]
    begun = time.perf_counter()
    found = choose_model(
        bench, list(bench.plants.values()), lambda p: [started(record, p)], problem, starts=STARTS, seed=seed
    )
    seconds = time.perf_counter() - begun
    e = found.best.estimate
    pairs = [
        (found.interval(u), interval, truth[u.name])
        for u, interval in zip(e.unknowns, e.intervals().tolist(), strict=True)
        if u.name in truth
    ]
    return Outcome(
        found.best.name,
        found.best.name in alike,
        max(found.candidates, key=lambda c: c.held_out).name in alike,
        any(c.fits for c in found.candidates if c.name in alike),
        any(c.name in alike for c in found.plausible),
        float(np.mean([low <= value <= high for (low, high), _, value in pairs])),
        float(np.mean([low <= value <= high for _, (low, high), value in pairs])),
        seconds,
    )


def compared(bench: Bench, plant: str, record: Experiment) -> Outcome:
    """All plants at nominal parameters."""
    begun, found = time.perf_counter(), {}
    for name, model in bench.plants.items():
        problem = Problem(bench, model, EstimationProblem(), (started(record, model),))
        z = problem.nominal()
        weights = problem.weights(z)
        errors, _ = problem.jacobian(z, weights)
        found[name] = float(errors @ errors) / sum(int((root > 0.0).sum()) for root in weights)
    first = min(found, key=lambda name: found[name])
    right = first == plant
    return Outcome(first, right, right, right, right, np.nan, np.nan, time.perf_counter() - begun)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="the right plant first?")
    parser.add_argument("--draws", type=int, default=10, help="records of each plant (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first record (default: %(default)s)")
    parser.add_argument("--nominal", action="store_true", help="compare at nominal parameters, fit nothing")
    parser.add_argument("--errors", type=float, default=0.0, help="systematic errors, in sigmas (default: none)")
    args = parser.parse_args()
    bench, outcomes, seed = load_bench(), [], args.seed
    print(f"seeds {args.seed} to {args.seed + args.draws * len(bench.plants) - 1}")
    print(f"{'plant':12}{'first':>7}{'held-out':>10}{'fits':>6}{'kept':>6}{'seconds':>9}  taken for")
    for name, plant in bench.plants.items():
        found = []
        for _ in range(args.draws):
            rng = np.random.default_rng(seed)
            brake = brake_of(bench, plant, rng.uniform(0.5, 1.5, 4))
            if args.errors:
                brake = with_errors(bench, plant, brake, args.errors, rng)
            record = simulate(brake, bench, rng, f"seed {seed}")
            truth = {"k_m": brake.k_m, "k_1": brake.k_1, "T_c": brake.t_c, "f_v": brake.f_v}
            found.append(compared(bench, name, record) if args.nominal else fitted(bench, name, record, truth, seed))
            seed += 1
        outcomes += found
        wrong, seconds = Counter(o.first for o in found if not o.right), np.median([o.seconds for o in found])
        print(
            f"{name:12}{sum(o.right for o in found):7}{sum(o.predicts for o in found):10}"
            f"{sum(o.fits for o in found):6}{sum(o.not_excluded for o in found):6}{seconds:9.2f}  "
            + ", ".join(f"{other} {count}" for other, count in wrong.most_common()),
            flush=True,
        )
    right = sum(o.right for o in outcomes)
    what = f"the right plant of {len(bench.plants)}, {len(outcomes)} records"
    print(f"\n| {what}: comes first | {100 * GOAL:.0f} % | {share(right, len(outcomes))} |")
    print(f"  by the held-out score alone:         {share(sum(o.predicts for o in outcomes), len(outcomes))}")
    if not args.nominal:
        print(f"| {what}: said not to fit | – | {share(sum(not o.fits for o in outcomes), len(outcomes))} |")
        print(f"the right plant not excluded:          {share(sum(o.not_excluded for o in outcomes), len(outcomes))}")
        print(f"| {what}: 95 % intervals cover | – | {100 * np.mean([o.covered for o in outcomes]):.1f} % |")
        print(f"95 % intervals of the first alone:     {100 * np.mean([o.alone for o in outcomes]):.1f} %")
    seconds = [o.seconds for o in outcomes]
    print(f"seconds a record takes:                median {np.median(seconds):.2f}, largest {np.max(seconds):.2f}")


if __name__ == "__main__":
    main()
