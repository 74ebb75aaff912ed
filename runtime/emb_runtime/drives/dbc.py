"""Messages of a drive's DBC, found in its text one by one: cantools reads only what a mapping uses, and little of it.

Ranges, units, names of values, comments and attributes are ignored, but for the one that marks a CAN FD frame. So what
a DBC costs is bounded, and nothing depends on the ranges. Pure.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from emb_runtime.errors import FrameError

MAX_DBC_BYTES = 4 << 20
MOST_STATEMENTS = 1000  # About a message: its signals, and how they are read
MOST_PAGES = 4096  # Values of a multiplexor for which the signals of a message are, all ranges together

_NUMBER = r"([-+]?\d[\d.eE+-]{0,39})"
_NOISE = re.compile(r'"(?:[^"\\]++|\\"?+)*+("|\Z)|(?:\s++|//[^\n]*+)++')
_FD = re.compile(r'BA_\s+"VFrameFormat"\s+BO_\s+(\d{1,10})\s+(?:1[45]|"\w+FD")\s*;')
_NEW_SYMBOLS, _NODES = re.compile(r"\bNS_ ?:"), re.compile(r"\bB[SU]_ ?:")
_ENDED = re.compile(r"\b(?:CM|BA|BA_DEF|BA_DEF_DEF|VAL|VAL_TABLE|EV|BO_TX_BU|SIG_GROUP|SIG_VALTYPE|SG_MUL_VAL)_\b")
_MESSAGE = re.compile(r"\bBO_ (\d{1,10}) (\w{1,128}) ?: ?(\d{1,5}) \w+")
_SIGNAL = re.compile(
    r" ?SG_ (\w{1,128}) ?((?:m\d{1,9})?M?) ?: ?(\d{1,4}) ?\| ?(\d{1,4}) ?@ ?([01]) ?([+-]) ?"
    rf"\( ?{_NUMBER} ?, ?{_NUMBER} ?\) ?\[[^][]*\] ?\"\" ?\w++(?: ?, ?\w++)*+"
)
_NEXT = re.compile(r" ?(?:(?!SG_)[A-Z_]+_\b|\Z)")
_TYPE = re.compile(r"\bSIG_VALTYPE_ (\d+) (\w+) ?: ?([0-3]) ?;")
_PAGES = re.compile(r"\bSG_MUL_VAL_ (\d+) (\w+) (\w+) (\d{1,9}-\d{1,9}(?: ?, ?\d{1,9}-\d{1,9})*) ?;")


class MessageText(NamedTuple):
    """A message as the DBC has it."""

    length: int  # Payload bytes
    is_fd: bool
    multiplexors: int
    multiplexed: bool  # One of them is multiplexed itself
    text: str  # A DBC with this message alone
    fault: str  # Reason why it cannot be read; empty if there is none so far


def find_messages(text: str) -> dict[str, MessageText]:
    """The messages of the text of a DBC, by name; FrameError if it is too long or cut off, or is none."""
    if len(text) > MAX_DBC_BYTES:
        raise FrameError(f"DBC: expected at most {MAX_DBC_BYTES} characters")
    bare = _NOISE.sub(lambda m: '""' if m[1] else '"' if m[0][0] == '"' else " ", text)
    if '"' in bare.replace('""', ""):
        raise FrameError("DBC: not readable: it ends within a text in quotes")
    if (symbols := _NEW_SYMBOLS.search(bare)) and (nodes := _NODES.search(bare, symbols.end())):
        bare = bare[: symbols.start()] + bare[nodes.start() :]  # a list of keywords
    ended = bare.rfind(";") + 1
    rest = bare[ended:].strip()
    if _ENDED.search(rest) or (ended and rest and "BO_ " not in rest):
        raise FrameError("DBC: not readable: it ends within a statement")
    fast, more = set(_FD.findall(text)), _statements(bare)
    found: dict[str, MessageText] = {}
    for head in _MESSAGE.finditer(bare):
        identifier, name, length = head.groups()
        signals, end = [], head.end()
        while signal := _SIGNAL.match(bare, end):
            signals.append(signal.groups())
            end = signal.end()
        fault = "" if _NEXT.match(bare, end) else f"unexpected {bare[end : end + 40].strip()!r}"
        if fault and end >= ended:
            raise FrameError(f"DBC: not readable: it ends within the message {name}")
        extra = more.get(identifier, [])
        ranges = re.findall(r"(\d+)-(\d+)", " ".join(extra))
        pages = sum(max(int(last) - int(first), 0) + 1 for first, last in ranges)
        fault = _excess(int(identifier), len(signals) + len(extra), pages, name in found) or fault
        lines = [f"BO_ {identifier} {name}: {length} X"]
        for signal_name, page, start, bits, order, sign, scale, offset in signals[:MOST_STATEMENTS]:
            lines.append(f' SG_ {signal_name} {page} : {start}|{bits}@{order}{sign} ({scale},{offset}) [0|0] "" X')
        switches = [page for _, page, *_ in signals if page.endswith("M")]
        found[name] = MessageText(
            length=int(length),
            is_fd=identifier in fast,
            multiplexors=len(switches),
            multiplexed=any(page != "M" for page in switches),
            text="" if fault else "\n".join([*lines, *extra]) + "\n",
            fault=fault,
        )
    if not found:
        raise FrameError("DBC: not readable: it has no message")
    return found


def _excess(identifier: int, statements: int, pages: int, twice: bool) -> str:
    """Reason why a message is beyond the bounds; empty if it is not."""
    if identifier >> 32:
        return f"expected an identifier of 32 bits, got {identifier}"
    if statements > MOST_STATEMENTS or pages > MOST_PAGES:
        return f"expected at most {MOST_STATEMENTS} statements and {MOST_PAGES} values of its multiplexor"
    return "its name is there twice" if twice else ""


def _statements(bare: str) -> dict[str, list[str]]:
    """Statements on how signals are read, by the identifier of their message: floats, and ranges of pages."""
    found: dict[str, list[str]] = {}
    for keyword, pattern in (("SIG_VALTYPE_", _TYPE), ("SG_MUL_VAL_", _PAGES)):
        statements = list(pattern.finditer(bare))
        for statement in statements:
            found.setdefault(statement[1], []).append(statement[0])
        if len(statements) != bare.count(f"{keyword} "):
            raise FrameError(f"DBC: not readable: a statement {keyword} is not of the form that it should have")
    return found
