"""Reports of a few runs, and what a parser of HTML reads in them."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from emb_bench.cli.replay import main

HEADINGS = ("h1", "h2", "h3", "h4")
VOID = ("meta", "img", "br", "hr", "col", "link", "input")


@dataclass
class Reader(HTMLParser):
    """What is in a page, by the parser of the standard library."""

    tags: list[str] = field(default_factory=list)
    attributes: list[tuple[str, str, str]] = field(default_factory=list)  # Element, name, value
    texts: list[str] = field(default_factory=list)  # Of the body, in order
    headings: list[str] = field(default_factory=list)
    open: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)
        if tag in HEADINGS:
            self.headings.append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, "elements are not nested"

    def handle_data(self, data: str) -> None:
        if "body" in self.open and data.strip():
            self.texts.append(data)
        if set(HEADINGS) & set(self.open):
            self.headings[-1] += data

    def values(self, name: str) -> list[str]:
        """Of an attribute, wherever it is."""
        return [value for _, key, value in self.attributes if key == name]

    @property
    def text(self) -> str:
        """All text of the body."""
        return " ".join(" ".join(self.texts).split())


def read(page: str) -> Reader:
    """Read a whole page."""
    reader = Reader()
    reader.feed(page)
    reader.close()
    assert reader.open == []
    return reader


@dataclass(frozen=True)
class Report:
    """A page and the numbers beside it."""

    path: Path
    html: str
    reader: Reader
    numbers: dict[str, Any]


def make(output: Path, *arguments: str | Path, code: int = 0) -> Report:
    """Write a report as the command does."""
    assert main(["report", *map(str, arguments), "-o", str(output)]) == code
    html = output.read_text(encoding="utf-8")

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    numbers = json.loads(output.with_suffix(".json").read_text(encoding="utf-8"), parse_constant=refuse)
    return Report(output, html, read(html), numbers)
