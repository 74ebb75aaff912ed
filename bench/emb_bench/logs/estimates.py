"""The running estimate of an experiment: the topic ``/estimate`` of a log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from emb_bench.logs.log import RunLog, Table
from emb_runtime.errors import LogError
from emb_runtime.estimator.estimate import Quantity, by_name
from emb_runtime.log.mcap_schema import ESTIMATE, deviation_of, estimate_topic

_STEP = "step"


def quantities(log: RunLog) -> tuple[Quantity, ...]:
    """Names and units of the estimated quantities; empty if there are none.

    Raises:
        LogError: the topic has other fields than a step, values, and a deviation for each.
    """
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
    """All estimates by their step: values, then standard deviations, in the order of :func:`quantities`.

    Raises:
        LogError: see :func:`quantities`; or a message cannot be decoded.
    """
    return {step: numbers for part, names in _parts(log) for step, numbers in _rows(part, names)}


def last_estimate(log: RunLog) -> dict[str, dict[str, Any]]:
    """The last estimate: value, standard deviation and unit by name; empty if there was none.

    Raises:
        LogError: see :func:`by_step`.
    """
    numbers: tuple[float, ...] = ()
    for part, names in _parts(log):
        for _, row in [*_rows(part, names)][-1:]:
            numbers = row
    return by_name(quantities(log), numbers)


def _parts(log: RunLog) -> Iterator[tuple[Table, list[str]]]:
    """The topic's messages, some at a time, and the names of its numbers."""
    names = [quantity.name for quantity in quantities(log)]
    names += [deviation_of(name) for name in names]
    if names:
        for part in log.batches({ESTIMATE: [_STEP, *names]}):
            yield part[ESTIMATE], names


def _rows(part: Mapping[str, Any], names: list[str]) -> Iterator[tuple[int, tuple[float, ...]]]:
    rows = zip(*(part[name].tolist() for name in names), strict=True)
    return zip(part[_STEP].tolist(), rows, strict=True)
