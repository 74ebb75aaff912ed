"""The CAN frames of the bench, typed; ``emb.dbc`` is the only source of their layout.

What does not fit its signal raises. By definition device time and charge wrap, and the count of rejected commands
saturates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from importlib import resources
from typing import Any, Final, NamedTuple

from emb_runtime.can.codec import Message, describe, parse
from emb_runtime.can.generated import Field, generate_codec
from emb_runtime.records import CurrentCommand, Frame, NodeState

CHARGE: Final = "EMB_Charge"
OPTIONAL_VERSION: Final = 1  # Version of each of the three messages that a node need not send


class StopReason(IntEnum):
    """Reason for which the node does not obey, or last began a safe stop. Values are those of the DBC."""

    NONE = 0
    NEVER_COMMANDED = 1
    WATCHDOG = 2  # No fresh, valid, enabled command for the watchdog's time
    DISABLED = 3  # The host's command was disabled
    LIMIT = 4  # The brake reached a limit of the bench


class AngleFrame(NamedTuple):
    """Content of the angle message."""

    counter: int  # Alive counter, 0..14
    angle: float  # [rad]
    device_time_ns: int  # The node's time of the sampling instant, wrapped to ``Layout.device_time_period_ns`` [ns]


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


def _fields(version: int) -> dict[str, tuple[type[Any], tuple[Field, ...]]]:
    """Record of each message, and the signal of each of its fields: all but the CRC. Nobody decodes the last three."""
    node_state, optional = Field("NodeState", choices=tuple(NodeState)), Field("Version", fixed=OPTIONAL_VERSION)
    return {
        "EMB_Command": (
            CurrentCommand,
            (*map(Field, ("Counter", "Answers", "Current")), Field("Enable", choices=(False, True))),
        ),
        "EMB_Angle": (AngleFrame, (Field("Counter"), Field("Angle"), Field("DeviceTime", scale=10**9, wraps=True))),
        "EMB_Velocity": (
            VelocityFrame,
            (*map(Field, ("Counter", "Velocity", "AppliedCurrent")), node_state, Field("CommandCounter")),
        ),
        "EMB_Status": (
            StatusFrame,
            (
                Field("Counter"),
                node_state,
                Field("ProtocolVersion", fixed=version),
                Field("StopReason", choices=tuple(StopReason)),
                Field("RejectedCommands", saturates=True),
                Field("BenchIdentity"),
            ),
        ),
        CHARGE: (tuple, (Field("Counter"), optional, Field("Charge", wraps=True))),
        "EMB_Gateway": (
            tuple,
            (
                Field("Counter"),
                optional,
                *(Field(name, saturates=True) for name in ("NotSent", "Braked", "NotBelieved", "Refused")),
            ),
        ),
        "EMB_Conditions": (tuple, (Field("Counter"), optional, Field("Temperature"), Field("SupplyVoltage"))),
    }


@dataclass(frozen=True)
class Layout:
    """All messages of ``emb.dbc`` with their encoders and decoders, and its text.

    An encoder takes the fields of its record, and raises FrameError where a value does not fit. A decoder raises
    FrameRejectedError for a frame that is not valid in all respects.
    """

    text: str
    protocol_version: int
    command: Message
    angle: Message
    velocity: Message
    status: Message
    optional: Mapping[str, Message]  # By name: those that a node or a gateway may send
    encode_command: Callable[[int, int, float, bool], Frame]
    encode_angle: Callable[[int, float, int], Frame]
    encode_velocity: Callable[[int, float, float, NodeState, int], Frame]
    encode_status: Callable[[int, NodeState, StopReason, int, int], Frame]  # The version is the layout's
    encode_charge: Callable[[int, float], Frame]  # Counter of the sample, and the integral of the current up to it
    encode_gateway: Callable[[int, int, int, int, int], Frame]  # Counter, and counts since the gateway started
    encode_conditions: Callable[[int, float, float], Frame]  # Counter, temperature [degC], supply voltage [V]
    decode_command: Callable[[Frame], CurrentCommand]
    decode_angle: Callable[[Frame], AngleFrame]
    decode_velocity: Callable[[Frame], VelocityFrame]
    decode_status: Callable[[Frame], StatusFrame]

    @property
    def messages(self) -> dict[str, Message]:
        """Messages that every node takes or sends, by name."""
        return {message.name: message for message in (self.command, self.angle, self.velocity, self.status)}

    @property
    def all_messages(self) -> tuple[Message, ...]:
        """All messages, the optional ones included."""
        return (*self.messages.values(), *self.optional.values())

    @property
    def device_time_period_ns(self) -> int:
        """Period after which the device time wraps [ns]."""
        time = self.angle.signal("DeviceTime")
        return round(time.factor * 1e9) * (time.mask + 1)

    def current_within(self, limit: float) -> float:
        """The largest current that a command can carry and that is not beyond a limit [A]."""
        step = self.command.signal("Current").factor
        return math.floor(limit / step + 1e-6) * step  # in floats a multiple of the step may lie just below it

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
    fields = _fields(version)
    messages = [describe(database.get_message_by_name(name)) for name in fields]
    codecs = [generate_codec(message, *fields[message.name]) for message in messages]
    optional = {message.name: message for message in messages[4:]}
    # In the order of the layout's fields.
    parts: list[Any] = [*messages[:4], optional, *(codec.encode for codec in codecs)]
    return Layout(text, version, *parts, *(codec.decode for codec in codecs[:4]))
