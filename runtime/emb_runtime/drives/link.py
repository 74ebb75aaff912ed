"""The way between a loop, its watchdog and the process of the software node: frames as packets of a UNIX socket.

A packet is a frame of ours, a frame of the drive's bus for the log, or a line of JSON. Whoever ends closes its end, and
the other side sees that.
"""

from __future__ import annotations

import json
import select
import socket
import struct
from collections import deque
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

from emb_runtime.can.transport import TransmitQueueFullError
from emb_runtime.config.bench import Bench
from emb_runtime.errors import BusError
from emb_runtime.records import Frame
from emb_runtime.system.clock import Clock, MonotonicClock

_FRAME = struct.Struct("<BqIBBQ8s")
LONGEST_PACKET = 4096
BUFFER = 1 << 20  # Bytes that wait at most: about a second of both buses


class Kind(IntEnum):
    """First byte of a packet."""

    OURS = 1  # A frame of ours
    DRIVE = 2  # A frame of the drive's bus
    DOCUMENT = 3  # A JSON document


Packet = Frame | dict[str, Any]


def link_pair() -> tuple[socket.socket, socket.socket]:
    """Two ends of a new link."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
    return ends


def pack_frame(frame: Frame, kind: Kind) -> bytes:
    """A frame as a packet."""
    identifier, data, time_ns, extended, remote, error, own, dropped = frame
    flags = extended | remote << 1 | error << 2 | own << 3
    return _FRAME.pack(kind, time_ns, identifier, flags, len(data), dropped, data)


def pack_document(document: Mapping[str, Any]) -> bytes:
    """A document as a packet."""
    return bytes((Kind.DOCUMENT,)) + json.dumps(dict(document)).encode()


def unpack(packet: bytes) -> tuple[Kind, Packet]:
    """Kind and content of a packet.

    Raises:
        ValueError: it is none of ours.
    """
    kind = Kind(packet[0])
    if kind is Kind.DOCUMENT:
        document = json.loads(packet[1:])
        if not isinstance(document, dict):
            raise ValueError("expected a JSON object")
        return kind, document
    try:
        _, time_ns, identifier, flags, length, dropped, data = _FRAME.unpack(packet)
    except struct.error as err:
        raise ValueError(str(err)) from err
    extended, remote, error, own = (bool(flags & 1 << i) for i in range(4))
    return kind, Frame(identifier, data[:length], time_ns, extended, remote, error, own, dropped)


def read_packets(end: socket.socket) -> tuple[list[bytes], bool]:
    """All packets that wait at an end, and whether the other end is closed."""
    packets: list[bytes] = []
    try:
        while packet := end.recv(LONGEST_PACKET):
            packets.append(packet)
    except BlockingIOError:
        return packets, False
    except OSError:
        pass
    return packets, True


class LinkTransport:
    """An end of a link, as a transport of our frames. It gives its own echo.

    Args:
        end: of the link.
        clock: of this computer.
        name: for messages.
    """

    truth = None
    obtained: Mapping[str, str] = {}

    def __init__(self, end: socket.socket, clock: Clock, name: str) -> None:
        self.name = name
        self._end = end
        self._clock = clock
        self._frames: deque[Frame] = deque()

    def send(self, frame: Frame) -> None:
        """See :meth:`emb_runtime.can.transport.Transport.send`."""
        self.tell(pack_frame(frame, Kind.OURS))
        self._frames.append(frame._replace(time_ns=self._clock.now_ns(), own=True))

    def tell(self, packet: bytes) -> None:
        """Hand over a packet.

        Raises:
            TransmitQueueFullError: the node does not read.
            BusError: it has ended.
        """
        try:
            self._end.send(packet)
        except BlockingIOError as err:
            raise TransmitQueueFullError(f"{self.name}: the drive's node does not read, frame dropped") from err
        except OSError as err:
            raise BusError(f"{self.name}: the drive's node has ended: {err.strerror}") from err

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`emb_runtime.can.transport.Transport.receive`."""
        while not self._frames:
            now_ns = self._clock.now_ns()
            if not select.select([self._end], [], [], max(0.0, (deadline_ns - now_ns) * 1e-9))[0]:
                return None
            packets, closed = read_packets(self._end)
            for packet in packets:
                self._take(*unpack(packet))
            if closed and not self._frames:
                raise BusError(f"{self.name}: the drive's node has ended; the drive lets go by its own time-out")
        return self._frames.popleft()

    def _take(self, kind: Kind, content: Packet) -> None:
        if kind is Kind.OURS and isinstance(content, Frame):
            self._frames.append(content)

    def close(self) -> None:
        """See :meth:`emb_runtime.can.transport.Transport.close`."""
        self._end.close()


def open_link(options: str, _bench: Bench) -> tuple[LinkTransport, Clock]:
    """The watchdog's end of a link that it has inherited: ``drive-link:FD``.

    Raises:
        BusError: there is no such end.
    """
    clock = MonotonicClock()
    try:
        end = socket.socket(fileno=int(options))
    except (OSError, ValueError) as err:
        raise BusError(f"drive-link:{options}: no such link; it is for the watchdog process only") from err
    end.setblocking(False)
    return LinkTransport(end, clock, "drive-link"), clock
