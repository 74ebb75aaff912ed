"""A page as records, and their HTML by one template.

The content of a log is not trusted: its metadata and events may contain anything. HTML is escaped wherever a value is
put into it, and the page forbids its reader's browser to load or to run anything whatever it contains.
"""

from __future__ import annotations

import base64
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any, ClassVar, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from emb_bench.report.text import Cell, Table
from emb_runtime.system.terminal import escaped

LONGEST = 2000  # Characters of a text from a log that are shown; report.json has them all

Words = str | Sequence[str]
"""A text, or its parts, of which cells have a style."""


class Panel(NamedTuple):
    """One figure, of several that stand beside each other."""

    svg: bytes
    shows: str  # Description for who cannot see it

    @property
    def source(self) -> str:
        """The figure as an address that holds it."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg).decode("ascii")


@dataclass(frozen=True)
class Text:
    """A text: a paragraph, or without one a line of its block."""

    kind: ClassVar[str] = "text"
    words: Words
    style: str = ""  # Class of the paragraph
    paragraph: bool = True


@dataclass(frozen=True)
class Items:
    """A list; without an item, nothing."""

    kind: ClassVar[str] = "items"
    items: Sequence[Words]
    style: str = ""


@dataclass(frozen=True)
class Facts:
    """Rows of a name with words or blocks."""

    kind: ClassVar[str] = "facts"
    rows: Sequence[tuple[str, Words | Sequence[Block]]]
    style: str = ""


@dataclass(frozen=True)
class Figures:
    """Figures with a caption; wide ones take a row each."""

    kind: ClassVar[str] = "figures"
    panels: Sequence[Panel]
    caption: str
    wide: bool = False


@dataclass(frozen=True)
class Section:
    """A part with a heading, which opens a folded one."""

    kind: ClassVar[str] = "section"
    name: str  # Its address on the page
    title: str
    blocks: Sequence[Block | None]
    level: int = 2
    folded: bool = False


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    kind: ClassVar[str] = "heading"
    title: str
    level: int = 4


Block = Text | Items | Facts | Figures | Section | Heading | Table


@dataclass(frozen=True)
class Page:
    """A page."""

    mark: str  # What stands before each title; empty for a real machine
    number: str
    title: str
    heading: str
    lead: str
    outside: Sequence[str]  # Banners before the verdict
    verdict: Cell
    banners: Sequence[Text]  # Those behind it
    summary: Section
    links: Sequence[tuple[str, str]]  # Addresses of sections, with their names
    sections: Sequence[Section]
    evidence: Sequence[Section]
    footer: str


def html(page: Page) -> str:
    """The page as HTML: the verdict, then its reasons; evidence is folded."""
    css = resources.files("emb_bench.report").joinpath("page.css").read_text(encoding="utf-8")
    return environment().get_template("page.html.j2").render(page=page, css=Markup(css))


@functools.cache
def environment() -> Environment:
    """The templates of this folder; values are escaped."""
    return Environment(
        loader=PackageLoader("emb_bench.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_printable,
    )


def code(text: str) -> Words:
    """Unchanged text from a log, cut at ``LONGEST``."""
    more = len(text) - LONGEST
    return [Cell(text[:LONGEST], "code"), f" … {more} further characters" if more > 0 else ""] if text else "–"


def _printable(value: Any) -> Any:
    """Text without characters that control or cannot be seen, but for spaces: a log may contain any."""
    if isinstance(value, Markup):
        return Markup(escaped(value, "\t\n\r"))
    return escaped(value, "\t\n\r") if isinstance(value, str) else value
