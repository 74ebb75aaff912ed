"""How frames reach the bus: a raw SocketCAN socket in the control loop, python-can for everything else.

Nothing here starts a thread, repeats a frame or retries one: a command that could not be sent in its period is worth
less than none. Where a kernel without CAN is all there is, ``emb-hil`` supplies one that has it.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
from collections import deque
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Protocol

from emb_runtime.bench import Bench
from emb_runtime.clock import Clock, MonotonicClock
from emb_runtime.errors import BusError, UsageError
from emb_runtime.records import Frame

if TYPE_CHECKING:
    import can

ENTRY_POINTS = "emb_runtime.transports"
"""Entry-point group of further transports: factories ``(options, bench) -> (transport, clock)``."""

# Values of <linux/can.h>, <linux/can/raw.h>, <linux/can/error.h> and <asm-generic/socket.h> that Python does not name.
_CAN_FRAME = struct.Struct("=IB3x8s")
_CAN_RAW_ERR_FILTER = 2
_CAN_ERR_BUSOFF = 0x40
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40
_TIMESPEC = struct.Struct("@ll")
_DROPS = struct.Struct("=I")

_RECEIVE_BUFFER = 4 << 20  # bytes; a classic frame takes about 770 of them, so this is over a second of the bench
_ANCILLARY = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_DROPS.size)
_SELECT_LIMIT = 1024  # FD_SETSIZE
_STEP_SLACK_NS = 1_000_000  # a wall clock that stepped less than a sample time is not noticed


class TransmitQueueFullError(BusError):
    """The frame was not sent because the interface's queue is full; it is lost, and never sent later."""


class Transport(Protocol):
    """A way to and from one bus."""

    @property
    def name(self) -> str:
        """What the user called it: ``can0``, ``sim``, ``virtual:test``."""
        ...

    @property
    def truth(self) -> Mapping[str, float | str] | None:
        """The brake's true parameters and the plant's name, which only a simulated bus knows; None on a real one."""
        ...

    def send(self, frame: Frame) -> None:
        """Hand one frame to the bus.

        Raises:
            TransmitQueueFullError: it was dropped for want of room.
            BusError: the bus is lost.
        """
        ...

    def receive(self, deadline_ns: int) -> Frame | None:
        """The next frame, waiting for it no longer than until the deadline.

        Args:
            deadline_ns: on the monotonic clock that came with the transport; one in the past, 0 say, only looks.

        Returns:
            None if no frame came in time. Error frames and the echo of own frames are frames too.

        Raises:
            BusError: the bus is lost.
        """
        ...

    def close(self) -> None:
        """Give the bus back."""
        ...


def _raw_socket() -> socket.socket:
    return socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)


def _wait_readable(descriptor: int, timeout_s: float) -> bool:
    # select() and not poll(), whose timeout has a resolution of one millisecond: a whole sample time.
    return bool(select.select([descriptor], [], [], timeout_s)[0])


class SocketCan:
    """A raw SocketCAN socket: classical frames, kernel time stamps, drop count, error frames, own echo.

    A receive that finds a frame waiting is one system call; one that has to wait is two more and a clock read.
    """

    truth = None

    def __init__(
        self,
        interface: str,
        clock: Clock,
        identifiers: tuple[int, ...] = (),
        *,
        open_socket: Callable[[], socket.socket] = _raw_socket,
        wait_readable: Callable[[int, float], bool] = _wait_readable,
    ) -> None:
        """Open and bind the socket.

        Args:
            interface: network interface, ``can0`` or ``vcan0``.
            clock: for deadlines and for translating time stamps.
            identifiers: the only 11-bit identifiers the kernel should pass on; empty for all frames.
            open_socket: makes the unbound socket.
            wait_readable: waits for a descriptor, at most so many seconds.

        Raises:
            BusError: this kernel has no CAN, or the interface does not exist or is down.
        """
        self.name = interface
        self._clock = clock
        self._wait_readable = wait_readable
        self._dropped = 0
        self._lost = ""
        try:
            self._socket = open_socket()
        except (OSError, AttributeError) as err:  # AttributeError: Python was built where there is no AF_CAN
            reason = err.strerror if isinstance(err, OSError) else "not a Linux Python"
            raise BusError(
                f"{interface}: no CAN sockets here ({reason}); run the same command under `emb-hil -- COMMAND`, "
                "or simulate with `emb-run --iface sim`"
            ) from err
        try:
            self._set_up(interface, identifiers)
        except BaseException:
            self._socket.close()
            raise
        self._wall_offset_ns = clock.wall_offset_ns()

    def _set_up(self, interface: str, identifiers: tuple[int, ...]) -> None:
        sock = self._socket
        sock.setblocking(False)
        self._descriptor = sock.fileno()
        if self._descriptor >= _SELECT_LIMIT:
            raise BusError(f"{interface}: file descriptor {self._descriptor} is too high; close some files first")
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)
        except PermissionError:  # without CAP_NET_ADMIN, as much as net.core.rmem_max allows
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self.receive_buffer = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        """What the kernel granted for received frames [bytes]."""
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 1)
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, socket.CAN_ERR_MASK)
        if identifiers:
            # With both flags in the mask the filter is exact, and the kernel looks it up instead of walking a list.
            mask = socket.CAN_SFF_MASK | socket.CAN_EFF_FLAG | socket.CAN_RTR_FLAG
            filters = b"".join(struct.pack("=II", identifier, mask) for identifier in identifiers)
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, filters)
        try:
            sock.bind((interface,))
        except OSError as err:
            raise BusError(
                f"{interface}: no such CAN interface ({err.strerror or err}); `ip -br link` lists what there is, "
                "`ip link add dev vcan0 type vcan` makes a virtual one"
            ) from err
        # Binding to an interface that is down succeeds and leaves the error pending; reading it clears it.
        if (pending := sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)) != 0:
            raise self._lose(pending)

    def send(self, frame: Frame) -> None:
        """See :meth:`Transport.send`."""
        identifier = frame.identifier
        if frame.extended:
            identifier |= socket.CAN_EFF_FLAG
        if frame.remote:
            identifier |= socket.CAN_RTR_FLAG
        data = frame.data
        try:
            self._socket.send(_CAN_FRAME.pack(identifier, len(data), data))
        except OSError as err:
            if err.errno in (errno.ENOBUFS, errno.EAGAIN):
                raise TransmitQueueFullError(
                    f"{self.name}: transmit queue full, frame {frame.identifier:#05x} dropped; "
                    "is anything on the bus to acknowledge?"
                ) from err
            raise self._lose(err.errno) from err

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`Transport.receive`."""
        if self._lost:  # the kernel says so once, then stays silent
            raise BusError(self._lost)
        if (frame := self._read()) is not None:
            return frame
        # Only looking costs no clock read: where that is a system call, it is a good part of a cycle.
        while deadline_ns > 0 and (now_ns := self._clock.now_ns()) < deadline_ns:
            if not self._wait_readable(self._descriptor, (deadline_ns - now_ns) * 1e-9):
                return None
            if (frame := self._read()) is not None:
                return self._plausible(frame, now_ns, deadline_ns)
        return None

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self._socket.close()

    def _read(self) -> Frame | None:
        try:
            raw, ancillary, flags, _ = self._socket.recvmsg(_CAN_FRAME.size, _ANCILLARY)
        except BlockingIOError:
            return None
        except OSError as err:
            raise self._lose(err.errno) from err
        if len(raw) != _CAN_FRAME.size:
            self._lost = f"{self.name}: expected {_CAN_FRAME.size} bytes per frame, got {len(raw)}; not a CAN socket"
            raise BusError(self._lost)
        time_ns = None
        for level, kind, value in ancillary:
            if level != socket.SOL_SOCKET:
                continue
            if kind == _SO_TIMESTAMPNS and len(value) == _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack(value)
                time_ns = seconds * 1_000_000_000 + nanoseconds - self._wall_offset_ns
            elif kind == _SO_RXQ_OVFL and len(value) == _DROPS.size:
                self._dropped = _DROPS.unpack(value)[0]
        if time_ns is None:
            time_ns = self._clock.now_ns()
        identifier, length, data = _CAN_FRAME.unpack(raw)
        remote = bool(identifier & socket.CAN_RTR_FLAG)
        extended = bool(identifier & socket.CAN_EFF_FLAG)
        error = bool(identifier & socket.CAN_ERR_FLAG)
        return Frame(
            identifier=identifier & (socket.CAN_EFF_MASK if extended or error else socket.CAN_SFF_MASK),
            data=b"" if remote else data[:length],
            time_ns=time_ns,
            extended=extended,
            remote=remote,
            error=error,
            own=bool(flags & socket.MSG_CONFIRM),
            dropped=self._dropped,
        )

    def _plausible(self, frame: Frame, empty_ns: int, deadline_ns: int) -> Frame:
        """A frame that came while we waited, its stamp corrected if the wall clock has stepped since it was measured.

        The queue was empty just before, so the frame cannot be older than that, nor younger than the deadline.
        """
        if empty_ns - _STEP_SLACK_NS <= frame.time_ns <= deadline_ns + _STEP_SLACK_NS:
            return frame
        offset_ns = self._clock.wall_offset_ns()
        frame = frame._replace(time_ns=frame.time_ns + self._wall_offset_ns - offset_ns)
        self._wall_offset_ns = offset_ns
        return frame

    def _lose(self, code: int | None) -> BusError:
        """Remember that the bus is lost, so that a later receive does not take the kernel's silence for an idle bus."""
        if code == errno.ENETDOWN:
            self._lost = f"{self.name}: the interface is down; `ip link set {self.name} up`"
        elif code in (errno.ENODEV, errno.ENXIO):
            self._lost = f"{self.name}: the interface has disappeared; is the adapter still plugged in?"
        else:
            self._lost = f"{self.name}: the socket failed: {os.strerror(code) if code else 'no reason given'}"
        return BusError(self._lost)


def is_bus_off(frame: Frame) -> bool:
    """Whether an error frame reports bus-off: the controller has stopped taking part (linux/can/error.h)."""
    return frame.error and bool(frame.identifier & _CAN_ERR_BUSOFF)


class PythonCan:
    """Any python-can backend: the in-process ``virtual`` bus, vendor adapters. Slower than :class:`SocketCan`."""

    truth = None

    def __init__(self, backend: str, channel: str, bitrate: int, clock: Clock) -> None:
        """Open the bus.

        Args:
            backend: python-can's name of the interface.
            channel: the backend's name of the channel.
            bitrate: for backends that set it [bit/s].
            clock: for deadlines and arrival times.

        Raises:
            UsageError: no such backend.
            BusError: the backend cannot open the channel.
        """
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
        # Not every backend gives back what it sent, so the echo is made here, when the backend has taken the frame.
        self._echoes: deque[Frame] = deque()

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

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`Transport.receive`."""
        import can

        if self._echoes:
            return self._echoes.popleft()
        timeout_s = max(0.0, (deadline_ns - self._clock.now_ns()) * 1e-9)
        try:
            message = self._bus.recv(timeout_s)
        except (can.CanError, OSError) as err:
            raise BusError(f"{self.name}: cannot receive: {err}") from err
        return None if message is None else self._frame(message)

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self._bus.shutdown()

    def _frame(self, message: can.Message) -> Frame:
        return Frame(
            identifier=message.arbitration_id,
            data=b"" if message.is_remote_frame else bytes(message.data),
            time_ns=self._clock.now_ns(),  # backends stamp on clocks of their own, and in floating point
            extended=message.is_extended_id,
            remote=message.is_remote_frame,
            error=message.is_error_frame,
        )


def open_transport(iface: str, bench: Bench, identifiers: tuple[int, ...] = ()) -> tuple[Transport, Clock]:
    """The transport that a user names, and the clock that its time stamps and deadlines are on.

    Args:
        iface: ``can0`` or ``vcan0`` for SocketCAN; ``NAME`` or ``NAME:OPTIONS`` of a registered transport, ``sim``
            among them; ``BACKEND:CHANNEL`` for python-can.
        bench: handed to registered transports; its bitrate to python-can.
        identifiers: the only 11-bit identifiers that a SocketCAN socket should pass on; empty for all frames.

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
    clock = MonotonicClock()
    if separator and head != "socketcan":
        return PythonCan(head, tail, bench.can.bitrate, clock), clock
    # python-can's own SocketCAN backend cannot tell our echo from a frame of another process on this host.
    return SocketCan(tail or head, clock, identifiers), clock
