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
from typing import NamedTuple

_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40
# <asm-generic/socket.h>: the option that asks for a control message is also its type.

_CONTROL = struct.Struct("@NiillNiiI4x")
"""The control messages, each a struct cmsghdr (length, level, type) and its value: the stamp, then the drop count if
something was dropped."""
_WITHOUT_COUNT = socket.CMSG_SPACE(struct.calcsize("@ll"))
"""Bytes of the control messages if nothing was dropped."""


class _Iovec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Msghdr(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint),
        ("vector", ctypes.POINTER(_Iovec)),
        ("vector_length", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Mmsghdr(ctypes.Structure):
    _fields_ = (("header", _Msghdr), ("length", ctypes.c_uint))


_LENGTHS = struct.Struct(f"@Ni{ctypes.sizeof(_Msghdr) - _Msghdr.flags.offset - _Msghdr.flags.size}xI")
"""Fields of a _Mmsghdr that the kernel fills in: control length, flags and length."""
_LENGTHS_AT = _Msghdr.control_length.offset

_libc = ctypes.CDLL(None, use_errno=True)
_recvmmsg = _libc.recvmmsg
_recvmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
_recvmmsg.restype = ctypes.c_int
_DONTWAIT = int(socket.MSG_DONTWAIT)  # the enumeration costs a conversion each time


class Datagram(NamedTuple):
    """One datagram, and what the kernel says of it."""

    data: bytes
    wall_ns: int
    """Arrival time, Unix time [ns]."""
    dropped: int | None
    """Datagrams that the kernel has dropped on this socket so far; None where nothing was dropped before this one."""
    flags: int
    """``MSG_CONFIRM``, ``MSG_TRUNC`` and so on."""


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
        data, control = ctypes.create_string_buffer(size * most), ctypes.create_string_buffer(_CONTROL.size * most)
        headers = (_Mmsghdr * most)()
        vectors = (_Iovec * most)()
        for k, message in enumerate(headers):
            vectors[k] = _Iovec(ctypes.addressof(data) + size * k, size)
            message.header.vector = ctypes.pointer(vectors[k])
            message.header.vector_length = 1
            message.header.control = ctypes.addressof(control) + _CONTROL.size * k
            message.header.control_length = _CONTROL.size
        self._vectors = vectors  # the kernel reads it
        self._address = ctypes.addressof(headers)
        self._data, self._control, self._headers = (memoryview(m).cast("B") for m in (data, control, headers))
        self._fresh, self._used = bytes(self._headers), False
        self._places = [(ctypes.sizeof(_Mmsghdr) * k + _LENGTHS_AT, _CONTROL.size * k, size * k) for k in range(most)]

    def read(self) -> list[Datagram]:
        """Returns waiting datagrams, oldest first, as many as fit into one call; never waits.

        Raises:
            OSError: the socket failed. What had come before is given first, the error by the next call.
        """
        if self._used:
            self._headers[:] = self._fresh  # the kernel wrote how much it used; not after reading, when time counts
            self._used = False
        count: int = _recvmmsg(self._descriptor, self._address, self._most, _DONTWAIT, None)
        if count < 0:
            code = ctypes.get_errno()
            if code == errno.EAGAIN:
                return []
            raise OSError(code, os.strerror(code))
        self._used = True
        found = []
        for lengths_at, control_at, begin in self._places[:count]:
            used, flags, length = _LENGTHS.unpack_from(self._headers, lengths_at)
            _, _, _, seconds, nanoseconds, _, _, _, dropped = _CONTROL.unpack_from(self._control, control_at)
            found.append(
                Datagram(
                    bytes(self._data[begin : begin + length]),
                    seconds * 1_000_000_000 + nanoseconds,
                    dropped if used > _WITHOUT_COUNT else None,
                    flags,
                )
            )
        return found
