"""Optimal designs at nominal parameters: the request, the prior, the result, and the distance to a bound.

    python benchmarks/design.py [--starts N]

500 samples of 1 ms, return to the origin, all limits held; relative parameters. Each design is simulated once more in
plain Python, between the samples too on the exact brake; the script stops if that gives another value or leaves a
limit.

Two bounds: ``proved`` is Hadamard's, loose, for the exact brake. ``mixture`` is what several different experiments
could reach per experiment: an estimate, for it is searched for, and more than one experiment can do.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.design_bound import ceiling, estimate
from emb_bench.design.problem import make_problem
from emb_bench.design.report import check
from emb_bench.design.search import search
from emb_bench.information.criteria import Name, criterion
from emb_bench.information.fisher import Kind
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench

ROUNDS = 4
ROUND_STARTS = 3


class Row(NamedTuple):
    """One requested design."""

    model: str
    criterion: Name
    kind: Kind
    params: tuple[str, ...]
    target: float
    before: str


ROWS = (
    Row("exact", "D", "physical", PARAMETER_NAMES, 100.7, "100.71 (10 ms)"),
    Row("exact", "E", "physical", PARAMETER_NAMES, 6.2e9, "6.2e9 (10 ms)"),
    Row("euler", "D", "physical", PARAMETER_NAMES, 102.0, "102.103"),
    Row("euler", "E", "physical", PARAMETER_NAMES, 1.7e10, "-"),
    Row("euler", "D", "weighted", ("f_v",), math.log(2.2e7), "-"),
)


def show(row: Row, starts: int) -> None:
    """Search, simulate again, bound; print two lines."""
    bench = load_bench()
    goal = criterion(row.criterion, row.params)
    problem = make_problem(bench, goal, row.params, model=row.model, kind=row.kind)
    begin = time.perf_counter()
    found = search(problem, starts=starts, seed=0)
    seconds = time.perf_counter() - begin
    value = goal.value(found.best.phi)
    again = check(bench, problem, goal, row.kind, found.best.currents, row.model)
    if not (again.limits_held and again.home and math.isclose(again.value, value, rel_tol=1e-6)):
        raise SystemExit(f"{row}: the design does not hold when it is simulated again: {again}")
    elsewhere = "exact" if row.model == "euler" else "euler"
    other = check(bench, problem, goal, row.kind, found.best.currents, elsewhere)
    verdict = "met" if value >= row.target else "MISSED"
    of = "4 parameters" if len(row.params) > 1 else row.params[0]
    print(
        f"{row.model:6}{row.criterion:3}{row.kind:9}{of:13}{value:12.6g}{row.target:11.5g} {verdict:7}"
        f"{row.before:>15}{seconds:7.1f}{starts:7}  {other.value:.5g} on {elsewhere}"
    )
    near = ", ".join(f"{goal.value(d.phi):.5g}" for d in found.designs[1:6])
    print(f"       other local optima {near}; coarse ones down to {goal.value(min(found.coarse)):.4g}")
    if row.model == "exact":
        begin = time.perf_counter()
        mixed = estimate(
            problem,
            goal,
            [(d.currents, d.matrix) for d in found.designs],
            rounds=ROUNDS,
            starts=ROUND_STARTS,
            seed=1,
        )
        print(
            f"       bounds: mixture {goal.value(mixed.bound):.5g} (estimate; a mixture that reaches "
            f"{goal.value(mixed.mixture):.5g} is known), proved {goal.value(ceiling(problem, goal)):.5g}; "
            f"{time.perf_counter() - begin:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--starts", type=int, default=24, help="coarse searches for each design")
    chosen = options.parse_args()
    print(
        f"{'brake':9}{'kind':9}{'of':13}{'found':>12}{'target':>11} {'':7}{'known before':>15}{'s':>7}{'starts':>7}"
        "  the same currents elsewhere"
    )
    for wanted in ROWS:
        show(wanted, chosen.starts)
