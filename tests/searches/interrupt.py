"""Time in which a command ends after Ctrl-C or SIGTERM, at random moments from its start to its end.

    python -m tests.searches.interrupt [--count N] [--seed S] [--only NAME]

Each time a command is started anew, in a folder with a log, and its process group gets the signal, as from a terminal,
at a moment drawn from the first line of its entry point to its usual end, at most 3 s. ``emb-run`` also gets SIGTERM,
on the simulated bus with a policy and a bench file that it has to load. Counted are ends later than 1 s after the
signal (5 s: what computes in compiled code; 10 s: what has Ray to end), in more than one line, with another exit code
than 130, by the signal itself, or that of a command that was over, and processes that are left. On a computer that has
other things to do everything takes longer.
"""

from __future__ import annotations

import argparse
import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from emb_bench.api import simulate
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.policy.policy import shipped_actor_path
from tests.bench.processes import processes

LONGEST = {"emb-run": 1.0, "emb-replay campaign --ray local": 10.0}  # Time from the signal to the end [s]
LONGEST_OTHERS = 5.0
USUAL = 3.0  # Latest moment [s]
BEGIN = "import re, importlib, os, sys; os.write(1, b'.'); sys.exit(getattr(importlib.import_module({!r}), {!r})())"
"""The command, which says when its entry point is imported."""
COMMANDS = {
    "emb-run": "--policy policy.onnx --bench bench.toml --log new.mcap --yes",
    "emb-gateway": "missing.toml --drive can0 --node can1",
    "emb-node": "--iface vcan0",
    "emb-replay info": "run.mcap",
    "emb-replay fim": "run.mcap",
    "emb-replay estimate": "run.mcap --starts 2",
    "emb-replay report": "run.mcap -o page.html",
    "emb-replay campaign": "a.mcap b.mcap -o rows.csv --jobs 2",
    "emb-replay campaign --ray local": "a.mcap b.mcap -o rows.csv",
    "emb-replay timing": "run.mcap",
    "emb-replay rerun": "run.mcap",
    "emb-replay export": "run.mcap -o figure.png",
    "emb-replay live": "runs --port 0",
    "emb-design": "--starts 1",
    "emb-commission": "new",
    "emb-train evaluate": "actor --draws 4",
    "emb-train ppo": "single-viscous --output new",
    "emb-export": "step --output new.onnx",
    "emb-hil": "--uml -- sleep 2",
}
"""Commands and their arguments."""
ENTRIES = {
    "emb-run": "emb_runtime.system.entry",
    "emb-gateway": "emb_runtime.system.entry",
    "emb-train": "emb_train",
    "emb-export": "emb_export",
}
"""Modules of entry points; the others' is that of the bench."""
DONE = {
    "emb-run": (0, 3),
    "emb-commission": (0, 3),
    "emb-gateway": (2,),
    "emb-node": (0, 4),
    "emb-replay timing": (2,),
}
"""Exit codes of a command that was over, or has one of its own for Ctrl-C; those of the others are 0, and 130 or the
signal. The gateway's file is missing, the node's bus too, and simulated time is not judged."""


class Ended(NamedTuple):
    """One command that got a signal."""

    command: str
    moment: float  # From the call of its first function to the signal [s]
    number: int
    took: float  # From the signal to its end [s]
    code: int
    said: str
    left: dict[int, str]  # Processes that it left

    @property
    def fault(self) -> str:
        """Reason why this must not be; empty if all is well."""
        if self.took > LONGEST.get(self.command, LONGEST_OTHERS):
            return f"ended {self.took:.2f} s after the signal"
        if self.code not in (*DONE.get(self.command, (0,)), 130, -self.number):
            return f"exit code {self.code}"
        if "Traceback" in self.said or "Exception ignored" in self.said:
            return "a traceback"
        return f"left {', '.join(self.left.values())}" if self.left else ""


def interrupted(command: str, moment: float, number: int, log: Path | None = None) -> Ended:
    """Start the command, send a signal ``moment`` seconds after its first function is called, and wait for its end."""
    name, *words = command.split(" ")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "policy.onnx").write_bytes(shipped_actor_path().read_bytes())
        (Path(folder) / "bench.toml").write_text(shipped_bench_text(), encoding="utf-8")
        for copy in ("run", "a", "b") if log else ():
            os.link(str(log), Path(folder) / f"{copy}.mcap")
        begin = BEGIN.format(ENTRIES.get(name, "emb_bench.cli.entry"), name.replace("-", "_"))
        process = subprocess.Popen(
            [sys.executable, "-c", begin, *words, *shlex.split(COMMANDS[command])],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
            cwd=folder,
        )
        assert process.stdout is not None
        process.stdout.read(1)
        began = time.monotonic()
        while time.monotonic() - began < moment and process.poll() is None:
            time.sleep(min(0.001, moment))
        sent = time.monotonic()
        if process.poll() is None:
            os.killpg(process.pid, number)
        _, said = process.communicate(timeout=60)
        took = time.monotonic() - sent
        left = processes(process.pid)
        if left:  # a process that is ended by the end of its parent takes its time; those of Ray more
            time.sleep(8.0 if "--ray" in words else 1.0)
            left = processes(process.pid)
    return Ended(
        command, min(moment, sent - began), number, took, process.returncode, said.decode("utf-8", "replace"), left
    )


def main() -> int:
    """Interrupt the commands; 1 if one does not end as it should."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=60, metavar="N", help="moments for each command (default: 60)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of the moments (default: 0)")
    parser.add_argument("--only", default="", metavar="NAME", help="commands whose names begin so (default: all)")
    args = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's job in the background ignores it
    dice, faults, longest = random.Random(args.seed), 0, dict[bool, float]()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        simulate(log)
        chosen = [command for command in COMMANDS if command.startswith(args.only)]
        for command in chosen:
            usual = interrupted(command, USUAL, signal.SIGINT, log).moment
            numbers = (signal.SIGINT, signal.SIGTERM) if command == "emb-run" else (signal.SIGINT,)
            ended = [
                interrupted(command, dice.uniform(0.0, usual), dice.choice(numbers), log) for _ in range(args.count)
            ]
            for one in (one for one in ended if one.fault):
                name = signal.Signals(one.number).name
                print(f"{name} after {one.moment:.3f} s: {one.fault}: {one.said.strip()[-300:]}")
                faults += 1
            took = [one.took for one in ended]
            own = command == "emb-run"
            longest[own] = max(longest.get(own, 0.0), *took)
            codes = {code: sum(one.code == code for one in ended) for code in sorted({one.code for one in ended})}
            print(f"{command}: moments of {usual:.2f} s; at most {max(took):.2f} s; exit codes {codes}", flush=True)
    print(
        "| a command after Ctrl-C (`emb-run`: or SIGTERM) at a random moment: late, in a traceback, or leaving a "
        f"process; longest time of `emb-run`, of the others | 0; {LONGEST['emb-run']:g} s, {LONGEST_OTHERS:g} s | "
        f"{faults} of {args.count * len(chosen)}; {longest.get(True, 0.0):.2f} s, {longest.get(False, 0.0):.2f} s |"
    )
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
