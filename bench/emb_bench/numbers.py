"""Numbers for people: formatting, and a number with its interval."""

from __future__ import annotations

import math
from typing import NamedTuple

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NOTHING = "–"
SMALL, LARGE = 1e-3, 1e5  # Values from one to the other are written without a power of ten
LOPSIDED = 1.2  # Longer side of an interval over half its width from which on both ends are written
LEVEL = 0.95  # Probability that an interval holds the number


class Score(NamedTuple):
    """A number and its 95 % interval; NaN where there is none."""

    value: float
    low: float
    high: float


def plain(value: float, digits: int = 3) -> str:
    """A number with some significant digits, powers of ten written out; a dash for NaN.

    ``2.16e-05`` is ``2.16 × 10⁻⁵``.
    """
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    mantissa, _, exponent = f"{value:.{digits}g}".partition("e")
    mantissa = mantissa.replace("-", "−")
    return f"{mantissa} × 10{str(int(exponent)).translate(SUPERSCRIPT)}" if exponent else mantissa


def spread(deviation: float, relative: bool, digits: int = 3) -> str:
    """A standard deviation: in percent if it is relative, above 100 % in whole ones."""
    if not math.isfinite(deviation):
        return "not identified"
    if not relative:
        return plain(deviation, digits)
    share = 100.0 * deviation
    return f"{share:.0f} %" if 100.0 <= share < 1e5 else f"{plain(share, digits)} %"


def around(value: float, half: float) -> str:
    """A value and half its interval, both to two digits of that half, in one power of ten.

    ``(2.1592 ± 0.0061) × 10⁻⁵``; without an interval the value alone.
    """
    if not (math.isfinite(half) and half > 0.0 and math.isfinite(value)):
        return plain(value, 4)
    return _in_one_power("{} ± {}", (value, half), half)


def between(low: float, high: float) -> str:
    """An interval, to two digits of its width."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{plain(low, 4)} to {plain(high, 4)}"
    if high <= low:
        return f"{plain(low, 4)} to {plain(high, 4)}"
    return _in_one_power("{} to {}", (low, high), high - low)


def _in_one_power(text: str, values: tuple[float, float], width: float) -> str:
    """Values in a text, all to two digits of a width and in one power of ten."""
    largest = max(map(abs, values))
    power = 0 if SMALL <= largest < LARGE else math.floor(math.log10(largest))
    places = _places(width / 10.0**power)
    shown = (round(value / 10.0**power, places) + 0.0 for value in values)  # no minus before a zero
    text = text.format(*(f"{value:.{places}f}" for value in shown)).replace("-", "−")
    return text if power == 0 else f"({text}) × 10{str(power).translate(SUPERSCRIPT)}"


def _places(width: float) -> int:
    """Decimal places that show two digits of a width."""
    return max(0, 1 - math.floor(math.log10(width)))


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
    return text.lstrip("+-") if float(text) == 0.0 else text.replace("-", "−")


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
    shown = f"{factor * value:.0f}".replace("-", "−") if whole else plain(factor * value, digits)
    return f"{shown} {name}"


def share_between(low: float, high: float) -> str:
    """An interval of a share, both ends with their signs, in one unit."""
    factor, name = (1e6, "ppm") if max(abs(low), abs(high)) < SMALL else (100.0, "%")
    if not (math.isfinite(low) and math.isfinite(high)):
        return f"{plain(factor * low)} to {plain(factor * high)} {name}"
    width = factor * (high - low)
    places = _places(width) if width > 0.0 else 3
    return f"{signed(factor * low, f'+.{places}f')} to {signed(factor * high, f'+.{places}f')} {name}"


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
