"""``emb-replay timing``: verdicts worked out by hand, from stamps that are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from emb_runtime.can.messages import Layout
from emb_runtime.config.bench import parse_bench, shipped_bench_text
from emb_runtime.control.result import Outcome
from emb_runtime.log.ring_buffer import EventRecord
from emb_runtime.records import CycleRecord

from tests.bench.conftest import Replay  # isort: skip
from tests.bench.hostile import write_trace
from tests.bench.logs.test_timing import MS, START, cycle, unanswered
from tests.bench.simulated_logs import square

from tests.conftest import Simulate  # isort: skip

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
        assert "not judged" in replay.text("timing", path, "-q", code=2)


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
