from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.logs.columns import columns, describe, message_class, side_by_side
from emb_runtime.log import mcap_schema
from emb_runtime.log.mcap_schema import Field, Topic

ALL = Topic(
    "/all",
    "test.All",
    (
        *(Field("real", "double"), Field("whole", "int64"), Field("natural", "uint64"), Field("small", "uint32")),
        *(Field("fixed", "fixed32"), Field("flag", "bool"), Field("text", "string"), Field("data", "bytes")),
        *(Field("stamp", "timestamp"), Field("kind", "enum", "", {"A": 0, "B": 1})),
        *(Field(f"far{n}", "int64") for n in range(8)),
    ),
    {},
)
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "real": st.floats(),
    "whole": st.integers(-(2**63), 2**63 - 1),
    "natural": st.integers(0, 2**63 - 1),
    "small": st.integers(0, 2**32 - 1),
    "fixed": st.integers(0, 2**32 - 1),
    "flag": st.booleans(),
    "text": st.text(max_size=200),
    "data": st.binary(max_size=200),
    "kind": st.integers(-(2**31), 2**31 - 1),
    "far7": st.integers(-300, 300),
}
SOME = st.sets(st.sampled_from(sorted(VALUES)))
MESSAGES = st.lists(st.fixed_dictionaries({}, optional=VALUES), max_size=12)


def laid_out(parts: list[bytes]) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Messages among other bytes: the data, and where each begins and ends."""
    data, begin, end = b"\xff" * 5, [], []
    for part in parts:
        begin.append(len(data))
        data += part
        end.append(len(data))
        data += b"\x80\x08"
    return np.frombuffer(data + bytes(32), np.uint8), np.array(begin, np.int64), np.array(end, np.int64)


def read(parts: list[bytes], wanted: set[str]) -> dict[str, Any]:
    return columns(ALL.factory, *laid_out(parts), wanted)


def expected(parts: list[bytes], wanted: set[str]) -> dict[str, list[Any]]:
    parsed = [ALL.factory.FromString(part) for part in parts]
    return {name: [getattr(message, name) for message in parsed] for name in wanted}


def same(got: dict[str, Any], wanted: dict[str, list[Any]]) -> None:
    assert set(got) == set(wanted)
    for name, column in got.items():
        np.testing.assert_array_equal(column, np.array(wanted[name], column.dtype), err_msg=name, strict=False)


@settings(deadline=None, max_examples=150)
@given(MESSAGES, SOME)
def test_columns_are_what_protobuf_parses(messages: list[dict[str, Any]], wanted: set[str]) -> None:
    parts = [ALL.factory(**message).SerializeToString() for message in messages]
    same(read(parts, wanted), expected(parts, wanted))


@settings(deadline=None, max_examples=100)
@given(st.fixed_dictionaries({}, optional=VALUES), st.integers(1, 9), st.data())
def test_messages_with_the_same_fields_take_the_fast_way(
    message: dict[str, Any], count: int, data: st.DataObject
) -> None:
    rows = [{name: data.draw(VALUES[name]) for name in message} for _ in range(count)]
    parts = [ALL.factory(**row).SerializeToString() for row in rows]
    assert side_by_side(ALL.factory, *laid_out(parts), set(message)) is not None
    same(read(parts, set(message)), expected(parts, set(message)))


@settings(deadline=None, max_examples=100)
@given(st.fixed_dictionaries({}, optional=VALUES), st.fixed_dictionaries({}, optional=VALUES))
def test_fields_that_come_again_or_in_another_order_count_as_protobuf_has_it(
    first: dict[str, Any], second: dict[str, Any]
) -> None:
    parts = [ALL.factory(**second).SerializeToString() + ALL.factory(**first).SerializeToString()]
    same(read(parts, set(VALUES)), expected(parts, set(VALUES)))


@settings(deadline=None, max_examples=200)
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=4))
def test_any_bytes_are_what_protobuf_makes_of_them_or_refused(parts: list[bytes]) -> None:
    try:
        wanted = expected(parts, set(VALUES))
    except (DecodeError, UnicodeDecodeError):
        with pytest.raises((DecodeError, UnicodeDecodeError, OverflowError)):
            read(parts, set(VALUES))
        return
    if any(value >= 2**63 for value in wanted["natural"]):
        with pytest.raises(OverflowError):
            read(parts, set(VALUES))
        return
    same(read(parts, set(VALUES)), wanted)


def test_every_topic_of_a_log_takes_the_fast_way() -> None:
    for topic in mcap_schema.FIXED_TOPICS:
        samples: dict[str, Any] = {"double": math.nan, "string": "x", "bytes": b"12345678", "bool": True}
        values = {f.name: samples.get(f.type, 1) for f in topic.fields if f.type != "timestamp"}
        parts = [topic.factory(**values).SerializeToString()] * 3
        factory = message_class(topic.message, topic.descriptor.SerializeToString())
        names = [column.name for column in describe(factory)]
        found = side_by_side(factory, *laid_out(parts), names)
        assert found is not None
        assert set(found) == set(names)
