"""Reliability of ``emb-run --stop-when``: what an actor states when it stops, against the brake's truth.

`python benchmarks/stopping.py [--brakes N]` lets the shipped actor, whose model is the exact brake, drive N random
brakes of ±50 %, exact and forward-Euler ones, as `emb-run --iface sim` does it, until k_1 is precise to 1 % and f_v to
5 %. For each kind it prints how often the run ended early, after how long, how far the
estimates were from the truth in the stated deviations (root mean square; the share beyond two of them, which is 4.6 %
if they are right), and the worst error of the runs that ended early.

`python benchmarks/stopping.py --quick [--brakes N]` does it with `emb-run --quick` on exact brakes: after which time it
had stated enough of all four parameters, and their true errors then and when the run ended.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from emb_bench.config.bench import load_bench
from emb_bench.logs.estimates import by_step
from emb_bench.logs.log import read_log
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES

PLANTS = ("exact", "euler")
GOAL = {"k_1": 0.02, "f_v": 0.1}
SEED = 11


def main() -> None:
    """Run the benchmark."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--brakes", type=int, default=30, help="of each kind (default: %(default)s)")
    p.add_argument("--quick", action="store_true", help="emb-run --quick in place of the whole experiment")
    arguments = p.parse_args()
    bench = load_bench()
    ranges = bench.range_set("pm50")
    low, high = (np.array([getattr(end, name) for name in PARAMETER_NAMES]) for end in (ranges.low, ranges.high))
    brakes = np.random.default_rng(SEED).uniform(low, high, (arguments.brakes, len(PARAMETER_NAMES)))
    with tempfile.TemporaryDirectory() as folder:
        (quick if arguments.quick else goals)(brakes, Path(folder))


def played(brake: np.ndarray, seed: int, plant: str, folder: Path, *arguments: str) -> dict[str, Any]:
    """Summary of one run of `emb-run --iface sim`, with the relative errors of its estimates as `errors`."""
    listed = ",".join(f"{name}={value!r}" for name, value in zip(PARAMETER_NAMES, brake.tolist(), strict=True))
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(io.StringIO()):
        code = emb_run(
            ["--iface", f"sim:plant={plant},seed={seed},{listed}", *arguments, "--log", str(folder), "--json"]
        )
    summary: dict[str, Any] = json.loads(printed.getvalue())
    if code:
        raise SystemExit(f"{plant}, brake {seed}: {summary['result']}")
    found = [summary["estimate"][name]["value"] for name in PARAMETER_NAMES]
    return summary | {"errors": np.array(found) / brake - 1.0}


def goals(brakes: np.ndarray, folder: Path) -> None:
    """The shipped actor on brakes of two kinds, until the parameters of GOAL are known."""
    count, rows = len(brakes), []
    goal = ",".join(f"{name}={share:.0%}" for name, share in GOAL.items())
    places = [PARAMETER_NAMES.index(name) for name in GOAL]
    print(f"--stop-when {goal}, {count} brakes each")
    print(f"{'brake':8}{'early':>8}{'mean s':>8}{'rms z':>8}{'beyond 2':>10}{'worst k_1, f_v if early':>26}")
    for plant in PLANTS:
        early, seconds, z, worst = 0, [], [], np.zeros(len(GOAL))
        for i, brake in enumerate(brakes):
            run = played(brake, i, plant, folder, "--stop-when", goal)
            stated = [run["estimate"][n]["deviation"] for n in PARAMETER_NAMES]
            z += (run["errors"] * brake / stated).tolist()
            seconds.append(run["duration_s"])
            if run["goal_reached"]:
                early += 1
                worst = np.maximum(worst, np.abs(run["errors"])[places])
        beyond = float((np.abs(z) > 2.0).mean())
        told = ", ".join(f"{share:.2%}" for share in worst) if early else "-"
        rows.append(f"{plant}: {early}, {told}")
        rms = float(np.sqrt(np.mean(np.square(z))))
        print(
            f"{plant:8}{f'{early}/{count}':>8}{np.mean(seconds):8.3f}{rms:8.2f}{beyond:10.1%}{told:>26}",
            flush=True,
        )
    print(f"| `--stop-when {goal}`: early of {count} brakes, largest errors | –; euler: 0 | {'; '.join(rows)} |")


def quick(brakes: np.ndarray, folder: Path) -> None:
    """`emb-run --quick` on exact brakes: when enough was known, when the brake was home, and the true errors."""
    runs, then = [], []
    for i, brake in enumerate(brakes):
        runs.append(run := played(brake, i, "exact", folder, "--quick"))
        if run["goal_reached"]:
            at = round(run["goal_s"] / load_bench().timing.sample_time)
            then.append(by_step(read_log(run["log"]))[at][: len(PARAMETER_NAMES)] / brake - 1.0)
        Path(run["log"]).unlink()
    enough = np.array([run["goal_s"] for run in runs if run["goal_reached"]])
    durations = np.array([run["duration_s"] for run in runs])
    home = sum(run["home"] for run in runs)
    print(f"emb-run --quick, {len(runs)} brakes: {len(enough)} ended early, {home} home")
    for what, seconds in (("enough known", enough), ("home", durations)):
        print(f"{what:22} mean {seconds.mean():.3f} s, 95 % within {np.quantile(seconds, 0.95):.3f} s, all within "
              f"{seconds.max():.3f} s")  # fmt: skip
    for when, errors in (("then", np.abs(then)), ("at the end", np.abs([run["errors"] for run in runs]))):
        for name, column in zip(PARAMETER_NAMES, errors.T, strict=True):
            told = f"95 % within {np.quantile(column, 0.95):.3%}, all within {column.max():.3%}"
            print(f"true error of {name} {when:11} {told}")
    what = f"`--quick`, {len(runs)} brakes ±50 % that stick"
    print(
        f"| {what}: time until the repeatability of all four is 1.2 %, mean and 95 % of the brakes | 0.10 s, 0.13 s | "
        f"{enough.mean():.3f} s, {np.quantile(enough, 0.95):.3f} s |"
    )
    shares = ", ".join(f"{100 * value:.2f}" for value in np.quantile(np.abs(then), 0.95, axis=0))
    print(f"| {what}: true errors of {', '.join(PARAMETER_NAMES)} then, 95 % of the brakes | 1.2 % | {shares} % |")


if __name__ == "__main__":
    main()
