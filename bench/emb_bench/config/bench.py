"""The bench file with the tables that simulation and analysis read: budgets, plants, machine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

import emb_runtime.config.bench as driven
from emb_bench.config.machine import Machine
from emb_bench.config.plants import BUILT_IN, Plant, read_plant
from emb_runtime.config.bench import PARAMETER_NAMES, REMEDY, checked_bench, read_bench_text
from emb_runtime.config.typed import parse_toml, read
from emb_runtime.errors import BenchFileError, near

AROUND = 3.0  # Factor around its nominal parameters within which searches for those of a machine begin
DRIVEN = ("ranges", "shield", "watch", "guard", "node", "can")  # Tables that the file of a machine does not have

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
    """Largest values of a run, ``[budgets]``, which ``emb-replay timing`` judges; without a budget, none."""

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
        """Budgets of the counts, by name, 0..1."""
        return {name: value for name in COUNTED if (value := getattr(self, name)) is not None}

    @property
    def intervals(self) -> dict[str, Mapping[str, float]]:
        """Budgets by interval and quantile [s]."""
        return {name: value for name in TIMED if (value := getattr(self, name))}


class _Tables(msgspec.Struct, frozen=True):
    """The tables as they stand."""

    budgets: Budgets | None = None
    plants: dict[str, dict[str, Any]] = {}
    machine: Machine | None = None


@dataclass(frozen=True)
class Bench(driven.Bench):
    """One bench: what is driven, and the tables of simulation and analysis."""

    budgets: Budgets | None  # Timing budgets of a run; None if the file has none
    plants: Mapping[str, Plant]
    machine: Machine | None  # A machine that is no brake of ours, for analysis only; None for a brake, which is driven

    def plant(self, name: str) -> Plant:
        """The named brake to simulate or to evaluate with."""
        try:
            return self.plants[name]
        except KeyError:
            names = f"{', '.join(self.plants)}{near(name, self.plants)}"
            raise BenchFileError(f"no plant is called {name!r}; this bench has: {names}") from None

    def model(self, name: str) -> Plant:
        """The named brake as a record of this bench is evaluated: behind the observer that ``[sensors]`` declares."""
        plant, bandwidth = self.plant(name), self.sensors.bandwidth
        if bandwidth is None:
            return plant
        return replace(plant, instruments=plant.instruments._replace(observer_bandwidth=bandwidth))


def load_bench(path: str | Path | None = None, *, analysis: bool = False) -> Bench:
    """Read a bench file with all its tables; without a path, the shipped one.

    Args:
        path: the file.
        analysis: True where logs are evaluated and nothing is driven, designed or trained: takes ``[machine]`` too.

    Raises:
        BenchFileError: see :func:`emb_runtime.config.bench.load_bench`; or a table of the analysis is wrong.
    """
    return parse_bench(*read_bench_text(path), analysis=analysis)


def parse_bench(text: str, source: str, *, analysis: bool = False) -> Bench:
    """Turn the text of a bench file into checked records; ``source`` and ``analysis`` as for :func:`load_bench`."""
    if not analysis:
        return with_tables(driven.parse_bench(text, source), source)
    document = parse_toml(text, source, BenchFileError)
    is_machine = "machine" in document
    if is_machine:
        document = _never_driven(document, source)
    return with_tables(checked_bench(document, text, source, driven=not is_machine), source)


def with_tables(bench: driven.Bench, source: str) -> Bench:
    """A bench of the runtime with the tables that only simulation and analysis read; one that has them, as it is.

    Raises:
        BenchFileError: one of them is wrong; the message begins with ``source``.
    """
    if isinstance(bench, Bench):
        return bench
    tables = read(_Tables, dict(bench.tables), source, BenchFileError, remedy=REMEDY)
    plants = dict(BUILT_IN)
    plants |= {name: read_plant(name, table, source) for name, table in tables.plants.items()}
    common = {f.name: getattr(bench, f.name) for f in fields(driven.Bench)}
    return Bench(**common, budgets=tables.budgets, plants=plants, machine=tables.machine)


def _never_driven(document: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The document of a machine with what only a driven brake needs as it is in the shipped file.

    The ranges, in which searches begin, are the nominal parameters over and times ``AROUND``.
    """
    for key in DRIVEN:
        if key in document:
            raise BenchFileError(f"{source}: {key}: does not go with [machine], with which nothing is driven")
    shipped = parse_toml(driven.shipped_bench_text(), "shipped bench.toml", BenchFileError)
    nominal = document.get("brake")
    around = {}
    for parameter in PARAMETER_NAMES:
        value = nominal.get(parameter) if isinstance(nominal, dict) else None
        if isinstance(value, int | float) and value > 0.0:
            around[parameter] = [value / AROUND, value * AROUND]
    ranges = {shipped["shield"]["ranges"]: around}
    return {**document, **{key: shipped[key] for key in DRIVEN}, "ranges": ranges}
