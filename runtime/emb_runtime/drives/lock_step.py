"""A mapped drive in simulated time: drive, gateway and host in lock-step, in one process."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Mapping as Dictionary

from emb_runtime.can.interfaces import open_transport
from emb_runtime.can.transport import Transport
from emb_runtime.config.bench import Bench
from emb_runtime.drives.gateway import LONGEST_SILENCE, Gateway, Port
from emb_runtime.drives.mapping import Mapping, require_fit
from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.errors import BusError, UsageError
from emb_runtime.records import Frame
from emb_runtime.system.clock import Clock


class LockStepDrive:
    """A mapped drive on a simulated bus, behind its gateway. Time moves while the host waits for a frame.

    It is armed when it is made; BusError if it cannot be.
    """

    obtained: Dictionary[str, str] = {}

    def __init__(self, mapping: Mapping, bench: Bench, bus: Transport, clock: Clock, name: str) -> None:
        self.name, self.truth = name, bus.truth
        self._bus, self._clock = bus, clock
        self._deadline_ns = 1 << 62  # the arming ends by itself
        self._of_drive, self._to_node, self._to_host = deque[Frame](), deque[Frame](), deque[Frame]()
        drive = Port(bus.send, lambda _: _popped(self._of_drive) or bus.receive(clock.now_ns()))
        node = Port(
            lambda frame: self._to_host.append(frame._replace(time_ns=clock.now_ns())), lambda _: _popped(self._to_node)
        )
        self._gateway = Gateway(mapping, bench, drive, node, clock, self._wait)
        self.node = self._gateway.node
        try:
            self._gateway.arm(lambda: False)
        except BusError as err:
            raise BusError(f"{name}: {err}") from err
        self._to_host.clear()
        # With its first sample the node judges what came before.
        self.receive(clock.now_ns() + round(LONGEST_SILENCE * 1e9))
        if self.node.failure:
            raise BusError(f"{name}: the drive was disarmed: {self.node.failure}")

    def send(self, frame: Frame) -> None:
        """See :meth:`Transport.send`."""
        self._to_node.append(frame)
        self._to_host.append(frame._replace(time_ns=self._clock.now_ns(), own=True))

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`Transport.receive`."""
        self._deadline_ns = deadline_ns
        while not self._to_host and self._clock.now_ns() < deadline_ns:
            self._gateway.serve_once()
        return _popped(self._to_host)

    def close(self) -> None:
        """Let the drive go, as a gateway that ends does, and close its bus."""
        with contextlib.suppress(BusError):  # the bus may be what is lost
            self.node.disarm()
            self.node.abandon()
        self._bus.close()

    def _wait(self, longest_ns: int) -> None:
        until_ns = min(self._clock.now_ns() + longest_ns, self._deadline_ns)
        if not self._to_node and (frame := self._bus.receive(until_ns)) is not None:
            self._of_drive.append(frame)


def _popped(frames: deque[Frame]) -> Frame | None:
    return frames.popleft() if frames else None


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
            f"--iface 'map:{options}': a mapped drive on a real bus needs another process: start emb-gateway "
            f"{file} --drive {iface} --node vcan0, then emb-run --iface vcan0 --drive {file}@{iface}"
        )
    return LockStepDrive(mapping, bench, bus, clock, f"map:{options}"), clock
