"""Topics of an experiment by step: its running estimate, and the sets that its shield learnt."""

from __future__ import annotations

from typing import Any

from emb_bench.logs.log import RunLog
from emb_runtime.errors import LogError
from emb_runtime.estimator.estimate import LOST, Quantity, by_name
from emb_runtime.log.mcap_schema import ESTIMATE, LEARNT, deviation_of, estimate_topic


def quantities(log: RunLog) -> tuple[Quantity, ...]:
    """Names and units of the estimated quantities; empty if there are none."""
    if ESTIMATE not in log.topics:
        return ()
    found = log.describe(ESTIMATE)[2:]  # behind the two times
    estimated = tuple(Quantity(column.name, column.unit) for column in found[1::2])
    kinds = {"int64": "int64", "double": "float64"}
    wanted = [(field.name, kinds[field.type]) for field in estimate_topic(estimated).fields]
    if [(column.name, column.kind) for column in found] != wanted:
        given = ", ".join(f"{column.name} ({column.kind})" for column in found)
        raise LogError(f"{log.path}: {ESTIMATE}: expected a step, and values with a deviation behind each, got {given}")
    return estimated


def by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All estimates by their step: values, then standard deviations, in the order of :func:`quantities`."""
    return {step: tuple(numbers) for step, *numbers in log.rows(ESTIMATE, "step", *_columns(log))}


def last_estimate(log: RunLog) -> dict[str, dict[str, Any]]:
    """The estimate at the end: value, standard deviation and unit by name; empty if there was none."""
    if any(event.code == LOST for event in log.events):
        return {}
    return by_name(quantities(log), log.last(ESTIMATE, *_columns(log)))


def _columns(log: RunLog) -> list[str]:
    names = [quantity.name for quantity in quantities(log)]
    return [*names, *map(deviation_of, names)]


_STEP, *_LEARNT = (field.name for field in LEARNT.fields)


def learnt_by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All learnt sets by their step: the numbers of :func:`emb_runtime.learning.known.numbers`."""
    return {step: tuple(numbers) for step, *numbers in log.rows(LEARNT.name, _STEP, *_LEARNT)}


def last_learnt(log: RunLog) -> dict[str, list[float]]:
    """The last learnt set, by parameter: its least and greatest value, relative to nominal; empty if there is none."""
    names = [name.removesuffix("_low") for name in _LEARNT[:8:2]]
    numbers = log.last(LEARNT.name, *_LEARNT)
    return {name: [*numbers[2 * i : 2 * i + 2]] for i, name in enumerate(names) if numbers}
