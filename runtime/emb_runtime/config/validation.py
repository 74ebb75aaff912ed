"""A TOML table read key by key: types, ranges, nothing unknown; every complaint names file, key and reason."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from emb_runtime.errors import BenchFileError

LONGEST_TEXT = 200
SMALLEST = 1e-30
"""No quantity of a brake is smaller, or larger than its inverse; beyond it arithmetic overflows."""


class Table:
    """One TOML table. Every method raises :class:`BenchFileError` for what is missing or not as it says."""

    def __init__(self, source: str, path: str, content: Mapping[str, Any]) -> None:
        self._source = source
        self._path = path
        self._content = content
        self._read: set[str] = set()

    def key(self, name: str) -> str:
        """The full name of a key, for messages."""
        return f"{self._path}.{name}" if self._path else name

    def fail(self, name: str, reason: str) -> BenchFileError:
        """The complaint about a key, to be raised."""
        key = self.key(name)  # it comes from the file, like all else
        return BenchFileError(f"{self._source}: {key if key.isprintable() else ascii(key)}: {reason}")

    def get(self, name: str) -> Any:
        """The value of a key that must be there."""
        self._read.add(name)
        if name not in self._content:
            raise self.fail(name, "missing")
        return self._content[name]

    def names(self) -> list[str]:
        """All keys."""
        return list(self._content)

    def table(self, name: str) -> Table:
        """A table inside this one."""
        value = self.get(name)
        if not isinstance(value, dict):
            raise self.fail(name, f"expected a table, got {value!r}")
        return Table(self._source, self.key(name), value)

    def text(self, name: str, choices: tuple[str, ...] | None = None) -> str:
        """A printable text, one of the choices if there are any."""
        value = self.get(name)
        if not isinstance(value, str) or not value or not value.isprintable() or len(value) > LONGEST_TEXT:
            raise self.fail(name, f"expected a printable text of at most {LONGEST_TEXT} characters, got {value!r}")
        if choices and value not in choices:
            raise self.fail(name, f"expected one of {', '.join(choices)}, got {value!r}")
        return value

    def integer(self, name: str, low: int = 0, high: int | None = None) -> int:
        """A whole number from ``low`` to ``high``."""
        return self._checked_integer(name, self.get(name), low, high)

    def number(self, name: str, check: Callable[[float], bool] = lambda _: True, wanted: str = "a number") -> float:
        """A finite number that passes the check; ``wanted`` says what that is."""
        return self._checked_number(name, self.get(name), check, wanted)

    def number_pair(self, name: str) -> tuple[float, float]:
        """[lower, upper]."""
        low, high = (self._checked_number(name, v, lambda _: True, "numbers") for v in self._pair(name))
        if low > high:
            raise self.fail(name, f"the lower value {low:g} is above the upper {high:g}")
        return low, high

    def integer_pair(self, name: str, high: int) -> tuple[int, int]:
        """[lower, upper], both from 0 to ``high``."""
        first, second = (self._checked_integer(name, v, 0, high) for v in self._pair(name))
        if first > second:
            raise self.fail(name, f"the lower value {first} is above the upper {second}")
        return first, second

    def nothing_else(self, known: Iterable[str] = ()) -> None:
        """Refuse every key that nobody asked for; ``known`` are further ones that could have been there."""
        for name in self._content:
            if name not in self._read:
                raise self.fail(name, f"unknown key; expected some of {', '.join(sorted({*self._read, *known}))}")

    def _pair(self, name: str) -> list[Any]:
        value = self.get(name)
        if not isinstance(value, list) or len(value) != 2:
            raise self.fail(name, f"expected [lower, upper], got {value!r}")
        return value

    def _checked_integer(self, name: str, value: object, low: int, high: int | None) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.fail(name, f"expected a whole number, got {value!r}")
        if value < low or (high is not None and value > high):
            bounds = f"at least {low}" if high is None else f"from {low} to {high}"
            raise self.fail(name, f"expected {bounds}, got {value}")
        return value

    def _checked_number(self, name: str, value: object, check: Callable[[float], bool], wanted: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail(name, f"expected {wanted}, got {value!r}")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.fail(name, "expected a finite number")
        if number and not SMALLEST <= abs(number) <= 1.0 / SMALLEST:
            raise self.fail(name, f"expected 0 or a size from {SMALLEST:g} to {1.0 / SMALLEST:g}, got {number:g}")
        if not check(number):
            raise self.fail(name, f"expected {wanted}, got {number:g}")
        return number
