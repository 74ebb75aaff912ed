from __future__ import annotations

import e2e.crc
import e2e.p01
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.can.e2e import (
    COUNTER_MODULUS,
    NO_COUNTER,
    CounterCheck,
    LeakyCount,
    check,
    crc8_j1850,
    next_counter,
    profile1_start,
    protect,
)

COUNTERS = st.integers(0, COUNTER_MODULUS - 1)


def test_the_crc_has_the_check_value_of_its_standard() -> None:
    assert crc8_j1850(b"123456789") == 0x4B
    assert crc8_j1850(b"") == 0x00


@given(st.binary(max_size=64))
def test_the_crc_equals_an_independent_library(data: bytes) -> None:
    assert crc8_j1850(data) == e2e.crc.calculate_crc8(data)


@given(st.integers(0, 0xFFFF), st.binary(min_size=1, max_size=7))
def test_protection_equals_profile_1_of_an_independent_library(data_id: int, body: bytes) -> None:
    theirs = bytearray(b"\x00" + body)
    e2e.p01.e2e_p01_protect(theirs, data_id, increment_counter=False)
    ours = protect(profile1_start(data_id), body)
    assert ours == theirs
    assert check(profile1_start(data_id), ours)


# The library's check refuses the invalid counter as well; here the codec does that (Fault.COUNTER).
@given(st.integers(0, 0xFFFF), st.binary(min_size=2, max_size=8).filter(lambda p: p[1] & 0x0F != NO_COUNTER))
def test_checking_equals_profile_1_of_an_independent_library(data_id: int, payload: bytes) -> None:
    assert check(profile1_start(data_id), payload) == e2e.p01.e2e_p01_check(bytearray(payload), data_id)


def test_counters_run_from_0_to_14_and_never_reach_the_invalid_one() -> None:
    counter, seen = 0, []
    for _ in range(2 * COUNTER_MODULUS):
        seen.append(counter)
        counter = next_counter(counter)
    assert seen == 2 * list(range(15))
    assert NO_COUNTER not in seen


def test_the_first_counter_is_accepted_whatever_it_is() -> None:
    for counter in range(COUNTER_MODULUS):
        counter_check = CounterCheck(saturation=5)
        assert counter_check.step(counter) == 1
        assert counter_check.last == counter


@given(COUNTERS, st.integers(1, COUNTER_MODULUS - 1))
def test_a_step_says_how_far_the_counter_moved(first: int, steps: int) -> None:
    counter_check = CounterCheck(saturation=5)
    counter_check.step(first)
    assert counter_check.step((first + steps) % COUNTER_MODULUS) == steps
    assert counter_check.errors == 0


def test_a_repeated_counter_is_an_error() -> None:
    counter_check = CounterCheck(saturation=5)
    counter_check.step(4)
    assert counter_check.step(4) == 0
    assert counter_check.errors == 1


def test_a_rejected_frame_does_not_update_the_stored_counter() -> None:
    counter_check = CounterCheck(saturation=5)
    counter_check.step(4)
    counter_check.reject()
    assert counter_check.last == 4
    assert counter_check.step(5) == 1


@pytest.mark.parametrize("counter", [-1, NO_COUNTER, 100])
def test_an_invalid_counter_is_refused_and_changes_nothing(counter: int) -> None:
    counter_check = CounterCheck(saturation=5)
    counter_check.step(4)
    with pytest.raises(ValueError, match=r"0\.\.14"):
        counter_check.step(counter)
    assert (counter_check.last, counter_check.errors) == (4, 0)


@given(st.integers(1, 20), st.lists(st.one_of(st.none(), COUNTERS)))
def test_the_error_count_leaks_saturates_and_follows_its_law(saturation: int, events: list[int | None]) -> None:
    counter_check = CounterCheck(saturation)
    last, errors = None, 0
    for event in events:
        if event is None:
            counter_check.reject()
        else:
            counter_check.step(event)
        if event is None or event == last:
            errors = min(errors + 1, saturation)
        else:
            last, errors = event, max(errors - 1, 0)
        assert (counter_check.last, counter_check.errors) == (last, errors)


def test_one_good_frame_forgives_one_bad_one_and_a_burst_is_forgiven_in_bounded_time() -> None:
    counter_check = CounterCheck(saturation=5)
    for _ in range(1000):
        counter_check.reject()
    assert counter_check.errors == 5
    for counter in range(5):
        counter_check.step(counter)
    assert counter_check.errors == 0


@given(st.integers(1, 20), st.lists(st.booleans()))
def test_a_leaky_count_follows_its_law(saturation: int, events: list[bool]) -> None:
    count, errors = LeakyCount(saturation), 0
    for good in events:
        if good:
            count.forgive()
            errors = max(errors - 1, 0)
        else:
            count.reject()
            errors = min(errors + 1, saturation)
        assert count.errors == errors


def test_a_saturation_that_could_never_count_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        CounterCheck(saturation=0)
