"""Shares of records with their intervals."""

from __future__ import annotations

from scipy import stats


def share(part: int, of: int) -> str:
    """A share with its 95 % interval (Clopper and Pearson 1934)."""
    if of == 0:
        return "none of 0"
    low, high = stats.binomtest(part, of).proportion_ci(method="exact")
    return f"{part} of {of} = {100 * part / of:.1f} % ({100 * low:.1f} to {100 * high:.1f} %)"
