"""Templates and their filters: results as text for a terminal and as HTML, with the same phrases.

The content of a log is not trusted: its metadata and events may contain anything. HTML is escaped wherever a value is
put into it, and the page forbids its reader's browser to load or to run anything whatever it contains.
"""

from __future__ import annotations

import base64
import functools
import math
import re
import textwrap
from datetime import UTC, datetime
from importlib import resources
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from emb_bench import numbers
from emb_bench.brake.parameters import UNITS
from emb_bench.estimate.records import METHODS, chance
from emb_bench.estimate.suspects import explained
from emb_bench.information.identifiability import combination
from emb_bench.report.text import WIDTH, Table

_FIXED = "\u00a0"  # a space where no line is broken
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def text(template: str, **values: Any) -> str:
    """A template as text for a terminal; lines that are too long are wrapped and indented."""
    found = environment(html=False).get_template(template).render(values)
    return "\n".join(piece for line in found.splitlines() for piece in _wrapped(line)).replace(_FIXED, " ").rstrip()


def html(template: str, **values: Any) -> Markup:
    """A template as HTML."""
    return Markup(environment(html=True).get_template(template).render(values))


def phrase(name: str, *values: Any) -> str:
    """A phrase of ``phrases.j2`` by the name of its macro."""
    return str(getattr(environment(html=False).get_template("phrases.j2").module, name)(*values))


def section(template: str, name: str, *values: Any) -> Markup:
    """A macro of a template as HTML."""
    return Markup(getattr(environment(html=True).get_template(template).module, name)(*values))


@functools.cache
def environment(*, html: bool) -> Environment:
    """The templates of this folder.

    Args:
        html: escape values; without, the result is plain text.
    """
    made = Environment(
        loader=PackageLoader("emb_bench.report"),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_printable if html else None,
    )
    made.filters |= {
        "plain": numbers.plain,
        "signed": numbers.signed,
        "percent": numbers.percent,
        "seconds": numbers.seconds,
        "amount": numbers.amount,
        "around": numbers.around,
        "p_value": chance,
        "deviation": deviation,
        "combination": combination,
        "data_uri": _data_uri,
        "date": date,
        "lines": _kept,
        "explained": explained,
        "capitalize_first": lambda words: words[:1].upper() + words[1:],
    }
    made.globals |= {
        "METHODS": METHODS,
        "UNITS": UNITS,
        "between": numbers.between,
        "inf": math.inf,
        "css": Markup(resources.files("emb_bench.report").joinpath("page.css").read_text(encoding="utf-8")),
    }
    return made


def deviation(value: float, name: str, digits: int = 3) -> str:
    """A standard deviation of an unknown: in percent, or in its unit if it has no scale."""
    found = numbers.spread(value, name not in UNITS, digits)
    unit = UNITS.get(name, "").removesuffix("1")  # of a share
    return f"{found} {unit}" if unit and found[0].isdigit() else found


def date(time_ns: int) -> str:
    """Date and time of the clock in UTC; one that was never set may show any time."""
    try:
        return datetime.fromtimestamp(time_ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M UTC")
    except (OverflowError, OSError, ValueError):
        return f"{time_ns} ns"


def _printable(value: Any) -> Any:
    """Control characters have no place in HTML; they are shown as a replacement."""
    if isinstance(value, Markup):
        return Markup(_CONTROL.sub("\ufffd", value))
    return _CONTROL.sub("\ufffd", value) if isinstance(value, str) else value


def _data_uri(svg: bytes) -> str:
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode("ascii")


def _kept(table: Table, indent: str = "") -> list[str]:
    """Lines of a table, not to be wrapped."""
    return [line.replace(" ", _FIXED) for line in table.lines(indent)]


def _wrapped(line: str) -> list[str]:
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    pieces = textwrap.wrap(line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return pieces or [""]
