"""Requests to the kernel's network configuration over rtnetlink, with nothing but sockets.

Neither iproute2 nor kmod is part of a minimal Debian, and starting a program would disturb the one processor whose
bus is being watched. Source of the message layout: netlink(7), rtnetlink(7).
"""

from __future__ import annotations

import os
import socket
import struct

ACK, REPLACE, EXCLUSIVE, CREATE = 0x4, 0x100, 0x200, 0x400
_REQUEST = 0x1
_ERROR = 2
_HEADER = struct.Struct("=IHHII")
_ATTRIBUTE = struct.Struct("=HH")
_TYPE_MASK = 0x3FFF  # without the flags for nested and network byte order


def attribute(kind: int, value: bytes) -> bytes:
    """One attribute: length without padding, type, value padded to four bytes."""
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value + b"\0" * (-len(value) % 4)


def attributes(data: bytes) -> dict[int, bytes]:
    """The attributes that follow one another in ``data``, by their type."""
    found = {}
    while len(data) >= _ATTRIBUTE.size:
        length, kind = _ATTRIBUTE.unpack_from(data)
        found[kind & _TYPE_MASK] = data[_ATTRIBUTE.size : length]
        data = data[length + (-length % 4) :]
    return found


def request(kind: int, flags: int, body: bytes) -> bytes:
    """Send one request and wait for its answer; the answer without its header, empty where it only confirms.

    Raises:
        OSError: what the kernel answered.
    """
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as sock:
        sock.send(_HEADER.pack(_HEADER.size + len(body), kind, flags | _REQUEST, 1, 0) + body)
        answer = sock.recv(65536)
    if _HEADER.unpack_from(answer)[1] != _ERROR:
        return answer[_HEADER.size :]
    (error,) = struct.unpack_from("=i", answer, _HEADER.size)
    if error:
        raise OSError(-error, os.strerror(-error))
    return b""
