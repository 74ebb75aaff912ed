"""The lying node on a SocketCAN bus, with a clock of its own: ``main(["--iface", "vcan0", "--identity", ...])``.

Standard library only. At the end, on SIGTERM, it prints what was true as JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import struct
import sys
import time

from tests.lying.node import COMMAND, PERIOD_NS, Lie, LyingNode

FRAME = struct.Struct("=IB3x8s")
PRIORITY = 75  # Real-time priority, above the run's: a real node's clock waits for no computer


def main(argv: list[str]) -> int:
    """Run until SIGTERM; 0."""
    p = argparse.ArgumentParser()
    p.add_argument("--iface", required=True)
    p.add_argument("--identity", type=int, required=True, help="of the bench, 16 bits")
    p.add_argument("--lie", type=json.loads, default={}, help="fields of Lie, as JSON")
    args = p.parse_args(argv)
    node = LyingNode(args.identity, Lie(**args.lie))
    ended = False

    def end(_signal: int, _frame: object) -> None:
        nonlocal ended
        ended = True

    signal.signal(signal.SIGTERM, end)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as bus:
        bus.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, struct.pack("=II", COMMAND, 0x7FF))
        bus.bind((args.iface,))
        bus.setblocking(False)
        sys.stderr.write(f"lying node: on {args.iface}\n")
        sys.stderr.flush()
        due_ns = time.monotonic_ns() + PERIOD_NS
        while not ended:
            while (now_ns := time.monotonic_ns()) < due_ns:
                time.sleep((due_ns - now_ns) * 1e-9)
            skipped = (now_ns - due_ns) // PERIOD_NS
            with contextlib.suppress(BlockingIOError):
                while True:
                    identifier, length, data = FRAME.unpack(bus.recv(FRAME.size))
                    node.receive(identifier, data[:length])
            for identifier, data in node.tick(skipped):
                bus.send(FRAME.pack(identifier, len(data), data))
            due_ns += (skipped + 1) * PERIOD_NS
    detected = None if node.began is None or node.stopped is None else node.stopped - node.began
    told = {
        "angle_min": node.lowest,
        "angle_max": node.highest,
        "top_speed": node.fastest,
        "obeyed": node.obeyed,
        "began": node.began,
        "stopped": node.stopped,
        "detected_ms": detected,
    }
    sys.stdout.write(json.dumps(told) + "\n")
    return 0
