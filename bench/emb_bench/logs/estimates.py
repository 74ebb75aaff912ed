"""The running estimate of an experiment, by step."""

from __future__ import annotations

from typing import Any

from emb_bench.logs.log import RunLog, once
from emb_runtime.config.bench import Systematic
from emb_runtime.errors import LogError
from emb_runtime.estimator.estimate import LOST, UNKNOWN, by_name
from emb_runtime.log.topics import message_class

_STEP, *_ESTIMATE = message_class("Estimate").DESCRIPTOR.fields_by_name


def by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All estimates by their step, see :attr:`emb_runtime.estimator.estimator.Estimator.estimate`."""
    return {step: tuple(numbers) for step, *numbers in log.rows("/estimate", _STEP, *_ESTIMATE)}


@once
def last_estimate(log: RunLog) -> dict[str, dict[str, Any]]:
    """The estimate at the end by name, see :func:`emb_runtime.estimator.estimate.by_name`; empty if there was none."""
    lost = any(event.code == LOST for event in log.events)
    return {} if lost else by_name(log.last("/estimate", *_ESTIMATE), known_errors(log))


def known_errors(log: RunLog) -> Systematic:
    """Systematic errors by the bench file in a log; UNKNOWN where it has none that is readable."""
    try:
        return log.bench.systematic
    except LogError:
        return UNKNOWN
