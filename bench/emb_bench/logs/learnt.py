"""Sets that the shield learnt while it ran: the topic ``/learnt`` of a log."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.logs.log import RunLog
from emb_runtime.log.mcap_schema import LEARNT

_STEP, *_NUMBERS = (field.name for field in LEARNT.fields)


def by_step(log: RunLog) -> dict[int, tuple[float, ...]]:
    """All sets by their step: the numbers of :func:`emb_runtime.learning.known.numbers`; empty if nothing was learnt.

    Raises:
        LogError: the topic has other fields, or a message cannot be decoded.
    """
    return {step: tuple(numbers) for step, *numbers in log.rows(LEARNT.name, _STEP, *_NUMBERS)}


def history(log: RunLog) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Steps, shape [n], and the numbers at each, shape [n, 13]; nothing if nothing was learnt.

    Raises:
        LogError: see :func:`by_step`.
    """
    found = by_step(log)
    return np.array([*found], np.int64), np.array([*found.values()]).reshape(len(found), len(_NUMBERS))


def last_ranges(numbers: NDArray[np.float64]) -> dict[str, list[float]]:
    """The last set, by parameter: its least and greatest value, relative to the nominal brake; empty if there is none.

    Args:
        numbers: of a :func:`history`.
    """
    names = [name.removesuffix("_low") for name in _NUMBERS[:8:2]]
    return {name: last[2 * i : 2 * i + 2] for last in numbers[-1:].tolist() for i, name in enumerate(names)}


def document(log: RunLog) -> dict[str, Any]:
    """The :func:`last_ranges` of a log.

    Raises:
        LogError: see :func:`by_step`.
    """
    last = deque(log.rows(LEARNT.name, *_NUMBERS), maxlen=1)
    return last_ranges(np.array(last).reshape(-1, len(_NUMBERS)))
