"""Compatibility of a trained actor with a bench: what has to be as in the training, and what to change otherwise.

A training may have a shield of its own (:attr:`emb_train.envs.conditions.Conditions.shield_ranges`), for brakes that
the bench's shield does not cover. Its actor is then for a bench file that names these brakes, and for no other.
"""

from __future__ import annotations

from emb_bench.config.bench import Bench
from emb_runtime.config.bench import Ranges


def unfit(bench: Bench, ranges: Ranges) -> str:
    """Reason why the bench's shield does not cover these brakes, and what to do; empty if it does."""
    box = bench.range_set(bench.shield.ranges)
    uncovered = box.uncovered(ranges.low, ranges.high)
    if not uncovered:
        return ""
    names = [f"{n} from {getattr(ranges.low, n):g} to {getattr(ranges.high, n):g}" for n in uncovered]
    covers = [f"{n} from {getattr(box.low, n):g} to {getattr(box.high, n):g}" for n in uncovered]
    middle = {n: 0.5 * (getattr(ranges.low, n) + getattr(ranges.high, n)) for n in ranges.low._fields}
    brake = [f"{n} = {middle[n]:g} in [brake]" for n in ranges.uncovered(bench.brake, bench.brake)]
    lines = " and ".join([*brake, f'ranges = "{ranges.name}" in [shield]'])
    return (
        f"it is for brakes with {', '.join(names)}, and the bench's shield covers {', '.join(covers)}: make a bench "
        f"file with emb-run --write-bench FILE, write {lines}, and give it to emb-export and emb-run with --bench FILE"
    )
