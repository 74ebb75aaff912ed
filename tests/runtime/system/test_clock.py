from __future__ import annotations

import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emb_bench.sim.transport import SteppedClock
from emb_runtime.system.clock import MonotonicClock, TimeUnwrapper

PERIOD_NS = 4_194_304_000


def test_the_wall_offset_is_the_tightest_of_three_measurements(monkeypatch: pytest.MonkeyPatch) -> None:
    # Three tries of (before, wall, after): interrupted before the wall clock is read, undisturbed, interrupted after.
    monotonic = iter([0, 5_000, 10_000, 10_002, 20_000, 29_000])
    wall = iter([1_004_999, 1_010_001, 1_020_001])
    monkeypatch.setattr(time, "monotonic_ns", lambda: next(monotonic))
    monkeypatch.setattr(time, "time_ns", lambda: next(wall))
    assert MonotonicClock().wall_offset_ns() == 1_000_000


def test_stepped_time_never_goes_back() -> None:
    clock = SteppedClock(start_ns=10)
    with pytest.raises(ValueError, match="cannot go back"):
        clock.advance_to(9)
    assert clock.now_ns() == 10


@given(
    start_ns=st.integers(0, 10**15),
    boot_ns=st.integers(0, 10**15),
    gaps_ns=st.lists(st.integers(0, 60 * 10**9), max_size=40),
    drift_ppm=st.integers(-100, 100),
    latencies_ns=st.lists(st.integers(0, 500_000_000), min_size=41, max_size=41),
)
def test_unwrapped_time_moves_exactly_as_the_device_clock_did(
    start_ns: int, boot_ns: int, gaps_ns: list[int], drift_ppm: int, latencies_ns: list[int]
) -> None:
    unwrapper = TimeUnwrapper(PERIOD_NS)
    device_ns, host_ns = start_ns, boot_ns
    first = unwrapper.unwrap(device_ns % PERIOD_NS, host_ns + latencies_ns[0])
    assert first == start_ns % PERIOD_NS
    for gap_ns, latency_ns in zip(gaps_ns, latencies_ns[1:], strict=False):
        host_ns += gap_ns
        device_ns += gap_ns + gap_ns * drift_ppm // 1_000_000
        assert unwrapper.unwrap(device_ns % PERIOD_NS, host_ns + latency_ns) - first == device_ns - start_ns


def test_a_stamp_from_before_the_last_one_unwraps_to_before_it() -> None:
    unwrapper = TimeUnwrapper(PERIOD_NS)
    unwrapper.unwrap(100, 1_000_000)
    assert unwrapper.unwrap(PERIOD_NS - 400, 1_000_500) == -400
