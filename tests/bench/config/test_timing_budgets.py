from __future__ import annotations

import pytest

from emb_bench.config.bench import Bench, parse_bench
from emb_runtime.config.bench import shipped_bench_text
from emb_runtime.errors import BenchFileError


def with_budgets(budgets: str) -> Bench:
    text = shipped_bench_text()
    begin, end = text.index("[budgets]"), text.index("# Brakes to simulate")
    return parse_bench(text[:begin] + budgets + "\n" + text[end:], "b.toml")


def test_a_bench_file_without_budgets_is_a_bench_file() -> None:
    assert with_budgets("").budgets is None


def test_budgets_are_read_as_they_stand() -> None:
    budgets = with_budgets('[budgets]\nmissed = 0\nnot_obeyed = 1\n[budgets.age]\n"p99.9" = 2e-4\np100 = 1').budgets
    assert budgets is not None
    assert budgets.shares == {"missed": 0.0, "not_obeyed": 1.0}
    assert budgets.intervals == {"age": {"p99.9": 2e-4, "p100": 1.0}}


def test_budgets_are_no_part_of_what_a_policy_depends_on() -> None:
    assert with_budgets("").identity_hash == parse_bench(shipped_bench_text(), "t").identity_hash


def test_the_shipped_response_is_well_within_the_period() -> None:
    bench = parse_bench(shipped_bench_text(), "t")
    assert bench.budgets is not None
    assert max(bench.budgets.intervals["response"].values()) < 0.75 * bench.timing.sample_time


def test_a_budget_that_makes_no_sense_is_refused_with_its_name() -> None:
    for budgets, reason in [
        ("[budgets]\nmissing = 0.1", "budgets.missing: unknown key; expected some of .*missed"),
        ("[budgets]\nmissed = 1.5", "budgets.missed: expected a number from 0 to 1, got 1.5"),
        ("[budgets]\nresponse = 1", "budgets.response: expected a table, got a number, 1"),
        ("[budgets.slack]\np50 = 1e-3", "budgets.slack: unknown key"),
        ("[budgets.age]\np42 = 1e-3", "budgets.age.p42: unknown key; expected one of p100, p50, p90, p99, p99.9"),
        ("[budgets.age]\np99 = 0", "budgets.age.p99: expected a number above 0, at most 1, got 0"),
        ("[budgets.age]\np99 = 300", "budgets.age.p99: expected a number above 0, at most 1, got 300"),
        ('[budgets.age]\np99 = "fast"', "budgets.age.p99: expected a number"),
    ]:
        with pytest.raises(BenchFileError, match=f"^b.toml: {reason}"):
            with_budgets(budgets)
