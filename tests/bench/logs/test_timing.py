"""Timing of a run: every interval in closed form, from stamps that are known."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.logs.log import read_log
from emb_bench.logs.timing import INTERVALS, Timing, timing, timing_numbers
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Bench
from emb_runtime.log.ring_buffer import EventRecord, Record
from emb_runtime.records import CycleRecord, NodeState, Reason, RunState
from tests.bench.hostile import HostileBus, drive, write_trace
from tests.bench.simulated_logs import square, write_log

from tests.conftest import Simulate  # isort: skip

MS = 1_000_000
START = 5_000_000_000


def cycle(step: int, receive_ns: int, **changes: Any) -> CycleRecord:
    """A cycle whose answer took 100 us to wake, 300 us to decide and 50 us to send."""
    fields: dict[str, Any] = {
        "step": step,
        "state": int(RunState.ACTIVE),
        "reasons": 0,
        "counter": step % 15,
        "command_counter": step % 15,
        "missed": 0,
        "node_state": int(NodeState.ACTIVE),
        **dict.fromkeys(("angle", "velocity", "applied_current"), 0.0),
        **dict.fromkeys(("policy_current", "clipped_current", "sent_current"), 1.0),
        "device_time_ns": step * MS,
        "receive_time_ns": receive_ns,
        "wake_time_ns": receive_ns + 100_000,
        "decide_time_ns": receive_ns + 400_000,
        "send_time_ns": receive_ns + 450_000,
    }
    return CycleRecord(**(fields | changes))


def unanswered(step: int, receive_ns: int, **changes: Any) -> CycleRecord:
    nothing = {"command_counter": NO_COUNTER, "reasons": int(Reason.MISSED), "send_time_ns": 0, "decide_time_ns": 0}
    return cycle(step, receive_ns, **(nothing | changes))


Measure = Callable[..., Timing]


@pytest.fixture
def measure(tmp_path: Path, bench: Bench, layout: Layout) -> Measure:
    """The timing of a log with these cycles."""

    def write_and_read(*cycles: CycleRecord) -> Timing:
        records: list[Record] = [EventRecord(START, "SILENT", ""), *cycles]
        log = write_trace(tmp_path / "run.mcap", records, bench, layout, None, steps=500)
        return timing(read_log(log))

    return write_and_read


def test_every_interval_is_the_difference_of_its_stamps(measure: Measure) -> None:
    t = measure(*(cycle(n, START + n * MS) for n in range(20)))
    expected = {"period": 1e-3, "age": 1e-4, "decision": 3e-4, "sending": 5e-5, "response": 4.5e-4, "slack": 5.5e-4}
    assert set(expected) == set(INTERVALS)
    for name, value in expected.items():
        np.testing.assert_allclose(t.interval(name), value, rtol=1e-12)
    np.testing.assert_allclose(t.times, 1e-3 * np.arange(20), rtol=0, atol=1e-15)
    assert not t.simulated


def test_a_missed_period_is_counted_and_is_no_long_one(measure: Measure) -> None:
    before = [cycle(n, START + n * MS) for n in range(5)]
    after = [cycle(n, START + n * MS) for n in range(9, 12)]
    t = measure(*before, cycle(8, START + 8 * MS, missed=3), *after)
    assert t.missed == 3
    np.testing.assert_allclose(t.period, 1e-3)
    assert len(t.period) == 7


def test_an_unanswered_sample_has_a_period_and_nothing_else(measure: Measure) -> None:
    t = measure(cycle(0, START), unanswered(1, START + MS), cycle(2, START + 2 * MS))
    assert t.unanswered == 1
    assert len(t.period) == 2
    assert [len(t.interval(name)) for name in INTERVALS if name != "period"] == [2] * 5


def test_cycles_outside_the_experiment_do_not_count(measure: Measure) -> None:
    stopping = cycle(3, START + 700 * MS, state=int(RunState.STOPPING))
    t = measure(cycle(-1, START - 9 * MS), *(cycle(n, START + n * MS) for n in range(3)), stopping)
    np.testing.assert_allclose(t.period, 1e-3)
    assert len(t.period) == 2


@pytest.mark.parametrize("drift", [0.0, 25e-6, -180e-6, 0.01])
def test_the_device_clock_s_drift_and_jitter_come_from_a_straight_line(measure: Measure, drift: float) -> None:
    n = np.arange(200)
    # Plus, minus, minus, plus is orthogonal to any straight line over whole groups of four.
    jitter_ns = np.where((n % 4 == 0) | (n % 4 == 3), 20_000, -20_000)
    arrivals = START + np.rint(n * MS * (1.0 + drift)).astype(int) + jitter_ns
    t = measure(*(cycle(int(k), int(arrivals[k])) for k in n))
    assert t.clock is not None
    assert t.clock.drift == pytest.approx(drift, abs=1e-9)
    assert t.clock.jitter == pytest.approx(20e-6 * np.sqrt(200 / 198), rel=1e-4)
    slope, offset = np.polyfit(n * 1e-3, (arrivals - START) * 1e-9, 1)
    np.testing.assert_allclose(t.clock.residuals, (arrivals - START) * 1e-9 - slope * n * 1e-3 - offset, atol=1e-11)


def test_a_log_without_an_experiment_has_no_intervals_and_no_clock(measure: Measure) -> None:
    t = measure(cycle(-1, START))
    assert all(len(t.interval(name)) == 0 for name in INTERVALS)
    assert t.clock is None
    assert timing_numbers(t)["intervals"] == {name: {} for name in INTERVALS}


def test_the_counts_are_the_loop_s_and_a_simulation_is_called_so(
    tmp_path: Path, bench: Bench, layout: Layout, simulate: Simulate
) -> None:
    run = drive(HostileBus(bench, layout, random.Random(0), slow=0.1, lost=0.02), square, 150)
    counters = run.outcome.counters
    assert min(counters.missed, counters.unanswered, counters.not_obeyed) > 0
    t = timing(read_log(write_trace(tmp_path / "r.mcap", run.journal.records, bench, layout, run.outcome, steps=150)))
    assert (t.missed, t.unanswered, t.not_obeyed) == (counters.missed, counters.unanswered, counters.not_obeyed)
    assert len(t.response) == counters.answered
    assert timing(read_log(write_log(tmp_path / "s.mcap", simulate(steps=50), steps=50))).simulated
