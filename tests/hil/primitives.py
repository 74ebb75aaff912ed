"""Brings every fault of :mod:`emb_bench.hil.faults` about, inside the kernel, and writes down what sockets saw.

    python primitives.py OUT.json WORD

The judgement is made outside. Waits for Ctrl-C at the end, and ends with status 7.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import struct
import sys
import time
from pathlib import Path
from typing import Any

from emb_bench.hil import faults, link
from emb_bench.hil.faults import Impairment, Route

FRAME = struct.Struct("=IB3x8s")
SO_RCVBUFFORCE, SO_TIMESTAMPNS, CAN_RAW_ERR_FILTER = 33, 35, 2
MANY = 400


def open_bus(name: str) -> socket.socket:
    """A socket that never waits, sees error frames and has room for all that a test sends."""
    bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    bus.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, 4 << 20)
    bus.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
    bus.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, struct.pack("=I", 0x1FFFFFFF))
    bus.bind((name,))
    bus.setblocking(False)
    return bus


def send(bus: socket.socket, number: int, identifier: int = 0x100) -> int:
    """When it was sent, in nanoseconds of the clock of the receiver's stamps."""
    now = time.time_ns()
    bus.send(FRAME.pack(identifier, 8, struct.pack("=Q", number)))
    return now


def received(bus: socket.socket) -> list[list[int]]:
    """All frames that wait: time in nanoseconds, identifier, number."""
    found: list[list[int]] = []
    while True:
        try:
            raw, ancillary, _, _ = bus.recvmsg(FRAME.size, 64)
        except BlockingIOError:
            return found
        seconds, nanoseconds = struct.unpack("@ll", ancillary[0][2])
        identifier, _, data = FRAME.unpack(raw)
        found.append([seconds * 1_000_000_000 + nanoseconds, identifier, *struct.unpack("=Q", data)])


def what_fails(action: Any, *arguments: Any) -> str:
    try:
        action(*arguments)
    except OSError as error:
        return errno.errorcode[error.errno or 0]
    return ""


def sent_and_seen(impairment: Impairment | None, count: int) -> dict[str, Any]:
    """One frame per millisecond on vcan0, from one socket to another."""
    with open_bus("vcan0") as sender, open_bus("vcan0") as listener:
        if impairment is not None:
            faults.impair("vcan0", impairment)
        sent = []
        for number in range(count):
            sent.append(send(sender, number))
            time.sleep(0.001)
        time.sleep(0.1)
        if impairment is not None:
            faults.heal("vcan0")
        return {"sent": sent, "seen": received(listener)}


def refused(name: str, to: str) -> dict[str, Any]:
    """A queue with room for four."""
    with open_bus(name) as sender, open_bus(to) as listener:
        faults.impair(name, Impairment(delay=0.02, limit=4))
        accepted = 0
        with contextlib.suppress(OSError):
            while True:
                send(sender, accepted)
                accepted += 1
        failure = what_fails(send, sender, 99)
        time.sleep(0.1)
        again = what_fails(send, sender, 100)
        time.sleep(0.1)
        faults.heal(name)
        seen = [number for _, _, number in received(listener)]
        return {"accepted": accepted, "failure": failure, "again": again, "seen": seen}


def seen_on_both(routes: list[Route]) -> dict[str, Any]:
    with contextlib.ExitStack() as stack:
        zero, at_zero, one, at_one = (
            stack.enter_context(open_bus(name)) for name in ("vcan0", "vcan0", "vcan1", "vcan1")
        )
        send(zero, 1, 0x100)
        send(zero, 2, 0x101)
        send(one, 3, 0x100)
        send(one, 4, 0x102)
        time.sleep(0.01)
        result: dict[str, Any] = {
            name: [[identifier, number] for _, identifier, number in received(bus)]
            for name, bus in (("vcan0", at_zero), ("vcan1", at_one))
        }
        for route in routes:
            faults.remove_route(route)
        send(zero, 5)
        time.sleep(0.01)
        return {**result, "after": len(received(at_one))}


def routed() -> dict[str, Any]:
    route = Route("vcan0", "vcan1", 0x100, xor=b"\xff\0\0\0\0\0\0\x01")
    faults.add_route(route)
    return seen_on_both([route])


def joined() -> dict[str, Any]:
    return seen_on_both(faults.join("vcan0", "vcan1", 0x100, b"\xff\0\0\0\0\0\0\0"))


def down_and_up(name: str, to: str) -> dict[str, Any]:
    with open_bus(name) as sender, open_bus(to) as listener:
        link.set_down(name)
        result: dict[str, Any] = {
            "first": what_fails(sender.recv, 16),
            "then": what_fails(sender.recv, 16),
            "send": what_fails(send, sender, 1),
            "other": what_fails(listener.recv, 16),
            "up": [link.is_up(name)],
        }
        link.set_up(name)
        result["up"].append(link.is_up(name))
        time.sleep(1.5)  # a controller's queue opens only then
        send(sender, 2)
        time.sleep(0.01)
        return {**result, "seen": [number for _, _, number in received(listener)]}


def controllers() -> dict[str, Any]:
    def says(name: str) -> list[Any]:
        status = link.controller(name)
        return [status.state.name, status.bitrate, status.transmit_errors, status.receive_errors]

    result: dict[str, Any] = {"at_start": [says("can0"), says("can1")]}
    with open_bus("can0") as zero, open_bus("can1") as one:
        for number in range(50):
            send(zero, number)
            time.sleep(0.001)
        result["seen"] = [number for _, _, number in received(one)]
    result["busy"] = what_fails(link.set_bitrate, "can1", 500_000)
    link.set_down("can1")
    link.set_bitrate("can1", 500_000)
    result["down"] = says("can1")
    link.set_up("can1")
    result["up"] = says("can1")
    return result


def bus_off() -> list[int]:
    with open_bus("vcan0") as listener:
        faults.report_bus_off("vcan0", off=True)
        faults.report_bus_off("vcan0", off=False)
        return [identifier for _, identifier, _ in received(listener)]


def disk() -> dict[str, Any]:
    directory = Path("/run/small")
    faults.small_disk(directory, 64 << 10)
    written = 0
    failure = ""
    with (directory / "file").open("wb", buffering=0) as file:
        while not failure:
            failure = what_fails(file.write, bytes(1024))
            written += 0 if failure else 1024
    faults.remove_disk(directory)
    return {"written": written, "failure": failure, "left": len(list(directory.iterdir()))}


def clock() -> list[float]:
    """What the time of day gained on the monotonic clock, after a step forward and one back."""
    gains = []
    begin = time.time() - time.monotonic()
    for step in (3600.0, -7200.0):
        faults.step_clock(step)
        gains.append(time.time() - time.monotonic() - begin)
    faults.step_clock(3600.0)
    return gains


def world() -> dict[str, Any]:
    outside = Path(os.environ["EMB_OUTSIDE"])
    outside.write_text("inside\n")
    return {
        "release": os.uname().release,
        "host": socket.gethostname(),
        "uid": os.getuid(),
        "cwd": str(Path.cwd()),
        "word": sys.argv[2],
        "env": os.environ["EMB_TEST"],
        "stdin": sys.stdin.read(),
        "outside": outside.read_text(),
        "time": time.time(),
    }


def main() -> None:
    sys.stdout.write("said\n")
    sys.stderr.write("complained\n")
    report = {
        "world": world(),
        "plain": sent_and_seen(None, 50),
        "delay": sent_and_seen(Impairment(delay=0.005), 50),
        "loss": sent_and_seen(Impairment(loss=0.3), MANY),
        "duplicate": sent_and_seen(Impairment(duplicate=0.3), MANY),
        "reorder": sent_and_seen(Impairment(delay=0.005, reorder=0.25), MANY),
        "jitter": sent_and_seen(Impairment(delay=0.005, jitter=0.004), MANY),
        "healed": sent_and_seen(None, 50),
        "refused": refused("vcan0", "vcan0"),
        "refused_by_controller": refused("can0", "can1"),
        "routed": routed(),
        "joined": joined(),
        "vcan0_down": down_and_up("vcan0", "vcan0"),
        "can0_down": down_and_up("can0", "can1"),
        "controllers": controllers(),
        "bus_off": bus_off(),
        "disk": disk(),
        "clock": clock(),
    }
    Path(sys.argv[1]).write_text(json.dumps(report))
    try:
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        time.sleep(1e6)
    except KeyboardInterrupt:
        sys.stdout.write("interrupted\n")
        sys.exit(7)


if __name__ == "__main__":
    main()
