"""The process of the software node: between the drive's bus and the links to the loop and to its watchdog.

``python -m emb_runtime.drives.node_process LOOP_FD WATCHDOG_FD DOCUMENT_FD``, started by
:class:`emb_runtime.drives.transport.ProcessDrive` and by nobody else. When the loop is gone it stops the brake, lets
the drive go by its sequence, and ends. Once the watchdog has spoken, it does not hear the loop any more.
"""

from __future__ import annotations

import contextlib
import select
import socket
import sys
from collections.abc import Mapping
from typing import Any

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import Transport
from emb_runtime.config.bench import Bench, parse_bench
from emb_runtime.drives.link import Kind, Packet, pack_document, pack_frame, read_packets, unpack
from emb_runtime.drives.mapping import Mapping as DriveMapping
from emb_runtime.drives.mapping_file import parse_mapping
from emb_runtime.drives.node import ARMED, DriveNode, Phase, report
from emb_runtime.errors import BusError, EmbError
from emb_runtime.records import Frame
from emb_runtime.system import child_side, realtime
from emb_runtime.system.clock import Clock

PRIORITY = realtime.PRIORITY + 5  # Above the loop's, below its watchdog's
LOOK_NS = 200_000  # Time between two looks at a bus that cannot be waited for [ns]
MOST_FRAMES = 64  # Frames that are taken at once: a babbling bus must not hold up the links


class NodeServer:
    """Serves one loop.

    Args:
        mapping: the drive.
        bench: limits, timing, the stop.
        bus: the drive's.
        clock: the time on it.
        loop: end of the link to the loop.
        watchdog: end of the link to its watchdog.
    """

    def __init__(
        self,
        mapping: DriveMapping,
        bench: Bench,
        bus: Transport,
        clock: Clock,
        loop: socket.socket,
        watchdog: socket.socket,
    ) -> None:
        self.node = DriveNode(mapping, bench, load_layout(), bus.send)
        self._bus = bus
        self._clock = clock
        self._loop = loop
        self._open = {loop, watchdog}
        self._watchdog = watchdog
        self._overruled = False
        self._told: Mapping[str, Any] = {}
        self._dropped = 0

    def run(self) -> None:
        """Serve until the loop and its watchdog are gone, and the drive is let go.

        Raises:
            BusError: the bus is lost.
        """
        while self._open or self.node.phase in (*ARMED, Phase.ARMING):
            now_ns = self._clock.now_ns()
            self._wait(self.node.due_ns(now_ns + 1) - now_ns)
            self.step()

    def step(self) -> None:
        """Take what has come, and do what is due.

        Raises:
            BusError: the bus is lost.
        """
        for end in tuple(self._open):
            packets, closed = read_packets(end)
            for packet in packets:
                with contextlib.suppress(ValueError):  # whatever is in it, it is no frame of ours
                    self._take_packet(end, *unpack(packet))
            if closed:
                self._open.discard(end)
                if end is self._loop:
                    self.node.disarm()
        for _ in range(MOST_FRAMES):
            if (frame := self._bus.receive(0)) is None:
                break
            self._take_frame(frame)
        self.node.tick(self._clock.now_ns())
        self._tell_phase()

    def _wait(self, longest_ns: int) -> None:
        descriptor = getattr(self._bus, "descriptor", None)
        if descriptor is None:
            longest_ns = min(longest_ns, LOOK_NS)
        readable = [*self._open, *([] if descriptor is None else [descriptor])]
        select.select(readable, [], [], max(0, longest_ns) * 1e-9)

    def _take_packet(self, end: socket.socket, kind: Kind, content: Packet) -> None:
        if end is self._watchdog and not self._overruled:
            self._overruled = True
            self.node.disarm()
        if end is self._loop and self._overruled:
            return
        if isinstance(content, Frame):
            if kind is Kind.OURS:
                self.node.take_host(content, self._clock.now_ns())
        elif end is self._loop:
            self._obey(content)

    def _obey(self, request: Mapping[str, Any]) -> None:
        match request.get("do"):
            case "listen":
                self.node.polling = True
            case "arm":
                self.node.arm(self._clock.now_ns(), zero=bool(request.get("zero", True)))
            case "disarm":
                self.node.disarm()
            case "report":
                self._tell(pack_document({"report": report(self.node)}))

    def _take_frame(self, frame: Frame) -> None:
        self._tell(pack_frame(frame, Kind.DRIVE))
        ours = self.node.take_drive(frame, self._clock.now_ns())
        for passed in (*((frame,) if frame.error else ()), *ours):
            self._tell(pack_frame(passed._replace(dropped=self._dropped), Kind.OURS))

    def _tell_phase(self) -> None:
        now = {"phase": str(self.node.phase), "failure": self.node.failure}
        if now != self._told:
            self._told = now
            self._tell(pack_document(now))

    def _tell(self, packet: bytes) -> None:
        """Hand a packet to the loop; one that stands still loses it, and nobody waits."""
        if self._loop in self._open:
            try:
                self._loop.send(packet)
            except OSError:
                self._dropped += 1


def main(arguments: list[str]) -> int:
    """Serve one loop. Returns the exit status."""
    child_side.leave_ending_to_parent()
    loop_fd, watchdog_fd, document_fd = map(int, arguments)
    document = child_side.read_document(document_fd)
    loop, watchdog = socket.socket(fileno=loop_fd), socket.socket(fileno=watchdog_fd)
    try:
        bench = parse_bench(document["bench"], "bench")
        mapping = parse_mapping(document["mapping"], document["dbc"], "mapping")
        infos = mapping.messages.values()
        ours = None if any(i.extended for i in infos) else tuple(i.identifier for i in infos)
        bus, clock = open_transport(document["iface"], bench, ours)
    except EmbError as err:
        child_side.answer({"error": str(err)})
        return 1
    server = NodeServer(mapping, bench, bus, clock, loop, watchdog)
    obtained = realtime.obtain(priority=PRIORITY)
    child_side.answer({"ready": True, "obtained": dict(bus.obtained), "realtime": obtained})
    try:
        server.run()
    except BusError as err:
        with contextlib.suppress(OSError):
            loop.send(pack_document({"lost": str(err)}))
        return 1
    finally:
        bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
