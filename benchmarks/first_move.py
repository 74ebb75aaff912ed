"""Information that the first move costs: as it is, with the constant limit of older logs, and with none.

    python benchmarks/first_move.py [--brakes 100] [--seed 0] [--plant exact]

Plays the shipped actor on the nominal brake and on brakes of the shield's set at random, through shield and monitor,
with the noise of the bench; each of them three times with the same noise. Physical Fisher information of the relative
parameters from the currents that acted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import numpy as np

from emb_bench.excitation import reference
from emb_bench.information.criteria import criteria
from emb_bench.information.fisher import fisher
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters, load_bench
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.safety.sensor_monitor import CONFIRMED, largest_current
from emb_runtime.safety.sensor_thresholds import SensorThresholds
from emb_runtime.safety.shield_design import ShieldLaw

Limit = Callable[[ShieldLaw, SensorThresholds, Any, float], float]


def constant(_law: ShieldLaw, limits: SensorThresholds, memory: Any, limit: float) -> float:
    """The limit of logs without the entry ``first_move``."""
    return limit if memory[CONFIRMED] != 0.0 else min(limit, limits.first_current)


def none(_law: ShieldLaw, _limits: SensorThresholds, _memory: Any, limit: float) -> float:
    """No first move."""
    return limit


LIMITS: dict[str, Limit] = {"constant": constant, "as it is": largest_current, "none": none}


def information(bench: Bench, plant: str, p: BrakeParameters, noise: Any, limit: Limit) -> tuple[float, float]:
    """F(f_v) and log det of one experiment."""
    actor = load_policy(shipped_actor_path(), bench)
    chosen = bench.plant(plant)
    with patch.object(reference, "largest_current", limit):
        played = reference.run_excitation(bench, actor, chosen.mechanics, p, shielded=True, noise=noise)
    found = fisher(bench, p, played.currents, plant=chosen, kind="physical", normalise_by="true").matrix
    viscous = PARAMETER_NAMES.index("f_v")
    return float(found[viscous, viscous]), criteria(found, PARAMETER_NAMES).log_det


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--brakes", type=int, default=100, help="beside the nominal one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plant", default="exact")
    arguments = parser.parse_args()
    bench, rng = load_bench(), np.random.default_rng(arguments.seed)
    box = bench.range_set(bench.shield.ranges)
    low, high = np.array(box.low), np.array(box.high)
    brakes = [bench.brake]
    brakes += [BrakeParameters(*(low + rng.random(len(low)) * (high - low))) for _ in range(arguments.brakes)]
    found = np.empty((len(brakes), len(LIMITS), 2))
    for i, p in enumerate(brakes):
        noise = rng.standard_normal((bench.timing.horizon + 1, 2)) * [bench.noise.angle, bench.noise.velocity]
        for j, limit in enumerate(LIMITS.values()):
            found[i, j] = information(bench, arguments.plant, p, noise, limit)
    print("| first move | nominal: F(f_v) | log det | brakes: F(f_v) to none | log det to none |")
    print("|---|---|---|---|---|")
    for j, name in enumerate(LIMITS):
        ratio = found[1:, j, 0] / found[1:, -1, 0] - 1.0
        lost = found[1:, j, 1] - found[1:, -1, 1]
        bound = 1.96 / max(len(ratio), 1) ** 0.5
        print(
            f"| {name} | {found[0, j, 0]:.4g} | {found[0, j, 1]:.3f} "
            f"| {ratio.mean():+.2%} ± {bound * ratio.std():.2%} | "
            f"{lost.mean():+.3f} ± {bound * lost.std():.3f} |"
        )


if __name__ == "__main__":
    main()
