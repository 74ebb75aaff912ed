"""Estimates of an actor as plain data by name, and in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from emb_runtime.policy.contract import Quantity


def by_name(quantities: Sequence[Quantity], numbers: Sequence[float]) -> dict[str, dict[str, Any]]:
    """Value, standard deviation and unit of each quantity.

    Args:
        quantities: what is estimated, in order.
        numbers: values, then standard deviations; none where nothing was estimated.
    """
    if not numbers:
        return {}
    count = len(quantities)
    both = zip(quantities, numbers[:count], numbers[count:], strict=True)
    return {q.name: {"value": value, "deviation": deviation, "unit": q.unit} for q, value, deviation in both}


def words(estimate: Mapping[str, Any]) -> list[str]:
    """Formats estimates for a person, a line for each quantity."""
    lines = []
    for name, said in estimate.items():
        value, deviation = said["value"], said["deviation"]
        part = f" ({100.0 * deviation / abs(value):.2g} %)" if value else ""
        known = f"{name} = {value:.4g} ± {deviation:.2g} {said['unit']}{part}"
        lines.append(f"{known}, by the actor itself, if the brake is as its model says; ± is one sigma")
    return lines
