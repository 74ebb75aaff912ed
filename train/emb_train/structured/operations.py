"""Choices without a branch, so that one function runs on numbers and on columns of torch numbers.

As plain Python such a function is what the tests look at, compiled it is what the batch runs, and
:func:`emb_train.structured.columns.on_columns` gives the same code for torch, which is what is exported.
"""

from __future__ import annotations


def where(condition: bool, a: float, b: float) -> float:
    """``a`` where the condition holds, else ``b``; both are computed before."""
    return a if condition else b


def ratio(a: float, b: float) -> float:
    """a/b for a choice by :func:`where`: no error where b is 0 and another value is chosen."""
    return a / b if b != 0.0 else 0.0
