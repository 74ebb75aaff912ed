"""All datagrams that wait on a socket, in one system call: recvmmsg(2).

Python's own ``recvmsg`` takes one at a time, and on a CAN socket it asks the kernel for the interface's name each time,
which is one more call per frame. Where system calls are dear, that is most of what reading costs.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
import sys
from typing import Final, NamedTuple

_SO_TIMESTAMPNS: Final = 35
_SO_RXQ_OVFL: Final = 40
# <asm-generic/socket.h>: the option that asks for a control message is also its type.

_CONTROL: Final = struct.Struct("@NiillNiiI4x")
"""The control messages, each a struct cmsghdr (length, level, type) and its value: the stamp, then the drop count if
something was dropped."""
_IOVEC: Final = struct.Struct("@PN")  # A struct iovec: address and length of the memory for one datagram
_MMSGHDR: Final = struct.Struct("@PIPNPNi0PI0P")
"""A struct mmsghdr: address and length of the sender's name, address and number of the iovecs, address and length of
the control messages, flags; then the length of the datagram. The kernel fills in the last three."""

if sys.platform == "linux":  # elsewhere the module can be imported, and no more
    _WITHOUT_COUNT = socket.CMSG_SPACE(struct.calcsize("@ll"))
    """Bytes of the control messages if nothing was dropped."""
    _libc = ctypes.CDLL(None, use_errno=True)
    _recvmmsg = _libc.recvmmsg
    _recvmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
    _recvmmsg.restype = ctypes.c_int
    _DONTWAIT = int(socket.MSG_DONTWAIT)  # the enumeration costs a conversion each time
    _WAITFORONE = 0x10000  # <linux/socket.h>


class Datagram(NamedTuple):
    """One datagram, and what the kernel says of it."""

    data: bytes
    wall_ns: int  # Arrival time, Unix time [ns]
    dropped: int | None
    """Datagrams that the kernel has dropped on this socket so far; None where nothing was dropped before this one."""
    flags: int  # ``MSG_CONFIRM``, ``MSG_TRUNC`` and so on


def stamp_and_count(sock: socket.socket) -> None:
    """Have the kernel stamp what arrives with nanoseconds, and tell what it drops."""
    sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    sock.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)


class DatagramReader:
    """Reads one socket that :func:`stamp_and_count` was called for; its memory is made once.

    Args:
        descriptor: of the socket.
        size: bytes of the longest datagram; what is longer is cut, and has ``MSG_TRUNC`` in its flags.
        most: datagrams in one call.
    """

    def __init__(self, descriptor: int, size: int, most: int) -> None:
        self._descriptor = descriptor
        self._size, self._most = size, most
        data = ctypes.create_string_buffer(size * most)
        self._data = memoryview(data).cast("B")
        self._control = ctypes.create_string_buffer(_CONTROL.size * most)
        self._vectors = ctypes.create_string_buffer(_IOVEC.size * most)  # the kernel reads it
        self._headers = ctypes.create_string_buffer(_MMSGHDR.size * most)
        data_at, control_at, vectors_at = map(ctypes.addressof, (data, self._control, self._vectors))
        for k in range(most):
            _IOVEC.pack_into(self._vectors, _IOVEC.size * k, data_at + size * k, size)
            places = vectors_at + _IOVEC.size * k, 1, control_at + _CONTROL.size * k, _CONTROL.size
            _MMSGHDR.pack_into(self._headers, _MMSGHDR.size * k, 0, 0, *places, 0, 0)
        self._address = ctypes.addressof(self._headers)
        self._fresh, self._used = self._headers.raw, False

    def read(self, *, wait: bool = False) -> list[Datagram]:
        """Returns waiting datagrams, oldest first, as many as fit into one call.

        Args:
            wait: if there is none, wait for the first: until a signal or the socket's own time-out ends that.

        Raises:
            OSError: the socket failed. What had come before is given first, the error by the next call.
        """
        if self._used:
            self._headers.raw = self._fresh  # the kernel wrote how much it used; not after reading, when time counts
            self._used = False
        count: int = _recvmmsg(self._descriptor, self._address, self._most, _WAITFORONE if wait else _DONTWAIT, None)
        if count < 0:
            code = ctypes.get_errno()
            if code == errno.EAGAIN or (wait and code == errno.EINTR):
                return []
            raise OSError(code, os.strerror(code))
        self._used = True
        found = []
        for k in range(count):
            _, _, _, _, _, used, flags, length = _MMSGHDR.unpack_from(self._headers, _MMSGHDR.size * k)
            _, _, _, seconds, nanoseconds, _, _, _, dropped = _CONTROL.unpack_from(self._control, _CONTROL.size * k)
            begin = self._size * k
            data, wall_ns = self._data[begin : begin + length].tobytes(), seconds * 1_000_000_000 + nanoseconds
            found.append(tuple.__new__(Datagram, (data, wall_ns, dropped if used > _WITHOUT_COUNT else None, flags)))
        return found
