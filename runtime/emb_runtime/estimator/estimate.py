"""An estimate as plain data by name, and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from emb_runtime.config.bench import PARAMETER_NAMES

LOST = "ESTIMATE_LOST"  # Code of the event after which a run has no estimate: it was not finite
NORMAL_95 = 1.959963984540054  # Standard deviations that 95 % of a Gaussian lie within
UNITS = {"k_m": "N·m/A", "k_1": "N/rad", "T_c": "N·m", "f_v": "N·m·s/rad"}  # Of the parameters


def by_name(numbers: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Value, standard deviation, 95 % interval and unit of each parameter that is estimated.

    The ``numbers`` are those of :attr:`emb_runtime.estimator.estimator.Estimator.estimate`.
    """
    return {
        name: {
            "value": value,
            "deviation": deviation,
            "interval_95": [value - NORMAL_95 * deviation, value + NORMAL_95 * deviation],
            "unit": UNITS[name],
        }
        for name, value, deviation in zip(PARAMETER_NAMES, numbers, numbers[len(PARAMETER_NAMES) :], strict=False)
        if deviation > 0.0
    }


def words(estimate: Mapping[str, Any]) -> list[str]:
    """Formats estimates for a person, a line for each quantity, with half its 95 % interval."""
    lines = []
    for name, said in estimate.items():
        value, half = said["value"], NORMAL_95 * said["deviation"]
        part = f"   {100.0 * half / abs(value):.2g} %" if value else ""
        lines.append(
            f"{name} = {_with_zeros(value, _digits(value, half))} ± {_with_zeros(half, 2)} {said['unit']}{part}"
        )
    return lines


def _digits(value: float, half: float) -> int:
    """Significant digits of a value as far as the second of half its interval; 12 at most."""
    if value == 0.0 or half == 0.0 or not math.isfinite(value) or not math.isfinite(half):
        return 4
    return min(max(math.floor(math.log10(abs(value))) - math.floor(math.log10(half)) + 2, 2), 12)


def _with_zeros(value: float, digits: int) -> str:
    """A number with so many significant digits, also where the last ones are zeros."""
    return f"{value:#.{digits}g}".rstrip(".")
