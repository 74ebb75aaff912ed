"""The CAN frames of the bench, typed; ``emb.dbc`` is the only source of their layout.

What does not fit its signal raises. Two signals wrap and saturate by definition, and only their encoders do that: the
device time and the count of rejected commands.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from importlib import resources
from typing import Final, NamedTuple

from emb_runtime.can.codec import Fault, FrameRejectedError, Message, Signal, generate, parse
from emb_runtime.errors import FrameError
from emb_runtime.records import CurrentCommand, Frame, NodeState

__all__ = [
    "AngleFrame",
    "Fault",
    "FrameRejectedError",
    "Layout",
    "Message",
    "Signal",
    "StatusFrame",
    "StopReason",
    "VelocityFrame",
    "bench_identity",
    "load_layout",
]

# What the typed encoders and decoders below fill in and read, in this order; a DBC that says otherwise is not ours.
_SIGNALS = {
    "EMB_Command": ("CRC", "Counter", "Answers", "Current", "Enable"),
    "EMB_Angle": ("CRC", "Counter", "Angle", "DeviceTime"),
    "EMB_Velocity": ("CRC", "Counter", "NodeState", "Velocity", "AppliedCurrent", "CommandCounter"),
    "EMB_Status": (
        *("CRC", "Counter", "NodeState", "ProtocolVersion", "StopReason", "RejectedCommands", "BenchIdentity"),
    ),
}

CHARGE: Final = "EMB_Charge"  # Name of an optional message, which the layouts of older logs do not have
_CHARGE_SIGNALS = ("CRC", "Counter", "Version", "Charge")
CHARGE_VERSION: Final = 1  # Version of the charge message

_NODE_STATES: Final = tuple(NodeState)
"""By their value: calling the enumeration takes three times as long, and each velocity frame has one."""


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


@dataclass(frozen=True)
class Layout:
    """All messages of the bench, their typed encoders and decoders, and the DBC text that they come from."""

    text: str
    protocol_version: int
    messages: Mapping[str, Message]  # Those that every node takes or sends, by name
    command: Message
    angle: Message
    velocity: Message
    status: Message
    charge: Message | None  # Optional: a node may send it, and a layout of an older log does not know it
    device_time_step: float  # Resolution of the device time stamps [s]
    device_time_step_ns: int  # Resolution of the device time in whole nanoseconds
    device_time_period_ns: int  # Period after which the device time wraps [ns]

    def encode_command(self, command: CurrentCommand) -> Frame:
        """The command frame.

        Raises:
            FrameError: the current is not finite or beyond the DBC's range, or a counter is not in 0..14.
        """
        return self.command.pack(command.counter, command.answers, command.current, command.enable)

    def decode_command(self, frame: Frame) -> CurrentCommand:
        """Decodes a command frame; raises FrameRejectedError."""
        counter, answers, current, enable = self.command.values(frame)
        return tuple.__new__(CurrentCommand, (counter, answers, current, enable != 0))

    def encode_angle(self, counter: int, angle: float, device_time_ns: int) -> Frame:
        """The angle frame.

        Args:
            counter: alive counter, 0..14.
            angle: [rad].
            device_time_ns: unwrapped; rounded to the signal's step and wrapped here [ns].

        Raises:
            FrameError: a value does not fit.
        """
        step_ns = self.device_time_step_ns
        steps = (device_time_ns + step_ns // 2) % self.device_time_period_ns // step_ns
        return self.angle.pack(counter, angle, steps * self.device_time_step)

    def decode_angle(self, frame: Frame) -> AngleFrame:
        """Decodes an angle frame; raises FrameRejectedError."""
        counter, angle, device_time = self.angle.values(frame)
        return tuple.__new__(AngleFrame, (counter, angle, round(device_time * 1e9)))

    def encode_velocity(
        self, counter: int, velocity: float, applied_current: float, node_state: NodeState, command_counter: int
    ) -> Frame:
        """The velocity frame.

        Args:
            counter: alive counter, 0..14.
            velocity: [rad/s].
            applied_current: in the period that ends at this sample [A].
            node_state: at the sampling instant.
            command_counter: counter of the command that was applied, 15 if none was.

        Raises:
            FrameError: a value does not fit.
        """
        return self.velocity.pack(counter, node_state, velocity, applied_current, command_counter)

    def decode_velocity(self, frame: Frame) -> VelocityFrame:
        """Decodes a velocity frame; raises FrameRejectedError."""
        counter, node_state, velocity, applied_current, command_counter = self.velocity.values(frame)
        state = _NODE_STATES[node_state]
        return tuple.__new__(VelocityFrame, (counter, velocity, applied_current, state, command_counter))

    def encode_status(
        self, counter: int, node_state: NodeState, stop_reason: StopReason, rejected: int, bench_identity: int
    ) -> Frame:
        """The status frame; the protocol version is this layout's.

        Args:
            counter: alive counter, 0..14.
            node_state: now.
            stop_reason: see :class:`StopReason`.
            rejected: commands not obeyed so far; saturates at the signal's maximum.
            bench_identity: :func:`bench_identity` of the node's bench file.

        Raises:
            FrameError: a value does not fit.
        """
        saturated = min(rejected, self.status.signal("RejectedCommands").raw_maximum)
        return self.status.pack(counter, node_state, self.protocol_version, stop_reason, saturated, bench_identity)

    def decode_status(self, frame: Frame) -> StatusFrame:
        """Decodes a status frame; raises FrameRejectedError."""
        counter, node_state, version, stop_reason, rejected, identity = self.status.values(frame)
        return StatusFrame(counter, NodeState(node_state), version, StopReason(stop_reason), rejected, identity)

    def encode_charge(self, counter: int, charge: float) -> Frame:
        """The frame of the charge.

        Args:
            counter: alive counter of the sample, 0..14.
            charge: integral of the current up to the sample [A·s]; rounded to the signal's step and wrapped here.

        Raises:
            FrameError: a value does not fit, or the layout has no such message.
        """
        if self.charge is None:
            raise FrameError(f"DBC: no message {CHARGE}: expected a layout that has it")
        signal = self.charge.signal("Charge")
        steps = round(charge / signal.factor) % (signal.raw_maximum + 1)
        return self.charge.pack(counter, CHARGE_VERSION, steps * signal.step)

    @property
    def known(self) -> tuple[Message, ...]:
        """All messages, the optional one included."""
        required = tuple(self.messages.values())
        return required if self.charge is None else (*required, self.charge)

    def decode_any(self, frame: Frame) -> tuple[str, dict[str, float]] | None:
        """Message name and signal values of a valid frame of ours; None for every other frame."""
        for message in self.known:
            if frame.identifier == message.identifier:
                try:
                    return message.name, message.decode(frame)
                except FrameRejectedError:
                    return None
        return None

    def current_within(self, limit: float) -> float:
        """The largest current that a command can carry and that is not beyond a limit [A]."""
        step = self.command.signal("Current").factor
        return math.floor(limit / step + 1e-6) * step  # a limit of whole steps may be no whole number of them in floats

    def bus_load(self, bitrate: int) -> float:
        """Worst-case share of the bus that ``messages`` take at their cycle times, 1.0 being all of it.

        Args:
            bitrate: [bit/s].
        """
        return sum(m.worst_bits / m.cycle_time for m in self.messages.values()) / bitrate


def bench_identity(contract_hash: str) -> int:
    """The 16 bits of a bench's hash (hexadecimal) that the status message carries."""
    return int(contract_hash[:4], 16)


def load_layout(dbc_text: str | None = None) -> Layout:
    """Generate the codec from the text of a DBC file; without one, from the shipped ``emb.dbc``.

    Raises:
        FrameError: the text is not a DBC, or not one of this protocol: the message names the entry and the reason.
    """
    return _shipped_layout() if dbc_text is None else _generate(dbc_text)


@cache
def _shipped_layout() -> Layout:
    return _generate(resources.files("emb_runtime.can").joinpath("emb.dbc").read_text(encoding="utf-8"))


def _generate(text: str) -> Layout:
    database = parse(text)
    messages = {name: generate(database, name, signals) for name, signals in _SIGNALS.items()}
    has_charge = any(message.name == CHARGE for message in database.messages)
    time = messages["EMB_Angle"].signal("DeviceTime")
    step_ns = round(time.factor * 1e9)
    if step_ns < 1 or not math.isclose(step_ns * 1e-9, time.factor, rel_tol=1e-9):
        raise FrameError(f"DBC: EMB_Angle.DeviceTime: expected a step of whole nanoseconds, got {time.factor:g} s")
    _check_choices(messages["EMB_Velocity"], "NodeState", NodeState)
    _check_choices(messages["EMB_Status"], "NodeState", NodeState)
    _check_choices(messages["EMB_Status"], "StopReason", StopReason)
    attributes = database.dbc.attributes if database.dbc else {}
    if "EmbProtocolVersion" not in attributes:
        raise FrameError("DBC: expected the attribute EmbProtocolVersion; this file is not a layout of this bench")
    return Layout(
        text=text,
        protocol_version=int(attributes["EmbProtocolVersion"].value),
        messages=messages,
        command=messages["EMB_Command"],
        angle=messages["EMB_Angle"],
        velocity=messages["EMB_Velocity"],
        status=messages["EMB_Status"],
        charge=generate(database, CHARGE, _CHARGE_SIGNALS) if has_charge else None,
        device_time_step=time.factor,
        device_time_step_ns=step_ns,
        device_time_period_ns=step_ns * (time.mask + 1),
    )


def _check_choices(message: Message, name: str, enum: type[IntEnum]) -> None:
    """Refuse a value table that says something else than the enum its values are decoded to."""
    signal = message.signal(name)
    expected = {int(member): member.name.lower() for member in enum}
    if signal.choices != expected or (signal.raw_minimum, signal.raw_maximum) != (min(expected), max(expected)):
        raise FrameError(f"DBC: {message.name}.{name}: expected the values {expected}, got {signal.choices}")
