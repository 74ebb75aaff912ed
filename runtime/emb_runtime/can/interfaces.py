"""Opening of the interface that a user names: SocketCAN, a registered transport such as ``sim``, or python-can's."""

from __future__ import annotations

import errno
from collections import deque
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import TYPE_CHECKING

from emb_runtime.can.transport import STEP_SLACK_NS, SocketCan, TransmitQueueFullError, Transport
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError, UsageError
from emb_runtime.records import Frame
from emb_runtime.system.child_process import HAS_CHILD_PROCESSES
from emb_runtime.system.clock import Clock, MonotonicClock

if TYPE_CHECKING:
    import can

ENTRY_POINTS = "emb_runtime.transports"
"""Entry-point group of further transports: factories ``(options, bench) -> (transport, clock)``."""

GIVES_BACK = ("udp_multicast",)
"""Backends that give a sender its own frames back, whatever they are asked, and do not mark them."""
_MOST_COPIES = 64  # frames that are waited for; a backend that loses one gives it back never
_STAMP_SLACK_NS = 50_000  # what floating-point seconds and two readings of the wall clock may be apart


def open_transport(
    iface: str, bench: Bench, identifiers: tuple[int, ...] | None = None, bitrate: int | None = None
) -> tuple[Transport, Clock]:
    """The transport that a user names, and the clock that its time stamps and deadlines are on.

    Args:
        iface: ``can0`` or ``vcan0`` for SocketCAN; ``NAME`` or ``NAME:OPTIONS`` of a registered transport, ``sim``
            among them; ``BACKEND:CHANNEL`` for python-can.
        bench: handed to registered transports.
        identifiers: the only 11-bit identifiers that a SocketCAN socket should pass on; None for all frames.
        bitrate: for backends of python-can that set it [bit/s]; None for the bench's.

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
        return PythonCan(head, tail, bitrate or bench.can.bitrate, clock), clock
    # python-can's own SocketCAN backend cannot tell our echo from a frame of another process on this host.
    return SocketCan(tail or head, clock, identifiers), clock


def same_bus(one: str, other: str) -> bool:
    """Returns True if two names open the same bus: SocketCAN needs no prefix."""
    return one.removeprefix("socketcan:") == other.removeprefix("socketcan:")


def require_linux(iface: str) -> None:
    """Refuse a bus on another system."""
    if not HAS_CHILD_PROCESSES:
        raise UsageError(f"--iface {iface}: a bus needs Linux, for the processes that watch and record; sim does not")


class PythonCan:
    """Any python-can backend: the in-process ``virtual`` bus, vendor adapters. Slower than a raw socket.

    The adapter's time stamps are used while they are consistent with our clock: monotonic, not in the future, not
    before an empty poll. Else a frame has the time of its reading, until one that was waited for is stamped right.
    """

    truth = None
    obtained: Mapping[str, str] = {}

    def __init__(self, backend: str, channel: str, bitrate: int, clock: Clock) -> None:
        """Open a channel of a backend, both by python-can's names; the bitrate is for backends that set it."""
        import can  # a quarter of a second that a raw socket does not need

        self.name = f"{backend}:{channel}"
        self._clock = clock
        if backend not in can.VALID_INTERFACES:
            known = ", ".join(sorted(can.VALID_INTERFACES))
            raise UsageError(f"{self.name}: python-can has no backend '{backend}'; it has: {known}")
        try:
            self._bus: can.BusABC = can.Bus(
                interface=backend, channel=channel, ignore_config=True, receive_own_messages=False, bitrate=bitrate
            )
        except Exception as err:  # what a vendor's driver raises when it is not there is anybody's guess
            raise BusError(f"{self.name}: python-can cannot open it: {err}") from err
        self._wall_offset_ns = clock.wall_offset_ns()
        self._stamps_count = True
        self._latest_ns = clock.now_ns()
        # Not every backend gives back what it sent, so the echo is made here, when the backend has taken the frame.
        self._echoes: deque[Frame] = deque()
        self._gives_back = backend in GIVES_BACK
        self._copies: deque[tuple[int, bytes, bool, bool]] = deque(maxlen=_MOST_COPIES)

    def send(self, frame: Frame) -> None:
        """See :meth:`Transport.send`."""
        import can

        message = can.Message(
            arbitration_id=frame.identifier,
            data=frame.data,
            is_extended_id=frame.extended,
            is_remote_frame=frame.remote,
        )
        try:
            self._bus.send(message)
        except (can.CanError, OSError) as err:
            if getattr(err, "error_code", None) in (errno.ENOBUFS, errno.EAGAIN):
                raise TransmitQueueFullError(
                    f"{self.name}: transmit queue full, frame {frame.identifier:#05x} dropped"
                ) from err
            raise BusError(f"{self.name}: cannot send: {err}") from err
        self._echoes.append(frame._replace(time_ns=self._clock.now_ns(), own=True))
        if self._gives_back:
            self._copies.append((frame.identifier, frame.data, frame.extended, frame.remote))

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`Transport.receive`."""
        import can

        if self._echoes:
            return self._echoes.popleft()
        while True:
            asked_ns = None
            try:
                if (message := self._bus.recv(0.0)) is None:
                    asked_ns = self._clock.now_ns()
                    if deadline_ns <= asked_ns or (message := self._bus.recv((deadline_ns - asked_ns) * 1e-9)) is None:
                        return None
            except (can.CanError, OSError) as err:
                raise BusError(f"{self.name}: cannot receive: {err}") from err
            if not self._is_copy(message):
                return self._frame(message, asked_ns)

    def _is_copy(self, message: can.Message) -> bool:
        """Returns True for a frame that this bus sent and its backend gives back; of each one copy."""
        copy = (message.arbitration_id, bytes(message.data), message.is_extended_id, message.is_remote_frame)
        if copy not in self._copies:
            return False
        self._copies.remove(copy)
        return True

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self._bus.shutdown()

    def _frame(self, message: can.Message, asked_ns: int | None) -> Frame:
        return Frame(
            identifier=message.arbitration_id,
            data=b"" if message.is_remote_frame else bytes(message.data),
            time_ns=self._arrival(round(message.timestamp * 1e9), asked_ns),
            extended=message.is_extended_id,
            remote=message.is_remote_frame,
            error=message.is_error_frame,
        )

    def _arrival(self, stamp_ns: int, asked_ns: int | None) -> int:
        """Arrival time of a frame, monotonic [ns]; ``asked_ns`` is a time when none had come yet, if known."""
        now_ns = self._clock.now_ns()
        time_ns = stamp_ns - self._wall_offset_ns
        if not self._latest_ns - STEP_SLACK_NS <= time_ns <= now_ns + STEP_SLACK_NS:
            self._wall_offset_ns = self._clock.wall_offset_ns()  # it may have stepped
            time_ns = stamp_ns - self._wall_offset_ns
        if not self._latest_ns - STEP_SLACK_NS <= time_ns <= now_ns + STEP_SLACK_NS:
            self._stamps_count = False
        elif asked_ns is not None:
            self._stamps_count = time_ns >= asked_ns - _STAMP_SLACK_NS
        self._latest_ns = max(self._latest_ns, min(time_ns, now_ns)) if self._stamps_count else now_ns
        return self._latest_ns
