"""Reproduced tables and figures: statements with a verdict, numbers, a picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

CLOSE = 0.2  # Relative tolerance: a printed number agrees if the mean of our seeds is this close to it


@dataclass(frozen=True)
class Statement:
    """One thing that the thesis prints, and what came out here."""

    printed: str  # Statement of the thesis, in our words
    found: str  # Result here
    agrees: bool  # True if the numbers agree with the statement
    numbers: Mapping[str, float]  # Numbers behind the verdict

    def sentence(self, counts: bool) -> str:
        """In words, with the verdict if it counts."""
        verdict = "Agrees" if self.agrees else "Does not agree"
        return f"{verdict if counts else 'Thesis'}: {self.printed}. Here: {self.found}."

    def document(self, counts: bool) -> dict[str, Any]:
        """Returns the JSON document, with the verdict if it counts."""
        numbers = {k: v if math.isfinite(v) else None for k, v in self.numbers.items()}  # JSON has no others
        agrees = self.agrees if counts else None
        return {"printed": self.printed, "found": self.found, "agrees": agrees, "numbers": numbers}


@dataclass(frozen=True)
class Result:
    """A reproduced table or figure."""

    target: str  # Its name on the command line: ``fig-5.2``
    title: str  # Title of the figure or table
    statements: Sequence[Statement]  # Statements of the thesis about it
    columns: Sequence[str] = ()  # Column heads of a table; empty for a figure
    rows: Sequence[Sequence[str]] = field(default=())  # Rows of a table; empty for a figure
    note: str = ""  # Reason that no verdict counts; empty if they do


def number(printed: float, ours: Sequence[float], what: str) -> Statement:
    """A printed number beside ours, one for each seed."""
    values = np.array(ours, np.float64)
    mean = float(values.mean())
    agrees = abs(mean - printed) <= CLOSE * abs(printed)
    numbers = {"printed": printed, "mean": mean, "least": float(values.min()), "most": float(values.max())}
    return Statement(f"{what} {printed:.3g}", spread(values.tolist()), agrees, numbers)


def spread(ours: Sequence[float]) -> str:
    """One number, or the mean and the range of several."""
    values = np.array(ours, np.float64)
    if len(values) == 1:
        return f"{values[0]:.3g}"
    return f"{values.mean():.3g} ({len(values)} seeds: {values.min():.3g} to {values.max():.3g})"
