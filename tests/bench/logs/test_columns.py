from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.logs.mcap_file import columns
from emb_runtime.log.mcap_schema import Field, Topic

ALL = Topic(
    "/all",
    "test.All",
    (
        *(Field("real", "double"), Field("whole", "int64"), Field("natural", "uint64"), Field("small", "uint32")),
        *(Field("flag", "bool"), Field("text", "string"), Field("data", "bytes")),
        Field("kind", "enum", "", {"A": 0, "B": 1}),
        *(Field(f"far{n}", "int64") for n in range(8)),
    ),
    {},
)
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
@given(MESSAGES, st.sets(st.sampled_from(sorted(VALUES))))
def test_columns_hold_what_was_written_and_zero_where_nothing_was(
    messages: list[dict[str, Any]], wanted: set[str]
) -> None:
    found = columns(ALL.factory, [ALL.factory(**message).SerializeToString() for message in messages], wanted)
    assert set(found) == wanted
    for name, column in found.items():
        assert column.dtype == TYPES.get(name, np.int64)
        expected = [message.get(name, DEFAULTS.get(name, 0)) for message in messages]
        np.testing.assert_array_equal(column, np.array(expected, column.dtype), err_msg=name)


@settings(deadline=None, max_examples=200)
@given(st.lists(st.binary(max_size=40), min_size=1, max_size=4))
def test_any_bytes_are_columns_of_one_row_each_or_refused(payloads: list[bytes]) -> None:
    with suppress(DecodeError, OverflowError):
        found = columns(ALL.factory, payloads, VALUES)
        assert {column.shape for column in found.values()} == {(len(payloads),)}


def test_a_number_beyond_63_bits_is_refused() -> None:
    with pytest.raises(OverflowError):
        columns(ALL.factory, [ALL.factory(natural=2**63).SerializeToString()], {"natural"})
