"""Outcome of commands on hostile files: policies, contracts, bench files and logs, each drawn from a seed.

    python -m tests.searches.hostile_files [--count N] [--seed S]

A file is refused, or read as far as it can be. Counted are those that end a command by a signal, in a traceback, with a
control character on the terminal, or that take more than 5 s of processor time or 512 MiB in the largest process. Each
command is a process forked from this one, so that the imports are not part of the time.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

from emb_bench import api
from tests.fuzz.hostile_files import LOG_COMMANDS, LONGEST, MOST_MEMORY, Hostile, draw, judge


def main() -> int:
    """Judge the files; 1 if one is not as it should be."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, metavar="N", help="files (default: 2000)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the first file (default: 0)")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    codes: Counter[str] = Counter()
    slowest = largest = 0.0
    faults = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        api.simulate(folder / "honest.mcap")
        honest = (folder / "honest.mcap").read_bytes()
        for command in LOG_COMMANDS:  # compiles what they run: its time is not the file's
            judge(Hostile("log", ".mcap", honest, command), folder)
        for seed in range(args.seed, args.seed + args.count):
            hostile = draw(seed, honest)
            judged = judge(hostile, folder)
            codes[f"{hostile.kind}: exit {judged.code}"] += 1
            slowest, largest = max(slowest, judged.cpu), max(largest, judged.memory)
            if judged.fault:
                faults += 1
                print(f"seed {seed}, {' '.join(hostile.command)}: {judged.fault}", flush=True)
    for what, count in sorted(codes.items()):
        print(f"{what:24} {count:6}")
    print(
        f"| hostile bench files, contracts, policies, logs: hangs or tracebacks; most processor time, most memory | 0; "
        f"{LONGEST:g} s, {MOST_MEMORY >> 20} MiB | {faults} of {args.count}; {slowest:.2f} s, "
        f"{largest / 2**20:.0f} MiB |"
    )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
