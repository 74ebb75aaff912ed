"""Conditions of a run that a node may send in ``EMB_Conditions``: nothing acts on them."""

from __future__ import annotations

from typing import NamedTuple


class Condition(NamedTuple):
    """One of them."""

    signal: str  # In emb.dbc
    unit: str
    label: str


CONDITIONS = {
    "temperature": Condition("Temperature", "°C", "temperature"),
    "supply_voltage": Condition("SupplyVoltage", "V", "supply voltage"),
}
"""By their names in options, logs and columns."""
