"""Opening of the interface that a user names: SocketCAN, a registered transport such as ``sim``, or python-can."""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata

from emb_runtime.can.python_can import PythonCan
from emb_runtime.can.transport import SocketCan, Transport
from emb_runtime.config.bench import Bench
from emb_runtime.errors import UsageError
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES
from emb_runtime.system.clock import Clock, MonotonicClock

ENTRY_POINTS = "emb_runtime.transports"
"""Entry-point group of further transports: factories ``(options, bench) -> (transport, clock)``."""


def open_transport(iface: str, bench: Bench, identifiers: tuple[int, ...] | None = None) -> tuple[Transport, Clock]:
    """The transport that a user names, and the clock that its time stamps and deadlines are on.

    Args:
        iface: ``can0`` or ``vcan0`` for SocketCAN; ``NAME`` or ``NAME:OPTIONS`` of a registered transport, ``sim``
            among them; ``BACKEND:CHANNEL`` for python-can.
        bench: handed to registered transports; its bitrate to python-can.
        identifiers: the only 11-bit identifiers that a SocketCAN socket should pass on; None for all frames, empty for
            none.

    Raises:
        UsageError: there is no such backend.
        BusError: it cannot be opened.
    """
    head, separator, tail = iface.partition(":")
    for entry in metadata.entry_points(group=ENTRY_POINTS):
        if entry.name == head:
            factory: Callable[[str, Bench], tuple[Transport, Clock]] = entry.load()
            return factory(tail, bench)
    if not iface or (separator and not (head and tail)):
        raise UsageError(f"--iface '{iface}': expected INTERFACE (vcan0), sim, or BACKEND:CHANNEL (virtual:test)")
    require_linux(iface)
    clock = MonotonicClock()
    if separator and head != "socketcan":
        return PythonCan(head, tail, bench.can.bitrate, clock), clock
    # python-can's own SocketCAN backend cannot tell our echo from a frame of another process on this host.
    return SocketCan(tail or head, clock, identifiers), clock


def same_bus(one: str, other: str) -> bool:
    """Returns True if two names open the same bus: SocketCAN needs no prefix."""
    return one.removeprefix("socketcan:") == other.removeprefix("socketcan:")


def require_linux(iface: str) -> None:
    """Refuse a bus on another system.

    Raises:
        UsageError: this is one.
    """
    if not HAS_CHILD_PROCESSES:
        raise UsageError(f"--iface {iface}: a bus needs Linux, for the processes that watch and record; sim does not")
