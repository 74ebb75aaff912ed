"""Protobuf messages of one kind as columns, and what each column is."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from numpy.typing import NDArray

MOST_FIELDS = 256  # Fields of a message; ours have fifty


@dataclass(frozen=True)
class Column:
    """Description of one column of a table."""

    name: str
    kind: str  # Name of numpy's type of its values, or ``text``, or ``bytes``
    unit: str = ""  # SI unit, empty if it has none
    choices: Mapping[int, str] | None = None  # Names of the values, where they are enumerated

    @property
    def title(self) -> str:
        """Name and unit, for a table's head."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def labels(self, values: NDArray[Any]) -> list[str]:
        """The names of enumerated values; of an unknown value its number."""
        choices = self.choices or {}
        return [choices.get(value, str(value)) for value in values.tolist()]


@lru_cache(maxsize=64)
def message_class(name: str, descriptors: bytes) -> Any:
    """The class of a message, from a serialised FileDescriptorSet.

    Raises:
        TypeError, KeyError, google.protobuf.message.DecodeError: the descriptors are damaged.
        ValueError: the message has more fields than any of ours.
    """
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    found = pool.FindMessageTypeByName(name)
    if len(found.fields) > MOST_FIELDS:
        raise ValueError(f"expected at most {MOST_FIELDS} fields, got {len(found.fields)}")
    return message_factory.GetMessageClass(found)


@lru_cache(maxsize=64)
def describe(factory: Any, units: str = "{}") -> tuple[Column, ...]:
    """The columns that the fields of a message become: all but messages in the message.

    Args:
        factory: the message class.
        units: SI units by field, as JSON.

    Raises:
        ValueError: the units are not JSON.
    """
    unit_of = json.loads(units)
    found = []
    for entry in factory.DESCRIPTOR.fields:
        if entry.cpp_type != entry.CPPTYPE_MESSAGE:
            kind = {entry.TYPE_STRING: "text", entry.TYPE_BYTES: "bytes"}.get(entry.type) or np.dtype(_type(entry)).name
            choices = {value.number: value.name for value in entry.enum_type.values} if entry.enum_type else None
            found.append(Column(entry.name, kind, unit_of.get(entry.name, ""), choices))
    return tuple(found)


def columns(factory: Any, payloads: Sequence[bytes], wanted: Collection[str]) -> dict[str, NDArray[Any]]:
    """Some fields of many messages.

    Args:
        factory: the message class.
        payloads: the n messages, serialised.
        wanted: names of fields; one that the message lacks, or that is itself a message, is left out.

    Returns:
        Numbers as int64 or float64, bool as bool, text and bytes as objects, each of shape (n,).

    Raises:
        google.protobuf.message.DecodeError: a message is damaged.
        OverflowError: a number is beyond int64.
    """
    messages = [factory.FromString(payload) for payload in payloads]
    return {
        entry.name: np.array([getattr(message, entry.name) for message in messages], dtype=_type(entry))
        for entry in factory.DESCRIPTOR.fields
        if entry.name in wanted and entry.cpp_type != entry.CPPTYPE_MESSAGE
    }


def _type(entry: Any) -> type[Any]:
    """Numpy's type of a field's values."""
    return {
        entry.CPPTYPE_DOUBLE: np.float64,
        entry.CPPTYPE_FLOAT: np.float64,
        entry.CPPTYPE_STRING: np.object_,
        entry.CPPTYPE_BOOL: np.bool_,
    }.get(entry.cpp_type, np.int64)
