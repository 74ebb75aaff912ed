"""A gateway in lock-step: ``map:FILE@BUS``, a mapped drive on a simulated bus, as a transport of our frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping as Dictionary
from pathlib import Path

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.messages import load_layout
from emb_runtime.can.transport import Transport
from emb_runtime.config.bench import Bench
from emb_runtime.drives.bench_fit import require_fit
from emb_runtime.drives.mapping import Mapping
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.drives.node import DriveNode, Phase
from emb_runtime.errors import BusError, UsageError
from emb_runtime.records import Frame
from emb_runtime.system.clock import Clock

ARM_TIMEOUT_NS = 10_000_000_000  # Longest time until the drive is armed [ns]


class LockStepDrive:
    """A mapped drive with its node; the drive is armed when it is made. Time moves while somebody waits for a frame.

    Args:
        mapping: the drive.
        bench: limits, timing, the stop.
        bus: the drive's, simulated.
        clock: the time on it.
        name: as given by the user.

    Raises:
        BusError: the drive cannot be armed.
    """

    obtained: Dictionary[str, str] = {}

    def __init__(self, mapping: Mapping, bench: Bench, bus: Transport, clock: Clock, name: str) -> None:
        self.name, self.truth = name, bus.truth
        self._bus, self._clock = bus, clock
        self._queue: deque[Frame] = deque()
        self.node = DriveNode(mapping, bench, load_layout(), bus.send)
        deadline_ns = clock.now_ns() + ARM_TIMEOUT_NS
        while not self.node.may_arm and clock.now_ns() < deadline_ns:
            self.receive(deadline_ns)
            self._queue.clear()
        if self.node.may_arm:
            self.node.arm(clock.now_ns())
        while self.node.phase is Phase.ARMING and clock.now_ns() < deadline_ns:
            self.receive(deadline_ns)
        if self.node.phase is not Phase.READY:
            raise BusError(f"{name}: cannot arm the drive: {self.node.failure or 'it was not heard'}")
        self._queue.clear()

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
                self._queue.extend(self.node.take_drive(frame, now_ns))
            self.node.tick(now_ns)  # also where frames come that make no sample: their lack is due as well
            if frame is None and now_ns >= deadline_ns:
                break
        return self._queue.popleft() if self._queue else None

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self._bus.close()


def drive_file(iface: str) -> Path | None:
    """Mapping file in an ``--iface map:FILE@BUS``; None in any other."""
    name, _, options = iface.partition(":")
    return Path(options.rpartition("@")[0]) if name == "map" else None


def open_mapped(options: str, bench: Bench) -> tuple[LockStepDrive, Clock]:
    """Open ``FILE@BUS``.

    Raises:
        UsageError: the mapping file, or the bench for it, is refused; or it is no simulated bus.
        BusError: the drive cannot be armed.
    """
    file, at, iface = options.rpartition("@")
    if not (file and at and iface) or iface.startswith(("map:", "sim:")) or iface in ("map", "sim"):
        raise UsageError(f"--iface 'map:{options}': expected map:FILE@BUS with a simulated drive on the bus")
    mapping = load_mapping(file)
    require_fit(mapping, bench)
    bus, clock = open_transport(iface, bench)
    if bus.truth is None:
        bus.close()
        raise UsageError(
            f"--iface 'map:{options}': a mapped drive on a real bus needs a process of its own: start emb-gateway "
            f"{file} --drive {iface} --node vcan0, then emb-run --iface vcan0 --drive {file}@{iface}"
        )
    return LockStepDrive(mapping, bench, bus, clock, f"map:{options}"), clock
