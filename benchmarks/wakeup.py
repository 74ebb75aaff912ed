"""Wake-up lateness of the loop, beside cyclictest on the same machine in the same minute.

    python benchmarks/wakeup.py [--seconds 20] [--cpu 0]

Both sleep until points of an absolute grid of 1 ms, at the loop's real-time priority, with locked memory and on the
same processor, in turns of two seconds: ``MonotonicClock.sleep_until`` in a process with the loop's settings, and
cyclictest of the rt-tests (C, clock_nanosleep), which is the measure of what this kernel and computer can do. Both
forbid the processors to sleep (``/dev/cpu_dma_latency``): cyclictest always does, and so do the loop's settings.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import shutil
import subprocess
import sys

import numpy as np
from numpy.typing import NDArray

from emb_runtime.errors import EXIT_DONE, EXIT_USAGE
from emb_runtime.system import realtime
from emb_runtime.system.clock import MonotonicClock

PERIOD_NS = 1_000_000
TURN = 2.0  # Seconds that each has before it is the other one's turn
LONGEST_US = 50_000  # Bins of cyclictest's histogram; what lies beyond is counted as the longest that it saw
QUANTILES = (50.0, 90.0, 99.0, 99.9, 100.0)

Lateness = NDArray[np.float64]  # Seconds after the time that was slept for, one per period


def main() -> int:
    """Measure and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--seconds", type=float, default=20.0, metavar="S", help="of each (default: %(default)g)")
    p.add_argument("--cpu", type=int, default=min(os.sched_getaffinity(0)), metavar="N", help="(default: %(default)s)")
    args = p.parse_args()
    if shutil.which("cyclictest") is None:
        print("cyclictest is missing: sudo apt-get install rt-tests", file=sys.stderr)
        return EXIT_USAGE
    turns = max(1, round(args.seconds / TURN))
    context = multiprocessing.get_context("spawn")  # a forked one would share pages, and fault on them
    ours: list[Lateness] = []
    theirs: list[Lateness] = []
    with context.Pool(1, realtime.obtain, (args.cpu,)) as pool:
        for _ in range(turns):
            ours.append(pool.apply(_our_turn, (round(TURN * 1e9 / PERIOD_NS),)))
            theirs.append(_their_turn(args.cpu))
        obtained = pool.apply(_scheduling)
    print(f"{turns} turns of {TURN:g} s each on processor {args.cpu}; loop: {obtained}; cyclictest: FIFO asked for")
    print(f"{'lateness':16}" + "".join(f"{q:10g} %" for q in QUANTILES))
    rows = {"loop": np.concatenate(ours), "cyclictest": np.concatenate(theirs)}
    for name, values in rows.items():
        print(f"{name:16}" + "".join(f"{1e6 * v:9.0f} us" for v in np.percentile(values, QUANTILES)))
    ratios = [np.percentile(rows["loop"], q) / np.percentile(rows["cyclictest"], q) for q in (50.0, 99.9)]
    print(f"loop over cyclictest: {ratios[0]:.2f} at the median, {ratios[1]:.2f} at 99.9 %")
    return EXIT_DONE


def _our_turn(periods: int) -> Lateness:
    clock = MonotonicClock()
    late = np.zeros(periods)
    deadline_ns = clock.now_ns() + PERIOD_NS
    for k in range(periods):
        late_ns = clock.sleep_until(deadline_ns) - deadline_ns
        late[k] = late_ns
        deadline_ns += (1 + late_ns // PERIOD_NS) * PERIOD_NS  # what was slept through is late once, as there
    return 1e-9 * late


def _scheduling() -> str:
    fifo = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    return f"FIFO {realtime.PRIORITY}" if fifo else "ordinary scheduling"


def _their_turn(cpu: int) -> Lateness:
    command = [
        "cyclictest",
        "--quiet",
        "--threads=1",
        f"--affinity={cpu}",
        f"--priority={realtime.PRIORITY}",
        "--mlockall",
    ]
    command += [f"--interval={PERIOD_NS // 1000}", f"--duration={TURN:g}", f"--histogram={LONGEST_US}"]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    counts = [(int(us), int(n)) for us, n in re.findall(r"^(\d{6}) (\d{6,})$", said, re.MULTILINE)]
    beyond = re.search(r"^# Histogram Overflows: 0*(\d+)", said, re.MULTILINE)
    longest = re.search(r"^# Max Latencies: 0*(\d+)", said, re.MULTILINE)
    counts.append((int(longest[1]) if longest else LONGEST_US, int(beyond[1]) if beyond else 0))
    return 1e-6 * np.repeat(*np.array(counts).T)


if __name__ == "__main__":
    sys.exit(main())
