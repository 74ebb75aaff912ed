"""Laws of the shield by the names of their numbers, in whatever group these are."""

from __future__ import annotations

from typing import Any

from emb_runtime.safety.shield_design import Box, Delay, Hidden, ShieldLaw, WayHome, hidden_by

GROUPS = (Box, Delay, WayHome)


def numbers(law: ShieldLaw) -> dict[str, float]:
    """All numbers of a law, in their order, without those that follow from the observer's bandwidth."""
    found: dict[str, Any] = {}
    for name, value in law._asdict().items():
        found |= value._asdict() if isinstance(value, GROUPS) else {name: value}
    return {name: value for name, value in found.items() if not isinstance(value, Hidden)}


def with_numbers(law: ShieldLaw, **changed: Any) -> ShieldLaw:
    """A law with some of its numbers changed."""
    if "observer" in changed:
        changed["hidden"] = hidden_by(changed["observer"])
    for name, value in law._asdict().items():
        if isinstance(value, GROUPS):
            inside = {field: changed.pop(field) for field in value._fields if field in changed}
            changed[name] = value._replace(**inside)
    return law._replace(**changed)
