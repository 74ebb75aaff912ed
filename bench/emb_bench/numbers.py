"""Numbers for people beside those of :mod:`emb_runtime.numbers`, and a number with its interval."""

from __future__ import annotations

import math
from typing import NamedTuple

from emb_runtime.numbers import LARGE, NOTHING, SMALL, around, between, in_percent, places, plain, typeset

LOPSIDED = 1.2  # Longer side of an interval over half its width from which on both ends are written
LEVEL = 0.95  # Probability that an interval holds the number


class Score(NamedTuple):
    """A number and its 95 % interval; NaN where there is none."""

    value: float
    low: float
    high: float


def relative(half: float, size: float) -> str:
    """Half an interval: in percent of a size, or as it is where the size is 0; a dash where it is open."""
    if not math.isfinite(half):
        return NOTHING
    return in_percent(half / abs(size)) if size else plain(half, 2)


def amount(value: float, interval: tuple[float, float], unit: str) -> str:
    """A value, its unit (none where it is 1) and its interval, to the digits that the interval allows."""
    low, high = interval
    if math.isinf(low) and math.isinf(high):
        return "any value"
    unit = "" if unit == "1" else unit
    shown = f"{plain(value, 4)} {unit}".rstrip()
    if math.isinf(low):
        return f"{shown} (below {plain(high, 4)})"
    if math.isinf(high):
        return f"{shown} (above {plain(low, 4)})"
    half = 0.5 * (high - low)
    if half > 0.0 and max(high - value, value - low) > LOPSIDED * half:
        return f"{shown} ({between(low, high)})"
    return f"{around(value, half)} {unit}".rstrip()


def signed(value: float, form: str = "+.3g") -> str:
    """A number with its sign; one that rounds to zero has none."""
    if not math.isfinite(value):
        return plain(value)
    text = f"{value:{form}}"
    return text.lstrip("+-") if float(text) == 0.0 else typeset(text)


def percent(share: float) -> str:
    """A share, in whole percent where that is precise enough."""
    amount = 100.0 * share
    if amount == 0.0:
        return "0 %"
    if amount < 0.1:
        return "< 0.1 %"
    return f"{amount:.1f} %" if amount < 10.0 or 99.0 < amount < 100.0 else f"{amount:.0f} %"


def share(value: float, digits: int = 2) -> str:
    """A share of a whole, in ppm below a tenth of a percent, else in percent."""
    factor, name = (1e6, "ppm") if 0.0 < abs(value) < SMALL else (100.0, "%")
    whole = 10.0**digits <= abs(factor * value) < LARGE
    shown = typeset(f"{factor * value:.0f}") if whole else plain(factor * value, digits)
    return f"{shown} {name}"


def share_between(low: float, high: float) -> str:
    """An interval of a share, both ends with their signs, in one unit."""
    factor, name = (1e6, "ppm") if max(abs(low), abs(high)) < SMALL else (100.0, "%")
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{plain(factor * low)} to {plain(factor * high)} {name}"
    width = factor * (high - low)
    form = f"+.{places(width) if width > 0.0 else 3}f"
    return f"{signed(factor * low, form)} to {signed(factor * high, form)} {name}"


def chance(p_value: float) -> str:
    """A p value."""
    return "< 10⁻⁶" if p_value < 1e-6 else plain(p_value, 2)


def p_value(value: float) -> str:
    """A p value behind its letter."""
    return "p < 1e-6" if value < 1e-6 else f"p = {value:.2g}"


def seconds(value: float) -> str:
    """A time in the unit that suits it."""
    if not math.isfinite(value):
        return NOTHING
    for factor, name in ((1.0, "s"), (1e3, "ms"), (1e6, "µs")):
        if abs(value) * factor >= 1.0:
            return f"{plain(value * factor)} {name}"
    return f"{plain(value * 1e6)} µs"


def in_samples(count: int) -> str:
    """A time in words."""
    return "1 sample" if count == 1 else f"{count} samples"
