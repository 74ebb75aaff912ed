"""Transports of frames: the interface of every bus, and the raw SocketCAN socket.

Nothing here starts a thread, repeats a frame or retries one: a command that could not be sent in its period is worth
less than none. Where a kernel without CAN is all there is, ``emb-hil`` supplies one that has it.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
from collections.abc import Callable, Mapping
from typing import Final, Protocol

from emb_runtime.errors import BusError
from emb_runtime.records import Frame
from emb_runtime.system.clock import Clock

# Values of <linux/can.h>, <linux/can/raw.h> and <asm-generic/socket.h> that Python does not name.
_CAN_FRAME: Final = struct.Struct("=IB3x8s")
_CAN_RAW_ERR_FILTER: Final = 2
_SO_RCVBUFFORCE: Final = 33
_SO_TIMESTAMPNS: Final = 35  # The option that asks for a control message is also its type
_SO_RXQ_OVFL: Final = 40
_STAMP: Final = struct.Struct("@ll")
_COUNT: Final = struct.Struct("@I")
_LONGEST_FRAME: Final = 72  # bytes of a CAN FD frame, so that one is not taken for a classical frame
_CONTROL_BYTES: Final = 64  # room for both control messages

_RECEIVE_BUFFER: Final = 4 << 20  # bytes; a classic frame takes about 770, so this is over a second of the bench
_SELECT_LIMIT: Final = 1024  # FD_SETSIZE
_SFF_MASK: Final = 0x7FF  # the hot path's, as plain numbers
_MSG_CONFIRM: Final = 0x800
_MSG_DONTWAIT: Final = 0x40
_OFFSET_ERROR_NS: Final = 20_000  # Error of a measured offset of the two clocks, at most; more is a step [ns]
_OFFSETS: Final = 16  # Offsets stored while the queue is never empty
_DELIVERY_NS: Final = 1_000_000_000  # Longest time from a stamp until the frame is in the queue [ns]


class TransmitQueueFullError(BusError):
    """The frame was not sent because the interface's queue is full; it is lost, and never sent later."""


class Transport(Protocol):
    """A way to and from one bus."""

    @property
    def name(self) -> str:
        """Name given by the user: ``can0``, ``sim``."""
        ...

    @property
    def truth(self) -> Mapping[str, float | str] | None:
        """The brake's true parameters and the plant's name, which only a simulated bus knows; None on a real one."""
        ...

    @property
    def obtained(self) -> Mapping[str, str]:
        """Requested settings of the bus, and what was obtained, for the log."""
        ...

    def send(self, frame: Frame) -> None:
        """Hand one frame to the bus; TransmitQueueFullError if it was dropped, another BusError if the bus is lost."""
        ...

    def receive(self, deadline_ns: int) -> Frame | None:
        """The next frame, error frames and echoes of sent frames included; None if none came by the deadline.

        That is on the monotonic clock that came with the transport; one in the past, 0 say, only looks. BusError if the
        bus is lost.
        """
        ...

    def close(self) -> None:
        """Give the bus back."""
        ...


class SocketCan:
    """A raw SocketCAN socket: classical frames, kernel time stamps, drop count, error frames, echoes."""

    truth = None

    def __init__(
        self,
        interface: str,
        clock: Clock,
        identifiers: tuple[int, ...] | None = None,
        *,
        open_socket: Callable[[], socket.socket] = lambda: socket.socket(
            socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW
        ),
        # select() and not poll(), whose timeout has a resolution of one millisecond: a sample time.
        wait_readable: Callable[[int, float], object] = lambda fd, timeout_s: select.select([fd], [], [], timeout_s)[0],
    ) -> None:
        """Open and bind the socket of a network interface; BusError where that cannot be.

        The kernel passes on these 11-bit identifiers only; all frames for None, none for an empty tuple.
        """
        self.name = interface
        self._clock = clock
        self._wait_readable = wait_readable
        self._dropped = 0
        self._empty_ns = clock.now_ns()  # the queue was empty then
        self._offsets_ns = [clock.wall_offset_ns()]  # from monotonic to wall time, measured since: the newest last
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

    def _set_up(self, interface: str, identifiers: tuple[int, ...] | None) -> None:
        sock = self._socket
        sock.setblocking(False)
        self.descriptor = sock.fileno()
        """The socket's file descriptor, for the watchdog that may have to take the bus away from it."""
        if self.descriptor >= _SELECT_LIMIT:
            raise BusError(f"{interface}: file descriptor {self.descriptor} is too high; close some files first")
        try:
            sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER)
        except PermissionError:  # without CAP_NET_ADMIN, as much as net.core.rmem_max allows
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        self.obtained = {
            "receive_buffer": f"{sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)} bytes",
            "identifiers": "all" if identifiers is None else ", ".join(f"{i:#05x}" for i in identifiers) or "none",
        }
        """See :attr:`Transport.obtained`."""
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 1)
        sock.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, 0 if identifiers == () else socket.CAN_ERR_MASK)
        if identifiers is not None:
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
            raise self._loss(pending)

    def send(self, frame: Frame) -> None:
        """See :meth:`Transport.send`."""
        identifier = frame.identifier
        if frame.extended:
            identifier |= socket.CAN_EFF_FLAG
        if frame.remote:
            identifier |= socket.CAN_RTR_FLAG
        data = frame.data
        try:
            self._socket.send(_CAN_FRAME.pack(identifier, len(data), data), _MSG_DONTWAIT)
        except OSError as err:
            if err.errno in (errno.ENOBUFS, errno.EAGAIN):
                raise TransmitQueueFullError(
                    f"{self.name}: transmit queue full, frame {frame.identifier:#05x} dropped; "
                    "is anything on the bus to acknowledge?"
                ) from err
            raise self._loss(err.errno) from err

    def receive(self, deadline_ns: int) -> Frame | None:
        """See :meth:`Transport.receive`; the kernel reports that the interface has gone down once."""
        frame = self._read_socket()
        while frame is None and deadline_ns > 0 and (now_ns := self._clock.now_ns()) < deadline_ns:
            if not self._wait_readable(self.descriptor, (deadline_ns - now_ns) * 1e-9):
                return None
            frame = self._read_socket()
        return frame

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        self._socket.close()

    def _read_socket(self) -> Frame | None:
        """The next frame that waits, if one does."""
        now_ns = self._clock.now_ns()
        try:
            raw, control, flags, _ = self._socket.recvmsg(_LONGEST_FRAME, _CONTROL_BYTES, _MSG_DONTWAIT)
        except BlockingIOError:
            self._empty_ns = now_ns
            del self._offsets_ns[:-1]
            return None
        except OSError as err:
            raise self._loss(err.errno) from err
        if len(raw) != _CAN_FRAME.size:
            raise BusError(f"{self.name}: expected {_CAN_FRAME.size} bytes per frame, got {len(raw)}; not a CAN socket")
        wall_ns = 0
        for _level, kind, value in control:
            if kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _STAMP.unpack(value)
                wall_ns = seconds * 1_000_000_000 + nanoseconds
            elif kind == _SO_RXQ_OVFL:
                (self._dropped,) = _COUNT.unpack(value)
        identifier, length, data = _CAN_FRAME.unpack(raw)
        time_ns, own = self._arrival_ns(wall_ns), bool(flags & _MSG_CONFIRM)
        if identifier <= _SFF_MASK:  # nearly all of them
            return tuple.__new__(Frame, (identifier, data[:length], time_ns, False, False, False, own, self._dropped))
        kinds = socket.CAN_EFF_FLAG, socket.CAN_RTR_FLAG, socket.CAN_ERR_FLAG
        extended, remote, error = (bool(identifier & kind) for kind in kinds)
        identifier &= socket.CAN_EFF_MASK if extended or error else _SFF_MASK
        data = b"" if remote else data[:length]
        return Frame(identifier, data, time_ns, extended, remote, error, own, self._dropped)

    def _arrival_ns(self, wall_ns: int) -> int:
        """Arrival of a frame that has just been read, by the kernel's stamp; both [ns].

        The stamp is the wall clock's, which may step at any time. What is sure is monotonic: the frame was put into the
        queue after that was last seen empty, and before now. Within these bounds the arrival is the stamp less an
        offset of the two clocks that was measured in between: after a step there are several, and the earliest arrival
        counts. Where none fits, the kernel delivered the frame late, and it came before the queue was seen empty; or
        the step was taken back, and the lower bound counts. So a step makes a frame look older, not newer, and only one
        that waited meanwhile or was the first to be read after it.
        """
        clock = self._clock
        offset_ns = clock.wall_offset_ns()
        if abs(offset_ns - self._offsets_ns[-1]) > _OFFSET_ERROR_NS:
            self._offsets_ns = [*self._offsets_ns[1 - _OFFSETS :], offset_ns]
        empty_ns, now_ns = self._empty_ns, clock.now_ns()
        earliest_ns, latest_ns = empty_ns - _OFFSET_ERROR_NS, now_ns + _OFFSET_ERROR_NS
        times_ns = [wall_ns - offset_ns for offset_ns in self._offsets_ns]
        if possible_ns := [time_ns for time_ns in times_ns if earliest_ns <= time_ns <= latest_ns]:
            return min(max(min(possible_ns), empty_ns), now_ns)
        return max((time_ns for time_ns in times_ns if 0 < empty_ns - time_ns < _DELIVERY_NS), default=empty_ns)

    def _loss(self, code: int | None) -> BusError:
        """The error about a lost bus."""
        if code == errno.ENETDOWN:
            reason = f"the interface is down; `ip link set {self.name} up`"
        elif code in (errno.ENODEV, errno.ENXIO):
            reason = "the interface has disappeared; is the adapter still plugged in?"
        else:
            reason = f"the socket failed: {os.strerror(code) if code else 'no reason given'}"
        return BusError(f"{self.name}: {reason}")
