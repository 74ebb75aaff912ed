"""Many boxes of numbers at once: intervals with outward rounding, over numpy arrays.

Every operation on floats is rounded to nearest, so the true result lies within the neighbours of what comes out; the
functions of ``math`` are good to two units in the last place. What an interval contains, it contains for sure.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from proof.symbolic_execution import Path, lift

Floats: TypeAlias = NDArray[np.float64]
Marks: TypeAlias = NDArray[np.bool_]

ULPS = 2  # Error of numpy's root and logarithm, in neighbouring floats


class Boxes(Path):
    """A path of many boxes at once; those that cannot take it are no longer among the living.

    Args:
        decisions: see :class:`Path`.
        count: of boxes.
    """

    def __init__(self, decisions: tuple[bool, ...], count: int) -> None:
        super().__init__(decisions)
        self.living: Marks = np.ones(count, dtype=np.bool_)

    def decide(self, can_hold: Marks, can_fail: Marks) -> bool:
        """Go where a box can go; the others die."""
        can_hold, can_fail = self.living & can_hold, self.living & can_fail
        holds = self.choose(bool(can_hold.any()), bool(can_fail.any()))
        self.living = can_hold if holds else can_fail
        return holds

    def constant(self, value: float) -> Interval:
        """Returns the same number for every box."""
        return Interval(self, np.full(1, value), np.full(1, value))

    def lift(self, fn: Callable[..., Any], **scope: Any) -> Callable[..., Any]:
        """One of our functions on intervals, with names in it replaced."""
        maths = SimpleNamespace(sqrt=_sqrt, log1p=_log1p, isfinite=lambda _: True, inf=math.inf)
        return lift(fn, {"math": maths, "max": greater, "min": smaller, **scope})


class Interval:
    """Numbers between two bounds, one pair per box."""

    __slots__ = ("boxes", "high", "low")
    __hash__ = None  # type: ignore[assignment]

    def __init__(self, boxes: Boxes, low: Floats, high: Floats) -> None:
        self.boxes = boxes
        self.low = low
        self.high = high

    def _of(self, value: Any) -> Interval:
        if isinstance(value, Interval):
            return value
        return self.boxes.constant(float(value))

    def __add__(self, other: Any) -> Interval:
        o = self._of(other)
        return _outward(self.boxes, self.low + o.low, self.high + o.high)

    __radd__ = __add__

    def __neg__(self) -> Interval:
        return Interval(self.boxes, -self.high, -self.low)

    def __sub__(self, other: Any) -> Interval:
        return self + (-self._of(other))

    def __rsub__(self, other: Any) -> Interval:
        found: Interval = self._of(other) - self
        return found

    def __mul__(self, other: Any) -> Interval:
        if isinstance(other, Interval) and other is self:
            return self._squared()
        o = self._of(other)
        return _hull(self.boxes, self.low * o.low, self.low * o.high, self.high * o.low, self.high * o.high)

    __rmul__ = __mul__

    def _squared(self) -> Interval:
        a, b = self.low * self.low, self.high * self.high
        least = np.where((self.low <= 0.0) & (self.high >= 0.0), 0.0, np.minimum(a, b))
        found = _outward(self.boxes, least, np.maximum(a, b))
        return Interval(self.boxes, np.maximum(found.low, 0.0), found.high)

    def __truediv__(self, other: Any) -> Interval:
        o = self._of(other)
        if np.any((o.low <= 0.0) & (o.high >= 0.0)):
            raise ArithmeticError("a division by an interval that contains zero")
        return _hull(self.boxes, self.low / o.low, self.low / o.high, self.high / o.low, self.high / o.high)

    def __rtruediv__(self, other: Any) -> Interval:
        over: Interval = self._of(other) / self
        return over

    def __abs__(self) -> Any:
        return greater(self, -self)

    def __le__(self, other: Any) -> bool:
        o = self._of(other)
        return self._narrowed(o, self.boxes.decide(self.low <= o.high, self.high > o.low))

    def __lt__(self, other: Any) -> bool:
        o = self._of(other)
        return self._narrowed(o, self.boxes.decide(self.low < o.high, self.high >= o.low))

    def __ge__(self, other: Any) -> bool:
        return not self < other

    def __gt__(self, other: Any) -> bool:
        return not self <= other

    def _narrowed(self, other: Interval, below: bool) -> bool:
        """On this path the order is known, so what cannot be of the living is cut off."""
        if below:
            self.high = np.where(self.boxes.living, np.minimum(self.high, other.high), self.high)
        else:
            self.low = np.where(self.boxes.living, np.maximum(self.low, other.low), self.low)
        return below


def _outward(boxes: Boxes, low: Floats, high: Floats, ulps: int = 1) -> Interval:
    for _ in range(ulps):
        low, high = np.nextafter(low, -np.inf), np.nextafter(high, np.inf)
    return Interval(boxes, low, high)


def _hull(boxes: Boxes, *ends: Floats) -> Interval:
    low, high = ends[0], ends[0]
    for end in ends[1:]:
        low, high = np.minimum(low, end), np.maximum(high, end)
    return _outward(boxes, low, high)


def greater(first: Any, second: Any) -> Any:
    """``max``."""
    if not isinstance(first, Interval) and not isinstance(second, Interval):
        return max(first, second)
    a, b = _pair(first, second)
    return Interval(a.boxes, np.maximum(a.low, b.low), np.maximum(a.high, b.high))


def smaller(first: Any, second: Any) -> Any:
    """``min``."""
    if not isinstance(first, Interval) and not isinstance(second, Interval):
        return min(first, second)
    a, b = _pair(first, second)
    return Interval(a.boxes, np.minimum(a.low, b.low), np.minimum(a.high, b.high))


def _pair(first: Any, second: Any) -> tuple[Interval, Interval]:
    if isinstance(first, Interval):
        return first, first._of(second)
    return second._of(first), second


def _sqrt(value: Any) -> Any:
    """Of what is left above zero: below it, the path is one that no number takes."""
    if not isinstance(value, Interval):
        return math.sqrt(value)
    found = _outward(value.boxes, np.sqrt(np.maximum(value.low, 0.0)), np.sqrt(np.maximum(value.high, 0.0)), ULPS)
    return Interval(value.boxes, np.maximum(found.low, 0.0), found.high)


def _log1p(value: Any) -> Any:
    if not isinstance(value, Interval):
        return math.log1p(value)
    return _outward(value.boxes, np.log1p(value.low), np.log1p(value.high), ULPS)
