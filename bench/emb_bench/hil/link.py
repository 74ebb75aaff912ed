"""Network interfaces over rtnetlink: make, set up and down, give a bit rate, read the state of a controller.

Sockets and nothing else: neither iproute2 nor kmod is part of a minimal Debian, and starting a program would disturb
the one processor whose bus is being watched. Source of the message layouts: netlink(7), rtnetlink(7), netdevice(7),
the kernel's ``linux/can/netlink.h``.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
from dataclasses import dataclass
from enum import IntEnum

ACK, REPLACE, EXCLUSIVE, CREATE = 0x4, 0x100, 0x200, 0x400
_REQUEST = 0x1
_ERROR = 2
_HEADER = struct.Struct("=IHHII")
_ATTRIBUTE = struct.Struct("=HH")
_TYPE_MASK = 0x3FFF  # without the flags for nested and network byte order

_RTM_NEWLINK, _RTM_DELLINK, _RTM_GETLINK = 16, 17, 18
_IFLA_IFNAME, _IFLA_LINKINFO = 3, 18
_IFLA_INFO_KIND, _IFLA_INFO_DATA = 1, 2
_IFLA_CAN_BITTIMING, _IFLA_CAN_STATE, _IFLA_CAN_BERR_COUNTER = 1, 4, 8
_IFINFO = struct.Struct("=BxHiII")
_BITTIMING = struct.Struct("=8I")  # struct can_bittiming; the bit rate is its first word
_IFF_UP = 1
_SIOCGIFFLAGS = 0x8913


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


class State(IntEnum):
    """The states of a CAN controller, ``enum can_state``."""

    ERROR_ACTIVE = 0
    ERROR_WARNING = 1
    ERROR_PASSIVE = 2
    BUS_OFF = 3
    STOPPED = 4
    SLEEPING = 5


@dataclass(frozen=True)
class Controller:
    """State, bit rate and error counters of a CAN controller."""

    state: State
    bitrate: int  # bit/s
    transmit_errors: int  # its transmit error counter, 0..255
    receive_errors: int  # its receive error counter, 0..255


def _set(index: int, kind: int, flags: int, attached: bytes, up: bool | None = None) -> None:
    """Change, make or remove an interface; ``up`` None leaves it as it is."""
    mask = 0 if up is None else _IFF_UP
    body = _IFINFO.pack(socket.AF_UNSPEC, 0, index, _IFF_UP if up else 0, mask)
    request(kind, flags | ACK, body + attached)


def add(name: str, kind: str) -> None:
    """Create the interface ``name`` of a virtual ``kind`` such as ``vcan`` and set it up.

    Raises:
        OSError: no right to (EPERM), the kernel does not know the kind (EOPNOTSUPP), the name is taken (EEXIST).
    """
    info = attribute(_IFLA_LINKINFO, attribute(_IFLA_INFO_KIND, kind.encode()))
    _set(0, _RTM_NEWLINK, CREATE | EXCLUSIVE, attribute(_IFLA_IFNAME, name.encode() + b"\0") + info, up=True)


def set_up(name: str) -> None:
    """Set an existing interface up.

    Raises:
        OSError: no such interface, or no right to.
    """
    _set(socket.if_nametoindex(name), _RTM_NEWLINK, 0, b"", up=True)


def set_down(name: str) -> None:
    """Set an existing interface down; its sockets get ENETDOWN once.

    Raises:
        OSError: no such interface, or no right to.
    """
    _set(socket.if_nametoindex(name), _RTM_NEWLINK, 0, b"", up=False)


def set_bitrate(name: str, bitrate: int) -> None:
    """Give a CAN controller that is down its bit rate [bit/s]; the kernel finds the bit timing.

    Raises:
        OSError: no such interface, it has no bit rate (EOPNOTSUPP), it is up (EBUSY), none fits (EDOM, EINVAL).
    """
    timing = attribute(_IFLA_CAN_BITTIMING, _BITTIMING.pack(bitrate, *[0] * 7))
    info = attribute(_IFLA_INFO_KIND, b"can") + attribute(_IFLA_INFO_DATA, timing)
    _set(socket.if_nametoindex(name), _RTM_NEWLINK, 0, attribute(_IFLA_LINKINFO, info))


def controller(name: str) -> Controller:
    """State, bit rate and error counters of a CAN controller; counters are 0 where it has none.

    Raises:
        OSError: no such interface.
        ValueError: the interface is no CAN controller.
    """
    body = _IFINFO.pack(socket.AF_UNSPEC, 0, socket.if_nametoindex(name), 0, 0)
    link = attributes(request(_RTM_GETLINK, 0, body)[_IFINFO.size :])
    info = attributes(link.get(_IFLA_LINKINFO, b""))
    data = attributes(info.get(_IFLA_INFO_DATA, b""))
    if _IFLA_CAN_STATE not in data:
        raise ValueError(f"{name} has no controller: expected a CAN device with a bit rate, such as can0")
    (state,) = struct.unpack("=I", data[_IFLA_CAN_STATE])
    (bitrate,) = struct.unpack_from("=I", data.get(_IFLA_CAN_BITTIMING, bytes(4)))
    transmit, receive = struct.unpack("=HH", data.get(_IFLA_CAN_BERR_COUNTER, bytes(4)))
    return Controller(State(state), bitrate, transmit, receive)


def exists(name: str) -> bool:
    """Returns True if the network namespace of this process has the interface; /sys may show another namespace's."""
    return any(name == known for _, known in socket.if_nameindex())


def is_up(name: str) -> bool:
    """Returns True if an existing interface is up.

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
    _set(socket.if_nametoindex(name), _RTM_DELLINK, 0, b"")
