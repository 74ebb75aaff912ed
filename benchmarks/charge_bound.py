"""Bound on the worth of the charge that a node sends, where a burst of samples is lost.

    python benchmarks/charge_bound.py [--draws 40] [--seed 1]

The charge on both sides of a burst gives the sum of the currents that acted in it. Cramér-Rao bounds of the four
parameters of random brakes under random excitations, by differences of ``benchmarks.independent_simulator``, relative
to those of the same motion without losses, where in the bursts

- each current is unknown by the bench's limit (one standard deviation);
- the same, and their sum is known exactly;
- each current is known: only the samples are missing.

The simulation is taken as linear in the unknown currents. A brake that can turn around or stick on the way tells less,
so that the second line is a bound for every treatment of the charge.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import Brake, Losses, brake_of, motion, simulate
from benchmarks.lost_samples import BURST, SHARES, Pattern
from emb_runtime.config.bench import Bench, load_bench

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

FIELDS = ("k_m", "k_1", "t_c", "f_v")
RELATIVE_STEP, CURRENT_STEP = 1e-5, 1e-3  # Of the differences: relative for a parameter, [A] for a current
SUM_KNOWN = 1e-3  # Standard deviation of a sum that the charge gives: a step of it [A]


def sensitivities(brake: Brake, bench: Bench, currents: Floats, unknown: Integers) -> Floats:
    """Samples in standard deviations by the logarithms of the parameters, then by single currents, shape (2 n, any)."""
    sigma = [bench.noise.angle, bench.noise.velocity]
    t_s, columns = bench.timing.sample_time, []
    for field in FIELDS:
        low, high = (
            motion(replace(brake, **{field: getattr(brake, field) * (1.0 + h)}), currents, t_s)
            for h in (-RELATIVE_STEP, RELATIVE_STEP)
        )
        columns.append((high - low) / (2.0 * RELATIVE_STEP))
    for k in unknown.tolist():
        pulse = np.zeros_like(currents)
        pulse[k] = CURRENT_STEP
        low, high = motion(brake, currents - pulse, t_s), motion(brake, currents + pulse, t_s)
        columns.append((high - low) / (2.0 * CURRENT_STEP))
    return np.stack([(column / sigma).ravel() for column in columns], axis=1)


def deviations(rows: Floats) -> Floats:
    """Of the four parameters, everything else unknown too."""
    lengths = np.linalg.norm(rows, axis=0)
    inverse = np.linalg.pinv(rows / lengths, rcond=1e-12)
    result: Floats = np.linalg.norm(inverse, axis=1)[: len(FIELDS)] / lengths[: len(FIELDS)]
    return result


def ratios(bench: Bench, pattern: Pattern, seed: int) -> Floats:
    """Median deviation over that without losses: unknown currents, a known sum of each burst, known currents."""
    rng = np.random.default_rng(seed)
    losses = pattern.draw(bench.timing.horizon, rng)
    while not losses.samples.any():
        losses = pattern.draw(bench.timing.horizon, rng)
    brake = brake_of(bench, bench.plant("exact"), rng.uniform(0.5, 1.5, len(FIELDS)))
    none = Losses(np.zeros_like(losses.samples), np.zeros_like(losses.commands))
    currents = simulate(brake, bench, rng, "whole", none).currents
    lost = np.flatnonzero(losses.samples)
    every = sensitivities(brake, bench, currents, lost)
    kept = every[np.repeat(~losses.samples, 2)]
    count = len(FIELDS)
    before = np.pad(np.eye(len(lost)) / bench.limits.current, ((0, 0), (count, 0)))
    bursts = np.split(np.arange(len(lost)), np.flatnonzero(np.diff(lost) > 1) + 1)
    sums = np.zeros((len(bursts), every.shape[1]))
    for row, burst in zip(sums, bursts, strict=True):
        row[count + burst] = 1.0 / SUM_KNOWN
    whole = deviations(every[:, :count])
    cases = (np.vstack([kept, before]), np.vstack([kept, before, sums]), kept[:, :count])
    return np.array([np.median(deviations(rows) / whole) for rows in cases])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="bound on the worth of the charge in a burst of lost samples")
    parser.add_argument("--draws", type=int, default=40, help="motions for each share of losses (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first motion (default: %(default)s)")
    args = parser.parse_args()
    bench, seed = load_bench(), args.seed
    print("deviations over those without losses, median (quartiles) of the motions; currents in the bursts are")
    print(f"{'':28}{'unknown':>22}{'known in sum':>22}{'known':>22}")
    for share in SHARES:
        pattern = Pattern(share, BURST)
        found = [ratios(bench, pattern, seed + k) for k in range(args.draws)]
        seed += args.draws
        low, middle, high = np.quantile(found, [0.25, 0.5, 0.75], axis=0)
        cells = (f"{m:.2f} ({a:.2f} to {b:.2f})" for a, m, b in zip(low, middle, high, strict=True))
        print(f"{pattern.name:28}" + "".join(f"{cell:>22}" for cell in cells))


if __name__ == "__main__":
    main()
