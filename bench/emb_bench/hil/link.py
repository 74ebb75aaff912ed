"""Virtual CAN interfaces over rtnetlink: make, set up or down.

Sockets and nothing else: a minimal Debian has neither iproute2 nor kmod, and starting a program would disturb the one
processor whose bus is being watched. Source of the message layouts: netlink(7), rtnetlink(7), netdevice(7).
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct

ACK, REPLACE, EXCLUSIVE, CREATE = 0x4, 0x100, 0x200, 0x400
_REQUEST = 0x1
_HEADER = struct.Struct("=IHHII")
_ATTRIBUTE = struct.Struct("=HH")

_RTM_NEWLINK = 16
_IFLA_IFNAME, _IFLA_LINKINFO, _IFLA_INFO_KIND = 3, 18, 1
_IFINFO = struct.Struct("=BxHiII")
_IFF_UP = 1
_SIOCGIFFLAGS = 0x8913


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


def add(name: str) -> None:
    """Create the vcan interface ``name`` and set it up.

    Raises:
        OSError: no right to (EPERM), the kernel does not know the kind (EOPNOTSUPP), the name is taken (EEXIST).
    """
    info = attribute(_IFLA_LINKINFO, attribute(_IFLA_INFO_KIND, b"vcan"))
    head = _IFINFO.pack(socket.AF_UNSPEC, 0, 0, _IFF_UP, _IFF_UP)
    request(_RTM_NEWLINK, CREATE | EXCLUSIVE, head + attribute(_IFLA_IFNAME, name.encode() + b"\0") + info)


def set_up(name: str, up: bool = True) -> None:
    """Set an existing interface up or down; when it goes down, its sockets get ENETDOWN once.

    Raises:
        OSError: no such interface, or no right to.
    """
    index = socket.if_nametoindex(name)
    request(_RTM_NEWLINK, 0, _IFINFO.pack(socket.AF_UNSPEC, 0, index, _IFF_UP if up else 0, _IFF_UP))


def is_up(name: str) -> bool:
    """Returns True if an interface of this process's network namespace exists and is up."""
    if all(name != known for _, known in socket.if_nameindex()):
        return False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        answer = fcntl.ioctl(sock, _SIOCGIFFLAGS, struct.pack("=16sH22x", name.encode(), 0))
    return bool(struct.unpack_from("=H", answer, 16)[0] & _IFF_UP)
