"""One function for numbers and for columns of torch numbers, with torch's operations in place of Python's.

A function that makes its choices by :func:`where`, without a branch, runs as plain Python, compiled for the batch, and
by :func:`on_columns` on torch, which is what is exported.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from types import FunctionType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from emb_bench.brake.euler import sign


def where(condition: bool, a: float, b: float) -> float:
    """``a`` where the condition holds, else ``b``; both are computed before."""
    return a if condition else b


def ratio(a: float, b: float) -> float:
    """a/b for a choice by :func:`where`: no error where b is 0 and another value is chosen."""
    return a / b if b != 0.0 else 0.0


def _where(condition: Tensor, a: Tensor | float, b: Tensor | float) -> Tensor:
    if not isinstance(a, Tensor) and not isinstance(b, Tensor):
        return torch.where(condition, a, b).double()
    return torch.where(condition, a, b)


def _larger(a: Tensor, b: Tensor | float) -> Tensor:
    return torch.maximum(a, b) if isinstance(b, Tensor) else torch.relu(a)  # the only number is 0


def _ratio(a: Tensor, b: Tensor) -> Tensor:
    return a / b


_OURS: dict[Any, Callable[..., Tensor]] = {where: _where, ratio: _ratio, sign: torch.sign}
_PYTHONS = {
    "min": torch.minimum,
    "max": _larger,
    "math": SimpleNamespace(tanh=torch.tanh, exp=torch.exp, sqrt=torch.sqrt),
}


@cache
def on_columns(fn: Callable[..., Any]) -> Callable[..., Any]:
    """A function of numbers, with all of ours that it calls by name, for columns of shape [N, 1], float64.

    Constants of its module become tensors, because the ONNX exporter rounds a Python number to single precision before
    it multiplies. A number that is written in the code has to be one of single precision, such as 0.5.
    """
    if fn in _OURS:
        return _OURS[fn]
    assert isinstance(fn, FunctionType)
    scope = {**fn.__globals__, **_PYTHONS}
    for name in fn.__code__.co_names:
        value = fn.__globals__.get(name)
        if isinstance(value, float):
            scope[name] = torch.tensor(value, dtype=torch.float64)
        elif isinstance(value, FunctionType):
            scope[name] = on_columns(value)
    return FunctionType(fn.__code__, scope, fn.__name__, fn.__defaults__)
