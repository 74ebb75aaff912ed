from __future__ import annotations

import itertools

import e2e.crc
import e2e.p01
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.e2e import (
    COUNTER_MODULUS,
    NO_COUNTER,
    WEIGHT,
    CounterCheck,
    LeakyCount,
    crc,
    has_valid_crc,
    next_counter,
    profile1_start,
)

COUNTERS = st.integers(0, COUNTER_MODULUS - 1)


@given(st.integers(0, 0xFFFF), st.binary(min_size=1, max_size=7))
def test_protection_equals_profile_1_of_an_independent_library(data_id: int, body: bytes) -> None:
    theirs = bytearray(b"\x00" + body)
    e2e.p01.e2e_p01_protect(theirs, data_id, increment_counter=False)
    ours = bytes((crc(profile1_start(data_id), body),)) + body
    assert ours == theirs
    assert has_valid_crc(profile1_start(data_id), ours)


# The library's check refuses the invalid counter as well; here the codec does that (Fault.COUNTER).
@given(st.integers(0, 0xFFFF), st.binary(min_size=2, max_size=8).filter(lambda p: p[1] & 0x0F != NO_COUNTER))
def test_checking_equals_profile_1_of_an_independent_library(data_id: int, payload: bytes) -> None:
    assert has_valid_crc(profile1_start(data_id), payload) == e2e.p01.e2e_p01_check(bytearray(payload), data_id)


def test_counters_run_from_0_to_14_and_never_reach_the_invalid_one() -> None:
    counter, seen = 0, []
    for _ in range(2 * COUNTER_MODULUS):
        seen.append(counter)
        counter = next_counter(counter)
    assert (seen, NO_COUNTER) == (2 * list(range(15)), 15)


@pytest.mark.parametrize("counter", [-1, NO_COUNTER, 100])
def test_an_invalid_counter_is_refused_and_changes_nothing(counter: int) -> None:
    counter_check = CounterCheck(5)
    counter_check.advance(4)
    with pytest.raises(ValueError, match=r"0\.\.14"):
        counter_check.advance(counter)
    assert (counter_check.last, counter_check.errors) == (4, 0)


@given(st.integers(1, 20), st.lists(st.one_of(st.none(), COUNTERS)))
def test_the_error_count_leaks_saturates_and_follows_its_law(tolerated: int, events: list[int | None]) -> None:
    counter_check = CounterCheck(tolerated)
    last, errors = None, 0
    for event in events:
        if event is None:
            counter_check.reject()
        else:
            steps = 1 if last is None else (event - last) % COUNTER_MODULUS
            assert counter_check.advance(event) == steps
        if event is None or event == last:
            errors = min(errors + 4, 4 * tolerated)
        else:
            last, errors = event, max(errors - 1, 0)
        assert (counter_check.last, counter_check.errors) == (last, errors)


def test_four_good_frames_forgive_one_bad_one() -> None:
    counter_check = CounterCheck(5)
    counter_check.reject()
    for counter in range(4):
        assert counter_check.errors == WEIGHT - counter
        counter_check.advance(counter)
    assert counter_check.errors == 0


@given(st.integers(1, 20), st.lists(st.booleans()))
def test_a_leaky_count_follows_its_law(tolerated: int, events: list[bool]) -> None:
    count, errors = LeakyCount(tolerated), 0
    for good in events:
        if good:
            count.forgive()
            errors = max(errors - 1, 0)
        else:
            count.reject()
            errors = min(errors + 4, 4 * tolerated)
        assert count.errors == errors
        assert count.exceeded == (errors == 4 * tolerated)


@given(st.integers(1, 20), st.integers(0, 10), st.integers(0, 10**12))
def test_some_bad_ones_at_once_count_as_in_a_row(tolerated: int, before: int, bad: int) -> None:
    """In no time, however many a node's clock says are missing."""
    at_once, in_a_row = LeakyCount(tolerated), LeakyCount(tolerated)
    for _ in range(before):
        at_once.reject()
        in_a_row.reject()
    at_once.reject(bad)
    for _ in range(min(bad, tolerated)):
        in_a_row.reject()
    assert at_once.errors == in_a_row.errors


def judged_until_exceeded(tolerated: int, bad: int, of: int, longest: int = 100_000) -> int | None:
    """How many were judged when the count was exceeded, with ``bad`` of every ``of`` bad, evenly spread."""
    count = LeakyCount(tolerated)
    for n in range(1, longest + 1):
        if n * bad // of > (n - 1) * bad // of:
            count.reject()
        else:
            count.forgive()
        if count.exceeded:
            return n
    return None


def test_a_fifth_or_less_is_never_too_many() -> None:
    for (bad, of), tolerated in itertools.product([(1, 5), (1, 6), (1, 10), (0, 1)], [2, 5, 20]):
        assert judged_until_exceeded(tolerated, bad, of, longest=20_000) is None


@given(st.integers(1, 20), st.integers(21, 100))
def test_the_time_until_a_share_is_too_many_is_as_documented(tolerated: int, percent: int) -> None:
    found = judged_until_exceeded(tolerated, percent, 100)
    assert found is not None
    assert found <= 4 * tolerated / (5 * percent / 100 - 1) + 6


def test_a_count_that_tolerates_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        CounterCheck(0)
    assert judged_until_exceeded(1, 1, 1) == 1
