"""Time in which ``emb-run`` ends after Ctrl-C or SIGTERM, at random moments from its start to its end.

    python -m tests.searches.interrupt [--count N] [--seed S]

Each time the command is started anew, on the simulated bus with a policy and a bench file that it has to load, and
gets one of the two signals at a moment drawn from the call of its first function to its usual end. Counted are those
that end later than 1 s after it, in a traceback, with another exit code than 3 (0 if the run was over; by the signal
itself until something is opened), or leave a process. On a computer that has other things to do everything takes
longer.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.policy.policy import shipped_actor_path

LONGEST = 1.0  # Time from the signal to the end [s]
BEGIN = "import os, sys; from emb_runtime.system.entry import emb_run; os.write(1, b'.'); sys.exit(emb_run())"
"""The command, which says when its first function is called."""
NUMBERS = (signal.SIGINT, signal.SIGTERM)


class Ended(NamedTuple):
    """One command that got a signal."""

    moment: float  # From the call of its first function to the signal [s]
    number: int
    took: float  # From the signal to its end [s]
    code: int
    said: str
    left: tuple[int, ...]  # Processes that it left

    @property
    def fault(self) -> str:
        """Reason why this must not be; empty if all is well."""
        if self.took > LONGEST:
            return f"ended {self.took:.2f} s after the signal"
        if self.code not in (0, 3, -self.number):
            return f"exit code {self.code}"
        if "Traceback" in self.said:
            return "a traceback"
        return f"left the processes {self.left}" if self.left else ""


def interrupted(folder: Path, moment: float, number: int) -> Ended:
    """Start the command, send a signal ``moment`` seconds after its first function is called, and wait for its end."""
    policy, bench, log = folder / "policy.onnx", folder / "bench.toml", folder / "run.mcap"
    if not policy.exists():
        policy.write_bytes(shipped_actor_path().read_bytes())
        bench.write_text(shipped_bench_text(), encoding="utf-8")
    log.unlink(missing_ok=True)
    options = ["--policy", str(policy), "--bench", str(bench), "--log", str(log), "--yes"]
    process = subprocess.Popen(
        [sys.executable, "-c", BEGIN, *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    assert process.stdout is not None
    process.stdout.read(1)
    began = time.monotonic()
    while time.monotonic() - began < moment and process.poll() is None:
        time.sleep(min(0.001, moment))
    sent = time.monotonic()
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    took = time.monotonic() - sent
    left = _session(process.pid)
    if left:  # a process that is ended by the end of its parent takes its time
        time.sleep(LONGEST)
        left = _session(process.pid)
    return Ended(moment, number, took, process.returncode, said.decode("utf-8", "replace"), left)


def _session(leader: int) -> tuple[int, ...]:
    """The processes of a session."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                ended = (entry / "stat").read_text().rpartition(")")[2].split()[0] == "Z"  # not yet reaped by init
                if os.getsid(int(entry.name)) == leader and not ended:
                    found.append(int(entry.name))
            except OSError:
                continue
    return tuple(found)


def main() -> int:
    """Interrupt the command; 1 if it does not end as it should."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=200, metavar="N", help="moments (default: 200)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the moments (default: 0)")
    args = parser.parse_args()
    dice = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        began = time.monotonic()
        interrupted(folder, 60.0, signal.SIGINT)  # after its end: how long it takes
        usual = time.monotonic() - began
        ended = [interrupted(folder, dice.uniform(0.0, usual), dice.choice(NUMBERS)) for _ in range(args.count)]
    faults = [one for one in ended if one.fault]
    for one in faults:
        print(f"{signal.Signals(one.number).name} after {one.moment:.3f} s: {one.fault}: {one.said.strip()[-200:]}")
    took = sorted(one.took for one in ended)
    codes = {code: sum(one.code == code for one in ended) for code in sorted({one.code for one in ended})}
    print(f"moments of {usual:.2f} s; ended after {statistics.median(took):.3f} s in the median; exit codes {codes}")
    print(
        "| `emb-run` after Ctrl-C or SIGTERM at a random moment: late, in a traceback, or leaving a process; longest "
        f"| 0; {LONGEST:g} s | {len(faults)} of {args.count}; {took[-1]:.2f} s |"
    )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
