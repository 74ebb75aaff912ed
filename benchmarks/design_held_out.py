"""Optimal designs of brakes that no search was tuned on, beside the best that is known of each.

    python benchmarks/design_held_out.py [--points N] [--first N] [--models euler exact] [--criteria D E f_v] [--seed N]
                                         [--long] [--keep] [--results FILE]

The brakes are drawn from the ranges ``viscous-stiffness`` and ``pm50`` in turn, by a fixed seed that is printed. D and
E are those of four parameters, ``f_v`` is the thesis's weighted information of that one alone. ``share`` compares
det M^(1/4), λ_min, or the information with the best known, which is stored in ``design_known.json`` with how it was
found. Seconds are of wall clock and of all processors together.

``--long`` searches otherwise: other seeds, tables of six to eight journeys, and each by a longer search in larger
populations; the best ones are polished to the end, and nothing is annealed. ``--keep`` stores what is better than the
best known.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from emb_bench.config.bench import Bench, load_bench
from emb_bench.design.kernel import COARSE_SEARCHES
from emb_bench.design.polish import polish
from emb_bench.design.problem import Problem, make_problem
from emb_bench.design.report import check
from emb_bench.design.search import LONG, coarse, evolved, search
from emb_bench.information.criteria import Criterion
from emb_bench.information.fisher import Kind
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters

KNOWN = Path(__file__).with_name("design_known.json")
DRAWN = 20261122  # Seed of the brakes
RANGES = ("viscous-stiffness", "pm50")
LONG_STARTS = 12
LONG_FIRST = 12000
LONG_POPULATION = 48
LONG_POLISHED = 6
LIMITS = {"D": 0.999, "E": 0.995, "f_v": 0.999}  # Least share of the best known, by criterion


def points(bench: Bench, count: int) -> list[BrakeParameters]:
    """The brakes."""
    rng = np.random.default_rng(DRAWN)
    found = []
    for number in range(count):
        ranges = bench.ranges[RANGES[number % len(RANGES)]]
        found.append(BrakeParameters(*(rng.uniform(a, b) for a, b in zip(ranges.low, ranges.high, strict=True))))
    return found


def problem_for(bench: Bench, brake: BrakeParameters, model: str, name: str) -> Problem:
    """The design problem of one line."""
    if name == "f_v":
        goal = Criterion("D")
        return make_problem(bench, goal, ("f_v",), model=model, kind="weighted", brake=brake)
    goal = Criterion("E" if name == "E" else "D")
    return make_problem(bench, goal, PARAMETER_NAMES, model=model, brake=brake)


def leaves(bench: Bench, problem: Problem, currents: Floats, name: str) -> bool:
    """True if the design leaves a limit or is not home when it is simulated once more, in plain Python."""
    kind: Kind = "weighted" if name == "f_v" else "physical"
    again = check(bench, problem, kind, currents, problem.plant.name)
    return not (again.limits_held and again.home)


def long_search(problem: Problem, seed: int) -> float:
    """φ of the best design of a search that is built otherwise than the one it judges."""
    best = -math.inf
    tables = []
    for number, state in enumerate(np.random.SeedSequence(seed).spawn(LONG_STARTS)):
        begin = coarse(problem, 6 + number % 3, state).genes
        rng = np.random.default_rng(state.spawn(1)[0])
        tables.append(evolved(problem, begin, 0.1, LONG_FIRST, rng, population=LONG_POPULATION))
    tables.sort(key=lambda table: -table.value)
    for table in tables[:LONG_POLISHED]:
        currents = problem.explore(table.genes[None])[0][0]
        design = polish(problem, currents, replace(LONG, steps=200, tolerance=1e-5))
        if design.feasible and max(problem.beyond(design)) <= 1e-5:
            best = max(best, design.phi)
    return best


class Line(NamedTuple):
    """One search."""

    model: str
    criterion: str
    number: int
    seed: int
    long: bool
    phi: float
    wall: float
    cpu: float

    @property
    def key(self) -> str:
        """Name of the design problem in ``design_known.json``."""
        return f"{self.model} {self.criterion} {self.number}"

    @property
    def how(self) -> str:
        """Options that find it again."""
        return f"{'--long' if self.long else 'search'} --seed {self.seed}"


def searched(bench: Bench, brake: BrakeParameters, model: str, name: str, number: int, seed: int, long: bool) -> Line:
    """Search one design and check it."""
    problem = problem_for(bench, brake, model, name)
    wall, cpu = time.perf_counter(), time.process_time()
    if long:
        phi = long_search(problem, 1000 + seed)
    else:
        best = search(problem, starts=COARSE_SEARCHES, seed=seed).best
        phi = best.phi
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    if not long and leaves(bench, problem, best.currents, name):
        raise SystemExit(f"{model} {name} {brake}: the design leaves a limit")
    return Line(model, name, number, seed, long, phi, wall, cpu)


def share(line: Line, best_known: dict[str, dict[str, Any]]) -> float:
    """Share of the best known, of det M^(1/4), λ_min, or the information."""
    return math.exp((line.phi - best_known[line.key]["phi"]) / (4.0 if line.criterion == "D" else 1.0))


def main() -> None:
    """Print a line for each design."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--points", type=int, default=24, help="how many brakes (default: %(default)s)")
    options.add_argument("--first", type=int, default=0, help="number of the first one (default: %(default)s)")
    options.add_argument("--models", nargs="+", default=["euler"], choices=("euler", "exact"))
    options.add_argument("--criteria", nargs="+", default=list(LIMITS), choices=LIMITS)
    options.add_argument("--seed", type=int, default=0, help="of the search (default: %(default)s)")
    options.add_argument("--long", action="store_true", help="search longer and otherwise")
    options.add_argument("--keep", action="store_true", help="store what is better than the best known")
    options.add_argument("--results", type=Path, help="file of results, one a line: those in it are not searched again")
    args = options.parse_args()
    bench = load_bench()
    best_known = json.loads(KNOWN.read_text(encoding="utf-8")) if KNOWN.exists() else {}
    lines: list[Line] = []
    if args.results is not None and args.results.exists():
        lines = [Line(**json.loads(text)) for text in args.results.read_text(encoding="utf-8").splitlines()]
    print(f"brakes drawn with seed {DRAWN}, search with seed {args.seed}")
    print(f"{'brake':7}{'of':5}{'number':>6}{'value':>13}{'share':>9}{'wall s':>8}{'cpu s':>7}")
    shown = []
    for number, brake in list(enumerate(points(bench, args.first + args.points)))[args.first :]:
        for model, name in itertools.product(args.models, args.criteria):
            key = (model, name, number, args.seed, args.long)
            line = next((before for before in lines if before[:5] == key), None)
            if line is None:
                line = searched(bench, brake, *key)
                if args.results is not None:
                    with args.results.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(line._asdict()) + "\n")
            note = "" if line.key in best_known else "  the first that is known"
            if line.key not in best_known or line.phi > best_known[line.key]["phi"]:
                best_known[line.key] = {"phi": line.phi, "how": line.how, "brake": brake._asdict()}
                if args.keep:
                    KNOWN.write_text(json.dumps(best_known, indent=1, sort_keys=True) + "\n", encoding="utf-8")
            shown.append(line)
            value, part = line.phi if name == "D" else math.exp(line.phi), share(line, best_known)
            print(
                f"{model:7}{name:5}{number:6}{value:13.7g}{part:9.4f}{line.wall:8.1f}{line.cpu:7.1f}{note}", flush=True
            )
    for model, name in itertools.product(args.models, args.criteria):
        of = [line for line in shown if (line.model, line.criterion) == (model, name)]
        shares, cpu = [share(line, best_known) for line in of], [line.cpu for line in of]
        low = sum(part < LIMITS[name] for part in shares)
        print(
            f"{model:7}{name:5}{len(of)} of them: share median {statistics.median(shares):.4f}, least {min(shares):.4f}"
        )
        print(f"{'':12}{low} below {LIMITS[name]}; cpu s median {statistics.median(cpu):.1f}, most {max(cpu):.1f}")
        missed, middle, least = ", **not met**" if low else "", statistics.median(shares), min(shares)
        print(
            f"| designs of {len(of)} held-out {model} brakes, {name}: below {LIMITS[name]} of the best known; "
            f"median, least; processor time, median and most | 0; –; 120 s | {low}{missed}; "
            f"{middle:.4f}, {least:.4f}; {statistics.median(cpu):.1f}, {max(cpu):.1f} s |"
        )


if __name__ == "__main__":
    main()
