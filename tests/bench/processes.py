"""Commands in processes of their own, and what lives of their process groups and sessions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

WAIT = 150.0  # s; most that a test waits for a process


def processes(leader: int) -> dict[int, str]:
    """Living processes of a group or session, with their command lines."""
    found = {}
    for entry in Path("/proc").iterdir():
        try:
            state, _, *of = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
            if entry.name.isdecimal() and str(leader) in of and state != "Z":
                found[int(entry.name)] = (entry / "cmdline").read_text().replace("\0", " ")
        except (OSError, ValueError):
            continue
    return found


def emb_replay(*arguments: str) -> list[str]:
    """The command line of the command, as its entry point starts it."""
    start = "import sys; from emb_bench.cli.entry import emb_replay; sys.exit(emb_replay())"
    return [sys.executable, "-c", start, *arguments]


def started(command: list[str]) -> subprocess.Popen[str]:
    """The command, running, in a process group of its own."""
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, process_group=0)


def press_ctrl_c(running: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Interrupt the group, as a terminal does; exit code, what was on standard output, what was still on the other."""
    os.killpg(running.pid, signal.SIGINT)
    out, err = running.communicate(timeout=WAIT)
    return running.returncode, out, err


def left_of(leader: int) -> dict[int, str]:
    """Processes of a group or session that do not end."""
    gone_by = time.monotonic() + WAIT
    while processes(leader) and time.monotonic() < gone_by:
        time.sleep(0.05)
    return processes(leader)


def wait_until_gone(pid: int) -> None:
    """Wait until a process has ended, reaped or not."""
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except FileNotFoundError:
            return
        if state == "Z":
            return
        time.sleep(0.01)
    pytest.fail(f"process {pid} is still there")
