"""A bus without a kernel that has CAN: a pair of local sockets that carry ``struct can_frame``.

One end is the loop's, with its own SocketCAN class on it; at the other one the simulated brake runs in a process of its
own, at 1 kHz by its own clock. A real bus gives the sender an echo; here the node sends it, marked in a byte that
SocketCAN leaves unused, and the reading end turns the mark into the kernel's flag.
"""

from __future__ import annotations

import multiprocessing
import socket
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from emb_bench.cli.node import run_node
from emb_bench.sim.node import BrakeNode
from emb_bench.sim.simulated_brake import gaussian_noise
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import SocketCan, TransmitQueueFullError
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.records import Frame
from emb_runtime.system import realtime
from emb_runtime.system.clock import Clock, MonotonicClock

_FRAME = struct.Struct("=IBB2x8s")  # can_id, length, __pad, data
_PAD_AT = 5
_MARK = 1


class _LocalSocket(socket.socket):
    """A local socket that takes the options of a CAN socket and forgets them."""

    def setsockopt(self, level: int, option: int, value: Any) -> None:  # type: ignore[override]
        if level != socket.SOL_CAN_RAW:
            super().setsockopt(level, option, value)

    def bind(self, address: Any) -> None:
        """It is connected already."""

    def recvmsg(self, *arguments: int) -> Any:
        """A frame; a marked one is an echo."""
        data, control, flags, sender = super().recvmsg(*arguments)
        return data, control, socket.MSG_CONFIRM if data[_PAD_AT] == _MARK else flags, sender


def local_bus(end: socket.socket, clock: Clock) -> SocketCan:
    """The project's SocketCAN class on one end of a pair, without what was sent before: a bus keeps nothing."""
    with suppress(BlockingIOError):
        while end.recv(64, socket.MSG_DONTWAIT):
            pass
    return SocketCan(
        "pair",
        clock,
        open_socket=lambda: _LocalSocket(fileno=end.detach()),
    )


class _NodesEnd:
    """The node's transport: echoes what it receives, and drops what the other end has no room for."""

    name, truth = "pair", None
    obtained: Mapping[str, str] = {}

    def __init__(self, end: socket.socket, clock: Clock) -> None:
        self._echo = end.dup().send
        self._bus = local_bus(end, clock)

    def send(self, frame: Frame) -> None:
        """Drops, as a bus does, what nobody reads."""
        with suppress(TransmitQueueFullError):
            self._bus.send(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        """A frame, whose sender gets its echo."""
        frame = self._bus.receive(deadline_ns)
        if frame is not None:
            with suppress(BlockingIOError):
                self._echo(_FRAME.pack(frame.identifier, len(frame.data), _MARK, frame.data))
        return frame

    def close(self) -> None:
        """Give the socket back."""
        self._bus.close()


def _serve(end: socket.socket, bench: Bench, ready: Any, stop: Any) -> None:
    clock = MonotonicClock()
    transport = _NodesEnd(end, clock)
    node = BrakeNode(bench, load_layout(), bench.brake, gaussian_noise(bench.noise, 1))
    realtime.obtain()
    ready.set()
    with suppress(BusError):  # the other end was closed: that is how it ends
        run_node(node, transport, clock, bench.timing.sample_time_ns, None, stop.is_set)


@contextmanager
def node_on_a_pair(bench: Bench) -> Iterator[socket.socket]:
    """The loop's end of a pair whose other end has a simulated brake on it, in real time."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    ready, stop = context.Event(), context.Event()
    process = context.Process(target=_serve, args=(theirs, bench, ready, stop))
    process.start()
    theirs.close()
    try:
        if not ready.wait(60.0):
            raise RuntimeError("the node did not start within a minute")
        yield ours
    finally:
        stop.set()
        process.join(10.0)
        process.kill()
        ours.close()
