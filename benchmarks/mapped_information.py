"""Information of a run on each mapped drive beside one on our own node with the same delay, over many noises.

    python benchmarks/mapped_information.py [--seeds 16] [--current 6]

A constant request of 6 A goes to the shield's limit and turns there. Whether the brake rests at the turning point for
a period or two is decided by the sensors' noise, on our node too, and changes the information about k_1 by a fifth. So
runs are compared with those that turn alike. The numbers are per parameter: 1 % is a determinant of 4 %.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the bench file with late frames lives with the tests

from emb_bench.api import fisher_information, open_run
from emb_bench.logs.log import read_log
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import parse_bench
from tests.actors import constant_actor
from tests.drives import EXAMPLES, SHIPPED
from tests.runtime.drives.mapped import late_bench

TURN = slice(100, 400)  # Samples among which the brake turns at the far end


def run(iface: str, folder: Path, polled: bool) -> tuple[bool, float]:
    """Rest of the brake where it turned (True), and log det of the information."""
    log = folder / "run.mcap"
    log.unlink(missing_ok=True)
    files = ["--policy", str(folder / "actor.onnx"), "--bench", str(folder / "bench.toml"), "--log", str(log)]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        if code := emb_run(["--iface", iface, *files, "--no-rt"]):
            raise SystemExit(f"{iface}: exit {code}")
    velocity = np.asarray(read_log(log).tables["/cycle"]["velocity"])[TURN]
    reversals = int((velocity[1:] * velocity[:-1] < 0.0).sum())
    found = fisher_information(open_run(log), model="late-command" if polled else "exact")
    return reversals > 1, float(np.linalg.slogdet(found.fisher("physical").matrix)[1])


def difference(node: list[float], drive: list[float]) -> str:
    """Difference of the means per parameter with a 95 % interval, and the deviation of a run from the next one."""
    error = 1.96 * math.sqrt(sum(np.var(v, ddof=1) / len(v) for v in (node, drive))) / 4.0
    mean = (np.mean(drive) - np.mean(node)) / 4.0
    return f"{mean:+.2%} ± {error:.2%}, deviation of a run on the node {np.std(node, ddof=1) / 4.0:.2%}"


def main() -> int:
    """Print the comparison of each drive."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--seeds", type=int, default=16)
    p.add_argument("--current", type=float, default=6.0)
    args = p.parse_args()
    for drive in SHIPPED:
        polled = drive == "mit"
        node = f"sim:plant={'late-command' if polled else 'exact'}"
        mapped = f"map:{EXAMPLES / drive}.toml@sim-drive:{drive}"
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "bench.toml").write_text(text := late_bench(polled))
            (folder / "actor.onnx").write_bytes(constant_actor(parse_bench(text, "bench.toml"), args.current))
            ours = [run(f"{node},seed={seed}", folder, polled) for seed in range(args.seeds)]
            theirs = [run(f"{mapped},seed={seed}", folder, polled) for seed in range(args.seeds)]
        print(f"{drive}, {args.current:g} A, {args.seeds} seeds each")
        for rests in (False, True):
            a, b = ([value for rested, value in runs if rested is rests] for runs in (ours, theirs))
            compared = f"drive over node {difference(a, b)}" if min(len(a), len(b)) > 1 else "too few to compare"
            print(f"  {'rests' if rests else 'does not rest'} where it turns: {len(a)} and {len(b)} runs, {compared}")
        print(f"  all: drive over node {difference([v for _, v in ours], [v for _, v in theirs])}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
