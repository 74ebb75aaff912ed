"""The shipped actor on brakes that it never saw, beside what needs no learning and the best known input of each brake.

    python benchmarks/evaluation.py [--draws N] [--optimum-draws N] [--criterion D|E] [--optimum-file FILE]

All four parameters within 50 %, on the brake that sticks, behind the shipped shield: ``emb-train evaluate actor`` with
these settings.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from emb_runtime.config.bench import PARAMETER_NAMES
from emb_train.cli.evaluate import main as evaluate
from emb_train.evaluation.known_optimum import default_path

if __name__ == "__main__":
    options = argparse.ArgumentParser(description="the shipped actor beside references and optimum")
    options.add_argument("--draws", type=int, default=200, help="brakes drawn for the evaluation (%(default)s)")
    options.add_argument("--optimum-draws", type=int, default=8, help="of these with an optimum (%(default)s)")
    options.add_argument("--criterion", choices=("D", "E"), default="D", help="(%(default)s)")
    options.add_argument(
        "--optimum-file", type=Path, default=default_path(), help="where optima are kept (%(default)s)"
    )
    given = options.parse_args()
    kept = ["--optimum-file", str(given.optimum_file)] if given.optimum_file is not None else []
    counts = ["--draws", str(given.draws), "--optimum-draws", str(given.optimum_draws)]
    asked = ["--parameters", ",".join(PARAMETER_NAMES), "--ranges", "pm50", "--criterion", given.criterion]
    raise SystemExit(evaluate(["actor", "four-d-exact-blind", *asked, "--plant", "exact", *counts, *kept]))
