"""Equality of the compiled core and its sources, bit for bit, on a million drawn inputs of each function.

    python -m tools.compile_core                               # first: it takes about a minute
    python benchmarks/compiled_core.py [--inputs 1000000] [--seed 1]

Among the inputs are the edges (zeros of both signs, infinities, NaN, subnormals) and any pattern of 64 bits; what a
function raises is compared as well, and one NaN is as good as another. Exit code 0 if nothing differs.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
from multiprocessing import get_context

CHECK = "emb_runtime.cli.core_check"


def main() -> int:
    """Compare and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--inputs", type=int, default=1_000_000, metavar="N", help="of each (default: %(default)d)")
    p.add_argument("--seed", type=int, default=1, metavar="N", help="of the drawing (default: %(default)d)")
    args = p.parse_args()
    os.environ["EMB_CORE"] = "compiled"  # before anything of ours is imported, here and in the children
    check = importlib.import_module(CHECK)
    differing = 0
    with get_context("spawn").Pool() as pool:
        arguments = [(name, args.inputs, args.seed) for name in check.COMPARISONS]
        for name, found, duration in pool.imap(_compared, arguments):
            print(
                f"{name:24}{args.inputs:10} inputs in {duration:6.1f} s: {found or 'the same, bit for bit'}", flush=True
            )
            differing += bool(found)
    return 1 if differing else 0


def _compared(argument: tuple[str, int, int]) -> tuple[str, str, float]:
    name, count, seed = argument
    check = importlib.import_module(CHECK)
    begin = time.monotonic()
    found: str = check.compared(check.COMPARISONS[name], *check.cores(), count, seed)
    return name, found, time.monotonic() - begin


if __name__ == "__main__":
    sys.exit(main())
