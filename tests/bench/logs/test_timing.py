"""Timing of a run: intervals in closed form, and verdicts worked out by hand, from stamps that are known."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emb_bench.logs.log import read_log
from emb_bench.logs.timing import INTERVALS, Timing, timing
from emb_runtime.can.e2e import NO_COUNTER
from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import Bench, parse_bench, shipped_bench_text
from emb_runtime.control.result import Outcome
from emb_runtime.log.ring_buffer import EventRecord, Record
from emb_runtime.records import CycleRecord, NodeState, Reason, RunState
from tests.bench.conftest import Replay
from tests.bench.hostile import HostileBus, drive, write_trace
from tests.bench.simulated_logs import square, write_log
from tests.conftest import Simulate

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
    outside = measure(cycle(-1, START))
    assert outside.clock is None
    assert all(len(outside.interval(name)) == 0 for name in INTERVALS)


def test_a_missed_period_is_counted_and_is_no_long_one(measure: Measure) -> None:
    before = [cycle(n, START + n * MS) for n in range(5)]
    after = [cycle(n, START + n * MS) for n in range(9, 12)]
    t = measure(*before, cycle(8, START + 8 * MS, missed=3), *after)
    assert t.missed == 3
    np.testing.assert_allclose(t.period, 1e-3)
    assert len(t.period) == 7


def test_an_unanswered_sample_has_a_period_and_nothing_else_and_cycles_outside_the_experiment_none(
    measure: Measure,
) -> None:
    stopping = cycle(3, START + 700 * MS, state=int(RunState.STOPPING))
    within = [cycle(0, START), unanswered(1, START + MS), cycle(2, START + 2 * MS)]
    t = measure(cycle(-1, START - 9 * MS), *within, stopping)
    assert t.unanswered == 1
    np.testing.assert_allclose(t.period, [1e-3, 1e-3])
    assert [len(t.interval(name)) for name in INTERVALS if name != "period"] == [2] * 5


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


def test_the_counts_are_the_loop_s_and_a_simulation_is_called_so(
    tmp_path: Path, bench: Bench, layout: Layout, simulate: Simulate
) -> None:
    run = drive(HostileBus(bench, layout, random.Random(0), slow=0.1, lost=0.02), square, 150)
    counters = run.outcome.counters
    assert min(counters.missed, counters.unanswered, counters.not_obeyed) > 0
    t = timing(read_log(write_trace(tmp_path / "r.mcap", run.journal.records, bench, layout, run.outcome, steps=150)))
    assert (t.missed, t.unanswered, t.not_obeyed) == (counters.missed, counters.unanswered, counters.not_obeyed)
    assert {len(t.interval(name)) for name in INTERVALS if name != "period"} == {counters.answered}
    assert timing(read_log(write_log(tmp_path / "s.mcap", simulate(steps=50), steps=50))).simulated


Write = Callable[..., Path]


def bench_text(budgets: str | None) -> str:
    """The shipped bench with other budgets, or with none."""
    text = shipped_bench_text()
    begin, end = text.index("[budgets]"), text.index("# Brakes to simulate")
    return text[:begin] + (budgets or "") + "\n" + text[end:]


@pytest.fixture(scope="module")
def outcome(simulate: Simulate) -> Outcome:
    """How some run ended."""
    return simulate(square).outcome


@pytest.fixture
def write(tmp_path: Path, layout: Layout, outcome: Outcome) -> Write:
    """Write a log that is not of a simulation: ``write(cycles, budgets, not_obeyed=0)``."""

    def write_one(
        cycles: Sequence[CycleRecord], budgets: str | None, not_obeyed: int | None = 0, name: str = "run.mcap"
    ) -> Path:
        ended = (
            None if not_obeyed is None else replace(outcome, counters=replace(outcome.counters, not_obeyed=not_obeyed))
        )
        bench = parse_bench(bench_text(budgets), "test")
        return write_trace(
            tmp_path / name, [EventRecord(START, "SILENT", ""), *cycles], bench, layout, ended, steps=500
        )

    return write_one


def punctual(count: int = 100) -> list[CycleRecord]:
    """Cycles of exactly 1 ms whose answers took 450 us, 300 us of it to decide."""
    return [cycle(n, START + n * MS) for n in range(count)]


def verdicts(replay: Replay, path: Path, code: int = 0) -> dict[str, tuple[Any, bool]]:
    (log,) = replay.document("timing", path, code=code)["logs"]
    return {entry["name"]: (entry["measured"], entry["met"]) for entry in log["budgets"]}


def test_each_budget_is_judged_by_its_own_quantile_or_share(write: Write, replay: Replay) -> None:
    """Punctual cycles; one that answers late; 20 samples, the last one after 5 periods without any, 4 unanswered."""
    outlier = punctual()
    outlier[50] = outlier[50]._replace(send_time_ns=outlier[50].receive_time_ns + 900_000)
    few = [unanswered(n, START + n * MS) if n % 5 == 4 else cycle(n, START + n * MS) for n in range(19)]
    few.append(unanswered(24, START + 24 * MS, missed=5))
    response, decision = "[budgets.response]\n", "[budgets.decision]\n"
    shares = "[budgets]\nmissed = 0.2\nunanswered = 0.19\nnot_obeyed = 0.125\n"
    table: list[tuple[list[CycleRecord], str, dict[str, tuple[float, bool]]]] = [
        (punctual(), "[budgets]\nmissed = 0\n", {"missed": (0.0, True)}),
        (punctual(), f"{response}p50 = 4.51e-4\n'p99.9' = 5e-4\n",
         {"response p50": (4.5e-4, True), "response p99.9": (4.5e-4, True)}),
        (punctual(), f"{decision}p50 = 2.99e-4\n", {"decision p50": (3e-4, False)}),
        (punctual(), "[budgets.age]\np50 = 1.01e-4\n", {"age p50": (1e-4, True)}),
        (outlier, f"{response}p50 = 4.6e-4\np100 = 8e-4\n",
         {"response p50": (4.5e-4, True), "response p100": (9e-4, False)}),
        (few, shares, {"missed": (0.2, True), "unanswered": (0.2, False), "not_obeyed": (0.125, True)}),
    ]  # fmt: skip
    for number, (cycles, budgets, expected) in enumerate(table):
        path = write(cycles, budgets, not_obeyed=2 if cycles is few else 0, name=f"{number}.mcap")
        found = verdicts(replay, path, code=0 if all(met for _, met in expected.values()) else 1)
        assert found == {name: (pytest.approx(value, rel=1e-9), met) for name, (value, met) in expected.items()}


def test_what_was_not_measured_is_not_met(write: Write, replay: Replay) -> None:
    before = [cycle(-1, START - MS)]  # no part of the experiment
    for name, (cycles, not_obeyed, budgets) in {
        "cut": (punctual(), None, "[budgets]\nnot_obeyed = 1\n"),  # the log ends before the run does
        "response": ([], 0, "[budgets.response]\np50 = 1\n"),
        "unanswered": ([], 0, "[budgets]\nunanswered = 1\n"),
    }.items():
        path = write(before + cycles, budgets, not_obeyed, f"{name}.mcap")
        assert list(verdicts(replay, path, code=1).values()) == [(None, False)]
        assert "NOT MET" in replay.text("timing", path, "-q", code=1)


def test_one_sample_has_an_answer_and_no_period(write: Write, replay: Replay) -> None:
    path = write(punctual(1), "[budgets]\nmissed = 0.1\n[budgets.response]\np50 = 1e-3\n")
    (log,) = replay.document("timing", path)["logs"]
    assert (log["met"], log["intervals"]["period"], log["clock_drift"]) == (True, {}, None)
    assert log["intervals"]["response"]["p50"] == pytest.approx(4.5e-4, rel=1e-9)
    assert replay.text("timing", path, "-q").endswith("met: all 2 budgets\n")


def test_without_budgets_there_is_nothing_to_judge_by(write: Write, replay: Replay) -> None:
    for name, budgets in enumerate((None, "[budgets]\n", "[budgets.age]\n")):
        path = write(punctual(), budgets, name=f"{name}.mcap")
        assert verdicts(replay, path, code=2) == {}
        assert "no verdict" in replay.text("timing", path, "-q", code=2)


def test_of_several_logs_one_that_is_not_met_decides(write: Write, replay: Replay) -> None:
    good = write(punctual(), "[budgets.response]\np50 = 1e-3\n", name="good.mcap")
    bad = write(punctual(), "[budgets.response]\np50 = 1e-6\n", name="bad.mcap")
    without = write(punctual(), None, name="without.mcap")
    replay.text("timing", good, write(punctual(), "[budgets.response]\np50 = 1e-3\n", name="other.mcap"))
    replay.text("timing", good, without, code=2)
    logs = replay.document("timing", without, bad, good, code=1)["logs"]
    assert [(Path(log["log"]).name, log["met"]) for log in logs] == [
        ("without.mcap", None),
        ("bad.mcap", False),
        ("good.mcap", True),
    ]
