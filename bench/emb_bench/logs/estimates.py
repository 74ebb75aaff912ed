"""Topics of an experiment by step: its running estimate, and the sets that its shield learnt."""

from __future__ import annotations

from typing import Any

from emb_bench.logs.log import RunLog
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.estimator.estimate import LOST, by_name
from emb_runtime.log.topics import message_class

_STEP, *_ESTIMATE = message_class("Estimate").DESCRIPTOR.fields_by_name
_STEP, *_LEARNT = message_class("Learnt").DESCRIPTOR.fields_by_name


def by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All estimates by their step, see :attr:`emb_runtime.estimator.estimator.Estimator.estimate`."""
    return {step: tuple(numbers) for step, *numbers in log.rows("/estimate", _STEP, *_ESTIMATE)}


def last_estimate(log: RunLog) -> dict[str, dict[str, Any]]:
    """The estimate at the end: value, standard deviation and unit by name; empty if there was none."""
    return {} if any(event.code == LOST for event in log.events) else by_name(log.last("/estimate", *_ESTIMATE))


def learnt_by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All learnt sets by their step: the numbers of :func:`emb_runtime.learning.known.numbers`."""
    return {step: tuple(numbers) for step, *numbers in log.rows("/learnt", _STEP, *_LEARNT)}


def last_learnt(log: RunLog) -> dict[str, list[float]]:
    """The last learnt set, by parameter: its least and greatest value, relative to nominal; empty if there is none."""
    numbers = log.last("/learnt", *_LEARNT)
    return {name: [*numbers[2 * i : 2 * i + 2]] for i, name in enumerate(PARAMETER_NAMES) if numbers}
