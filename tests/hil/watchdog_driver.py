"""Plays what a watchdog is for on vcan0: a loop that is stopped, killed or hung, and a watchdog that is.

    python -m tests.hil.watchdog_driver PLAN.json OUT_DIR

PLAN is a list of scenarios: {"name", "node": [...], "run": [...], "log", "do"}, where "do" is what happens when the run
has begun: "stop" or "kill" it, "stop watchdog" or "kill watchdog", or "wait" for what it does to itself. For each it
writes OUT_DIR/NAME.json: exit codes, outputs, when the run could go on (Unix time), and all frames.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.hil.driver import COMMAND, open_socket, read, wait_until

AFTER = 5  # Enabled commands after which the run counts as begun
STOP_FRAMES = 3
PATIENCE = 120.0
LINGER = 0.5  # For what must not come any more [s]


def play(scenario: dict[str, Any]) -> dict[str, Any]:
    everything, commands = open_socket([]), open_socket([COMMAND])
    enables: list[int] = []

    def listen() -> list[int]:
        enables.extend(int(data[8:10], 16) & 1 for _, _, data in read(commands)[0])
        return enables

    report: dict[str, Any] = {"name": scenario["name"]}
    node = subprocess.Popen(scenario["node"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert node.stderr is not None
    report["ready"] = node.stderr.readline()
    run = subprocess.Popen(scenario["run"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: sum(listen()) >= AFTER or run.poll() is not None, PATIENCE)
    watchdogs = watching()
    if watchdogs and run.poll() is None and sum(enables) >= AFTER:
        do(scenario["do"], run, watchdogs[0], report, listen)
    else:
        report["error"] = "the run did not begin"
        run.kill()
    result, err = run.communicate(timeout=PATIENCE)
    report["run"] = {"exit": run.returncode, "out": result, "err": err}
    time.sleep(LINGER)
    report["watchdog ended"] = wait_until(lambda: not watching(), PATIENCE)
    node.send_signal(signal.SIGTERM)
    result, err = node.communicate(timeout=PATIENCE)
    report["node"] = {"exit": node.returncode, "out": result, "err": err}
    report["frames"], report["dropped"] = read(everything)
    everything.close()
    commands.close()
    return report


def do(
    what: str, run: subprocess.Popen[str], watchdog: int, report: dict[str, Any], listen: Callable[[], list[int]]
) -> None:
    """Do it, wait for the stop frames, and let a loop that was only stopped go on."""
    victim = watchdog if what.endswith("watchdog") else run.pid
    if what != "wait":
        os.kill(victim, {"stop": signal.SIGSTOP, "kill": signal.SIGKILL}[what.split()[0]])
    wait_until(lambda: listen().count(0) >= STOP_FRAMES or run.poll() is not None, PATIENCE)
    if what == "wait":
        run.send_signal(signal.SIGSTOP)  # it may be computing, and in a slow kernel only idle time is skipped
    time.sleep(LINGER)
    report["resumed_ns"] = time.time_ns()
    if what == "stop":
        run.send_signal(signal.SIGCONT)
    if what == "wait":
        run.kill()  # it would never end


def watching() -> list[int]:
    """Process ids of all watchdogs that have not ended."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            if b"emb_runtime.safety.watchdog_process" in entry.read_bytes().split(
                b"\0"
            ):  # an ended one has no words left
                found.append(int(entry.parent.name))
    return found


def main() -> None:
    plan, out = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    for scenario in plan:
        report = play(scenario)
        # Written in memory: a write to the host's files holds up the whole User-Mode Linux kernel.
        log = Path(scenario["log"])
        if log.exists():
            shutil.move(log, out / log.name)
        (out / f"{scenario['name']}.json").write_text(json.dumps(report))


if __name__ == "__main__":
    main()
