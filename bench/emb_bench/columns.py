"""Many protobuf messages of one kind as columns, without an object for each.

A recorder writes the fields of a message in the order of their numbers, each once. Where that is so in every message,
all of them are walked side by side, field by field, with numpy. Where one is not, or holds a number that its type does
not, the messages are parsed by protobuf itself, one by one: the result is the same.
"""

from __future__ import annotations

from collections.abc import Container
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from numpy.typing import NDArray

from emb_bench.contents import Integers, windows

_VARINT, _EIGHT, _SPAN, _FOUR = 0, 1, 2, 5  # wire types
_MORE = np.uint64(0x8080808080808080)
_GROUPS = (
    (np.uint64(0x007F007F007F007F), np.uint64(0x7F007F007F007F00), np.uint64(1)),
    (np.uint64(0x00003FFF00003FFF), np.uint64(0x3FFF00003FFF0000), np.uint64(2)),
    (np.uint64(0x000000000FFFFFFF), np.uint64(0x0FFFFFFF00000000), np.uint64(4)),
)
"""Neighbouring groups of 7, 14 and 28 bits, and by how much the upper ones move down."""


class Spans(NamedTuple):
    """A field of bytes or text in each message."""

    begin: Integers
    """Where it begins in the data."""
    length: Integers


@lru_cache(maxsize=64)
def message_class(name: str, descriptors: bytes) -> Any:
    """The class of a message, from a serialised FileDescriptorSet.

    Raises:
        TypeError, KeyError, google.protobuf.message.DecodeError: the descriptors are damaged.
    """
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def field_names(factory: Any) -> list[str]:
    """The fields that become columns: all but messages in the message."""
    return [entry.name for entry in factory.DESCRIPTOR.fields if entry.cpp_type != entry.CPPTYPE_MESSAGE]


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
    found = plain_columns(factory, data, begin, end, wanted)
    if found is None:
        return _parsed(factory, data, begin, end, wanted)
    entries = factory.DESCRIPTOR.fields_by_name
    return {name: _objects(entries[name], data, c) if isinstance(c, Spans) else c for name, c in found.items()}


def plain_columns(
    factory: Any, data: NDArray[np.uint8], begin: Integers, end: Integers, wanted: Container[str]
) -> dict[str, NDArray[Any] | Spans] | None:
    """The same, text and bytes as places in the data; None where protobuf has to parse the messages one by one.

    Raises:
        OverflowError: a number is beyond int64.
    """
    at, found = begin.copy(), dict[str, NDArray[Any] | Spans]()
    for entry in sorted(factory.DESCRIPTOR.fields, key=lambda field: int(field.number)):
        wire = _wire(entry)
        here = _tagged(data, at, end, entry.number << 3 | wire)
        present = bool(here.all())
        if not present and here.any():
            return None
        name = entry.name if entry.name in wanted and entry.cpp_type != entry.CPPTYPE_MESSAGE else ""
        if not present:
            if name:
                found[name] = _default(entry, len(at))
            continue
        at += 1 if entry.number < 16 else 2
        column = _take(entry, wire, data, at, bool(name))
        if column is None or (at > end).any():  # what is cut off was read with what follows
            return None
        if name:
            found[name] = column
    return found if bool((at == end).all()) else None


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
    """Whether a field begins with this tag in each message."""
    here: NDArray[np.bool_] = at < end
    place = np.where(here, at, 0)
    if tag < 0x80:
        here &= data[place] == tag
    else:
        here &= (data[place] == (tag & 0x7F | 0x80)) & (data[place + 1] == tag >> 7)
    return here


def _take(entry: Any, wire: int, data: NDArray[np.uint8], at: Integers, wanted: bool) -> NDArray[Any] | Spans | None:
    """The field that begins at ``at``, which moves behind it; None if protobuf has to say what it is."""
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
        return _integers(entry, values)
    # A length beyond what is there leads behind the end, which is noticed there.
    lengths = np.minimum(values, np.uint64(len(data))).astype(np.int64)
    begin = at.copy()
    at += lengths
    return Spans(begin, lengths)


def _varints(data: NDArray[np.uint8], at: Integers) -> NDArray[np.uint64] | None:
    """Numbers of variable length that begin at ``at``, which moves behind them; None if one never ends."""
    first = data[at]
    if (first < 0x80).all():  # flags, lengths, counters
        at += 1
        return first.astype(np.uint64)
    words = windows(data, "<u8")[at]
    stops = ~words & _MORE
    long = stops == 0
    last = stops & (~stops + np.uint64(1))  # the lowest stop bit: the last byte's
    values = words & (last - np.uint64(1)) & ~_MORE
    for low, high, shift in _GROUPS:
        values = (values & low) | ((values & high) >> shift)
    lengths = (np.bitwise_count(last - np.uint64(1)).astype(np.int64) + 1) // 8
    if not long.any():
        at += lengths
        return values
    ninth, tenth = data[at + 8].astype(np.uint64), data[at + 9].astype(np.uint64)
    further = long & (ninth >= 0x80)
    if (further & (tenth > 1)).any():
        return None
    upper = ((ninth & np.uint64(0x7F)) << np.uint64(56)) | np.where(further, tenth << np.uint64(63), np.uint64(0))
    # Of a long number no stop bit masks anything: last - 1 is all ones.
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


def _default(entry: Any, count: int) -> NDArray[Any]:
    return column_of(entry, [entry.default_value] * count)


def _objects(entry: Any, data: NDArray[np.uint8], spans: Spans) -> NDArray[Any]:
    raw = data.tobytes()
    parts = [raw[a : a + n] for a, n in zip(spans.begin.tolist(), spans.length.tolist(), strict=True)]
    return column_of(entry, [part.decode() for part in parts] if entry.type == entry.TYPE_STRING else parts)


def _parsed(
    factory: Any, data: NDArray[np.uint8], begin: Integers, end: Integers, wanted: Container[str]
) -> dict[str, NDArray[Any]]:
    raw = data.tobytes()
    messages = [factory.FromString(raw[a:b]) for a, b in zip(begin.tolist(), end.tolist(), strict=True)]
    return {
        entry.name: column_of(entry, [getattr(message, entry.name) for message in messages])
        for entry in factory.DESCRIPTOR.fields
        if entry.name in wanted and entry.cpp_type != entry.CPPTYPE_MESSAGE
    }


def column_of(entry: Any, values: list[Any]) -> NDArray[Any]:
    """Values of one field as a column."""
    if entry.cpp_type in (entry.CPPTYPE_DOUBLE, entry.CPPTYPE_FLOAT):
        return np.array(values, dtype=np.float64)
    if entry.cpp_type == entry.CPPTYPE_STRING:
        column = np.empty(len(values), dtype=object)
        column[:] = values
        return column
    return np.array(values, dtype=bool if entry.cpp_type == entry.CPPTYPE_BOOL else np.int64)
