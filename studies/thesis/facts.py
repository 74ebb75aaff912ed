"""A statement of the thesis, what the equations give for it, and whether the two agree."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

AGREES = "agrees"
DIFFERS = "does not follow"
WIDTH = 120
"""Of the lines for a person."""
_MARGIN = " " * 19
_HANGING: Any = {"subsequent_indent": _MARGIN, "break_long_words": False, "break_on_hyphens": False}


@dataclass(frozen=True)
class Fact:
    """One statement, checked."""

    figure: str
    """The figure or section that it belongs to: ``fig-4.2``."""
    source: str
    """Where the thesis says it: section, equation or table."""
    claim: str
    """What it says, in our words."""
    found: str
    """What its equations give."""
    agrees: bool
    numbers: Mapping[str, float]
    """What the verdict was taken from."""

    @property
    def verdict(self) -> str:
        """In words."""
        return AGREES if self.agrees else DIFFERS

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "figure": self.figure,
            "source": self.source,
            "claim": self.claim,
            "found": self.found,
            "verdict": self.verdict,
            "numbers": dict(self.numbers),
        }


def facts_text(facts: Iterable[Fact]) -> str:
    """For a person: the facts by figure, the verdict first."""
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
