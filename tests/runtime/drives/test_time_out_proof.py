"""The silence by which a drive shows that it lets go: when it begins, and what ends it."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from emb_runtime.drives.mapping_file import load_mapping
from emb_runtime.drives.phases import AIMS
from emb_runtime.drives.time_out_proof import TimeOutProof
from emb_runtime.drives.wire import DriveState
from tests.drives import EXAMPLES

MS = 1_000_000
_STATE = load_mapping(EXAMPLES / "odrive.toml").state
assert _STATE is not None
STATE = _STATE  # is believed for 0.25 s
ACTIVE, IDLE, FAULT = DriveState.ACTIVE, DriveState.IDLE, DriveState.FAULT


def proof(polled: bool = False) -> TimeOutProof:
    return TimeOutProof(0.010, STATE, MS, polled=polled)


def silent(it: TimeOutProof, until_ms: int) -> list[int]:
    return [ms for ms in range(until_ms) if it.silent(ms * MS)]


def begun(first: int = 0, period: int = 100, polled: bool = False) -> tuple[TimeOutProof, int]:
    """A proof of a drive that has said twice that it is armed, and the last instant at which it is fed [ms]."""
    it = proof(polled)
    assert silent(it, 400) == []
    for number in (0, 1):
        it.add_report(ACTIVE, (first + number * period) * MS)
    last = silent(it, 400)[0] - 1
    it.fed(last * MS)
    return it, last


@pytest.mark.parametrize(("period", "wait"), [(100, 89), (20, 9), (11, 0), (5, 4), (3, 1), (1, 0)])
def test_the_silence_begins_so_that_a_message_comes_one_period_after_the_time_out(period: int, wait: int) -> None:
    for first in (0, 50):
        it, last = begun(first, period)
        assert last == first + period + wait
        assert silent(it, 400) == list(range(last + 1, 400))
        it.fed((last + 1) * MS)  # too late to count
        it.add_report(IDLE, (last + 11) * MS)
        assert (it.done, it.seen_ns, it.failure) == (True, 11 * MS, "")
        assert silent(it, 400) == []


def test_a_message_before_the_silence_moves_it() -> None:
    it, last = begun(0, 200)  # one was lost
    it.fed((last - 1) * MS)
    it.add_report(ACTIVE, 300 * MS)
    assert silent(it, 600)[0] == 390
    it.add_report(ACTIVE, 389 * MS)  # at the last instant
    assert silent(it, 600)[0] == 390 + 78


@pytest.mark.parametrize(
    ("said", "after_ns", "outcome"),
    [
        (IDLE, 1, "done"),
        (IDLE, 12 * MS, "done"),
        (FAULT, 12 * MS, "done"),
        (IDLE, 12 * MS + 1, "unresolved"),
        (FAULT, 12 * MS + 1, "unresolved"),
        (ACTIVE, 12 * MS - 1, ""),
        (ACTIVE, 12 * MS, "failed"),
    ],
)
def test_what_it_says_up_to_two_periods_after_the_time_out_decides(
    said: DriveState, after_ns: int, outcome: str
) -> None:
    it, last = begun()
    it.fed(last * MS)
    it.add_report(said, last * MS + after_ns)
    found = {"done": it.done, "unresolved": it.unresolved, "failed": bool(it.failure)}
    assert [name for name, there in found.items() if there] == [outcome][: bool(outcome)]
    assert it.seen_ns == after_ns
    assert it.over == bool(outcome)
    if outcome == "failed":
        assert "did not act: 0.012 s after the last command it was still armed, node.watchdog is 0.01 s" in it.failure
    if outcome:  # what comes later changes nothing
        before = (it.done, it.unresolved, it.failure, it.seen_ns)
        for later, ms in ((ACTIVE, 130), (IDLE, 230)):
            it.add_report(later, (last + ms) * MS)
        it.tick(0)
        it.tick(10_000 * MS)
        assert (it.done, it.unresolved, it.failure, it.seen_ns) == before
        assert not it.silent((last + 5) * MS)  # whoever gives it up says so by frames


ODD = 0.0157  # Time of which the nanoseconds, rounded off and not to the nearest, are one fewer [s]


def test_before_a_silence_nothing_is_asked_and_nothing_seen() -> None:
    it = proof(polled=True)
    assert (it.asks_ns, it.seen_ns) == (None, 0)
    assert it.silent(0) is False


def test_without_a_frame_to_it_a_drive_has_been_left_alone_since_the_begin_of_time() -> None:
    it = proof()
    for ms, said in ((500, ACTIVE), (511, ACTIVE), (522, IDLE)):
        it.add_report(said, ms * MS)
    assert (it.unresolved, it.seen_ns) == (True, 522 * MS)


def test_times_are_rounded_to_the_nearest_nanosecond() -> None:
    it = TimeOutProof(0.010, STATE, MS + 1, polled=True, aim=0.75)
    for ns in (5, 6):
        it.add_report(ACTIVE, ns)
    assert it.asks_ns == 6 + 10_750_001
    it = TimeOutProof(0.010, STATE, MS + 1, polled=False)
    for ns in (5, 6):
        it.add_report(ACTIVE, ns)
    assert it.silent(7)
    it = TimeOutProof(ODD, STATE, MS, polled=False)
    for ns in (5, 6):
        it.add_report(ACTIVE, ns)
    it.fed(6)
    it.add_report(IDLE, 6 + 15_700_000 + 2 * MS)
    assert it.done


@pytest.mark.parametrize("aim", [1.0, 0.75])
def test_a_polled_drive_is_asked_after_the_silence_to_the_nanosecond(aim: float) -> None:
    length = 15_700_000 + round(aim * MS)
    for polled in (True, False):
        it = TimeOutProof(ODD, STATE, MS, polled=polled, aim=aim)
        it.add_report(ACTIVE, 3 * MS)
        it.add_report(ACTIVE, 5 * MS)
        begin = 5 * MS if polled else 5 * MS + -length % (2 * MS)
        assert it.asks_ns == begin + length
        assert [it.silent(begin + ns) for ns in (0, 1, length - 1, length)] == [False, True, True, not polled]
        it.fed(begin)
        it.fed(begin + length)  # asks
        it.add_report(IDLE, begin + length + 1)
        assert (it.done, it.seen_ns) == (True, length + 1)


def test_two_messages_of_one_time_are_no_period_of_nothing() -> None:
    it = proof()
    it.add_report(ACTIVE, 5 * MS)
    it.add_report(ACTIVE, 5 * MS)
    assert it.silent(5 * MS + 1)


def test_the_time_to_say_something_is_known_to_the_nanosecond() -> None:
    it = TimeOutProof(0.010, replace(STATE, timeout=ODD), MS, polled=False)
    for ns, failed in ((0, False), (12 * MS + 62_800_000, False), (12 * MS + 62_800_001, True)):
        it.tick(ns)
        assert bool(it.failure) == failed


def test_a_drive_that_does_not_say_what_it_does_is_given_up() -> None:
    it = proof()
    it.add_report(ACTIVE, 7 * MS)
    for ms, failed in ((7, False), (1019, False), (1020, True)):
        it.tick(ms * MS)
        assert bool(it.failure) == failed
    assert silent(it, 2000) == []


class Drive:
    """A drive of a time-out that says its state each so often, and a commander that feeds it each millisecond [ns].

    Continuous times, but for a time-out that is looked at each millisecond where ``ticks``.
    """

    def __init__(self, time_out: float, says: float, draw: random.Random, ticks: bool = False) -> None:
        self.time_out, self.says, self.draw, self.ticks = round(time_out * MS), round(says * MS), draw, ticks
        self.jitter, self.lost = 0.0, 0.0
        self.phase = draw.randrange(MS)

    def proved(self, polled: bool = False) -> str:
        """What comes of it: done, unresolved, or failed; at the first silence that decides, of four."""
        for aim in AIMS:
            it = TimeOutProof(0.010, STATE, MS, polled=polled, aim=aim)
            outcome = self._silence(it, polled)
            if outcome != "unresolved":
                return outcome
        return "unresolved"

    def _silence(self, it: TimeOutProof, polled: bool) -> str:
        start = self.draw.randrange(self.says)
        says = 0
        fed, step = -1, MS // 20
        for now in range(0, 1500 * MS, step):
            it.tick(now)
            messages = []
            if not polled and now >= start + says * self.says:
                says += 1
                if self.draw.random() >= self.lost:
                    messages = [now + round(self.draw.uniform(0.0, self.jitter) * MS)]
            due = now % MS == self.phase // step * step or (it.asks_ns is not None and 0 <= now - it.asks_ns < step)
            if due and not it.silent(now):
                if polled:
                    messages = [now + 2 * step]
                it.fed(now)
                before, fed = fed, now
            for at in messages:
                last = before if polled else fed  # packed before the frame that asks is unpacked
                it.add_report(ACTIVE if self._armed(last, at - step if polled else now) else IDLE, at)
            if it.over:
                return "done" if it.done else "unresolved" if it.unresolved else "failed"
        raise AssertionError("nothing was decided")

    def _armed(self, fed: int, now: int) -> bool:
        looked = now // MS * MS if self.ticks else now
        return looked - fed < self.time_out


AGE = [*range(5, 31)]  # Time-outs [ms]


@pytest.mark.parametrize("polled", [False, True])
@pytest.mark.parametrize("faults", [(0.0, 0.0, False), (0.3, 0.0, False), (0.0, 0.2, False), (0.3, 0.2, True)])
def test_no_time_out_is_proved_that_is_longer_than_the_speed_into_an_end_stop_was_computed_with(
    faults: tuple[float, float, bool], polled: bool
) -> None:
    hold = load_mapping(EXAMPLES / "odrive.toml").longest_hold(1e-3)
    assert hold == pytest.approx(0.012)
    proved = dict.fromkeys(AGE, 0)
    for says in range(1, 21) if not polled else (1,):
        for time_out in AGE:
            drive = Drive(time_out, says, random.Random(100 * says + time_out), ticks=faults[2])
            drive.jitter, drive.lost = faults[:2]
            proved[time_out] += drive.proved(polled) == "done"
    assert all(time_out * 1e-3 <= hold for time_out, count in proved.items() if count)
    if faults == (0.0, 0.0, False):
        assert all(proved[time_out] == (1 if polled else 20) for time_out in range(5, 11))
