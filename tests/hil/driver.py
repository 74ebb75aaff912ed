"""Runs scenarios on vcan0, inside the kernel that has it: starts the processes, kills some, and keeps every frame.

Standard library only: what it captured is judged outside, by other means than those of the project.

    python driver.py PLAN.json OUT_DIR

PLAN is a list of scenarios: {"name", "node": [...], "run": [...], "kill": null | {"after": n, "signal": s,
"recorder": bool}, "linger": seconds}. For each it writes OUT_DIR/NAME.json: exit codes, outputs, and all frames as
[time, identifier, data in hex].
"""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

COMMAND = 0x80
FRAME = struct.Struct("=IB3x8s")
SO_RCVBUFFORCE, SO_TIMESTAMPNS, SO_RXQ_OVFL = 33, 35, 40


class Sniffer(threading.Thread):
    """Everything that is on the bus, by a socket of its own."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.frames: list[tuple[int, int, str]] = []
        self.enabled = 0
        self.dropped = 0
        self.over = False
        self.socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 16 << 20)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        self.socket.bind(("vcan0",))
        self.socket.settimeout(0.1)

    def run(self) -> None:
        while not self.over:
            try:
                raw, ancillary, _, _ = self.socket.recvmsg(FRAME.size, 128)
            except TimeoutError:
                continue
            time_ns = 0
            for _, kind, value in ancillary:
                if kind == SO_TIMESTAMPNS:
                    seconds, nanoseconds = struct.unpack("@ll", value)
                    time_ns = seconds * 1_000_000_000 + nanoseconds
                elif kind == SO_RXQ_OVFL:
                    self.dropped = struct.unpack("=I", value)[0]
            identifier, length, data = FRAME.unpack(raw)
            self.frames.append((time_ns, identifier, data[:length].hex()))
            if identifier == COMMAND and data[4] & 1:
                self.enabled += 1


def wait_until(condition: Any, seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.002)
    return True


def children(pid: int) -> list[int]:
    """Read from every process's parent: the User-Mode Linux kernel has no list of children."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        parent = int(stat.read_text().rpartition(")")[2].split()[1])
        if parent == pid:
            found.append(int(stat.parent.name))
    return found


def play(scenario: dict[str, Any]) -> dict[str, Any]:
    sniffer = Sniffer()
    sniffer.start()
    report: dict[str, Any] = {"name": scenario["name"]}
    node = None
    if scenario["node"]:
        node = subprocess.Popen(scenario["node"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        if not wait_until(lambda: len(sniffer.frames) > 20, 60):
            report["error"] = "the node sent nothing"
    run = subprocess.Popen(scenario["run"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    if kill := scenario["kill"]:
        if not wait_until(lambda: sniffer.enabled >= kill["after"] or run.poll() is not None, 90):
            report["error"] = "the run sent too few commands"
        if kill["recorder"]:
            report["killed"] = children(run.pid)
            for pid in report["killed"]:
                os.kill(pid, signal.SIGKILL)
        os.kill(run.pid, getattr(signal, kill["signal"]))
        report["kill_time_ns"] = time.time_ns()
    out, err = run.communicate(timeout=120)
    report["run"] = {"exit": run.returncode, "out": out, "err": err}
    time.sleep(scenario["linger"])
    if node is not None:
        node.send_signal(signal.SIGTERM)
        out, err = node.communicate(timeout=60)
        report["node"] = {"exit": node.returncode, "out": out, "err": err}
    sniffer.over = True
    sniffer.join()
    sniffer.socket.close()
    return report | {"frames": sniffer.frames, "dropped": sniffer.dropped}


def main() -> None:
    plan, out = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[2])
    for scenario in plan:
        (out / f"{scenario['name']}.json").write_text(json.dumps(play(scenario)))


if __name__ == "__main__":
    main()
