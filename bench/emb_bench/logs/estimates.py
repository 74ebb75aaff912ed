"""The running estimate of an experiment, by step."""

from __future__ import annotations

from typing import Any

from emb_bench.logs.log import RunLog
from emb_runtime.estimator.estimate import LOST, by_name
from emb_runtime.log.topics import message_class

_STEP, *_ESTIMATE = message_class("Estimate").DESCRIPTOR.fields_by_name


def by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All estimates by their step, see :attr:`emb_runtime.estimator.estimator.Estimator.estimate`."""
    return {step: tuple(numbers) for step, *numbers in log.rows("/estimate", _STEP, *_ESTIMATE)}


def last_estimate(log: RunLog) -> dict[str, dict[str, Any]]:
    """The estimate at the end: value, standard deviation and unit by name; empty if there was none."""
    return {} if any(event.code == LOST for event in log.events) else by_name(log.last("/estimate", *_ESTIMATE))
