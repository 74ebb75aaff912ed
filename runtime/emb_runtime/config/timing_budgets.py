"""Timing budgets: ``[budgets]`` of a bench file, by which ``emb-replay timing`` judges logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from emb_runtime.config.validation import Table

QUANTILES = (50.0, 90.0, 99.0, 99.9, 100.0)  # Of an interval, in percent; the last one is the largest value
QUANTILE_NAMES = tuple(f"p{percent:g}" for percent in QUANTILES)

TIMED = ("period", "age", "decision", "sending", "response")
"""Intervals that can have a budget; :data:`emb_bench.logs.timing.INTERVALS` says what each is."""
COUNTED = ("missed", "unanswered", "not_obeyed")
"""Quantities with a budget as a share of the periods, samples or commands."""


@dataclass(frozen=True)
class Budgets:
    """Largest values of a run; a quantity without a budget is not judged."""

    intervals: Mapping[str, Mapping[str, float]]  # By interval and quantile [s]
    shares: Mapping[str, float]  # By what is counted, 0..1


def read_budgets(table: Table) -> Budgets:
    """A bench file's ``[budgets]``.

    Raises:
        BenchFileError: an interval or a quantile is unknown, or a value is out of range.
    """
    given = table.names()
    shares = {n: table.number(n, lambda v: 0 <= v <= 1, "a share from 0 to 1") for n in COUNTED if n in given}
    intervals = {name: _quantiles(table.table(name)) for name in TIMED if name in given}
    table.nothing_else((*COUNTED, *TIMED))
    return Budgets(intervals, shares)


def _quantiles(table: Table) -> dict[str, float]:
    given = table.names()
    limits = {n: table.number(n, lambda v: 0 < v <= 1, "a time in (0, 1] s") for n in QUANTILE_NAMES if n in given}
    table.nothing_else(QUANTILE_NAMES)
    return limits
