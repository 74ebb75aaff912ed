"""A socket that keeps every frame of a bus with the kernel's time stamp until it is read. Standard library only."""

from __future__ import annotations

import errno
import socket
import struct
import time
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
        filters = b"".join(struct.pack("=II", i, 0x1FFFFFFF | socket.CAN_EFF_FLAG) for i in identifiers)
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
