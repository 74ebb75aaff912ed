"""Tables as aligned text and as Markdown."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

WIDTH = 120


@dataclass(frozen=True)
class Sheet:
    """One table."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    def text(self) -> list[str]:
        """Aligned; the first column to the left."""
        cells = [self.header, *self.rows]
        widths = [max(len(row[i]) for row in cells) for i in range(len(self.header))]
        lines = []
        for name, *others in cells:
            rest = "".join(f"  {cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True))
            lines.append(f"{name:{widths[0]}}{rest}".rstrip())
        return [*textwrap.wrap(self.title, WIDTH), *lines, ""]

    def markdown(self) -> list[str]:
        """The same."""
        rule = "|".join(["---", *(["---:"] * (len(self.header) - 1))])
        rows = [f"| {' | '.join(row)} |" for row in (self.header, *self.rows)]
        return [f"**{self.title}**", "", rows[0], f"|{rule}|", *rows[1:], ""]
