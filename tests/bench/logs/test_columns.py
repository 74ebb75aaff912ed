from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.logs.mcap_file import message_class, message_columns

KINDS = {
    "real": "double",
    "whole": "int64",
    "natural": "uint64",
    "small": "uint32",
    "flag": "bool",
    "text": "string",
    "data": "bytes",
    "kind": "enum",
    **{f"far{n}": "int64" for n in range(8)},
}


def all_kinds() -> Any:
    """The class of a message with a field of each kind."""
    file = FileDescriptorProto(name="all.proto", package="test", syntax="proto3")
    message, enum = file.message_type.add(name="All"), file.enum_type.add(name="Kind")
    enum.value.add(name="A", number=0)
    enum.value.add(name="B", number=1)
    for number, (name, kind) in enumerate(KINDS.items(), 1):
        of = FieldDescriptorProto.Type.Value(f"TYPE_{kind.upper()}")
        message.field.add(name=name, number=number, type=of, type_name=".test.Kind" if kind == "enum" else None)
    return message_class("test.All", FileDescriptorSet(file=[file]).SerializeToString())


ALL = all_kinds()
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "real": st.floats(),
    "whole": st.integers(-(2**63), 2**63 - 1),
    "natural": st.integers(0, 2**63 - 1),
    "small": st.integers(0, 2**32 - 1),
    "flag": st.booleans(),
    "text": st.text(max_size=200),
    "data": st.binary(max_size=200),
    "kind": st.integers(-(2**31), 2**31 - 1),
    "far7": st.integers(-300, 300),
}
MESSAGES = st.lists(st.fixed_dictionaries({}, optional=VALUES), max_size=12)
DEFAULTS = {"real": 0.0, "flag": False, "text": "", "data": b""}  # 0 for the others
TYPES = {"real": np.float64, "flag": np.bool_, "text": np.object_, "data": np.object_}  # int64 for the others


@settings(deadline=None, max_examples=100)
@given(MESSAGES)
def test_columns_hold_what_was_written_and_zero_where_nothing_was(messages: list[dict[str, Any]]) -> None:
    found = message_columns(ALL, [ALL(**message).SerializeToString() for message in messages])
    assert set(found) == set(KINDS)
    for name, column in found.items():
        assert column.dtype == TYPES.get(name, np.int64)
        expected = [message.get(name, DEFAULTS.get(name, 0)) for message in messages]
        np.testing.assert_array_equal(column, np.array(expected, column.dtype), err_msg=name)


@settings(deadline=None, max_examples=200)
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=4))
def test_any_bytes_are_columns_of_one_row_each_or_refused(payloads: list[bytes]) -> None:
    with suppress(DecodeError, OverflowError):
        found = message_columns(ALL, payloads)
        assert {column.shape for column in found.values()} == {(len(payloads),)}


def test_a_message_that_was_cut_takes_nothing_of_the_next() -> None:
    values = {"whole": 3, "natural": 4, "small": 5, "flag": True, "text": "eleven", "data": b"12", "kind": 1}
    payload = ALL(real=2.0, **values, **{f"far{n}": n + 1 for n in range(8)}).SerializeToString()
    for length in range(len(payload)):
        try:
            last = ALL.FromString(payload[:length])
        except DecodeError:
            with pytest.raises(DecodeError):
                message_columns(ALL, [payload, payload[:length], payload])
        else:
            found = message_columns(ALL, [payload, payload[:length], payload])
            assert {name: column[1] for name, column in found.items()} == {name: getattr(last, name) for name in KINDS}


def test_a_number_beyond_63_bits_is_refused() -> None:
    with pytest.raises(OverflowError):
        message_columns(ALL, [ALL(natural=2**63).SerializeToString()])
