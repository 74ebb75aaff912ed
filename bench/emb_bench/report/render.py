"""Templates of the page and their filters.

The content of a log is not trusted: its metadata and events may contain anything. HTML is escaped wherever a value is
put into it, and the page forbids its reader's browser to load or to run anything whatever it contains.
"""

from __future__ import annotations

import base64
import functools
import re
from datetime import UTC, datetime
from importlib import resources
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from emb_bench import numbers
from emb_bench.estimate.records import METHODS
from emb_bench.report import sentences

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def html(template: str, **values: Any) -> Markup:
    """A template as HTML."""
    return Markup(environment().get_template(template).render(values))


def section(template: str, name: str, *values: Any) -> Markup:
    """A macro of a template as HTML."""
    return Markup(getattr(environment().get_template(template).module, name)(*values))


@functools.cache
def environment() -> Environment:
    """The templates of this folder; values are escaped."""
    made = Environment(
        loader=PackageLoader("emb_bench.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_printable,
    )
    made.filters |= {
        "plain": numbers.plain,
        "signed": numbers.signed,
        "seconds": numbers.seconds,
        "p_value": sentences.p_value,
        "data_uri": _data_uri,
        "date": date,
        "capitalize_first": lambda words: words[:1].upper() + words[1:],
    }
    made.globals |= {
        "METHODS": METHODS,
        "say": sentences,
        "css": Markup(resources.files("emb_bench.report").joinpath("page.css").read_text(encoding="utf-8")),
    }
    return made


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
