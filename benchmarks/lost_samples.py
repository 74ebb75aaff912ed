"""Lost samples and commands: do right models still pass, and are the intervals still true?

    python benchmarks/lost_samples.py [--draws 40] [--seed 1] [--charge]

Of right brakes with random parameters within ±50 % under random excitations, 2, 5 and 10 % of the samples are lost, one
by one or in bursts of 20 ms, and one command in five of that share. A sample that is lost is not answered: the node
brakes, and of two in a row the report of the braking is lost as well. The records are those of
``independent_simulator``, which shares no line with the estimators. With ``--charge`` the node sends the integral of
its current along, so that what acted before a single lost sample is known. Reported for each pattern of losses are

- false alarms: right records that are said not to fit;
- how often the 95 % intervals cover the truth, with the systematic errors of the bench file estimated along, which
  makes them wide on purpose (these records have none, so that the truth lies at the middle of each prior and the
  estimate errs by less than it allows for), and without any, where 95 % is what they should be;
- the mean error of each parameter in its stated deviation, without systematic errors;
- the median deviation over that of the same experiment without losses, and the median time of an estimate;

shares with their 95 % intervals (Clopper and Pearson 1934).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import Losses, brake_of, simulate
from benchmarks.intervals import share
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.records import Estimate, EstimationProblem, Record, with_systematic
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench

Floats = NDArray[np.float64]

SHARES = (0.02, 0.05, 0.1)
BURST = 20  # Samples in a burst
COMMANDS = 0.2  # Commands that are lost, for each sample that is


class Pattern(NamedTuple):
    """Losses of one kind."""

    share: float  # Of the samples that are lost
    burst: int  # Samples that are lost together

    def draw(self, n: int, rng: np.random.Generator) -> Losses:
        """Losses of an experiment of ``n`` periods."""
        samples = np.zeros(n, np.bool_)
        if self.burst == 1:
            samples = rng.random(n) < self.share
        else:
            for begin in rng.integers(0, n - self.burst, rng.poisson(self.share * n / self.burst)):
                samples[begin : begin + self.burst] = True
        return Losses(samples, rng.random(n) < COMMANDS * self.share)

    @property
    def name(self) -> str:
        """Name of the pattern."""
        return f"{100 * self.share:.0f} %, " + ("one by one" if self.burst == 1 else f"bursts of {self.burst} ms")


class Outcome(NamedTuple):
    """Answer to one record beside the truth."""

    fits: bool
    fits_alone: bool
    covered: int  # Parameters inside their intervals, with systematic errors estimated along
    alone: int  # Parameters inside their intervals without
    errors: Floats  # Of the parameters in stated deviations, without
    wider: float  # Median deviation over that of the experiment without losses, without systematic errors
    lost: int
    seconds: float


def judge(bench: Bench, pattern: Pattern, seed: int, *, charge: bool) -> Outcome:
    """Estimates from one record, and compares what is said with what is true."""
    plant, rng = bench.plant("exact"), np.random.default_rng(seed)
    factors = rng.uniform(0.5, 1.5, len(PARAMETER_NAMES))
    losses, brake = pattern.draw(bench.timing.horizon, rng), brake_of(bench, plant, factors)
    record = simulate(brake, bench, rng, f"seed {seed}", losses, charge=charge)
    truth = factors * [getattr(bench.brake, name) for name in PARAMETER_NAMES]
    begun = time.perf_counter()
    e = estimated(bench, record, systematic=True)
    seconds = time.perf_counter() - begun
    alone = estimated(bench, record, systematic=False)
    none = Losses(np.zeros_like(losses.samples), np.zeros_like(losses.commands))
    whole = simulate(brake, bench, np.random.default_rng(seed), "whole", none)
    ideal = estimated(bench, whole, systematic=False)
    count = len(truth)
    errors = (alone.values[:count] / truth - 1.0) / alone.deviations()[:count]
    wider = float(np.median(alone.deviations()[:count] / ideal.deviations()[:count]))
    fits = e.validation.fits, alone.validation.fits
    lost = int(losses.samples.sum())
    return Outcome(*fits, covered(e, truth), covered(alone, truth), errors, wider, lost, seconds)


def estimated(bench: Bench, record: Record, *, systematic: bool) -> Estimate:
    """The estimate as the command makes it, with or without ``--systematic none``."""
    plant, asked = bench.plant("exact"), EstimationProblem()
    return run_method("oem", bench, plant, [record], with_systematic(asked, bench, plant) if systematic else asked)


def covered(e: Estimate, truth: Floats) -> int:
    """Parameters whose 95 % interval holds the truth."""
    low, high = e.intervals()[: len(truth)].T
    return int(np.sum((low <= truth) & (truth <= high)))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="right models with lost samples: do they pass, are intervals true?")
    parser.add_argument("--draws", type=int, default=40, help="records of each pattern (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first record (default: %(default)s)")
    parser.add_argument("--charge", action="store_true", help="the node sends the integral of its current along")
    args = parser.parse_args()
    patterns = [Pattern(part, burst) for burst in (1, BURST) for part in SHARES]
    bench, seed, every = load_bench(), args.seed, list[Outcome]()
    print(f"seeds {seed} to {seed + args.draws * len(patterns) - 1}")
    for pattern in patterns:
        outcomes = [judge(bench, pattern, seed + k, charge=args.charge) for k in range(args.draws)]
        seed += args.draws
        every += outcomes
        report(pattern.name, outcomes)
    report("all of them", every)


def report(name: str, outcomes: list[Outcome]) -> None:
    """One row of the table."""
    count, parameters = len(outcomes), len(outcomes) * len(PARAMETER_NAMES)
    errors = np.array([o.errors for o in outcomes])
    mean, spread = errors.mean(axis=0), errors.std(axis=0, ddof=1)
    print(f"\n{name}: {np.mean([o.lost for o in outcomes]):.0f} of 500 samples lost")
    print(f"  false alarms                      {share(sum(not o.fits for o in outcomes), count)}")
    print(f"  false alarms, --systematic none   {share(sum(not o.fits_alone for o in outcomes), count)}")
    print(f"  intervals cover                   {share(sum(o.covered for o in outcomes), parameters)}")
    print(f"  intervals cover, none             {share(sum(o.alone for o in outcomes), parameters)}")
    bias = ", ".join(
        f"{n} {m:+.2f} ± {1.96 * s / count**0.5:.2f}" for n, m, s in zip(PARAMETER_NAMES, mean, spread, strict=True)
    )
    print(f"  mean error in deviations, none    {bias}")
    print(f"  deviation over that without loss  median {np.median([o.wider for o in outcomes]):.2f}")
    print(f"  seconds an estimate takes         median {np.median([o.seconds for o in outcomes]):.2f}")


if __name__ == "__main__":
    main()
