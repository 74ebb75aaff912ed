"""An estimate as plain data by name, and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

LOST = "ESTIMATE_LOST"  # Code of the event after which a run has no estimate: it was not finite
NORMAL_95 = 1.959963984540054  # Standard deviations that 95 % of a Gaussian lie within


class Quantity(NamedTuple):
    """A signal with its unit."""

    name: str
    unit: str


def by_name(quantities: Sequence[Quantity], numbers: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Value, standard deviation, 95 % interval and unit of each quantity, by values that their deviations follow."""
    if not numbers:
        return {}
    count = len(quantities)
    both = zip(quantities, numbers[:count], numbers[count:], strict=True)
    return {
        q.name: {
            "value": value,
            "deviation": deviation,
            "interval_95": [value - NORMAL_95 * deviation, value + NORMAL_95 * deviation],
            "unit": q.unit,
        }
        for q, value, deviation in both
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
