from __future__ import annotations

import os
import struct
from collections.abc import Iterator

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.safety.heartbeat import Heartbeat, Unwatched

MS = 1_000_000
START = 7_000 * MS
COUNTERS = range(15)


@pytest.fixture
def heartbeat() -> Iterator[Heartbeat]:
    made = Heartbeat.create(0.005, START)
    yield made
    made.close()


def contents(heartbeat: Heartbeat) -> bytes:
    return os.pread(heartbeat.fd, 1 << 16, 0)


def test_a_new_one_is_not_armed_and_not_tripped_and_the_first_command_has_counter_0(heartbeat: Heartbeat) -> None:
    assert (heartbeat.armed, heartbeat.tripped, heartbeat.heartbeat_ns) == (False, False, 5 * MS)
    assert heartbeat.last == (14, 0)


def test_what_one_side_says_the_other_reads(heartbeat: Heartbeat) -> None:
    other = Heartbeat(os.dup(heartbeat.fd))
    heartbeat.arm(START + 1)
    assert (other.armed, other.beat_ns) == (True, START + 1)
    heartbeat.beat(START + 2)
    assert other.beat_ns == START + 2
    heartbeat.disarm()
    assert not other.armed
    other.trip()
    assert heartbeat.tripped
    other.close()
    assert heartbeat.tripped


def test_every_pair_of_counters_arrives_as_it_was_published(heartbeat: Heartbeat) -> None:
    for counter in COUNTERS:
        for answers in COUNTERS:
            heartbeat.publish(counter, answers)
            assert heartbeat.last == (counter, answers)


def test_nothing_that_the_loop_says_takes_a_trip_back(heartbeat: Heartbeat) -> None:
    heartbeat.trip()
    heartbeat.arm(START)
    heartbeat.beat(START + MS)
    heartbeat.publish(3, 4)
    heartbeat.disarm()
    heartbeat.arm(START)
    assert heartbeat.tripped


def test_each_word_has_one_writer_and_the_two_sides_share_no_cache_line(heartbeat: Heartbeat) -> None:
    def changed(before: bytes) -> set[int]:
        return {at // 64 for at, (a, b) in enumerate(zip(before, contents(heartbeat), strict=True)) if a != b}

    before = contents(heartbeat)
    heartbeat.arm(START + 1)
    heartbeat.beat(START + 2)
    heartbeat.publish(5, 6)
    loop_lines, before = changed(before), contents(heartbeat)
    heartbeat.trip()
    heartbeat.mark_alive(START + 3)
    assert loop_lines
    assert changed(before)
    assert loop_lines.isdisjoint(changed(before))


def test_the_watchdog_counts_as_lost_after_four_silent_heartbeats_and_not_before(heartbeat: Heartbeat) -> None:
    assert heartbeat.watched(START + 20 * MS - 1)
    assert not heartbeat.watched(START + 20 * MS)
    heartbeat.mark_alive(START + 1)
    assert heartbeat.watched(START + 20 * MS)
    assert not heartbeat.watched(START + 20 * MS + 1)


@settings(deadline=None)
@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1))
def test_whatever_the_memory_holds_the_counters_are_counters_and_only_a_clear_no_is_unarmed(
    armed: int, last: int
) -> None:
    heartbeat = Heartbeat.create(0.005, START)
    os.pwrite(heartbeat.fd, struct.pack("=QQQ", armed, 0, last), 64)
    assert all(0 <= counter <= 14 for counter in heartbeat.last)
    assert heartbeat.armed == (armed != 0)
    heartbeat.close()


@pytest.mark.parametrize("memory", [b"", bytes(4095), bytes(4096), bytes(8192)])
def test_memory_that_is_no_heartbeat_is_refused(memory: bytes) -> None:
    fd = os.memfd_create("test")
    os.write(fd, memory)
    with pytest.raises(ValueError, match="heartbeat"):
        Heartbeat(fd)


def test_a_run_without_a_watchdog_is_never_tripped_and_always_watched() -> None:
    pulse: Heartbeat = Unwatched()
    pulse.arm(START)
    pulse.beat(START)
    pulse.publish(14, 14)
    assert not pulse.tripped
    assert pulse.watched(1 << 62)
    pulse.disarm()
    assert not pulse.tripped
    pulse.trip()
    pulse.close()
    assert not Unwatched().tripped  # another run's memory is its own
