"""A page that needs nothing but itself: markup in which text is escaped unless it is markup already.

What a log says is not to be trusted: its metadata and events may contain anything. So text becomes markup in one place,
:func:`tag`, and the page forbids its reader's browser to load or to run anything whatever it contains.
"""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Iterable, Sequence
from importlib import resources

POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
"""Content security policy: no script, no network; style sheets and pictures that are inside the page."""

_EMPTY = ("meta", "img", "br", "hr", "col")


class Html(str):
    """Markup. A plain ``str`` is text."""

    __slots__ = ()


Child = str | None | Iterable["Child"]
"""What an element may contain: text, markup, nothing, or several of them."""


def tag(name: str, /, *children: Child, **attributes: str | None) -> Html:
    """An element; text in it and in its attributes is escaped.

    Args:
        name: of the element.
        children: what is in it.
        attributes: ``cls`` is ``class``, an underscore is a hyphen; None leaves one out.
    """
    words = "".join(
        f' {"class" if key == "cls" else key.replace("_", "-")}="{html.escape(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in _EMPTY:
        return Html(f"<{name}{words}>")
    return Html(f"<{name}{words}>{join(children)}</{name}>")


def join(children: Child) -> Html:
    """Several things after each other, text escaped."""
    if children is None:
        return Html("")
    if isinstance(children, Html):
        return children
    if isinstance(children, str):
        return Html(html.escape(_printable(children)))
    return Html("".join(join(child) for child in children))


def _printable(text: str) -> str:
    """Control characters have no place in HTML; they are shown as a replacement."""
    return re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]", "\ufffd", text)


def anchor(title: str) -> str:
    """What a heading is linked by."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


class Section:
    """A section, its heading and those below it."""

    def __init__(self, title: str, *children: Child, within: Sequence[Section] = (), name: str | None = None) -> None:
        """Make one.

        Args:
            title: its heading.
            children: what stands below the heading.
            within: sections below it.
            name: what it is linked by; made of the title without.
        """
        self.title, self.children, self.within = title, children, tuple(within)
        self.name = anchor(title) if name is None else name

    def markup(self, level: int = 2) -> Html:
        """The section."""
        below = [section.markup(level + 1) for section in self.within]
        return tag("section", tag(f"h{level}", self.title), self.children, below, id=self.name)


def table(head: Sequence[Child], rows: Iterable[Sequence[Child]], caption: str, *, words: Sequence[int] = (0,)) -> Html:
    """A table whose first column names its rows.

    Args:
        head: headings of the columns.
        rows: cells.
        caption: what the table shows, for everyone; above it.
        words: columns that hold words, set to the left; numbers are set to the right.
    """

    def kind(column: int) -> str | None:
        return None if column in words else "n"

    body = [
        tag(
            "tr",
            [
                tag("th", cell, scope="row") if column == 0 else tag("td", cell, cls=kind(column))
                for column, cell in enumerate(row)
            ],
        )
        for row in rows
    ]
    headings = [tag("th", cell, scope="col", cls=kind(column)) for column, cell in enumerate(head)]
    return tag(
        "div",
        tag("p", caption, cls="caption"),
        tag(
            "div",
            tag("table", tag("thead", tag("tr", headings)), tag("tbody", body), aria_label=caption),
            cls="scroll",
            tabindex="0",
            role="region",
            aria_label=caption,
        ),
        cls="table",
    )


def facts(rows: Iterable[tuple[str, Child]]) -> Html:
    """Names and what is to be said of them."""
    return tag("dl", [(tag("dt", name), tag("dd", said)) for name, said in rows])


def listed(items: Iterable[Child], cls: str | None = None) -> Html | None:
    """A list; nothing if nothing is in it."""
    lines = [tag("li", item) for item in items]
    return tag("ul", lines, cls=cls) if lines else None


def picture(svg: bytes, says: str, caption: Child) -> Html:
    """A figure, inside the page; ``says`` is what it shows in words, for who cannot see it."""
    source = "data:image/svg+xml;base64," + base64.b64encode(svg).decode("ascii")
    return tag("figure", tag("img", src=source, alt=says), tag("figcaption", caption))


def page(title: str, opening: Child, sections: Sequence[Section], closing: str) -> str:
    """The whole page.

    Args:
        title: of the window.
        opening: what comes before everything else.
        sections: in the order in which they are read.
        closing: a line at the very end.
    """
    style = resources.files("emb_bench.report").joinpath("page.css").read_text(encoding="utf-8")
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("style", Html(style)),
    )
    links = [[" · " if n else None, tag("a", s.title, href=f"#{s.name}")] for n, s in enumerate(sections)]
    contents = tag("nav", tag("p", "On this page: ", links), aria_label="Contents")
    first, *others = [section.markup() for section in sections]
    body = tag("body", tag("main", opening, first, contents, others), tag("footer", tag("p", closing)))
    return f"<!DOCTYPE html>\n{tag('html', head, body, lang='en')}\n"
