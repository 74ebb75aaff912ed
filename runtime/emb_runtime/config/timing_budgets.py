"""Timing budgets: ``[budgets]`` of a bench file, by which ``emb-replay timing`` judges logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from msgspec import Meta

QuantileName = Literal["p50", "p90", "p99", "p99.9", "p100"]
QUANTILE_NAMES: tuple[str, ...] = get_args(QuantileName)
QUANTILES = tuple(float(name[1:]) for name in QUANTILE_NAMES)  # In percent; the last one is the largest value

TIMED = ("period", "age", "decision", "sending", "response")
"""Intervals that can have a budget; :data:`emb_bench.logs.timing.INTERVALS` says what each is."""
COUNTED = ("missed", "unanswered", "not_obeyed")
"""Quantities with a budget as a share of the periods, samples or commands."""

Share = Annotated[float, Meta(ge=0, le=1)]
Quantiles = Mapping[QuantileName, Annotated[float, Meta(gt=0, le=1)]]  # [s]


@dataclass(frozen=True)
class Budgets:
    """Largest values of a run; a quantity without a budget is not judged."""

    missed: Share | None = None
    unanswered: Share | None = None
    not_obeyed: Share | None = None
    period: Quantiles = field(default_factory=dict)
    age: Quantiles = field(default_factory=dict)
    decision: Quantiles = field(default_factory=dict)
    sending: Quantiles = field(default_factory=dict)
    response: Quantiles = field(default_factory=dict)

    @property
    def shares(self) -> dict[str, float]:
        """Budgets by what is counted, 0..1."""
        return {name: value for name in COUNTED if (value := getattr(self, name)) is not None}

    @property
    def intervals(self) -> dict[str, Mapping[str, float]]:
        """Budgets by interval and quantile [s]."""
        return {name: value for name in TIMED if (value := getattr(self, name))}
