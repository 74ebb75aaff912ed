"""The topics of a log and their protobuf messages, with descriptors built when the program runs.

Every scalar field has explicit presence (``proto3_optional``), so that a zero is written and read as a zero. MCAP has
no place for units: they travel in the channel's metadata, together with what each field means.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from emb_runtime.records import CYCLE_UNITS, CycleRecord, NodeState, Reason, RunState

_Proto = descriptor_pb2.FieldDescriptorProto
_TYPES = {
    "double": _Proto.TYPE_DOUBLE,
    "int64": _Proto.TYPE_INT64,
    "uint64": _Proto.TYPE_UINT64,
    "uint32": _Proto.TYPE_UINT32,
    "bool": _Proto.TYPE_BOOL,
    "string": _Proto.TYPE_STRING,
    "bytes": _Proto.TYPE_BYTES,
}


class Field(NamedTuple):
    """One field of a message."""

    name: str
    type: str  # A key of the protobuf scalar types above, or ``enum``
    unit: str = ""  # SI unit, empty if it has none
    choices: Mapping[str, int] | None = None  # Names and values, for an ``enum``


@dataclass(frozen=True)
class Topic:
    """One channel of the log: its name, its message, and what a reader should know about the fields."""

    name: str  # With a leading slash
    message: str  # Fully qualified protobuf name
    fields: tuple[Field, ...]
    notes: Mapping[str, str]  # Further channel metadata

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of the channel: the units as JSON, and the notes."""
        units = {f.name: f.unit for f in self.fields if f.unit}
        return ({"units": json.dumps(units, ensure_ascii=False)} if units else {}) | dict(self.notes)

    @cached_property
    def descriptor(self) -> descriptor_pb2.FileDescriptorSet:
        """The message, as a reader without our code needs it."""
        package, _, short = self.message.rpartition(".")
        file = descriptor_pb2.FileDescriptorProto(
            name=f"{self.message.replace('.', '/')}.proto", package=package, syntax="proto3"
        )
        message = file.message_type.add(name=short)
        for number, field in enumerate(self.fields, 1):
            proto = message.field.add(name=field.name, number=number, label=_Proto.LABEL_OPTIONAL)
            if field.type == "enum":
                proto.type = _Proto.TYPE_ENUM
                proto.type_name = f".{self.message}.{self._add_enum(message, field)}"
            else:
                proto.type = _TYPES[field.type]
            proto.proto3_optional = True
            proto.oneof_index = len(message.oneof_decl)
            message.oneof_decl.add(name=f"_{field.name}")
        return descriptor_pb2.FileDescriptorSet(file=[file])

    def _add_enum(self, message: descriptor_pb2.DescriptorProto, field: Field) -> str:
        """Declare a field's enum and return its name inside the message.

        The values of a protobuf enum share the namespace of what encloses it, so each enum gets an enclosing message
        of its own: RunState and NodeState both have an ACTIVE.
        """
        title = "".join(part.capitalize() for part in field.name.split("_"))
        enum = message.nested_type.add(name=title).enum_type.add(name="Value")
        choices = dict(field.choices or {})
        if 0 not in choices.values():
            choices = {"UNNAMED_0": 0} | choices  # proto3 demands a zero, first
        for label, value in sorted(choices.items(), key=lambda item: item[1]):
            enum.value.add(name=label, number=value)
        return f"{title}.Value"

    @cached_property
    def factory(self) -> Any:
        """The message class."""
        pool = descriptor_pool.DescriptorPool()
        for file in self.descriptor.file:
            pool.Add(file)
        return message_factory.GetMessageClass(pool.FindMessageTypeByName(self.message))


def _names(enum: type[IntEnum]) -> dict[str, int]:
    return {member.name: int(member) for member in enum}


_FRAME_FIELDS = (  # the names of can_msgs/Frame, then what only we know
    Field("id", "uint32"),
    Field("is_rtr", "bool"),
    Field("is_extended", "bool"),
    Field("is_error", "bool"),
    Field("dlc", "uint32"),
    Field("data", "bytes"),
    Field("dropped", "uint64"),
    Field("read_time_ns", "int64", "ns"),
)


def _frame_topic(name: str, what: str) -> Topic:
    notes = {
        "description": what,
        "dropped": "frames that the kernel has dropped on this socket so far",
        "read_time_ns": "monotonic time at which the loop had the frames of one read; 0 in all but the last of them",
    }
    return Topic(name, "emb.CanFrame", _FRAME_FIELDS, notes)


CAN_RX = _frame_topic("/can/rx", "every frame that was received")
CAN_TX = _frame_topic("/can/tx", "every frame that was sent")
DRIVE = _frame_topic("/drive/rx", "every frame on the bus of a mapped drive, its gateway's among them")

_CYCLE_ENUMS = {"state": _names(RunState), "node_state": _names(NodeState)}


def _cycle_field(name: str) -> Field:
    if choices := _CYCLE_ENUMS.get(name):
        return Field(name, "enum", "", choices)
    if name in CYCLE_UNITS:
        return Field(name, "double", CYCLE_UNITS[name])
    return Field(name, "int64", "ns") if name.endswith("_ns") else Field(name, "int64")


CYCLE = Topic(
    "/cycle",
    "emb.Cycle",
    tuple(_cycle_field(name) for name in CycleRecord._fields),
    {
        "description": "one record per control cycle; times are monotonic, a value that a cycle does not have is NaN",
        "reasons": ", ".join(f"{int(bit)} {bit.name}" for bit in Reason if bit.name),
    },
)
SAFETY = Topic(
    "/safety", "emb.SafetyEvent", (Field("code", "string"), Field("text", "string")), {"description": "on change"}
)
CLOCK = Topic(
    "/clock",
    "emb.ClockSample",
    (Field("monotonic_ns", "int64", "ns"), Field("wall_ns", "int64", "ns")),
    {"description": "both clocks read at once: each message's time is monotonic, plus their difference at the start"},
)
ESTIMATE = "/estimate"  # Topic of an experiment, see :func:`estimate_topic`
LEARNT = Topic(
    "/learnt",
    "emb.Learnt",
    (
        Field("step", "int64"),
        *(Field(f"{name}_{end}", "double") for name in ("k_m", "k_1", "T_c", "f_v") for end in ("low", "high")),
        *(Field(f"angle_{end}", "double", "rad") for end in ("low", "high")),
        *(Field(f"velocity_{end}", "double", "rad/s") for end in ("low", "high")),
        Field("age", "double"),
    ),
    {
        "description": "of a shield that learns: the brakes, relative to the nominal one, and the states that are "
        "possible at a sample; age: periods since the shield's law was made for them"
    },
)
"""Topic of logs whose shield learns, see :class:`emb_runtime.learning.known.Known`."""
FIXED_TOPICS = (CAN_RX, CAN_TX, CYCLE, SAFETY, CLOCK)
"""Topics that every log has; one per DBC message comes on top, see :func:`message_topic`."""


def message_topic(name: str, identifier: int, fields: Sequence[Field]) -> Topic:
    """The decoded topic of one DBC message, by its name, its CAN identifier and its signals."""
    clean = re.sub(r"\W", "_", name)
    notes = {"dbc_message": name, "can_id": f"0x{identifier:X}"}
    return Topic(f"/emb/{name}", f"emb.dbc.{clean}", tuple(fields), notes)


def estimate_topic(estimates: Sequence[tuple[str, str]]) -> Topic:
    """The topic of the running estimate of quantities with these names and units."""
    fields = [Field("step", "int64")]
    for name, unit in estimates:
        fields += [Field(name, "double", unit), Field(deviation_of(name), "double", unit)]
    notes = {"description": "the running estimate, and the standard deviation of each"}
    return Topic(ESTIMATE, "emb.Estimate", tuple(fields), notes)


def deviation_of(name: str) -> str:
    """Name of the field for the standard deviation of an estimate."""
    return f"{name}_deviation"
