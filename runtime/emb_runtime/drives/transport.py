"""``--iface map:FILE@BUS``: a mapped drive as a transport of our frames.

On a real bus the software node runs in a process of its own, see :mod:`emb_runtime.drives.node_process`. Where only
this process can be on the bus, as on a simulated one in lock-step, it runs here, while somebody waits for a frame.
"""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from emb_runtime.can.interfaces import ENTRY_POINTS, open_transport, require_linux
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import Transport
from emb_runtime.config.bench import Bench
from emb_runtime.drives import mapping_file
from emb_runtime.drives.bench_fit import require_fit
from emb_runtime.drives.link import Kind, LinkTransport, Packet, link_pair, pack_document
from emb_runtime.drives.mapping import Mapping as DriveMapping
from emb_runtime.drives.node import DriveNode, Phase, report
from emb_runtime.errors import BusError, UsageError
from emb_runtime.records import Frame
from emb_runtime.system.child_process import Child
from emb_runtime.system.clock import Clock, MonotonicClock

ARM_TIMEOUT_NS = 10_000_000_000  # Longest time until the drive is armed [ns]
DISARM_TIMEOUT_NS = 3_000_000_000  # Longest time until the brake rests and the drive is let go [ns]
START_TIMEOUT = 30.0  # Longest wait for the process to be on the bus [s]
LOOK_NS = 10_000_000  # Time between two looks at the state of the node [ns]


class MappedTransport:
    """A mapped drive, as its loop sees it.

    Args:
        mapping: the drive.
        name: as given by the user.
    """

    truth: Mapping[str, float | str] | None = None

    def __init__(self, mapping: DriveMapping, name: str) -> None:
        self.mapping = mapping
        self.name = name
        self.on_drive_frame: Callable[[Frame], None] = lambda _frame: None
        """Told each frame of the drive's bus, see :func:`overheard`."""

    @property
    def obtained(self) -> Mapping[str, str]:
        """See :attr:`Transport.obtained`."""
        return {"drive": self.mapping.name, "mapping_sha256": self.mapping.sha256}

    def listen(self) -> None:
        """Ask a polled drive for samples from now on: that sends 0 A."""
        raise NotImplementedError

    def arm(self, *, zero: bool = False) -> None:
        """Arm the drive by the file's sequence; it then gets 0 A until the first command.

        Args:
            zero: nothing but 0 A may leave, not even to brake.

        Raises:
            BusError: it cannot be armed, or the bus is lost.
        """
        raise NotImplementedError

    def disarm(self) -> None:
        """Let the drive go by the file's sequence, after a stop if it moves."""
        raise NotImplementedError

    def report(self) -> dict[str, str]:
        """Counts of the node so far, for the log."""
        raise NotImplementedError


@contextmanager
def overheard(transport: Transport, listener: Callable[[Frame], None]) -> Iterator[None]:
    """Tell a listener each frame of a mapped drive's bus meanwhile; without such a drive there is none."""
    if not isinstance(transport, MappedTransport):
        yield
        return
    transport.on_drive_frame = listener
    try:
        yield
    finally:
        transport.on_drive_frame = lambda _frame: None


class InProcessDrive(MappedTransport):
    """A mapped drive whose node runs in this process.

    Args:
        mapping: the drive.
        bench: limits, timing, the stop.
        bus: the drive's.
        clock: the time on it.
        name: as given by the user.
    """

    def __init__(self, mapping: DriveMapping, bench: Bench, bus: Transport, clock: Clock, name: str) -> None:
        super().__init__(mapping, name)
        self._bus = bus
        self._clock = clock
        self.truth = bus.truth
        self._queue: deque[Frame] = deque()
        self._command_identifier = (layout := load_layout()).command.identifier
        self.node = DriveNode(mapping, bench, layout, bus.send)

    def send(self, frame: Frame) -> None:
        """See :meth:`Transport.send`."""
        now_ns = self._clock.now_ns()
        self.node.take_host(frame, now_ns)
        self._queue.append(frame._replace(time_ns=now_ns, own=True))

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`Transport.receive`."""
        while not self._queue:
            now_ns = self._clock.now_ns()
            due_ns = self.node.due_ns(now_ns)
            if due_ns <= now_ns:
                self.node.tick(now_ns)
                due_ns = self.node.due_ns(now_ns + 1)
            frame = self._bus.receive(min(deadline_ns, due_ns))
            now_ns = self._clock.now_ns()
            if frame is not None:
                self._take(frame, now_ns)
            self.node.tick(now_ns)  # also where frames come that make no sample: their lack is due as well
            if frame is None and now_ns >= deadline_ns:
                break
        return self._queue.popleft() if self._queue else None

    def listen(self) -> None:
        """See :meth:`MappedTransport.listen`."""
        self.node.polling = True

    def arm(self, *, zero: bool = False) -> None:
        """See :meth:`MappedTransport.arm`."""
        now_ns = self._clock.now_ns()
        deadline_ns = now_ns + ARM_TIMEOUT_NS
        self.node.arm(now_ns, zero=zero)
        while self.node.phase is Phase.ARMING and self._clock.now_ns() < deadline_ns:
            self.receive(deadline_ns)
        if self.node.phase is not Phase.READY:
            raise BusError(f"{self.name}: cannot arm the drive: {self.node.failure or 'it is not let go yet'}")

    def disarm(self) -> None:
        """See :meth:`MappedTransport.disarm`."""
        self.node.disarm()

    def report(self) -> dict[str, str]:
        """See :meth:`MappedTransport.report`."""
        return report(self.node)

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        try:
            self.node.disarm()
        except BusError:
            pass  # the drive's own time-out is left
        finally:
            self._bus.close()

    def _take(self, frame: Frame, now_ns: int) -> None:
        self.on_drive_frame(frame)
        if frame.error:
            self._queue.append(frame)
        self._queue.extend(self.node.take_drive(frame, now_ns))


class ProcessDrive(MappedTransport):
    """A mapped drive whose node runs in a process of its own.

    Args:
        mapping: the drive.
        bench: limits, timing, the stop.
        iface: the drive's bus.
        clock: of this computer.
        name: as given by the user.

    Raises:
        BusError: the process cannot be started, or cannot open the bus.
    """

    def __init__(self, mapping: DriveMapping, bench: Bench, iface: str, clock: Clock, name: str) -> None:
        super().__init__(mapping, name)
        self._clock = clock
        self._phase, self._failure, self._report = Phase.OFF, "", dict[str, str]()
        loop, node_loop = link_pair()
        self._watchdog_end, node_watchdog = link_pair()
        self.watchdog_link = self._watchdog_end.fileno()
        """File descriptor of the link for the watchdog process."""
        self._link = _LoopLink(loop, clock, name, self)
        document = {"bench": bench.text, "mapping": mapping.text, "dbc": mapping.dbc_text, "iface": iface}
        ends = [node_loop.fileno(), node_watchdog.fileno()]
        try:
            self._child = Child("drive", "emb_runtime.drives.node_process", document, ends)
        except OSError as err:
            raise BusError(f"{name}: cannot start the drive's process: {err.strerror}") from err
        finally:
            node_loop.close()
            node_watchdog.close()
        answer = self._child.answer(START_TIMEOUT)
        if "ready" not in answer:
            self._child.end()
            self._close_ends()
            raise BusError(f"{name}: {answer['error']}")
        self._obtained = dict(answer["obtained"])

    @property
    def obtained(self) -> Mapping[str, str]:
        """See :attr:`Transport.obtained`."""
        return {**super().obtained, **self._obtained}

    @property
    def pid(self) -> int:
        """Process id of the node."""
        return self._child.pid

    def send(self, frame: Frame) -> None:
        """See :meth:`Transport.send`."""
        self._link.send(frame)

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`Transport.receive`."""
        return self._link.receive(deadline_ns)

    def listen(self) -> None:
        """See :meth:`MappedTransport.listen`."""
        self._ask("listen")

    def arm(self, *, zero: bool = False) -> None:
        """See :meth:`MappedTransport.arm`."""
        self._ask("arm", zero=zero)
        self._await(lambda: self._phase in (Phase.READY, Phase.FAILED), ARM_TIMEOUT_NS)
        if self._phase is not Phase.READY:
            raise BusError(f"{self.name}: cannot arm the drive: {self._failure or 'it did not say that it is armed'}")

    def disarm(self) -> None:
        """See :meth:`MappedTransport.disarm`."""
        self._ask("disarm")
        self._await(lambda: self._phase in (Phase.OFF, Phase.FAILED), DISARM_TIMEOUT_NS)

    def report(self) -> dict[str, str]:
        """See :meth:`MappedTransport.report`."""
        try:
            self._report = {}
            self._ask("report")
            self._await(lambda: bool(self._report), DISARM_TIMEOUT_NS)
        except BusError:
            pass  # whoever has lost the bus has ended
        return self._report

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self._close_ends()
        self._child.release()
        self._child.end()

    def hear(self, document: Mapping[str, Any]) -> None:
        """Take what the node says of itself.

        Raises:
            BusError: it has lost the bus.
        """
        if "lost" in document:
            raise BusError(str(document["lost"]))
        if "phase" in document:
            self._phase, self._failure = Phase(document["phase"]), str(document["failure"])
        self._report = document.get("report", self._report)

    def _ask(self, what: str, **more: bool) -> None:
        self._link.tell(pack_document({"do": what, **more}))

    def _await(self, reached: Callable[[], bool], longest_ns: int) -> None:
        """Pass over frames of ours until something is reached, or a time has passed."""
        deadline_ns = self._clock.now_ns() + longest_ns
        while not reached() and (now_ns := self._clock.now_ns()) < deadline_ns:
            self._link.receive(min(deadline_ns, now_ns + LOOK_NS))

    def _close_ends(self) -> None:
        self._link.close()
        self._watchdog_end.close()


class _LoopLink(LinkTransport):
    """The loop's end: what is not a frame of ours goes to the drive's transport."""

    def __init__(self, end: socket.socket, clock: Clock, name: str, drive: ProcessDrive) -> None:
        super().__init__(end, clock, name)
        self._drive = drive

    def _take(self, kind: Kind, content: Packet) -> None:
        if not isinstance(content, Frame):
            self._drive.hear(content)
        elif kind is Kind.DRIVE:
            self._drive.on_drive_frame(content)
        else:
            super()._take(kind, content)


def open_mapped(options: str, bench: Bench) -> tuple[MappedTransport, Clock]:
    """Open ``FILE@BUS``.

    Args:
        options: mapping file and bus, as of ``--iface``.
        bench: what the drive moves.

    Raises:
        UsageError: the mapping file, or the bench for it, is refused; or there is no such bus.
        BusError: the bus cannot be opened.
    """
    file, at, iface = options.rpartition("@")
    if not (file and at and iface):
        raise UsageError(f"--iface 'map:{options}': expected map:FILE@BUS (map:drive.toml@can0)")
    if iface.startswith(("map:", "sim:")) or iface in ("map", "sim"):
        raise UsageError(f"--iface 'map:{options}': expected the drive's own bus after the @, got '{iface}'")
    mapping = mapping_file.load_mapping(Path(file))
    require_fit(mapping, bench)
    name = f"map:{options}"
    if (head := iface.partition(":")[0]) == "virtual" or metadata.entry_points(group=ENTRY_POINTS, name=head):
        bus, clock = open_transport(iface, bench)
        return InProcessDrive(mapping, bench, bus, clock, name), clock
    require_linux(name)
    real_clock = MonotonicClock()
    return ProcessDrive(mapping, bench, iface, real_clock, name), real_clock
