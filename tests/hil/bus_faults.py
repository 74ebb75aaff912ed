"""Faults of a bus, caused on purpose inside a kernel of our own (``emb-hil --uml --root``).

Each function acts at once, by a system call or a request to the kernel; no program is started, nothing is read from
disk: a loop under test loses microseconds at most. All need root. ``link.set_up`` completes the set.

Source of the message layouts: tc-netem(8), the kernel's ``linux/pkt_sched.h``, ``linux/can/gw.h``,
``linux/can/error.h``.
"""

from __future__ import annotations

import ctypes
import os
import socket
import struct
import time
from dataclasses import dataclass
from pathlib import Path

from tests.hil.link import CREATE, REPLACE, attribute, request

_RTM_NEWROUTE, _RTM_DELROUTE, _RTM_NEWQDISC, _RTM_DELQDISC = 24, 25, 36, 37

_TCMSG = struct.Struct("=B3xiIII")
_ROOT = 0xFFFFFFFF
_TCA_KIND, _TCA_OPTIONS = 1, 2
_NETEM = struct.Struct("=6I")  # struct tc_netem_qopt: latency, limit, loss, gap, duplicate, jitter
_NETEM_REORDER, _NETEM_LATENCY64 = 3, 10

_RTCANMSG = struct.Struct("=BBH")
_GATEWAY, _ECHO = 1, 1
_CGW_XOR, _CGW_SOURCE, _CGW_DESTINATION, _CGW_FILTER = 3, 9, 10, 11
_MODIFY_DATA = 4
_CAN_FRAME = struct.Struct("=IB3x8s")
_EXACT = 0x7FF | 0xC0000000  # the whole identifier, no extended and no remote frame
_INVERTED = 0x20000000  # CAN_INV_FILTER: every frame but these
_ERROR_FRAME, _ERROR_BUS_OFF, _ERROR_RESTARTED = 0x20000000, 0x40, 0x100

_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Impairment:
    """Impairment of the frames that are sent on a bus; probabilities 0..1, of each frame for itself."""

    delay: float = 0.0  # s
    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0  # of not being delayed, and so overtaking what waits; needs a delay
    limit: int = 1000  # frames that may wait; one more gets ENOBUFS


def impair(interface: str, impairment: Impairment) -> None:
    """Give an interface this impairment, in place of any that it had. A vcan must have been loaded with ``echo=1``."""
    if impairment.reorder and not impairment.delay:
        raise ValueError("a frame overtakes others only where these are delayed: give a delay too")
    head = _NETEM.pack(
        0, impairment.limit, _share(impairment.loss), 1 if impairment.reorder else 0, _share(impairment.duplicate), 0
    )
    options = attribute(_NETEM_LATENCY64, struct.pack("=q", round(impairment.delay * 1e9))) + attribute(
        _NETEM_REORDER, struct.pack("=II", _share(impairment.reorder), 0)
    )
    kind = attribute(_TCA_KIND, b"netem\0")
    _qdisc(_RTM_NEWQDISC, CREATE | REPLACE, interface, kind + attribute(_TCA_OPTIONS, head + options))


def clear_netem(interface: str) -> None:
    """Take the impairment away; frames that wait in it are lost."""
    _qdisc(_RTM_DELQDISC, 0, interface, b"")


def _share(probability: float) -> int:
    """A probability as the kernel has it: in parts of 2**32 - 1."""
    return round(probability * 0xFFFFFFFF)


def _qdisc(kind: int, flags: int, interface: str, attached: bytes) -> None:
    body = _TCMSG.pack(socket.AF_UNSPEC, socket.if_nametoindex(interface), 0, _ROOT, 0)
    request(kind, flags, body + attached)


@dataclass(frozen=True)
class Route:
    """Frames that the kernel hands on from one bus to another; what it sends there is seen there as any frame."""

    source: str
    destination: str
    identifier: int
    others: bool = False  # every frame but those with this identifier
    xor: bytes = b""  # 8 bytes that are laid over the data


def add_route(route: Route) -> None:
    """Hand frames on from now on. A frame is handed on once: two buses may be joined in both directions."""
    _route(_RTM_NEWROUTE, route)


def remove_route(route: Route) -> None:
    """Stop handing these frames on."""
    _route(_RTM_DELROUTE, route)


def bridge(one: str, other: str, identifier: int, xor: bytes) -> list[Route]:
    """Make one bus of two, on which frames with ``identifier`` arrive corrupted on the other side."""
    routes = [
        Route(source, destination, identifier, others, b"" if others else xor)
        for source, destination in ((one, other), (other, one))
        for others in (False, True)
    ]
    for route in routes:
        add_route(route)
    return routes


def _route(kind: int, route: Route) -> None:
    identifier = route.identifier | (_INVERTED if route.others else 0)
    body = _RTCANMSG.pack(socket.AF_CAN, _GATEWAY, _ECHO)
    if route.xor:
        body += attribute(_CGW_XOR, _CAN_FRAME.pack(0, 0, route.xor) + bytes([_MODIFY_DATA]))
    body += attribute(_CGW_FILTER, struct.pack("=II", identifier, _EXACT))
    for side, name in ((_CGW_SOURCE, route.source), (_CGW_DESTINATION, route.destination)):
        body += attribute(side, struct.pack("=I", socket.if_nametoindex(name)))
    request(kind, 0, body)


def report_bus_off(interface: str, off: bool) -> None:
    """Send the error frame with which a controller reports that it went bus-off, or that it recovered.

    It reaches every socket that subscribed to error frames; the interface itself goes on as before.
    """
    what = _ERROR_FRAME | (_ERROR_BUS_OFF if off else _ERROR_RESTARTED)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sock:
        sock.bind((interface,))
        sock.send(_CAN_FRAME.pack(what, 8, bytes(8)))


def step_clock(seconds: float) -> None:
    """Set the time of day that much later (earlier where negative); the monotonic clock goes on."""
    now = time.clock_gettime_ns(time.CLOCK_REALTIME)
    time.clock_settime_ns(time.CLOCK_REALTIME, now + round(seconds * 1e9))


def small_disk(directory: Path, size: int) -> None:
    """Make ``directory`` a file system in memory with room for ``size`` bytes, rounded up to whole pages."""
    directory.mkdir(parents=True, exist_ok=True)
    if _libc.mount(b"tmpfs", os.fsencode(directory), b"tmpfs", 0, f"size={size}".encode()) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()), str(directory))
