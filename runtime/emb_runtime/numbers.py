"""Numbers for people: the one format of values, their uncertainties and shares, in every command and on every page."""

from __future__ import annotations

import math

SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
NOTHING = "–"
SMALL, LARGE = 1e-3, 1e5  # Values from one to the other are written without a power of ten
TINY = 1e-300  # Half of an interval below which none is written
PLACES = 7  # Decimal places up to which a value below 1 is written without a power of ten


def plain(value: float, digits: int = 3) -> str:
    """A number with some significant digits, powers of ten written out; a dash for NaN.

    ``2.16e-05`` is ``2.16 × 10⁻⁵``.
    """
    if math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    return typeset(f"{value:.{digits}g}")


def typeset(text: str) -> str:
    """A formatted number with minus sign and power of ten as in print."""
    mantissa, _, exponent = text.replace("-", "−").partition("e")
    return f"{mantissa} × 10{str(int(exponent.replace('−', '-'))).translate(SUPERSCRIPT)}" if exponent else mantissa


def in_percent(share: float, digits: int = 2) -> str:
    """A share in percent, with some significant digits; in whole percent where these are fewer."""
    amount = 100.0 * share
    whole = 10.0**digits - 0.5 <= abs(amount) < LARGE
    return f"{typeset(f'{amount:.0f}') if whole else plain(amount, digits)} %"


def around(value: float, half: float) -> str:
    """A value and half its interval, both to two digits of that half, in one power of ten.

    ``(2.1592 ± 0.0061) × 10⁻⁵``; without an interval the value alone.
    """
    if not (math.isfinite(half) and half > TINY and math.isfinite(value)):
        return plain(value, 4)
    return _in_one_power("{} ± {}", (value, half), half)


def between(low: float, high: float) -> str:
    """An interval, to two digits of its width."""
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        return f"{plain(low, 4)} to {plain(high, 4)}"
    return _in_one_power("{} to {}", (low, high), high - low)


def places(width: float) -> int:
    """Decimal places that show two digits of a width."""
    digits = f"{width:.1e}"  # 0.0996 is 0.10
    return max(0, 1 - int(digits.partition("e")[2]))


def _in_one_power(text: str, values: tuple[float, float], width: float) -> str:
    """Values in a text, all to two digits of a width and in one power of ten."""
    largest = max(map(abs, values))
    written_out = SMALL <= largest < LARGE and (largest >= 1.0 or places(width) <= PLACES)
    power = 0 if written_out else math.floor(math.log10(largest))
    digits = places(width / 10.0**power)
    shown = (round(value / 10.0**power, digits) + 0.0 for value in values)  # no minus before a zero
    text = text.format(*(typeset(f"{value:.{digits}f}") for value in shown))
    return text if power == 0 else f"({text}) × 10{str(power).translate(SUPERSCRIPT)}"
