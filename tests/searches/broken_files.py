"""Outcomes of commands on broken files: hostile ones, each drawn from a seed, and a log with every damage of a table.

    python -m tests.searches.broken_files [--count N] [--seed S]

A hostile policy, contract, bench file or log is refused, or read as far as it can be. Counted are those that end a
command by a signal, in a traceback, with a control character on the terminal, or that take more than 5 s of processor
time or 512 MiB in the largest process. Each command is a process forked from this one, so that the imports are not part
of the time. Of damaged logs those are counted that give a wrong number without a word, or what a user would see as a
traceback.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import warnings
from collections import Counter
from pathlib import Path

from emb_bench import api
from tests import corrupt

CHUNK_SIZE = 2048
"""Size of the log that is damaged, once unpacked [bytes]: its last chunk has some hundred places to be cut at."""
WRONG = "WRONG"


def hostile(folder: Path, seeds: range) -> int:
    """Judge commands on hostile files, and print how they ended; how many did as none may."""
    codes: Counter[str] = Counter()
    slowest = largest = 0.0
    faults = 0
    api.simulate(folder / "honest.mcap")
    honest = (folder / "honest.mcap").read_bytes()
    for command in corrupt.LOG_COMMANDS:  # compiles what they run: its time is not the file's
        corrupt.command(corrupt.Hostile("log", ".mcap", honest, command), folder)
    for seed in seeds:
        drawn = corrupt.draw(seed, honest)
        judged = corrupt.command(drawn, folder)
        codes[f"{drawn.kind}: exit {judged.code}"] += 1
        slowest, largest = max(slowest, judged.cpu), max(largest, judged.memory)
        if judged.fault:
            faults += 1
            print(f"seed {seed}, {' '.join(drawn.command)}: {judged.fault}", flush=True)
    for what, count in sorted(codes.items()):
        print(f"{what:24} {count:6}")
    print(
        f"| hostile bench files, contracts, policies, logs: hangs or tracebacks; most processor time, most memory | 0; "
        f"{corrupt.LONGEST:g} s, {corrupt.MOST_MEMORY >> 20} MiB | {faults} of {len(seeds)}; {slowest:.2f} s, "
        f"{largest / 2**20:.0f} MiB |"
    )
    return faults


def damaged(path: Path) -> int:
    """Read a log with every damage, and print how that ended; how often as it may not."""
    wrong = total = 0
    api.simulate(path, seed=1, duration=0.04)
    corrupt.rewritten(path, chunk_size=CHUNK_SIZE)
    data, whole = path.read_bytes(), corrupt.read(path)
    assert isinstance(whole, corrupt.Read)
    print(f"{'damage':56}" + "".join(f"{outcome:>18}" for outcome in (*corrupt.OUTCOMES, WRONG)))
    for damage in corrupt.damages(data, random.Random(1)):
        counts = Counter[str]()
        for change in damage.changes:
            try:
                counts[corrupt.outcome(damage, change, path, data, whole)] += 1
            except Exception:
                counts[WRONG] += 1
        print(f"{damage.what:56}" + "".join(f"{counts[outcome]:18}" for outcome in (*corrupt.OUTCOMES, WRONG)))
        wrong, total = wrong + counts[WRONG], total + counts.total()
    print(f"| damaged logs that give a wrong number without a warning, or a traceback | 0 | {wrong} of {total:,} |")
    return wrong


def main() -> int:
    """Judge both; 1 if anything is not as it should be."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=2000, metavar="N", help="hostile files (default: 2000)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the first file (default: 0)")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        faults = hostile(Path(folder), range(args.seed, args.seed + args.count))
        return 1 if faults + damaged(Path(folder) / "short.mcap") else 0


if __name__ == "__main__":
    sys.exit(main())
