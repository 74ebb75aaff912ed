"""Network interfaces by rtnetlink, because neither iproute2 nor kmod is part of a minimal Debian.

Source of the message layout: rtnetlink(7), netlink(7), netdevice(7).
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct

_RTM_NEWLINK, _RTM_DELLINK = 16, 17
_REQUEST, _ACK, _EXCL, _CREATE = 0x1, 0x4, 0x200, 0x400
_IFLA_IFNAME, _IFLA_LINKINFO, _IFLA_INFO_KIND = 3, 18, 1
_IFF_UP = 1
_SIOCGIFFLAGS = 0x8913


def _attribute(kind: int, value: bytes) -> bytes:
    """One netlink attribute: length without padding, type, value padded to four bytes."""
    return struct.pack("=HH", 4 + len(value), kind) + value + b"\0" * (-len(value) % 4)


def _request(kind: int, flags: int, index: int, up: bool, attributes: bytes) -> None:
    body = struct.pack("=BxHiII", socket.AF_UNSPEC, 0, index, _IFF_UP if up else 0, _IFF_UP if up else 0) + attributes
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as sock:
        sock.send(struct.pack("=IHHII", 16 + len(body), kind, flags | _REQUEST | _ACK, 1, 0) + body)
        (error,) = struct.unpack_from("=i", sock.recv(65536), 16)
    if error:
        raise OSError(-error, os.strerror(-error))


def add(name: str, kind: str) -> None:
    """Create the interface ``name`` of a virtual ``kind`` such as ``vcan`` and set it up.

    Raises:
        OSError: no right to (EPERM), the kernel does not know the kind (EOPNOTSUPP), the name is taken (EEXIST).
    """
    info = _attribute(_IFLA_LINKINFO, _attribute(_IFLA_INFO_KIND, kind.encode()))
    _request(_RTM_NEWLINK, _CREATE | _EXCL, 0, True, _attribute(_IFLA_IFNAME, name.encode() + b"\0") + info)


def set_up(name: str) -> None:
    """Set an existing interface up.

    Raises:
        OSError: no such interface, or no right to.
    """
    _request(_RTM_NEWLINK, 0, socket.if_nametoindex(name), True, b"")


def exists(name: str) -> bool:
    """Whether the network namespace of this process has the interface; /sys may show another namespace's."""
    return any(name == known for _, known in socket.if_nameindex())


def is_up(name: str) -> bool:
    """Whether an existing interface is up.

    Raises:
        OSError: no such interface.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        answer = fcntl.ioctl(sock, _SIOCGIFFLAGS, struct.pack("=16sH22x", name.encode(), 0))
    return bool(struct.unpack_from("=H", answer, 16)[0] & _IFF_UP)


def remove(name: str) -> None:
    """Remove a virtual interface.

    Raises:
        OSError: no such interface, or no right to.
    """
    _request(_RTM_DELLINK, 0, socket.if_nametoindex(name), False, b"")
