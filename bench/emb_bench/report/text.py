"""Text of a result on a terminal: aligned tables, lists of facts, verdicts in colour. Needs the base install only.

Tables are HTML too, by the templates.
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

from emb_runtime.system import terminal

WIDTH = 80  # Columns of a text
BAD = r"(?P<bad>^(WARNING|STOPPED|OUTSIDE):.*|^.*DOES NOT [A-Z]+|NOT [a-z]+|LIMITS LEFT|FAILED|\bNO\b|AT THE BORDER)"
CARE = r"(?P<care>^NOTE:|^SIMULATED:|if the model is right|identified, but biased)"
GOOD = r"(?P<good>^The model '[^']*' fits\b|limits kept|\byes$)"  # Words that stand out in colour


class Cell(str):
    """Text that stands out: ``good``, ``bad``, ``care``, ``name`` or ``code``, and a background from -1 to 1."""

    tone: str
    shade: float

    def __new__(cls, text: str, tone: str = "", shade: float = 0.0) -> Cell:
        """Make a cell."""
        cell = super().__new__(cls, text)
        cell.tone, cell.shade = tone, shade
        return cell


def facts(*rows: tuple[str, str]) -> list[str]:
    """Lines of a name and its text, without empty texts."""
    return [line for name, text in rows if text for line in wrapped(f"{name:12} {text}", 13)]


def wrapped(text: str, indent: int = 4) -> list[str]:
    """A text in lines of at most ``WIDTH`` columns; all but the first begin ``indent`` columns further to the right."""
    margin = len(text) - len(text.lstrip())
    later, joined = " " * (margin + indent), text.replace(" × ", "\xa0×\xa0")  # a power of ten stays with its number
    lines = textwrap.wrap(joined, WIDTH, subsequent_indent=later, break_long_words=False, break_on_hyphens=False)
    return [line.replace("\xa0", " ") for line in lines] or [""]


def listed(mark: str, texts: Iterable[str]) -> list[str]:
    """Lines of several texts, each behind a mark."""
    return [line for text in texts if text for line in wrapped(f"{mark}{text}")]


@dataclass(frozen=True)
class Table:
    """One table; its first column names the rows."""

    kind: ClassVar[str] = "table"
    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: Sequence[int] = (0,)  # Columns of words; the others are aligned to the right

    def lines(self, indent: str = "") -> list[str]:
        """Aligned lines, without the title."""
        cells = [self.header, *self.rows]
        widths = [max(len(row[i]) for row in cells) for i in range(len(self.header))]
        return [
            indent
            + "  ".join(f"{cell:{'<' if i in self.words else '>'}{widths[i]}}" for i, cell in enumerate(row)).rstrip()
            for row in cells
        ]

    def text(self, indent: str = "") -> list[str]:
        """Title and aligned lines."""
        return [*textwrap.wrap(self.title, WIDTH), *self.lines(indent), ""]


def show(text: str) -> None:
    """Prints a result."""
    terminal.show(text, coloured if sys.stdout is not None and sys.stdout.isatty() else str)


def coloured(text: str) -> str:
    """The text with the colours of a terminal; ``NO_COLOR`` in the environment leaves it plain."""
    from rich.console import Console
    from rich.highlighter import RegexHighlighter
    from rich.theme import Theme

    class Verdicts(RegexHighlighter):
        highlights = [f"(?m){BAD}", f"(?m){CARE}", f"(?m){GOOD}"]  # noqa: RUF012  # rich reads it from the class

    console = Console(force_terminal=True, theme=Theme({"bad": "bold red", "care": "yellow", "good": "green"}))
    with console.capture() as captured:
        console.print(Verdicts()(text), soft_wrap=True, end="")
    return captured.get()
