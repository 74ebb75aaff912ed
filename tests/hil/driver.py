"""Runs scenarios on vcan0, inside the kernel that has it: starts the processes, kills some, and keeps every frame.

Standard library only: what it captured is judged outside, by other means than those of the project.

    python driver.py PLAN.json OUT_DIR

PLAN is a list of scenarios: {"name", "node": [...], "run": [...], "log", "kill": null | {"after": n, "signal": s,
"recorder": bool}, "linger": seconds}. For each it writes OUT_DIR/NAME.json: exit codes, outputs, and all frames as
[time, identifier, data in hex].
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

COMMAND = 0x80
FRAME = struct.Struct("=IB3x8s")
SO_RCVBUFFORCE, SO_TIMESTAMPNS, SO_RXQ_OVFL = 33, 35, 40


def open_socket(identifiers: list[int], interface: str = "vcan0") -> socket.socket:
    """A socket that keeps everything (or only some identifiers) until it is read."""
    sniffer = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    sniffer.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 128 << 20)
    sniffer.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    sniffer.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
    if identifiers:
        filters = b"".join(struct.pack("=II", identifier, 0x7FF) for identifier in identifiers)
        sniffer.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
    sniffer.bind((interface,))
    sniffer.setblocking(False)
    return sniffer


def read(sniffer: socket.socket) -> tuple[list[tuple[int, int, str]], int]:
    """All frames that wait, and how many the kernel had no room for.

    Nothing reads while the bus is busy: on this kernel's one processor the reader would slow down what it watches.
    """
    frames: list[tuple[int, int, str]] = []
    dropped = 0
    while True:
        try:
            raw, ancillary, _, _ = sniffer.recvmsg(FRAME.size, 128)
        except BlockingIOError:
            return frames, dropped
        except OSError as err:
            if err.errno != errno.ENETDOWN:  # told once: what was received before and after is still there
                raise
            continue
        time_ns = 0
        for _, kind, value in ancillary:
            if kind == SO_TIMESTAMPNS:
                seconds, nanoseconds = struct.unpack("@ll", value)
                time_ns = seconds * 1_000_000_000 + nanoseconds
            elif kind == SO_RXQ_OVFL:
                dropped = struct.unpack("=I", value)[0]
        identifier, length, data = FRAME.unpack(raw)
        frames.append((time_ns, identifier, data[:length].hex()))


def wait_until(condition: Any, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.02)
    return True


def children(pid: int) -> list[int]:
    """Read from every process's parent: the User-Mode Linux kernel has no list of children."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            if parent == pid:
                found.append(int(stat.parent.name))
    return found


def play(scenario: dict[str, Any], out: Path) -> dict[str, Any]:
    everything, commands = open_socket([]), open_socket([COMMAND])
    enabled = 0

    def sent(count: int) -> bool:
        nonlocal enabled
        enabled += sum(int(data[8:10], 16) & 1 for _, _, data in read(commands)[0])
        return enabled >= count

    report: dict[str, Any] = {"name": scenario["name"]}
    node = None
    if scenario["node"]:
        node = subprocess.Popen(scenario["node"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert node.stderr is not None
        report["ready"] = node.stderr.readline()  # it says so when it is on the bus
    run = subprocess.Popen(scenario["run"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if kill := scenario["kill"]:
        if not wait_until(lambda: sent(kill["after"]) or run.poll() is not None, 60):
            report["error"] = "the run sent too few commands"
        if kill["recorder"]:
            report["killed"] = children(run.pid)
            for pid in report["killed"]:
                os.kill(pid, signal.SIGKILL)
        run.send_signal(getattr(signal, kill["signal"]))
        report["kill_time_ns"] = time.time_ns()
    result, err = run.communicate(timeout=120)
    report["run"] = {"exit": run.returncode, "out": result, "err": err}
    time.sleep(scenario["linger"])
    if node is not None:
        node.send_signal(signal.SIGTERM)
        result, err = node.communicate(timeout=60)
        report["node"] = {"exit": node.returncode, "out": result, "err": err}
    report["frames"], report["dropped"] = read(everything)
    # Written in memory: a write to the host's files holds up the whole User-Mode Linux kernel.
    shutil.move(scenario["log"], out / f"{scenario['name']}.mcap")
    everything.close()
    commands.close()
    return report


def main() -> None:
    plan, out = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    for scenario in plan:
        (out / f"{scenario['name']}.json").write_text(json.dumps(play(scenario, out)))


if __name__ == "__main__":
    main()
