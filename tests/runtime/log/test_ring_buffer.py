from __future__ import annotations

import math
import os
import subprocess
import sys
from collections import deque
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.log.ring_buffer import (
    MAX_PAYLOAD,
    SLOT,
    ClockRecord,
    EstimateRecord,
    EventRecord,
    FrameRecord,
    InputRecord,
    Record,
    Ring,
    pack,
    unpack,
)
from emb_runtime.records import Call, CycleRecord, Frame

INT64 = st.integers(-(2**63), 2**63 - 1)

PRODUCER = """
import sys
from emb_runtime.log.ring_buffer import Ring
ring = Ring(int(sys.argv[1]))
pushed = 0
while pushed < int(sys.argv[2]):
    payload = pushed.to_bytes(4, "little") * (1 + pushed % 60)
    pushed += ring.push(pushed % 7, payload)
"""


def test_a_full_ring_drops_the_new_record_and_counts_it_for_both_sides() -> None:
    ring = Ring.create(2)
    other = Ring(os.dup(ring.fd))
    assert [ring.push(1, b"a"), ring.push(1, b"b"), ring.push(1, b"c"), ring.push(1, b"d")] == [
        True,
        True,
        False,
        False,
    ]
    assert (ring.dropped, other.dropped) == (2, 2)
    assert other.pop() == (1, b"a")
    assert ring.push(1, b"e")
    assert [other.pop(), other.pop(), other.pop()] == [(1, b"b"), (1, b"e"), None]
    ring.close()
    other.close()


@settings(deadline=None)
@given(st.lists(st.one_of(st.none(), st.binary(max_size=MAX_PAYLOAD)), max_size=60))
def test_the_ring_is_a_bounded_queue(operations: list[bytes | None]) -> None:
    ring = Ring.create(8)
    model: deque[tuple[int, bytes]] = deque()
    dropped = 0
    for kind, payload in enumerate(operations):
        if payload is None:
            assert ring.pop() == (model.popleft() if model else None)
        elif ring.push(kind, payload):
            model.append((kind, payload))
        else:
            dropped += 1
            assert len(model) == 8
        assert len(ring) == len(model)
    assert ring.dropped == dropped
    ring.close()


def test_another_process_reads_what_this_one_writes() -> None:
    ring = Ring.create(64)
    count = 5_000
    with subprocess.Popen([sys.executable, "-c", PRODUCER, str(ring.fd), str(count)], pass_fds=(ring.fd,)) as producer:
        got = 0
        while got < count:
            item = ring.pop()
            if item is None:
                assert producer.poll() in (None, 0)
                continue
            assert item == (got % 7, got.to_bytes(4, "little") * (1 + got % 60))
            got += 1
    assert producer.returncode == 0
    assert len(ring) == 0
    ring.close()


@pytest.mark.parametrize("byte", [*range(7), 8, 12, 17])  # byte 7 is padding
def test_a_slot_that_is_not_all_visible_yet_reads_as_not_written_yet(byte: int) -> None:
    ring = Ring.create(2)
    ring.push(3, b"0123456789")
    where = 4096 + byte
    right = os.pread(ring.fd, 1, where)
    os.pwrite(ring.fd, bytes([right[0] ^ 0x40]), where)
    assert ring.pop() is None
    assert len(ring) == 1
    os.pwrite(ring.fd, right, where)
    assert ring.pop() == (3, b"0123456789")
    ring.close()


def test_the_record_of_the_lap_before_is_not_taken_for_the_new_one() -> None:
    ring = Ring.create(2)
    ring.push(1, b"old")
    slot = os.pread(ring.fd, SLOT, 4096)
    ring.pop()
    ring.push(1, b"next")
    ring.pop()
    ring.push(1, b"new")
    os.pwrite(ring.fd, slot, 4096)  # what a processor that delays stores would still show
    assert ring.pop() is None
    ring.close()


def test_a_payload_that_does_not_fit_a_slot_is_refused() -> None:
    ring = Ring.create(2)
    assert ring.push(1, bytes(MAX_PAYLOAD))
    with pytest.raises(ValueError, match=r"at most 248 bytes, got 249"):
        ring.push(1, bytes(MAX_PAYLOAD + 1))
    assert len(ring) == 1
    ring.close()


def test_a_slot_count_that_is_no_power_of_two_and_memory_that_is_no_ring_are_refused() -> None:
    for slots in (0, 3, -4, 1000):
        with pytest.raises(ValueError, match="power of two"):
            Ring.create(slots)
    for content in (b"", bytes(100), bytes(4096 + SLOT), os.urandom(4096 + 4 * SLOT)):
        fd = os.memfd_create("other")
        os.write(fd, content)
        with pytest.raises(ValueError, match="ring"):
            Ring(fd)


FRAMES = st.builds(
    Frame,
    st.integers(0, 2**29 - 1), st.binary(max_size=8), INT64, st.booleans(), st.booleans(), st.booleans(),
    st.booleans(), st.integers(0, 2**32 - 1),
)  # fmt: skip
FLOATS = st.floats(allow_nan=False)


@given(
    st.one_of(
        st.builds(FrameRecord, FRAMES, INT64),
        st.tuples(*[INT64] * 7, *[FLOATS] * 6, *[INT64] * 5).map(CycleRecord._make),
        st.builds(EventRecord, INT64, st.text(max_size=10), st.text(max_size=40)),
        st.builds(ClockRecord, INT64, INT64),
        st.builds(InputRecord, INT64, st.sampled_from(Call), INT64, st.text(max_size=10), st.text(max_size=40)),
        st.builds(EstimateRecord, INT64, INT64, st.tuples(*[FLOATS] * 24)),
    )
)
def test_every_record_fits_a_slot_and_travels_unchanged(record: Record) -> None:
    kind, payload = pack(record)
    assert len(payload) <= MAX_PAYLOAD
    back = unpack(kind, payload)
    assert back == record
    assert type(back) is type(record)


def test_a_value_that_a_cycle_does_not_have_stays_nan_and_numbers_of_numpy_travel() -> None:
    record = CycleRecord(*[0] * 7, *[math.nan] * 6, *[0] * 5)
    back = unpack(*pack(record))
    assert isinstance(back, CycleRecord)
    assert all(math.isnan(value) for value in back[7:13])
    numbers: tuple[Any, ...] = (np.float64(1.5), np.float32(0.5))
    assert unpack(*pack(EstimateRecord(1, 2, numbers))) == EstimateRecord(1, 2, (1.5, 0.5))


@given(INT64, st.text(max_size=300), st.text(max_size=300))
def test_texts_travel_or_are_cut_between_characters(when: int, code: str, text: str) -> None:
    packed = pack(EventRecord(when, code, text))
    assert len(packed[1]) <= MAX_PAYLOAD
    assert len(pack(InputRecord(when, Call.EXPLAIN, 0, code, text))[1]) <= MAX_PAYLOAD
    event = unpack(*packed)
    assert isinstance(event, EventRecord)
    assert event.time_ns == when
    for got, sent in ((event.code, code), (event.text, text)):
        assert got == sent or (got[-1] == "…" and sent.startswith(got[:-1]))
    assert event.text == text or len(text.encode()) > 190
    assert unpack(*pack(EventRecord(1, "X", "a\udcff"))) == EventRecord(1, "X", "a\\udcff")  # no valid Unicode


def test_an_unknown_kind_or_a_payload_that_is_no_such_record_is_refused() -> None:
    with pytest.raises(IndexError):
        unpack(99, b"")
    with pytest.raises(msgspec.DecodeError):
        unpack(pack(ClockRecord(1, 2))[0], b"short")
