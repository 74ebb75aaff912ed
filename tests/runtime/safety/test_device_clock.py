"""The node's clock is held against the computer's to the nanosecond, in both directions, and adds up."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_runtime.safety.device_clock import DeviceClock

MS = 1_000_000
BASE = 7_000 * MS  # Arrival less device time, of a frame without latency


def learned(period_ns: int = MS, latencies: tuple[int, ...] = (0,) * 10) -> tuple[DeviceClock, int]:
    """A clock that has learned from pairs with these latencies, and the device time of the last."""
    clock, device_ns = DeviceClock(period_ns), 100 * MS
    for latency_ns in latencies:
        device_ns += period_ns
        assert clock.learn(device_ns, BASE + device_ns + latency_ns)
    return clock, device_ns


def judge(clock: DeviceClock, device_ns: int, late_ns: int = 0, seen_after_ns: int = 0) -> str:
    arrival_ns = BASE + device_ns + late_ns
    return clock.time_problem(device_ns, arrival_ns, arrival_ns + seen_after_ns)


# --- fast -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("period_ns", "allowance_ns"), [(MS, 2 * MS), (MS // 10, 2 * MS), (3 * MS, 6 * MS)])
def test_a_sample_may_be_two_periods_and_two_milliseconds_too_early_and_no_more(
    period_ns: int, allowance_ns: int
) -> None:
    for early_ns, wrong in ((allowance_ns, False), (allowance_ns + 1, True)):
        clock, device_ns = learned(period_ns)
        assert clock.allowance_ns == allowance_ns
        assert bool(judge(clock, device_ns + period_ns, -early_ns)) == wrong


def test_the_reference_is_the_least_late_of_the_pairs_before_arming() -> None:
    clock, device_ns = learned(latencies=(500_000, 300_000, 900_000))
    assert judge(clock, device_ns + MS, 300_000 - 2 * MS) == ""
    assert judge(clock, device_ns + 2 * MS, 300_000 - 2 * MS - 1) == "it has gained 2.000 ms on this computer's"


def test_too_early_is_judged_by_when_the_sample_was_in_hand_for_its_stamp_may_be_wrong() -> None:
    clock, device_ns = learned()
    assert judge(clock, device_ns + MS, -10 * MS, seen_after_ns=8 * MS) == ""
    assert judge(clock, device_ns + 2 * MS, -10 * MS, seen_after_ns=8 * MS - 1) != ""


def test_a_jump_of_13_ms_is_told_at_once_and_for_good() -> None:
    clock, device_ns = learned()
    assert judge(clock, device_ns + 14 * MS, -13 * MS) == "it has gained 13.000 ms on this computer's"
    assert judge(clock, device_ns + 15 * MS) == "it has gained 13.000 ms on this computer's"
    assert judge(clock, device_ns + 16 * MS, -20 * MS) == "it has gained 13.000 ms on this computer's"
    assert clock.problem == "it has gained 13.000 ms on this computer's"


def test_what_came_earlier_than_the_first_pair_by_more_than_the_allowance_begins_the_reference_anew() -> None:
    clock = DeviceClock(MS)
    assert clock.learn(0, BASE + 5 * MS)
    assert clock.learn(MS, BASE + MS + 3 * MS)
    assert not clock.learn(2 * MS, BASE + 2 * MS + 3 * MS - 1)
    assert clock.learn(3 * MS, BASE + 3 * MS + 3 * MS - 1 - 2 * MS)  # from the third one on
    assert judge(clock, 4 * MS, 3 * MS - 1 - 4 * MS) == ""
    assert judge(clock, 5 * MS, 3 * MS - 2 - 4 * MS) != ""


def test_a_reference_that_begins_anew_forgets_the_ones_before() -> None:
    clock, device_ns = learned(latencies=(0, 0))
    clock.restart()
    assert clock.learn(device_ns + MS, BASE + device_ns + MS + 4 * MS)
    assert judge(clock, device_ns + 2 * MS, 4 * MS - 2 * MS - 1) != ""


# --- slow -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("late_ns", "wrong"), [(2 * MS, False), (2 * MS + 1, True)])
def test_twenty_samples_late_by_more_than_two_periods_are_a_slow_clock(late_ns: int, wrong: bool) -> None:
    clock, device_ns = learned()
    said = [judge(clock, device_ns + n * MS, late_ns) for n in range(1, 21)]
    assert said[:-1] == [""] * 19
    assert said[-1] == ("it has lost 2.000 ms on this computer's" if wrong else "")


def test_a_window_begins_where_the_last_one_ended() -> None:
    clock, device_ns = learned()
    lates = [0, *[3 * MS] * 38, 3 * MS]
    said = [judge(clock, device_ns + n * MS, late) for n, late in enumerate(lates, start=1)]
    assert [bool(text) for text in said].index(True) == 39


# --- drift ----------------------------------------------------------------------------------------------------------


def drifting(clock: DeviceClock, device_ns: int, ppm: int, samples: int) -> int | None:
    """The sample at which a clock of a constant rate is blamed; the arrivals are the computer's own milliseconds."""
    for n in range(1, samples + 1):
        said_ns = device_ns + n * MS + n * ppm
        arrival_ns = BASE + device_ns + n * MS
        if clock.time_problem(said_ns, arrival_ns, arrival_ns):
            return n
    return None


@pytest.mark.parametrize(("ppm", "earliest", "latest"), [(10_000, 205, 212), (-10_000, 205, 252), (1_000, 3900, 4100)])
def test_what_is_beyond_two_quartzes_adds_up(ppm: int, earliest: int, latest: int) -> None:
    found = drifting(*learned(), ppm, 10_000)
    assert found is not None
    assert earliest <= found <= latest


FOLLOWED = [
    (1, 9_000, 9_000), (1, 10_000, 10_000), (1, 11_000, 10_000), (1, -9_000, -9_000), (1, -11_000, -10_000),
    (4, 4 * MS, 40_000), (100, 100 * MS, 1_000_000),
]  # fmt: skip
"""Period [ms], how late a window is [ns], and how far the reference follows [ns]."""


def test_a_window_moves_the_reference_by_500_ppm_of_its_length_and_no_more() -> None:
    for (period_ms, late_ns, follows_ns), (beyond_ns, wrong) in itertools.product(FOLLOWED, [(0, False), (1, True)]):
        period_ns = period_ms * MS
        clock, device_ns = learned(period_ns)
        for n in range(1, 21):
            assert judge(clock, device_ns + n * period_ns, late_ns) == ""
        assert bool(judge(clock, device_ns + 21 * period_ns, follows_ns - 2 * period_ns - beyond_ns)) == wrong


@given(st.lists(st.integers(0, 1_900_000), min_size=200, max_size=200), st.integers(-400, 400))
def test_latencies_below_the_allowance_never_blame_a_quartz(latencies: list[int], ppm: int) -> None:
    clock, device_ns = learned(latencies=tuple(latencies[:10]))
    for n, late_ns in enumerate(latencies[10:], start=1):
        said_ns = device_ns + n * MS + n * ppm
        arrival_ns = BASE + device_ns + n * MS + late_ns
        assert clock.time_problem(said_ns, arrival_ns, arrival_ns) == ""


# --- the grid -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("elapsed_ns", [0, -1, -MS])
def test_a_device_time_that_does_not_go_on_is_wrong_at_once(elapsed_ns: int) -> None:
    clock, device_ns = learned()
    expected = f"it went from one sample to the next by {elapsed_ns / 1e6:.3f} ms"
    assert clock.time_problem(device_ns + elapsed_ns, BASE + device_ns + MS, BASE + device_ns + MS) == expected


def test_five_samples_off_the_grid_by_more_than_a_quarter_period_are_too_many() -> None:
    for (off_ns, wrong), periods in itertools.product(
        [(250_000, False), (250_001, True), (-250_000, False), (-250_001, True), (500_000, True)], [1, 2, 7]
    ):
        clock, device_ns = learned()
        said = []
        for _ in range(5):
            device_ns += periods * MS + off_ns
            arrival_ns = BASE + device_ns + 100 * MS  # late, so that nothing else is wrong with it
            said.append(clock.time_problem(device_ns, arrival_ns, arrival_ns))
        assert said[:4] == [""] * 4
        apart = (periods * MS + off_ns) / 1e6
        assert said[4] == (f"its samples are {apart:.3f} ms apart, the bench's period is 1 ms" if wrong else "")


def test_samples_on_the_grid_forgive_those_off_it() -> None:
    clock, device_ns = learned()
    for n in range(50):
        device_ns += MS + (300_000 if n % 5 == 0 else 0)
        arrival_ns = BASE + device_ns
        assert clock.time_problem(device_ns, arrival_ns, arrival_ns) == ""


@pytest.mark.parametrize("step_ns", [1, 200_000, 250_000, 400_000, 749_999])
def test_samples_closer_than_three_quarters_of_a_period_are_off_the_grid(step_ns: int) -> None:
    clock, device_ns = learned()
    for n in range(1, 6):
        device_ns += step_ns
        said = clock.time_problem(device_ns, BASE + device_ns, BASE + device_ns)
        assert bool(said) == (n == 5)
