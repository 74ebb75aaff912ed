"""Processor time that ``emb-run --iface sim`` takes before and after its cycles, beside another environment's in turns.

    python benchmarks/start_up.py [--other /path/to/.venv/bin/emb-run] [--times 10]

An experiment of 10 ms, with all the processes that it starts: imports, bench, policy with its test vectors, pre-flight,
recorder, and what is said at the end. Of each command the least and the median of user and system time.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

OURS = Path(sys.executable).with_name("emb-run")


def main() -> int:
    """Measure and print."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--other", type=Path, metavar="EMB-RUN", help="command of another environment")
    p.add_argument("--times", type=int, default=10, metavar="N", help="runs of each (default: %(default)d)")
    args = p.parse_args()
    commands = {"this": OURS} | ({"other": args.other} if args.other else {})
    times: dict[str, list[float]] = {name: [] for name in commands}
    for _ in range(args.times + 1):
        for name, command in commands.items():
            times[name].append(processor_time(command))
    medians = {}
    for name, values in times.items():
        medians[name] = float(np.median(values[1:]))  # the first one compiles
        print(f"{name:6} {1e3 * min(values[1:]):5.0f} ms at least, {1e3 * medians[name]:5.0f} ms at the median")
    if args.other:
        ratio = medians["this"] / medians["other"]
        print(f"| start of `emb-run --iface sim`: processor time over that of another version | 0.5 | {ratio:.2f} |")
    return 0


def processor_time(command: Path) -> float:
    """User and system time of one run with its processes [s]."""
    with tempfile.TemporaryDirectory(prefix="emb-start-") as folder:
        log = f"{folder}/run.mcap"
        before = os.times()
        run = [str(command), "--iface", "sim", "--duration", "0.01", "--log", log, "--json"]
        subprocess.run(run, check=True, capture_output=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
        after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


if __name__ == "__main__":
    sys.exit(main())
