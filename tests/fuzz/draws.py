"""Where a fuzzed sequence gets its choices from: a seeded generator, or bytes that a coverage-guided fuzzer makes."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Protocol, TypeVar

T = TypeVar("T")


class Draw(Protocol):
    """Makes choices."""

    def integer(self, low: int, high: int) -> int:
        """One of low..high."""
        ...

    def blob(self, length: int) -> bytes:
        """So many bytes."""
        ...

    @property
    def spent(self) -> bool:
        """Nothing is left to choose with: every further choice is the least one."""
        ...


class RandomDraw:
    """Choices of a generator that is seeded by what names the sequence."""

    spent = False

    def __init__(self, *name: object) -> None:
        self._random = random.Random(":".join(map(str, name)))

    def integer(self, low: int, high: int) -> int:
        """One of low..high, all equally likely."""
        return low + int(self._random.random() * (high - low + 1))

    def blob(self, length: int) -> bytes:
        """So many bytes."""
        return self._random.randbytes(length)


class ByteDraw:
    """Choices read from bytes, the first ones first; zeros when they are used up."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def spent(self) -> bool:
        """All bytes are read."""
        return self._at >= len(self._data)

    def integer(self, low: int, high: int) -> int:
        """One of low..high, of as few bytes as can tell them apart."""
        span = high - low + 1
        return low + int.from_bytes(self.blob(((span - 1).bit_length() + 7) // 8), "little") % span

    def blob(self, length: int) -> bytes:
        """So many bytes."""
        part = self._data[self._at : self._at + length]
        self._at += length
        return part.ljust(length, b"\0")


def pick(draw: Draw, options: Sequence[T]) -> T:
    """One of the options."""
    return options[draw.integer(0, len(options) - 1)]


def chance(draw: Draw, percent: int) -> bool:
    """True so often; never once nothing is left to choose with."""
    return draw.integer(0, 99) >= 100 - percent
