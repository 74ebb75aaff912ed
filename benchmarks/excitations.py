"""Information of the reference excitations about four parameters, beside the known-parameter optimum of the same run.

    python benchmarks/excitations.py [--starts N]

The nominal brake solved exactly, 500 samples, physical Fisher information of the relative parameters, no noise.
``free`` plays the excitation as it is, which may leave the limits; ``shielded`` passes it through the envelope shield,
as the runtime does, for every brake of a ±50 % box. ``efficiency`` is that of the shielded one against the optimal
design, exp((log det − log det*) / 4): the square of the ratio of the standard deviations, in the geometric mean.
"""

from __future__ import annotations

import argparse
import math

from emb_bench.design.problem import make_problem
from emb_bench.design.search import search
from emb_bench.excitation.reference import EXCITATIONS, Response, parse_excitation, run_excitation
from emb_bench.information.criteria import criteria, criterion
from emb_bench.information.fisher import fisher
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench

VARIANTS = (*EXCITATIONS, "constant-speed:turn=0.15", "square:period=0.1,amplitude=1.5", "step:amplitude=6")


def log_det(bench: Bench, response: Response) -> float:
    """Information of the currents that acted, on the exact brake."""
    plant = bench.plant("exact")
    found = fisher(bench, bench.brake, response.currents, plant=plant, kind="physical", normalise_by="true")
    return criteria(found.matrix, PARAMETER_NAMES).log_det


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="reference excitations beside the optimal design")
    parser.add_argument("--starts", type=int, default=24, help="coarse searches of the optimal design")
    starts = parser.parse_args().starts
    bench = load_bench()
    mechanics = bench.plant("exact").mechanics
    problem = make_problem(bench, criterion("D", PARAMETER_NAMES), PARAMETER_NAMES, model="exact", kind="physical")
    best = search(problem, starts=starts, seed=0).best.phi
    print(f"{'excitation':36}{'free':>9} {'limits':8}{'shielded':>9} {'limits':8}{'ends':10}{'efficiency':>11}")
    for text in VARIANTS:
        excited = parse_excitation(text, bench)
        free, safe = (run_excitation(bench, excited, mechanics, bench.brake, shielded=s) for s in (False, True))
        told = log_det(bench, safe)
        print(
            f"{text:36}{log_det(bench, free):>9.2f} {'kept' if free.kept else 'LEFT':8}"
            f"{told:>9.2f} {'kept' if safe.kept else 'LEFT':8}{'home' if safe.home else 'away':10}"
            f"{100.0 * math.exp((told - best) / 4.0):>9.3g} %"
        )
    ruler = f"emb-design, {starts} starts, known"
    print(f"{ruler:36}{best:>9.2f} {'kept':8}{'':>9} {'':8}{'home':10}{100:>9} %")


if __name__ == "__main__":
    main()
