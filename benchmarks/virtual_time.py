"""Is every cycle answered where no other load disturbs? The runtime with logging on, in time of its own.

    python benchmarks/virtual_time.py [--seconds 30] [--slow N]

``emb-node`` and ``emb-run`` on vcan0 in QEMU with the instruction counter (`emb-hil --qemu`), with the shipped bench's
own time-outs and the shipped actor: one instruction is one nanosecond, so that this computer's load changes nothing.
Its one processor has no time left for the recorder there, so a long log is not whole. With ``--slow N`` it is User-Mode
Linux, N times slower than this computer: a system call, 10 to 40 us there, then takes an Nth of that.
What is printed comes from both programs' own accounts and, counted again, from the log. The times are virtual: they
compare parts of the program with each other and with the period, and are those of no real computer. Exit code 0 if
no period was missed, no sample unanswered, no answer too late, and the log is whole.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

import emb_bench.cli.node
import emb_runtime.cli.main
from benchmarks.bus.long_run import actor_for
from emb_bench.logs.log import read_log
from emb_bench.logs.timing import INTERVALS, quantiles, timing
from emb_runtime.config.bench import parse_bench, shipped_bench_text
from emb_runtime.config.timing_budgets import QUANTILE_NAMES
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE
from emb_runtime.policy.policy import shipped_actor_path
from tests.hil.fault_driver import Child

BUS = "vcan0"
HORIZON = "horizon     = 500 "
TIME_LIMIT_S = 3600
LOG = "run.mcap"


def main() -> int:
    """Run and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--seconds", type=float, default=30.0, metavar="S", help="of virtual time (default: %(default)g)")
    p.add_argument("--slow", type=int, metavar="N", help="User-Mode Linux, N times slower, in place of QEMU")
    p.add_argument("--keep", type=Path, metavar="DIR", help="leave the log and what was said in this new folder")
    p.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = p.parse_args()
    if args.slow is not None and args.slow < 1:
        p.error(f"--slow: expected at least 1, got {args.slow}")
    if args.inside:
        _play()
        return EXIT_DONE
    if args.keep is not None:
        args.keep.mkdir()
        return _outside(args.keep.resolve(), round(args.seconds * 1000), args.slow)
    with tempfile.TemporaryDirectory(prefix="emb-virtual-") as folder:
        return _outside(Path(folder), round(args.seconds * 1000), args.slow)


def _outside(folder: Path, samples: int, slow: int | None) -> int:
    text = shipped_bench_text()
    if HORIZON not in text:
        raise ValueError(f"expected '{HORIZON}' in the shipped bench.toml")
    bench = parse_bench(text.replace(HORIZON, f"horizon     = {samples} "), "virtual time")
    (folder / "bench.toml").write_text(bench.text)
    (folder / "actor.onnx").write_bytes(actor_for(bench, shipped_actor_path()))
    begin = time.monotonic()
    kernel = ["--qemu"] if slow is None else ["--uml", "--slow", str(slow)]
    hil = [sys.executable, "-m", "emb_bench.hil.cli", *kernel, "--root", "--timeout", str(TIME_LIMIT_S), "--"]
    subprocess.run([*hil, sys.executable, __file__, "--inside"], cwd=folder, check=True, stdin=subprocess.DEVNULL)
    took = time.monotonic() - begin
    run, node = (json.loads((folder / f"{name}.json").read_text()) for name in ("run", "node"))
    name = "QEMU's virtual time" if slow is None else f"User-Mode Linux, {slow} times slower"
    return _report(run, node, folder / LOG, samples, took, name)


def _report(run: dict[str, Any], node: dict[str, Any], log: Path, samples: int, took: float, kernel: str) -> int:
    t = timing(read_log(log))
    counted = {"answered": len(t.response), "missed": t.missed, "unanswered": t.unanswered, "not_obeyed": t.not_obeyed}
    print(f"{samples / 1000:g} s at 1 kHz in {kernel}, logging on; took {took:.0f} s\n")
    print(f"{'':14}{'emb-run':>10}{'from log':>10}")
    for name, count in counted.items():
        print(f"{name:14}{run[name]:10}{count!s:>10}")
    print(f"emb-node: {node['obeyed']} commands obeyed")
    print(f"log: {run['log_messages']} messages, {run['log_dropped']} dropped, whole: {run['log_complete']}\n")
    print(f"{'its us':20}{'least':>9}" + "".join(f"{name:>9}" for name in QUANTILE_NAMES))
    for name, said in INTERVALS.items():
        values = t.interval(name)
        row = [values.min(), *quantiles(values).values()] if len(values) else []
        print(f"{said:20}" + "".join(f"{1e6 * value:9.1f}" for value in row))
    lost = sum(run[name] for name in ("missed", "unanswered", "not_obeyed"))
    same = all(run[name] == count for name, count in counted.items())
    met = run["result"] == "done" and run["answered"] == samples and lost == 0 and same and run["log_complete"]
    answered = f"{run['result']}: {run['answered']} of {samples} samples answered, {lost} periods lost"
    print(f"\n{answered}: {'met' if met else 'NOT MET'}")
    return EXIT_DONE if met else EXIT_CHECK_FAILED


def _play() -> None:
    """Inside: the node, and one run; everything is written in memory until both are over."""
    memory = Path("/dev/shm")
    bench = ["--iface", BUS, "--bench", "bench.toml", "--json"]
    # Forks of this process: to import everything anew in each would take longer than the run.
    node = Child(emb_bench.cli.node.main, bench, memory, "node")
    while not (node.err.exists() and node.err.read_text().endswith("\n")):  # it reports that it is on the bus
        time.sleep(0.1)
    run = Child(
        emb_runtime.cli.main.main, [*bench, "--policy", "actor.onnx", "--log", str(memory / LOG)], memory, "run"
    )
    while run.running():
        time.sleep(0.5)
    os.kill(node.pid, signal.SIGTERM)
    for name, program in (("run", run), ("node", node)):
        Path(f"{name}.json").write_text(program.end()["out"])
    shutil.move(memory / LOG, Path.cwd())


if __name__ == "__main__":
    sys.exit(main())
