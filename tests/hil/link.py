"""Requests over rtnetlink, and interfaces set up or down; starting a program would disturb the watched processor.

Source of the message layouts: netlink(7), rtnetlink(7), netdevice(7).
"""

from __future__ import annotations

import os
import socket
import struct

ACK, REPLACE, CREATE = 0x4, 0x100, 0x400
_REQUEST = 0x1
_HEADER = struct.Struct("=IHHII")
_ATTRIBUTE = struct.Struct("=HH")

_RTM_NEWLINK = 16
_IFINFO = struct.Struct("=BxHiII")
_IFF_UP = 1


def attribute(kind: int, value: bytes) -> bytes:
    """One attribute: length without padding, type, value padded to four bytes."""
    return _ATTRIBUTE.pack(_ATTRIBUTE.size + len(value), kind) + value + b"\0" * (-len(value) % 4)


def request(kind: int, flags: int, body: bytes) -> None:
    """Send one request and wait until the kernel has acknowledged it.

    Raises:
        OSError: what the kernel answered.
    """
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as sock:
        sock.send(_HEADER.pack(_HEADER.size + len(body), kind, flags | ACK | _REQUEST, 1, 0) + body)
        (error,) = struct.unpack_from("=i", sock.recv(65536), _HEADER.size)
    if error:
        raise OSError(-error, os.strerror(-error))


def set_up(name: str, up: bool = True) -> None:
    """Set an existing interface up or down; when it goes down, its sockets get ENETDOWN once.

    Raises:
        OSError: no such interface, or no right to.
    """
    index = socket.if_nametoindex(name)
    request(_RTM_NEWLINK, 0, _IFINFO.pack(socket.AF_UNSPEC, 0, index, _IFF_UP if up else 0, _IFF_UP))
