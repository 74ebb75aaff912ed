"""Speed of reading logs, and memory for a long one.

    python benchmarks/replaying.py [--minutes 4] [--logs 300]

First, logs per second on one core: read, experiment and both informations with the exact plant. Second, ``fim`` and
``estimate`` on a log of 0.5 s, in a process of their own once its modules are loaded, against their limits, and
``api.fisher_information`` of an opened log, in turns with the calculation in it. Third, a log of ``--minutes`` at 1
kHz, at most 16, and one of a quarter of that: time and peak memory of ``emb-replay fim`` and ``info``, and what an hour
would take, along a straight line through both. They are runs of ``emb-run`` on a simulated brake with a longer
experiment, a square wave.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

# A core is what is counted; numpy and the compiled functions read this when they are loaded.
os.environ |= {f"{library}_NUM_THREADS": "1" for library in ("NUMBA", "OMP", "OPENBLAS", "MKL")}

import numba  # noqa: F401  # what is loaded is used
import numpy as np

from emb_bench import api
from emb_bench.config.bench import load_bench
from emb_bench.experiment.from_log import read_experiment
from emb_bench.experiment.simulate import Theta
from emb_bench.information.evaluation import Evaluation, Question, evaluate, information_and_fit
from emb_bench.logs.log import read_log
from emb_export.export import main as emb_export
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text
from emb_runtime.errors import EXIT_DONE

BATCH = 20  # Logs whose time is measured together
RATE, FIM_LIMIT, ESTIMATE_LIMIT, HOUR, BESIDE = 100.0, 0.1, 2.0, 400.0, 0.5
"""Limits to be met: logs per second, seconds, seconds, MiB for a log of an hour, and ms beside a calculation."""

# The peak that the kernel reports to a parent of its child is at least the parent's own, so the child reads its own.
ALONE = """
import sys
from emb_bench.cli.replay import main
code = main(sys.argv[1:])
with open("/proc/self/status") as status:
    print(next(line.split()[1] for line in status if line.startswith("VmHWM")), file=sys.stderr)
sys.exit(code)
"""


def measured(arguments: list[str]) -> tuple[float, float, str]:
    """Wall time [s], peak memory [MiB] and output of a command in a process of its own."""
    begin = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", ALONE, *arguments], capture_output=True, text=True, check=False)
    if done.returncode != EXIT_DONE:
        raise SystemExit(f"emb-replay {' '.join(arguments)}: exit code {done.returncode}: {done.stderr}")
    return time.perf_counter() - begin, int(done.stderr) / 1024.0, done.stdout


def simulated(folder: Path, name: str, *options: str) -> Path:
    """A log of a run on a simulated brake."""
    path = folder / f"{name}.mcap"
    with contextlib.redirect_stdout(io.StringIO()):
        assert emb_run(["--iface", "sim:plant=exact,seed=1", "--log", str(path), *options]) == EXIT_DONE
    return path


def long_logs(folder: Path, minutes: float) -> bool:
    """Make a long log and a shorter one; what they take. True if an hour keeps its limits."""
    sample_time, line = load_bench().timing.sample_time, "horizon     = 500 "
    text, bench, policy = shipped_bench_text(), folder / "long.toml", folder / "square.onnx"
    assert line in text
    found: list[dict[str, tuple[float, float]]] = []
    print(f"{'log':>10}{'messages':>12}{'MiB':>8}{'command':>9}{'time [s]':>10}{'peak [MiB]':>12}")
    for length in (0.25 * minutes, minutes):
        samples = round(length * 60.0 / sample_time)
        bench.write_text(text.replace(line, f"horizon     = {samples} "))
        with contextlib.redirect_stdout(io.StringIO()):
            assert emb_export(["square:period=0.05,amplitude=1", "--bench", str(bench), "--output", str(policy)]) == 0
        path = simulated(folder, f"{length:g}", "--bench", str(bench), "--policy", str(policy))
        size, messages = path.stat().st_size / 2**20, 0
        found.append({})
        for command in ("info", "fim"):
            taken, memory, output = measured([command, str(path), "--json"])
            document = json.loads(output)
            assert document["complete"], document
            if command == "info":
                messages = sum(document["messages"].values())
            else:
                assert document["samples"]["measured"] == samples, document["samples"]
                assert document["fit_sigmas"]["fits"], document["fit_sigmas"]
            found[-1][command] = taken, memory
            print(f"{length:6g} min{messages:12}{size:8.0f}{command:>9}{taken:10.1f}{memory:12.0f}")
        path.unlink()
    share, hours = (60.0 - 0.25 * minutes) / (0.75 * minutes), []
    for one, other in zip(found[0].values(), found[1].values(), strict=True):
        hours.append([short + share * (long - short) for short, long in zip(one, other, strict=True)])
    time_, memory = np.max(hours, axis=0)
    print(
        f"| hour of log, `fim`, along a straight line through {0.25 * minutes:g} and {minutes:g} minutes: peak memory; "
        f"wall clock | {HOUR:g} MiB; 30 s | {memory:.0f} MiB; {time_:.0f} s |"
    )
    return bool(memory <= HOUR)


def rate(path: Path, logs: int) -> bool:
    """Logs per second of one core's time, in a process that has its modules and compiled functions.

    Other programs on the machine take time and give none: what counts is the best batch of ``BATCH`` logs.
    """
    times = []
    for _ in range(logs + 1):
        begin = time.process_time()
        log = read_log(path)
        bench = log.bench
        question = Question(PARAMETER_NAMES)
        experiment = read_experiment(log)
        (found,) = evaluate(log, experiment, bench, [bench.plant("exact")], question, "nominal", bench.brake)
        told = [found.fisher(kind).criteria().log_det for kind in found.histories]
        times.append(time.process_time() - begin)
        assert found.fit.fits
        assert np.isfinite(told).all()
    times = times[1:]
    best = min(sum(times[k : k + BATCH]) / len(times[k : k + BATCH]) for k in range(0, len(times), BATCH))
    shown = f"{1.0 / best:.0f} /s, in the mean {len(times) / sum(times):.0f} /s"
    print(f"| logs of 0.5 s read and evaluated for both informations, one core | {RATE:g} /s | {shown} |")
    return 1.0 / best >= RATE


def calls(path: Path) -> bool:
    """Time of the information of an opened log, in turns with what is calculated in it; True if it is short enough."""
    opened = api.open_run(path)
    e = api.fisher_information(opened)
    assert isinstance(e, Evaluation)
    at = Theta(e.theta, e.experiment.x0(Theta(e.theta).offset(e.plant)))
    times = []
    for _ in range(300):
        just_opened, begin = api.open_run(path), time.perf_counter()
        information_and_fit(e.bench, e.plant, at, e.experiment, e.params, instants=e.instants)
        calculated = time.perf_counter()
        api.fisher_information(opened)
        called = time.perf_counter()
        api.fisher_information(just_opened)
        times.append((calculated - begin, called - calculated, time.perf_counter() - called))
    core, call, first = 1e3 * np.min(times, axis=0)
    print(
        f"| `api.fisher_information` of an opened log of 0.5 s, beside the calculation in it; over it; the first call "
        f"beside it | {BESIDE:g} ms; –; – | {call - core:.2f} ms; {call / core:.2f}; {first - core:.1f} ms |"
    )
    return bool(call - core <= BESIDE)


COMMANDS = """
import contextlib, io, sys, time
import cantools.database.can
from emb_bench.cli.replay import main
for n in range(int(sys.argv[1])):
    begin = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        assert main(sys.argv[2:]) == 0
    print(time.process_time() - begin)
"""


def commands(path: Path) -> bool:
    """The processor's time for the commands on a short log, their modules being loaded; True if it is short enough."""
    good = True
    for arguments, runs, limit in (
        (["fim", str(path)], 1, FIM_LIMIT),
        (["fim", str(path), "--json"], 1, math.inf),  # criteria after each sample, which the text does not have
        (["estimate", str(path)], 2, ESTIMATE_LIMIT),
    ):
        best = min(
            float(
                subprocess.run(
                    [sys.executable, "-c", COMMANDS, str(runs), *arguments], capture_output=True, text=True, check=True
                ).stdout.split()[-1]
            )
            for _ in range(3)
        )
        shown = " ".join(a for a in arguments if a != str(path))
        print(
            f"emb-replay {shown:12} on a log of 0.5 s: {best:.3f} s of the processor after start-up (limit {limit:g})"
        )
        good &= best <= limit
    return good


def main() -> None:
    """Print all of it; fail if a limit is not met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=4.0, help="length of the longer log (default: %(default)s)")
    parser.add_argument("--logs", type=int, default=300, help="times that the short log is evaluated (%(default)s)")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = simulated(Path(folder), "short")
        met = [rate(path, args.logs), commands(path), calls(path), long_logs(Path(folder), args.minutes)]
    if not all(met):
        raise SystemExit("a limit is not met")


if __name__ == "__main__":
    main()
