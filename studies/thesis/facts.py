"""A statement of the thesis, what its equations or a training give for it, and whether the two agree."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

AGREES = "agrees"
DIFFERS = "does not follow"
SUGGESTED = "only suggested"
"""Verdict on what the thesis calls possible: a number beside it, which proves nothing against it."""
WIDTH = 120  # Width of the text
Statement = tuple[str, str, str, bool | None]
"""Source, claim, result, and whether the two agree: a :class:`Fact` without its figure."""
_MARGIN = " " * 19
_HANGING: Any = {"subsequent_indent": _MARGIN, "break_long_words": False, "break_on_hyphens": False}


@dataclass(frozen=True)
class Fact:
    """One statement, checked."""

    figure: str  # The figure or section that it belongs to: ``fig-4.2``
    source: str  # Section, equation or table of the thesis
    claim: str  # Statement of the thesis, in our words
    found: str  # Result
    agrees: bool | None  # None for what the thesis says to be possible, and no more

    @property
    def verdict(self) -> str:
        """In words."""
        return SUGGESTED if self.agrees is None else AGREES if self.agrees else DIFFERS

    def document(self) -> dict[str, Any]:
        """The JSON document."""
        return {**asdict(self), "verdict": self.verdict}


def facts_text(facts: Iterable[Fact]) -> str:
    """The facts as text by figure, the verdict first."""
    lines: list[str] = []
    figure = ""
    for fact in facts:
        if fact.figure != figure:
            figure = fact.figure
            lines += ["", figure] if lines else [figure]
        lines += [
            *textwrap.wrap(f"{fact.source}: {fact.claim}", WIDTH, initial_indent=f"  {fact.verdict:16} ", **_HANGING),
            *textwrap.wrap(fact.found, WIDTH, initial_indent=_MARGIN, **_HANGING),
        ]
    return "\n".join(lines)
