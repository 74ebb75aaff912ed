"""A table of a TOML or JSON document, read key by key: types, ranges, nothing unknown.

Every complaint names the document, the key, what was expected and what came, in one line whatever the document says.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from emb_runtime.config.typed import LONGEST_VALUE
from emb_runtime.config.typed import shown as shown
from emb_runtime.errors import EmbError

LONGEST_LIST = 40  # Most texts in a list


@dataclass(frozen=True)
class Rules:
    """Bounds for every value of a document."""

    error: Callable[[str], EmbError]  # Makes the error that is raised from its message
    longest_text: int  # Characters
    smallest: float = 0.0  # Smallest magnitude of a number other than 0; its inverse is the largest
    remedy: str = "add it"  # Advice where a key is missing


class Table:
    """A table of a document. Every method raises the rules' error for what is missing or not as it says.

    Args:
        source: the document's name in messages.
        path: the table's place in it; empty for the document itself.
        content: the table, as the document has it.
        rules: of the document.
    """

    def __init__(self, source: str, path: str, content: object, rules: Rules) -> None:
        self._source = source
        self._path = path
        self._rules = rules
        self._read: set[str] = set()
        if not isinstance(content, Mapping):
            raise self._error(path, f"expected a table, got {shown(content)}")
        self._content = content

    def fail(self, name: str, reason: str) -> EmbError:
        """Returns the error about a key, to be raised."""
        return self._error(f"{self._path}.{name}" if self._path else name, reason)

    def get(self, name: str, wanted: str = "a value") -> Any:
        """Value of a key that must be there; ``wanted`` says what is expected."""
        self._read.add(name)
        if name not in self._content:
            raise self.fail(name, f"missing: expected {wanted}; {self._rules.remedy}")
        return self._content[name]

    def schema(self, wanted: int) -> None:
        """Refuses a document of another version."""
        self.get("schema", f"{wanted}")
        if (found := self.integer("schema")) != wanted:
            raise self.fail("schema", f"expected {wanted}, got {found}")

    def names(self) -> list[str]:
        """All keys."""
        return list(self._content)

    def table(self, name: str) -> Table:
        """A table inside this one."""
        return self._inner(name, self.get(name, "a table"))

    def tables(self, name: str, least: int, most: int) -> list[Table]:
        """A list of tables."""
        return [self._inner(f"{name}[{i}]", v) for i, v in enumerate(self._list(name, least, most))]

    def table_lists(self, name: str, least: int, most: int) -> list[list[Table]]:
        """A list of lists of tables, each of 1 to ``most``."""
        found = []
        for i, inner in enumerate(self._list(name, least, most)):
            place = f"{name}[{i}]"
            entries = self._checked_list(place, inner, 1, most)
            found.append([self._inner(f"{place}[{j}]", v) for j, v in enumerate(entries)])
        return found

    def text(self, name: str, choices: tuple[str, ...] | None = None) -> str:
        """A printable text, one of the choices if there are any."""
        return self._inner_text(name, self.get(name, _one_of(choices) if choices else "a text"), choices)

    def _inner_text(self, name: str, value: object, choices: tuple[str, ...] | None) -> str:
        longest = self._rules.longest_text
        if not isinstance(value, str) or not value or not value.isprintable() or len(value) > longest:
            raise self.fail(name, f"expected a printable text of at most {longest} characters, got {shown(value)}")
        if choices and value not in choices:
            raise self.fail(name, f"expected {_one_of(choices)}, got {shown(value)}")
        return value

    def texts(self, name: str, choices: tuple[str, ...] | None = None) -> tuple[str, ...]:
        """A list of different printable texts, each one of the choices if there are any."""
        values = self._list(name, 0, LONGEST_LIST)
        found = tuple(self._inner_text(f"{name}[{i}]", value, choices) for i, value in enumerate(values))
        if len(set(found)) < len(found):
            raise self.fail(name, f"expected each once, got {shown(values)}")
        return found

    def text_or_number(self, name: str) -> str | int | float:
        """A text, a whole number of any size, or a finite number."""
        if isinstance(value := self.get(name, "a text or a number"), str):
            return self.text(name)
        number = self.number(name)
        return value if isinstance(value, int) else number

    def flag(self, name: str) -> bool:
        """True or false."""
        if not isinstance(value := self.get(name, "true or false"), bool):
            raise self.fail(name, f"expected true or false, got {shown(value)}")
        return value

    def integer(self, name: str, low: int = 0, high: int | None = None) -> int:
        """A whole number from ``low`` to ``high``."""
        return self._checked_integer(name, self.get(name, "a whole number"), low, high)

    def number(self, name: str, check: Callable[[float], bool] = lambda _: True, wanted: str = "a number") -> float:
        """A finite number that passes the check; ``wanted`` says what that is."""
        return self._checked_number(name, self.get(name, wanted), check, wanted)

    def numbers(self, name: str, least: int, most: int) -> tuple[float, ...]:
        """A list of finite numbers."""
        values = self._list(name, least, most)
        return tuple(self._checked_number(f"{name}[{i}]", v, lambda _: True, "a number") for i, v in enumerate(values))

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
        """Refuses every key that was not read; ``known`` are further ones that could have been there."""
        for name in self._content:
            if name not in self._read:
                raise self.fail(name, f"unknown key; expected some of {', '.join(sorted({*self._read, *known}))}")

    def _error(self, key: str, reason: str) -> EmbError:
        place = key if key.isprintable() and len(key) <= LONGEST_VALUE else shown(key)  # it comes from the document
        return self._rules.error(f"{self._source}: {place}: {reason}" if place else f"{self._source}: {reason}")

    def _inner(self, name: str, value: object) -> Table:
        return Table(self._source, f"{self._path}.{name}" if self._path else name, value, self._rules)

    def _list(self, name: str, least: int, most: int) -> list[Any]:
        return self._checked_list(name, self.get(name, f"a list of {least} to {most} entries"), least, most)

    def _checked_list(self, name: str, value: object, least: int, most: int) -> list[Any]:
        if not isinstance(value, list) or not least <= len(value) <= most:
            raise self.fail(name, f"expected a list of {least} to {most} entries, got {shown(value)}")
        return value

    def _pair(self, name: str) -> list[Any]:
        value = self.get(name, "[lower, upper]")
        if not isinstance(value, list) or len(value) != 2:
            raise self.fail(name, f"expected [lower, upper], got {shown(value)}")
        return value

    def _checked_integer(self, name: str, value: object, low: int, high: int | None) -> int:
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.fail(name, f"expected a whole number, got {shown(value)}")
        if value < low or (high is not None and value > high):
            bounds = f"at least {low}" if high is None else f"from {low} to {high}"
            raise self.fail(name, f"expected {bounds}, got {shown(value)}")
        return value

    def _checked_number(self, name: str, value: object, check: Callable[[float], bool], wanted: str) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.fail(name, f"expected {wanted}, got {shown(value)}")
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.fail(name, "expected a finite number")
        smallest = self._rules.smallest
        if number and smallest and not smallest <= abs(number) <= 1.0 / smallest:
            raise self.fail(name, f"expected 0 or a size from {smallest:g} to {1.0 / smallest:g}, got {number:g}")
        if not check(number):
            raise self.fail(name, f"expected {wanted}, got {number:g}")
        return number


def _one_of(choices: tuple[str, ...]) -> str:
    return f"one of {', '.join(choices)}"
