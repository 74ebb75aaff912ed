"""Search for a brake, a policy and noise that break the learning shield: docs/explanation/learning-shield.md.

python -m tests.searches.learning_shield [--episodes 100000] [--seed 0]  # both brakes
python -m tests.searches.learning_shield --break NAME | all              # pads left out: must be found
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import Bench, load_bench
from emb_runtime.config.bench import Noise
from tests.properties.learning_mutants import MUTANTS, broken
from tests.properties.learning_search import (
    FASTEST,
    HIGHEST,
    LOWEST,
    SLOWEST,
    Found,
    episodes,
    search,
    setting_for,
)

WRONG = ("outside", "falsified", "violated", "away")
UNDECLARED = (0.0, 1e-3)
DECLARED = (50.0, 0.05)  # Errors of model [rad/s²] and current [A]: those of the shipped bench, and greater ones


class Case(NamedTuple):
    """One line of a table."""

    name: str
    flow: bool
    errors: tuple[float, float] = UNDECLARED  # Declared, of the model [rad/s²] and of the current [A]
    quiet: bool = False  # Sensors so good that the pads for them hide nothing


def cases() -> list[Case]:
    """Of the search proper."""
    found = []
    for flow in (True, False):
        brake = "flow" if flow else "Euler"
        found.append(Case(brake, flow))
        found.append(Case(f"{brake}, 50 rad/s² and 50 mA", flow, errors=DECLARED))
        found.append(Case(f"{brake}, quiet sensors", flow, quiet=True))
    return found


def bench_of(case: Case) -> Bench:
    """The shipped bench with what a case declares."""
    bench = load_bench()
    if case.quiet:
        bench = replace(bench, noise=Noise(angle=1e-7, velocity=1e-3))
    model_error, current_error = case.errors
    return replace(bench, shield=bench.shield._replace(model_error=model_error, current_error=current_error))


HEAD = (
    "| case | episodes | outside | falsified | violating | not home¹ | angle [rad] | velocity [rad/s] |\n"
    "|---|---|---|---|---|---|---|---|"
)


def line(name: str, found: list[Found]) -> None:
    """One line of a table: several searches together."""
    rows = np.concatenate([f.rows for f in found])
    sums = [sum(int(getattr(f, key).sum()) for f in found) for key in (*WRONG, "lossless")]
    outside, falsified, violating, away, lossless = sums
    print(
        f"| {name} | {len(rows)} | {outside} | {falsified} | {violating} | {away} of {lossless} | "
        f"{rows[:, LOWEST].min():.2f} .. {rows[:, HIGHEST].max():.2f} | "
        f"{rows[:, SLOWEST].min():.1f} .. {rows[:, FASTEST].max():.1f} |",
        flush=True,
    )


def show_search(n: int, seed: int) -> bool:
    """Both brakes under what the learner assumes; whether anything is wrong."""
    everything = []
    print(HEAD)
    for case in cases():
        bench = bench_of(case)
        found = search(setting_for(bench, case.flow), bench, n, seed)
        for i in np.flatnonzero(wrong_in(found))[:1]:
            print(found.describe(int(i)), file=sys.stderr)
        line(case.name, [found])
        everything.append(found)
    line("all", everything)
    return any(wrong_in(found).any() for found in everything)


def wrong_in(found: Found) -> NDArray[np.bool_]:
    """Episodes in which something went wrong."""
    wrong: NDArray[np.bool_] = np.logical_or.reduce([getattr(found, key) for key in WRONG])
    return wrong


def show_mutants(names: list[str], n: int, seed: int) -> bool:
    """Pads left out; whether one is not found."""
    missed = False
    print("| left out | brake | sensors | episodes | outside or falsified | violating |")
    print("|---|---|---|---|---|---|")
    for name in names:
        mutant = MUTANTS[name]
        errors = DECLARED if mutant.declared else UNDECLARED
        case = Case(name, mutant.flow, errors=errors, quiet=mutant.quiet)
        bench = bench_of(case)
        found = search(setting_for(bench, case.flow), bench, n, seed, run=broken(mutant, episodes))
        wrong = int((found.outside | found.falsified).sum())
        missed |= wrong == 0
        print(
            f"| {name}: {mutant.says} | {'flow' if case.flow else 'Euler'} | "
            f"{'quiet' if case.quiet else 'shipped'} | {n} | {wrong} | {int(found.violated.sum())} |",
            flush=True,
        )
    return missed


def main() -> int:
    """Print the figures that are asked for; 1 if the learner fails, or a pad that is left out is not found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=70_000, help="of each case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--break", dest="left_out", choices=(*MUTANTS, "all"), help="leave a pad out instead")
    arguments = parser.parse_args()
    n, seed = arguments.episodes, arguments.seed
    if arguments.left_out:
        names = list(MUTANTS) if arguments.left_out == "all" else [arguments.left_out]
        return int(show_mutants(names, n, seed))
    return int(show_search(n, seed))


if __name__ == "__main__":
    sys.exit(main())
