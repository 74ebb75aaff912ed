"""Opening of the interface that a user names: SocketCAN, or a registered transport such as ``sim``."""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata
from pathlib import Path

from emb_runtime.can.transport import SocketCan, Transport
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError, UsageError, near
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES
from emb_runtime.system.clock import Clock, MonotonicClock

CAN = "280"  # Kind of a CAN interface in /sys/class/net
ENTRY_POINTS = "emb_runtime.transports"
"""Entry-point group of further transports: factories ``(options, bench) -> (transport, clock)``."""


def open_transport(iface: str, bench: Bench, identifiers: tuple[int, ...] | None = None) -> tuple[Transport, Clock]:
    """The transport that a user names, and the clock that its time stamps and deadlines are on.

    That is ``can0`` or ``vcan0`` for SocketCAN, which passes on these 11-bit ``identifiers`` only; or ``NAME`` or
    ``NAME:OPTIONS`` of a registered transport, ``sim`` among them.

    Raises:
        UsageError: no interface can have that name, or this system has no bus.
        BusError: it cannot be opened.
    """
    head, _, options = iface.partition(":")
    entries = metadata.entry_points(group=ENTRY_POINTS)
    for entry in entries:
        if entry.name == head:
            factory: Callable[[str, Bench], tuple[Transport, Clock]] = entry.load()
            return factory(options, bench)
    there = [kind.parent.name for kind in Path("/sys/class/net").glob("*/type") if kind.read_text().strip() == CAN]
    hint = "" if head in there else near(head, [*entries.names, *there])
    if not iface or ":" in iface:
        raise UsageError(f"--iface '{iface}': expected a SocketCAN interface (can0, vcan0), or sim{hint}")
    if not HAS_CHILD_PROCESSES:
        raise UsageError(f"--iface {iface}: a bus needs Linux, for the processes that watch and record; sim does not")
    clock = MonotonicClock()
    try:
        return SocketCan(iface, clock, identifiers), clock
    except BusError as err:
        raise BusError(f"{err}{hint}") from err
