"""Options of a command as a record, which API and command line take: each with its default and a line of help."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import Field, dataclass, field, fields
from numbers import Integral, Real
from typing import Any, NamedTuple, TypeVar

from emb_runtime.errors import UsageError

T = TypeVar("T")
HELP = "help"  # Key of a field's metadata


class Help(NamedTuple):
    """Help and type of an option on a command line."""

    text: str  # Line of help; of one that is on by itself, help of its ``--no-NAME``
    metavar: str = ""
    kind: Callable[[str], Any] = str
    choices: Sequence[str] = ()
    least: int | None = None


def option(default: T, text: str, metavar: str = "", **more: Any) -> T:
    """An option of a record; ``more`` are further fields of :class:`Help`."""
    return field(default=default, metadata={HELP: Help(text, metavar, **more)})


def help_of(one: Field[Any]) -> Help | None:
    """Help and type of a field of a record; None if no command line has it."""
    return one.metadata.get(HELP)


@dataclass(frozen=True, eq=False)
class Options:
    """Options of a command."""

    def __post_init__(self) -> None:
        """Check numbers and words that are one of several.

        Raises:
            UsageError: a number is none or too small, or a word is none of them.
        """
        for one in fields(self):
            value, row = getattr(self, one.name), help_of(one)
            if row is None or value is one.default:
                continue
            name = f"--{one.name.replace('_', '-')}"
            if row.least is not None and not (isinstance(value, Integral) and int(value) >= row.least):
                raise UsageError(f"{name}: expected a number from {row.least}, got {value!r:.40}")
            if row.kind is float and not isinstance(value, Real):
                raise UsageError(f"{name}: expected a number, got {value!r:.40}")
            if row.choices and value not in row.choices:
                raise UsageError(f"{name}: expected one of {', '.join(row.choices)}, got {value!r:.40}")
