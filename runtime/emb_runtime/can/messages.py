"""The CAN frames of the bench, typed; ``emb.dbc`` is the only source of their layout.

What does not fit its signal raises. By definition device time and charge wrap, and the count of rejected commands
saturates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

from emb_runtime.can.codec import Message, describe, parse
from emb_runtime.can.generated import Field, generate_codec
from emb_runtime.records import CurrentCommand, Frame, NodeState

CHARGE: Final = "EMB_Charge"
GATEWAY: Final = "EMB_Gateway"  # Names of the messages that a node need not send
OPTIONAL_VERSION: Final = 1  # Version of each of the two


class StopReason(IntEnum):
    """Reason for which the node does not obey, or last began a safe stop. Values are those of the DBC."""

    NONE = 0
    NEVER_COMMANDED = 1
    WATCHDOG = 2  # No fresh, valid, enabled command for the watchdog's time
    DISABLED = 3  # The host said disabled
    LIMIT = 4  # The brake reached a limit of the bench


class AngleFrame(NamedTuple):
    """Content of the angle message."""

    counter: int  # Alive counter, 0..14
    angle: float  # [rad]
    device_time_ns: int  # The node's own time of the sampling instant, wrapped to ``Layout.device_time_period_ns`` [ns]


class VelocityFrame(NamedTuple):
    """Content of the velocity message."""

    counter: int  # Alive counter, 0..14
    velocity: float  # [rad/s]
    applied_current: float  # Applied in the period that ends at this sample [A]
    node_state: NodeState
    command_counter: int  # Counter of the command applied in the period that ends at this sample; 15: none


class StatusFrame(NamedTuple):
    """Content of the status message."""

    counter: int  # Alive counter, 0..14
    node_state: NodeState
    protocol_version: int
    stop_reason: StopReason
    rejected: int  # Command frames not obeyed since the node started; saturated at the signal's maximum
    bench_identity: int  # :func:`bench_identity` of the node's bench file


class ChargeFrame(NamedTuple):
    """Content of the charge message."""

    counter: int  # Alive counter of the sample, 0..14
    version: int  # :data:`OPTIONAL_VERSION`
    charge: float  # Integral of the current up to the sample, wrapped [A·s]


class GatewayFrame(NamedTuple):
    """Content of the gateway's message: counts since it started, saturated."""

    counter: int  # Alive counter, 0..14
    version: int  # :data:`OPTIONAL_VERSION`
    not_sent: int  # Commands for which the drive's bus had no room
    braked: int  # Periods without an answer in time, while a run was active
    not_believed: int  # Frames of the drive that were refused
    refused: int  # Frames to the drive that the second guard refused


_FIELDS: Mapping[str, tuple[type[Any], tuple[Field, ...]]] = {
    "EMB_Command": (
        CurrentCommand,
        (Field("Counter"), Field("Answers"), Field("Current"), Field("Enable", choices=(False, True))),
    ),
    "EMB_Angle": (
        AngleFrame,
        (Field("Counter"), Field("Angle"), Field("DeviceTime", scale=10**9, wraps=True)),
    ),
    "EMB_Velocity": (
        VelocityFrame,
        (
            Field("Counter"),
            Field("Velocity"),
            Field("AppliedCurrent"),
            Field("NodeState", choices=tuple(NodeState)),
            Field("CommandCounter"),
        ),
    ),
    "EMB_Status": (
        StatusFrame,
        (
            Field("Counter"),
            Field("NodeState", choices=tuple(NodeState)),
            Field("ProtocolVersion"),
            Field("StopReason", choices=tuple(StopReason)),
            Field("RejectedCommands", saturates=True),
            Field("BenchIdentity"),
        ),
    ),
    CHARGE: (ChargeFrame, (Field("Counter"), Field("Version", fixed=OPTIONAL_VERSION), Field("Charge", wraps=True))),
    GATEWAY: (
        GatewayFrame,
        (
            Field("Counter"),
            Field("Version", fixed=OPTIONAL_VERSION),
            Field("NotSent", saturates=True),
            Field("Braked", saturates=True),
            Field("NotBelieved", saturates=True),
            Field("Refused", saturates=True),
        ),
    ),
}
"""Record of each message, and the signal of each of its fields: all but the CRC."""


@dataclass(frozen=True)
class Layout:
    """All messages of ``emb.dbc`` with their encoders and decoders, and its text.

    An encoder takes the fields of its record, and raises FrameError where a value does not fit. A decoder raises
    FrameRejectedError for a frame that is not valid in all respects.
    """

    text: str
    protocol_version: int
    messages: Mapping[str, Message]  # Those that every node takes or sends, by name
    command: Message
    angle: Message
    velocity: Message
    status: Message
    charge: Message  # A node may send it
    gateway: Message  # A gateway sends it
    device_time_period_ns: int  # Period after which the device time wraps [ns]
    encode_command: Callable[[int, int, float, bool], Frame]
    encode_angle: Callable[[int, float, int], Frame]
    encode_velocity: Callable[[int, float, float, NodeState, int], Frame]
    encode_status: Callable[[int, NodeState, StopReason, int, int], Frame]  # The version is the layout's
    encode_charge: Callable[[int, float], Frame]
    encode_gateway: Callable[[int, int, int, int, int], Frame]
    decode_command: Callable[[Frame], CurrentCommand]
    decode_angle: Callable[[Frame], AngleFrame]
    decode_velocity: Callable[[Frame], VelocityFrame]
    decode_status: Callable[[Frame], StatusFrame]

    @property
    def known(self) -> tuple[Message, ...]:
        """All messages, those included that need not be sent."""
        return (*self.messages.values(), self.charge, self.gateway)

    def current_within(self, limit: float) -> float:
        """The largest current that a command can carry and that is not beyond a limit [A]."""
        step = self.command.signal("Current").factor
        return math.floor(limit / step + 1e-6) * step  # a limit of whole steps may be no whole number of them in floats

    def bus_load(self, bitrate: int) -> float:
        """Worst-case share of the bus that ``messages`` take at their cycle times and a bitrate; 1.0 is all of it."""
        return sum(m.worst_bits / m.cycle_time for m in self.messages.values()) / bitrate


def bench_identity(identity_hash: str) -> int:
    """The 16 bits of a bench's hash (hexadecimal) that the status message carries."""
    return int(identity_hash[:4], 16)


@cache
def load_layout() -> Layout:
    """Generate the codec from ``emb.dbc``."""
    text = resources.files("emb_runtime.can").joinpath("emb.dbc").read_text(encoding="utf-8")
    database: Any = parse(text)
    version = int(database.dbc.attributes["EmbProtocolVersion"].value)
    messages = {name: describe(database.get_message_by_name(name)) for name in _FIELDS}
    codecs = {name: generate_codec(message, *_fields(name, version)) for name, message in messages.items()}
    command, angle, velocity, status, charge, gateway = codecs.values()
    optional = messages.pop(CHARGE), messages.pop(GATEWAY)
    time = messages["EMB_Angle"].signal("DeviceTime")
    return Layout(
        text=text,
        protocol_version=version,
        messages=messages,
        command=messages["EMB_Command"],
        angle=messages["EMB_Angle"],
        velocity=messages["EMB_Velocity"],
        status=messages["EMB_Status"],
        charge=optional[0],
        gateway=optional[1],
        device_time_period_ns=round(time.factor * 1e9) * (time.mask + 1),
        encode_command=command.encode,
        encode_angle=angle.encode,
        encode_velocity=velocity.encode,
        encode_status=status.encode,
        encode_charge=charge.encode,
        encode_gateway=gateway.encode,
        decode_command=command.decode,
        decode_angle=angle.decode,
        decode_velocity=velocity.decode,
        decode_status=status.decode,
    )


def _fields(name: str, version: int) -> tuple[type[Any], tuple[Field, ...]]:
    record, fields = _FIELDS[name]
    return record, tuple(replace(f, fixed=version) if f.signal == "ProtocolVersion" else f for f in fields)
