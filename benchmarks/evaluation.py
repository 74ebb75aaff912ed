"""The shipped actor for f_v: on the thesis's 40-value grid and on fresh draws, beside what needs no learning.

    python benchmarks/evaluation.py [--draws N] [--optimum-draws N] [--optimum-file FILE]

The thesis's weighted information, normalised by the true value, 500 steps, home at the end, on the Euler brake: thesis
1.94e7 and 2.03e7 for its agents A and B. On the grid the optimum if the brake were known is looked for as well, for
every so many of the 40 values; on the draws ``emb-train evaluate actor`` does the same and reports the same.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from emb_runtime.config.bench import load_bench
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_train.cli.evaluate import main as evaluate
from emb_train.envs.excitations import OnnxFile
from emb_train.envs.measure import MEASURES, mean_score
from emb_train.envs.play import GRID, grid_of, middle_of, reference_ladder, run_grid
from emb_train.evaluation.actors import references
from emb_train.evaluation.known_optimum import KnownOptimum, default_path

PARAMETER, RANGES, PLANT, SEED = "f_v", "viscous", "euler", 0


def on_the_grid(count: int, path: Path | None) -> None:
    """The table of the grid; with the optimum on ``count`` of its values."""
    bench = load_bench()
    ranges = bench.range_set(RANGES)
    policy = load_policy(shipped_actor_path(), bench)
    played = {"shipped actor": OnnxFile(policy.data, policy.contract.initial_state), **references(bench)}
    results = run_grid(bench, ranges, PARAMETER, list(played.values()), SEED, PLANT)
    rows = [*zip(played, results, strict=True)]
    rows += [(r.name, r) for r in reference_ladder(bench, ranges, PARAMETER, SEED, PLANT)]
    chosen = np.linspace(0, GRID - 1, count).astype(int)
    optima = np.zeros(0)
    if count:
        brakes = [grid_of(ranges, PARAMETER)[i] for i in chosen]
        known = KnownOptimum(bench, MEASURES["weighted"], (PARAMETER,), path)
        optima = known.optima(PLANT, middle_of(ranges), brakes, os.cpu_count() or 1, lambda line: None)
    beside = f"; the optimum on {count} of them: {optima.mean():.4e}" if count else ""
    print(f"{GRID} values of {PARAMETER}, {PLANT}{beside}")
    print(f"{'excitation':44}{'mean':>12}{'of the optimum':>16}{'left':>6}{'home':>8}")
    for name, r in rows:
        share = f"{100.0 * mean_score(r.fim[chosen] / optima).value:.2f} %" if count else "-"
        print(f"{name:44}{r.mean:12.4e}{share:>16}{r.violations:6}{f'{r.home}/{GRID}':>8}")


if __name__ == "__main__":
    options = argparse.ArgumentParser(description="the shipped actor beside references and optimum")
    options.add_argument("--draws", type=int, default=200, help="brakes drawn for the evaluation (%(default)s)")
    options.add_argument("--optimum-draws", type=int, default=8, help="of these with an optimum (%(default)s)")
    options.add_argument(
        "--optimum-file", type=Path, default=default_path(), help="where optima are kept (%(default)s)"
    )
    given = options.parse_args()
    on_the_grid(given.optimum_draws, given.optimum_file)
    kept = ["--optimum-file", str(given.optimum_file)] if given.optimum_file is not None else []
    counts = ["--draws", str(given.draws), "--optimum-draws", str(given.optimum_draws)]
    raise SystemExit(evaluate(["actor", "--criterion", "weighted", "--plant", "euler,exact", *counts, *kept]))
