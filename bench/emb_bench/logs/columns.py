"""Many protobuf messages of one kind as columns, without an object for each, and what each column is.

A recorder writes the fields of a message in the order of their numbers, each once. Where that is so in every message,
all of them are walked side by side, field by field, with numpy. Where one is not, or holds a number that its type does
not, the messages are parsed by protobuf itself, one by one: the result is the same.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from numpy.typing import NDArray

from emb_bench.logs.chunks import Integers, windows

MOST_FIELDS = 256  # Fields of a message; ours have fifty
_VARINT, _EIGHT, _SPAN, _FOUR = 0, 1, 2, 5  # wire types
_MORE = np.uint64(0x8080808080808080)
_ALL, _ONE = np.uint64(0xFFFFFFFFFFFFFFFF), np.uint64(1)
_GROUPS = (
    (np.uint64(0x007F007F007F007F), np.uint64(0x7F007F007F007F00), np.uint64(1)),
    (np.uint64(0x00003FFF00003FFF), np.uint64(0x3FFF00003FFF0000), np.uint64(2)),
    (np.uint64(0x000000000FFFFFFF), np.uint64(0x0FFFFFFF00000000), np.uint64(4)),
)
"""Neighbouring groups of 7, 14 and 28 bits, and by how much the upper ones move down."""


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


class _Spans(NamedTuple):
    """A field of bytes or text in each message, as places in the data."""

    begin: Integers
    length: Integers


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
        if entry.cpp_type == entry.CPPTYPE_MESSAGE:
            continue
        kind = {entry.TYPE_STRING: "text", entry.TYPE_BYTES: "bytes"}.get(entry.type) or _column(entry, []).dtype.name
        choices = {value.number: value.name for value in entry.enum_type.values} if entry.enum_type else None
        found.append(Column(entry.name, kind, unit_of.get(entry.name, ""), choices))
    return tuple(found)


def columns(
    factory: Any, data: NDArray[np.uint8], begin: Integers, end: Integers, wanted: Container[str]
) -> dict[str, NDArray[Any]]:
    """Some fields of many messages.

    Args:
        factory: the message class.
        data: bytes among which the messages are, with some to spare behind the last one.
        begin: where each begins, shape (n,).
        end: where each ends, shape (n,).
        wanted: names of fields; of those that are no messages.

    Returns:
        Numbers as int64 or float64, bool as bool, text and bytes as objects, each of shape (n,).

    Raises:
        google.protobuf.message.DecodeError: a message is damaged.
        OverflowError: a number is beyond int64.
        UnicodeDecodeError: a text is not UTF-8.
    """
    found = side_by_side(factory, data, begin, end, wanted)
    return _parsed(factory, data, begin, end, wanted) if found is None else found


def side_by_side(
    factory: Any, data: NDArray[np.uint8], begin: Integers, end: Integers, wanted: Container[str]
) -> dict[str, NDArray[Any]] | None:
    """The columns, made without protobuf; None where the messages are not alike enough for that."""
    at, found = begin.copy(), dict[str, NDArray[Any] | _Spans]()
    for entry, wire, tag, own in _plan(factory):
        here = _tagged(data, at, end, tag)
        present = bool(here.all())
        if not present and here.any():
            return None
        name = own if own in wanted else ""
        if not present:
            if name:
                found[name] = _column(entry, [entry.default_value] * len(at))
            continue
        at += 1 if tag < 0x80 else 2
        column = _take(entry, wire, data, at, bool(name))
        # Behind its end no field of a message begins; a number leads there by some bytes, a length by any.
        if column is None or (wire == _SPAN and (at > end).any()):
            return None
        if name:
            found[name] = column
    if (at != end).any():
        return None
    entries = factory.DESCRIPTOR.fields_by_name
    return {name: _objects(entries[name], data, c) if isinstance(c, _Spans) else c for name, c in found.items()}


@lru_cache(maxsize=64)
def _plan(factory: Any) -> tuple[tuple[Any, int, int, str], ...]:
    """The fields in the order of their numbers: each with its wire type, tag, and name if it becomes a column."""
    plan = []
    for entry in sorted(factory.DESCRIPTOR.fields, key=lambda field: int(field.number)):
        wire, name = _wire(entry), "" if entry.cpp_type == entry.CPPTYPE_MESSAGE else entry.name
        plan.append((entry, wire, entry.number << 3 | wire, name))
    return tuple(plan)


def _wire(entry: Any) -> int:
    match entry.type:
        case entry.TYPE_DOUBLE | entry.TYPE_FIXED64 | entry.TYPE_SFIXED64:
            return _EIGHT
        case entry.TYPE_FLOAT | entry.TYPE_FIXED32 | entry.TYPE_SFIXED32:
            return _FOUR
        case entry.TYPE_STRING | entry.TYPE_BYTES | entry.TYPE_MESSAGE:
            return _SPAN
    return _VARINT


def _tagged(data: NDArray[np.uint8], at: Integers, end: Integers, tag: int) -> NDArray[np.bool_]:
    """Mask of the messages in which a field with this tag begins at ``at``, which may be the message's end."""
    found = data[at] if tag < 0x80 else windows(data, "<u2")[at]
    written = tag if tag < 0x80 else tag & 0x7F | 0x80 | tag >> 7 << 8
    here: NDArray[np.bool_] = (found == written) & (at < end)
    return here


def _take(entry: Any, wire: int, data: NDArray[np.uint8], at: Integers, wanted: bool) -> NDArray[Any] | _Spans | None:
    """The field that begins at ``at``, which moves behind it; None if only protobuf can decode it."""
    if wire == _EIGHT:
        if entry.type != entry.TYPE_DOUBLE:
            return None
        place = at.copy()
        at += 8
        return windows(data, "<f8")[place].astype(np.float64) if wanted else place
    if wire == _FOUR:
        if entry.type != entry.TYPE_FIXED32:
            return None
        place = at.copy()
        at += 4
        return windows(data, "<u4")[place].astype(np.int64)
    values = _varints(data, at)
    if values is None:
        return None
    if wire == _VARINT:
        return _integers(entry, values) if wanted else at
    # A length beyond what is there leads behind the end, which is noticed there.
    lengths = np.minimum(values, np.uint64(len(data))).astype(np.int64)
    begin = at.copy()
    at += lengths
    return _Spans(begin, lengths)


def _varints(data: NDArray[np.uint8], at: Integers) -> NDArray[np.uint64] | None:
    """Numbers of variable length that begin at ``at``, which moves behind them; None if one never ends."""
    first = data[at]
    if first.max(initial=0) < 0x80:  # flags, lengths, counters
        at += 1
        return first.astype(np.uint64)
    words = windows(data, "<u8")[at]
    stops = ~words & _MORE
    below = (stops & (~stops + _ONE)) - _ONE  # bits below the one that ends the number; all if none of the eight does
    long = below == _ALL
    values = words & below & ~_MORE
    for low, high, shift in _GROUPS:
        values = (values & low) | ((values & high) >> shift)
    lengths = (np.bitwise_count(below).astype(np.int64) + 1) >> 3
    if not long.any():
        at += lengths
        return values
    ninth, tenth = data[at + 8].astype(np.uint64), data[at + 9].astype(np.uint64)
    further = long & (ninth >= 0x80)
    if (further & (tenth > 1)).any():
        return None
    upper = ((ninth & np.uint64(0x7F)) << np.uint64(56)) | np.where(further, tenth << np.uint64(63), np.uint64(0))
    values = np.where(long, values | upper, values)
    at += np.where(long, 9 + further, lengths)
    return values


def _integers(entry: Any, values: NDArray[np.uint64]) -> NDArray[Any] | None:
    match entry.type:
        case entry.TYPE_BOOL:
            return values.astype(bool)
        case entry.TYPE_INT64:
            return values.view(np.int64)
        case entry.TYPE_UINT64:
            if len(values) and values.max() >= 1 << 63:
                raise OverflowError(f"{entry.name}: a number beyond 63 bits")
            return values.view(np.int64)
        case entry.TYPE_UINT32:
            fits = values < 1 << 32
        case entry.TYPE_INT32 | entry.TYPE_ENUM:
            fits = (values + np.uint64(1 << 31)) < 1 << 32  # modulo 2^64, as negative ones are written
        case _:
            return None
    return values.view(np.int64) if fits.all() else None


def _objects(entry: Any, data: NDArray[np.uint8], spans: _Spans) -> NDArray[Any]:
    raw = data.tobytes()
    parts = [raw[a : a + n] for a, n in zip(spans.begin.tolist(), spans.length.tolist(), strict=True)]
    return _column(entry, [part.decode() for part in parts] if entry.type == entry.TYPE_STRING else parts)


def _parsed(
    factory: Any, data: NDArray[np.uint8], begin: Integers, end: Integers, wanted: Container[str]
) -> dict[str, NDArray[Any]]:
    raw = data.tobytes()
    messages = [factory.FromString(raw[a:b]) for a, b in zip(begin.tolist(), end.tolist(), strict=True)]
    return {
        entry.name: _column(entry, [getattr(message, entry.name) for message in messages])
        for entry in factory.DESCRIPTOR.fields
        if entry.name in wanted and entry.cpp_type != entry.CPPTYPE_MESSAGE
    }


def _column(entry: Any, values: list[Any]) -> NDArray[Any]:
    """Values of one field as a column."""
    if entry.cpp_type in (entry.CPPTYPE_DOUBLE, entry.CPPTYPE_FLOAT):
        return np.array(values, dtype=np.float64)
    if entry.cpp_type == entry.CPPTYPE_STRING:
        column = np.empty(len(values), dtype=object)
        column[:] = values
        return column
    return np.array(values, dtype=bool if entry.cpp_type == entry.CPPTYPE_BOOL else np.int64)
