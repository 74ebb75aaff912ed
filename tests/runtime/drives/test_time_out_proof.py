"""The silence by which a drive shows that it lets go: when it begins, and what ends it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.drives.time_out_proof import TimeOutProof
from emb_runtime.drives.wire import DriveState
from tests.drives import EXAMPLES

MS = 1_000_000
STATE = load_mapping(EXAMPLES / "odrive.toml").state  # is believed for 0.25 s
ACTIVE, IDLE, FAULT = DriveState.ACTIVE, DriveState.IDLE, DriveState.FAULT


def proof(polled: bool = False) -> TimeOutProof:
    assert STATE is not None
    return TimeOutProof(0.010, STATE, MS, polled=polled)


def silent(it: TimeOutProof, until_ms: int) -> list[int]:
    return [ms for ms in range(until_ms) if it.silent(ms * MS)]


@pytest.mark.parametrize("first", [0, 50])
def test_the_silence_begins_so_that_the_next_message_comes_three_periods_after_the_time_out(first: int) -> None:
    it = proof()
    it.take(ACTIVE, first * MS)
    assert silent(it, 400) == []
    it.take(ACTIVE, (first + 100) * MS)
    assert silent(it, 400) == list(range(first + 187, 400))
    it.take(IDLE, (first + 200) * MS)
    assert (it.done, it.seen_ns, it.failure) == (True, 13 * MS, "")
    assert silent(it, 400) == []


@pytest.mark.parametrize(
    ("said", "after_ms", "done", "failed"),
    [
        (ACTIVE, 11, False, False),
        (IDLE, 11, False, False),
        (IDLE, 12, True, False),
        (FAULT, 12, True, False),
        (ACTIVE, 12, False, True),
    ],
    ids=["early", "idle early", "idle", "error", "armed"],
)
def test_what_it_says_from_two_periods_after_the_time_out_decides(
    said: DriveState, after_ms: int, done: bool, failed: bool
) -> None:
    it = proof()
    for ms in (0, 5):  # more often than its time-out: the silence begins at once
        it.take(ACTIVE, ms * MS)
    it.take(said, (5 + after_ms) * MS)
    assert (it.done, bool(it.failure)) == (done, failed)


ODD = 0.0157  # Time of which the nanoseconds, rounded off and not to the nearest, are one fewer [s]


def test_the_silence_is_as_long_as_the_time_out_and_two_periods_to_the_nanosecond() -> None:
    assert STATE is not None
    length = 15_700_000 + 2 * MS
    for polled in (True, False):
        it = TimeOutProof(ODD, STATE, MS, polled=polled)
        it.take(ACTIVE, 3 * MS)
        it.take(ACTIVE, 5 * MS)
        assert [it.silent(5 * MS + ns) for ns in (-1, 0, length - 1, length)] == [False, True, True, not polled]
        it.take(IDLE, 5 * MS + length - 1)
        assert (it.done, it.seen_ns) == (False, 0)
        it.take(IDLE, 5 * MS + length)
        assert (it.done, it.seen_ns) == (True, length)


def test_the_time_to_say_something_is_known_to_the_nanosecond() -> None:
    assert STATE is not None
    it = TimeOutProof(0.010, replace(STATE, timeout=ODD), MS, polled=False)
    for ns, failed in ((0, False), (12 * MS + 62_800_000, False), (12 * MS + 62_800_001, True)):
        it.tick(ns)
        assert bool(it.failure) == failed


def test_a_drive_whose_time_out_did_not_act_is_not_asked_again() -> None:
    it = proof()
    for ms in (3, 5, 17):
        it.take(ACTIVE, ms * MS)
    assert it.silent(18 * MS) is False  # whoever gives it up says so by frames
    reason = it.failure
    assert "did not act: 0.012 s after the last command it was still armed" in reason
    it.take(IDLE, 30 * MS)
    it.tick(0)
    it.tick(10_000 * MS)
    assert (it.done, it.failure, it.seen_ns) == (False, reason, 12 * MS)


def test_what_comes_after_the_decision_changes_nothing() -> None:
    it = proof()
    for ms, said in ((0, ACTIVE), (5, ACTIVE), (20, IDLE), (120, ACTIVE)):
        it.take(said, ms * MS)
    it.tick(0)
    it.tick(10_000 * MS)
    assert (it.done, it.failure, it.seen_ns) == (True, "", 15 * MS)


def test_a_polled_drive_is_asked_again_after_the_time_out() -> None:
    it = proof(polled=True)
    it.take(ACTIVE, 0)
    it.take(ACTIVE, MS)
    assert silent(it, 40) == list(range(1, 13))
    it.take(IDLE, 13 * MS)
    assert it.done


def test_a_drive_that_does_not_say_what_it_does_is_given_up() -> None:
    it = proof()
    it.take(ACTIVE, 7 * MS)
    for ms, failed in ((7, False), (1019, False), (1020, True)):
        it.tick(ms * MS)
        assert bool(it.failure) == failed
    assert silent(it, 2000) == []
