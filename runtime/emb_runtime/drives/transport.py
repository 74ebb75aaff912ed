"""``--iface map:FILE@BUS``: a mapped drive as a transport of our frames.

On a real bus the software node runs in a process of its own, see :mod:`emb_runtime.drives.node_process`. Where only
this process can be on the bus, as on a simulated one in lock-step, it runs here, while somebody waits for a frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import Transport
from emb_runtime.config.bench import Bench
from emb_runtime.drives import mapping as files
from emb_runtime.drives.bench_fit import require_fit
from emb_runtime.drives.node import DriveNode, Phase
from emb_runtime.errors import BusError, UsageError
from emb_runtime.records import Frame
from emb_runtime.system.clock import Clock

ARM_TIMEOUT_NS = 10_000_000_000
"""Longest time until the drive is armed [ns]."""


class MappedTransport:
    """A mapped drive, as its loop sees it.

    Args:
        mapping: the drive.
        name: as given by the user.
    """

    truth: Mapping[str, float | str] | None = None

    def __init__(self, mapping: files.Mapping, name: str) -> None:
        self.mapping = mapping
        self.name = name
        self.on_drive_frame: Callable[[Frame], None] = lambda _frame: None
        """Told each frame of the drive's bus, for the log."""

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


class InProcessDrive(MappedTransport):
    """A mapped drive whose node runs in this process.

    Args:
        mapping: the drive.
        bench: limits, timing, the stop.
        bus: the drive's.
        clock: the time on it.
        name: as given by the user.
    """

    def __init__(self, mapping: files.Mapping, bench: Bench, bus: Transport, clock: Clock, name: str) -> None:
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
            elif now_ns >= due_ns:
                self.node.tick(now_ns)
            elif now_ns >= deadline_ns:
                return None
        return self._queue.popleft()

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


def report(node: DriveNode) -> dict[str, str]:
    """Counts of a node, for the log."""
    counts = {f"drive_{name}": str(value) for name, value in asdict(node.counts).items()}
    rejected = ", ".join(f"{reason} ({count})" for reason, count in node.rejected.items())
    return counts | {
        "drive_frames_passed": str(node.guard.passed),
        "drive_frames_refused": str(node.guard.rejected),
        "drive_frames_not_believed": rejected or "none",
        "drive_failure": node.failure or "none",
    }


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
    mapping = files.load_mapping(Path(file))
    require_fit(mapping, bench)
    name = f"map:{options}"
    bus, clock = open_transport(iface, bench)
    return InProcessDrive(mapping, bench, bus, clock, name), clock
