"""Guarantee of the envelope shield: the figures of docs/explanation/shield.md.

    python -m tests.searches.shield [--episodes 20000] [--seed 0]

Searches for violations with adversarial episodes on three brakes (forward Euler, a finer one with an exact standstill,
the bench's plants) and by hill climbing, breaks each assumption in turn to show that the search can fail, and measures
what a freewheeling node would do.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import Any

import numpy as np

from emb_bench.config.bench import Bench
from emb_runtime.config.bench import Ranges
from emb_runtime.safety.shield_design import make_law
from tests.benches import SENSOR_BENCH
from tests.properties.shield_climb import climb
from tests.properties.shield_search import (
    DROPS,
    END_ANGLE,
    END_VELOCITY,
    EXTENSIONS,
    FASTEST,
    HIGHEST,
    LAST_SPEED,
    LOWEST,
    PLANTS,
    SLOWEST,
    Found,
    bench_with,
    search,
)


def bench_for(ranges: str = "envelope", **declared: Any) -> Bench:
    """The shipped bench with a sensor, another set and other bounds of its shield; ``known`` is the nominal brake."""
    bench = SENSOR_BENCH
    known = Ranges("known", bench.brake, bench.brake)
    return replace(
        bench,
        ranges={**bench.ranges, "known": known},
        shield=bench.shield._replace(ranges=ranges, **declared),
    )


def report(label: str, found: Found) -> bool:
    """One line of a table of :func:`table`; whether a limit was passed, or a brake that lost no command is not home."""
    r, told = found.rows, found.obeyed
    away = int((~found.home[told]).sum())
    line = (
        f"{label:44s} {len(r):8d} {int(found.violated.sum()):9d}   {r[:, LOWEST].min():7.2f} {r[:, HIGHEST].max():7.2f}"
    )
    line += f"   {r[:, SLOWEST].min():7.1f} {r[:, FASTEST].max():6.1f}"
    if told.any():
        line += f"   {away:6d}/{int(told.sum()):<7d} {np.abs(r[told, END_ANGLE]).max():6.3f}"
        line += f" {np.abs(r[told, END_VELOCITY]).max():6.2f}"
    print(line, flush=True)
    return bool(found.violated.any()) or away > 0


def table(title: str) -> None:
    """Head of a table of searches."""
    print(f"\n{title}")
    print(
        f"{'':44s} {'episodes':>8s} {'violating':>9s}   {'angle [rad]':>15s}   {'velocity [rad/s]':>14s}   "
        f"{'not home':>14s} {'worst end':>13s}"
    )


def show_search(n: int, seed: int) -> bool:
    """The law under its own assumptions; whether it fails."""
    table("Search with the law's own assumptions (half of the episodes lose commands)")
    found = search(bench_for(), n, seed)
    fails = report("envelope", found)
    for name in ("pm50", "viscous", "viscous-stiffness", "known"):
        fails |= report(name, search(bench_for(name), n // 5, seed))
    for name, declared in EXTENSIONS.items():
        fails |= report(f"envelope, {name}", search(bench_with(**declared), n // 5, seed, freewheel="coasting" in name))
    table("Brakes that are not the model, half by the bench's own solver: without the bound and with it")
    for plant, declared in PLANTS.items():
        report(f"{plant}, nothing declared", search(bench_for(), n // 5, seed, plant=plant))
        if declared:
            fails |= report(f"{plant}, declared", search(bench_for(**declared), n // 5, seed, plant=plant))
    print(f"| limits passed under the shield in {n:,} adversarial episodes | 0 | {int(found.violated.sum())} |")
    print("\nHome in spite of lost commands (envelope), share of episodes:")
    print("  " + ", ".join(f"{d} {found.home[found.of(d)].mean():.3f}" for d in DROPS))
    return fails


def show_climbs(n: int, seed: int) -> bool:
    """Hill climbing, 50 chains each; whether one passes a limit, or none does where the margin is left out."""
    print(
        "\nHill climbing, least margin of all chains (angle [rad], or speed [10 rad/s]); negative: a limit was passed"
    )
    chains, fails = 50, False
    for name, declared in {"envelope": {}, **EXTENSIONS}.items():
        margins = climb(bench_with(**declared), chains, n // chains, seed)
        print(f"  {name:36s} {chains * (n // chains):7d} episodes   {margins.min():7.3f}")
        fails |= bool(margins.min() < 0.0)
    law = make_law(bench_for())
    careless = law._replace(bottom=law.bottom - 0.3, top=law.top + 0.3)
    margins = climb(bench_for(), chains, n // chains, seed, law=careless)
    print(f"  {'without angle margin':36s} {chains * (n // chains):7d} episodes   {margins.min():7.3f}")
    return fails or bool(margins.min() >= 0.0)


def show_broken(n: int, seed: int) -> bool:
    """Each assumption broken in turn; whether a search does not find one."""
    bench, observed = bench_for(), bench_with(observer=1520.0)
    law = make_law(bench)
    table("Search with an assumption broken (violations must be found)")
    careless = law._replace(bottom=law.bottom - 0.3, top=law.top + 0.3)
    finds = report("brake outside the set (viscous, envelope)", search(bench_for("viscous"), n, seed, truth="envelope"))
    finds &= report("no angle margin", search(bench, n, seed, law=careless))
    finds &= report("frames one period late", search(bench, n, seed, ages=(0, 1)))
    finds &= report("observer at 80 % of what is declared", search(observed, n, seed, bandwidth=0.8 * 1520.0))
    finds &= report("observer at half of it", search(observed, n, seed, bandwidth=0.5 * 1520.0))
    finds &= report("observer, nothing declared", search(bench, n, seed, bandwidth=1520.0))
    found = search(bench, n, seed, drops=("killed",), freewheel=True)
    finds &= report("freewheel after a kill", found)
    for stop, column, limit in (("lower", LOWEST, -10.0), ("upper", HIGHEST, 100.0)):
        hit = found.rows[:, column] < limit if limit < 0.0 else found.rows[:, column] > limit
        speed = found.rows[hit, LAST_SPEED].max() if hit.any() else 0.0
        print(f"  freewheel: {hit.mean():.1%} of the kills run into the {stop} stop, with up to {speed:.0f} rad/s")
    return not finds


def main() -> int:
    """Print all figures; 1 if the shield fails, or a search that must find what is broken does not."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20_000, help="of the main search; the others have a fifth")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    n, seed = arguments.episodes, arguments.seed
    fails = show_search(n, seed)
    fails |= show_climbs(n // 5, seed)
    fails |= show_broken(max(n // 5, 1), seed)
    return 1 if fails else 0


if __name__ == "__main__":
    sys.exit(main())
