"""Documents of unknown origin, read into records by msgspec: types, bounds, no unknown key.

A record is a frozen ``msgspec.Struct`` or dataclass whose fields carry their bounds, ``Annotated[float, Meta(gt=0)]``.
An error is one line: document, key, what was expected, what came.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar, get_type_hints

import msgspec
from msgspec import inspect

from emb_runtime.errors import EmbError

Record = TypeVar("Record")
SMALLEST = 1e-30  # No quantity of a brake is smaller, or larger than its inverse; beyond it arithmetic overflows
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]

LONGEST_VALUE = 120  # Characters of a foreign value that a message repeats
_PLACE = re.compile(r" - at `(key` in `)?\$([^`]*)`$")
_STEP = re.compile(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]")
_RECORDS = (inspect.StructType, inspect.DataclassType)
_LISTS = (inspect.ListType, inspect.VarTupleType)


Keys = tuple[str | int, ...]  # Keys and indices that lead to a value


class FieldError(ValueError):
    """Raised by a record's ``__post_init__``: one of its values contradicts another.

    Args:
        key: of the record.
        reason: what was expected and what came.
    """

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(reason)
        self.key = key


class _RefusedError(Exception):
    def __init__(self, keys: Keys, reason: str) -> None:
        super().__init__(reason)
        self.keys = keys


def read(
    kind: type[Record],
    document: object,
    source: str,
    error: Callable[[str], EmbError],
    *,
    at: Keys = (),
    remedy: str = "add it",
    longest_text: int = 200,
    smallest: float = 0.0,
) -> Record:
    """Convert a document into a record.

    Args:
        kind: the record's type.
        document: as a TOML or JSON parser returns it.
        source: name of the document in messages.
        error: makes the error that is raised from its message.
        at: place of the value in the document, where it is part of one.
        remedy: advice where a key is missing.
        longest_text: most characters of a text; all are printable, and none is empty.
        smallest: smallest magnitude of a number other than 0; its inverse is the largest.

    Raises:
        EmbError: of the given kind: a key is missing or unknown, or a value has another type or is out of bounds.
    """
    info = inspect.type_info(kind)
    check = _Check(longest_text, smallest)
    try:
        check.walk(document, info, ())
        if check.missing:
            raise _RefusedError((), _missing(check.missing, remedy))
        return msgspec.convert(document, kind)
    except _RefusedError as err:
        keys, reason = err.keys, str(err)
    except msgspec.ValidationError as err:
        keys, reason = _explain(kind, document, err)
    place = key_text((*at, *keys))
    raise error(f"{source}: {place}: {reason}" if place else f"{source}: {reason}")


def struct_of(*kinds: type[Any], **others: tuple[Any, Any]) -> Any:
    """A struct with the fields, bounds and defaults of named tuples, which msgspec itself reads from a list.

    Args:
        kinds: the named tuples.
        others: types and defaults of further fields, or of those that a document writes in another way.
    """
    fields = {}
    for kind in kinds:
        for name, hint in get_type_hints(kind, include_extras=True).items():
            fields[name] = hint, kind._field_defaults.get(name, msgspec.NODEFAULT)
    return msgspec.defstruct(
        "Table", [(name, *field) for name, field in (fields | others).items()], frozen=True, kw_only=True
    )


def key_text(keys: Keys) -> str:
    """The place of a value, as ``plants.rough.f_l`` or ``sequences[3].action``."""
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).removeprefix(".")
    return text if text.isprintable() and len(text) <= LONGEST_VALUE else shown(text)


def shown(value: object) -> str:
    """A foreign value for a message: printable ASCII in one line, shortened."""
    try:
        text = ascii(value)
    except ValueError:  # a whole number of more digits than Python turns into text
        return "a number of too many digits"
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


class _Check:
    """Looks for unknown keys, texts that are not printable and numbers that are not finite, which msgspec takes."""

    def __init__(self, longest_text: int, smallest: float) -> None:
        self._longest_text = longest_text
        self._smallest = smallest
        self.missing: list[tuple[Keys, inspect.Type]] = []  # Required keys that are not there

    def walk(self, value: object, kind: inspect.Type | None, keys: Keys) -> None:
        """Raises _RefusedError at the first such value."""
        if isinstance(value, str):
            if not value or not value.isprintable() or len(value) > self._longest_text:
                wanted = f"expected a printable text of 1 to {self._longest_text} characters"
                raise _RefusedError(keys, f"{wanted}, got {shown(value)}")
        elif isinstance(value, int | float) and not isinstance(value, bool):
            if (problem := _number_problem(value, self._smallest)) and _matching(kind, value) is not None:
                raise _RefusedError(keys, problem)
        elif isinstance(value, dict | list) and (kind := _matching(kind, value)) is not None:
            if isinstance(kind, _RECORDS) and isinstance(value, dict):
                self._compare_keys(value, kind, keys)
            for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
                self.walk(inner, _inner(kind, key), (*keys, key))

    def _compare_keys(
        self, value: Mapping[str, object], kind: inspect.StructType | inspect.DataclassType, keys: Keys
    ) -> None:
        known = {field.encode_name: field for field in kind.fields}
        for key in value:
            if key not in known:
                raise _RefusedError((*keys, key), f"unknown key; expected some of {', '.join(sorted(known))}")
        self.missing += [((*keys, n), f.type) for n, f in known.items() if f.required and n not in value]


def _missing(missing: list[tuple[Keys, inspect.Type]], remedy: str) -> str:
    names = ", ".join(key_text(keys) for keys, _ in missing)
    wanted = f": expected {_wanted(missing[0][1])}" if len(missing) == 1 else ""
    return f"{names}: missing{wanted}; {remedy}"


def _number_problem(value: float, smallest: float) -> str:
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        return "expected a finite number"
    if number and smallest and not smallest <= abs(number) <= 1.0 / smallest:
        return f"expected 0 or a size from {smallest:g} to {1.0 / smallest:g}, got {number:g}"
    return ""


def _matching(kind: inspect.Type | None, value: object) -> inspect.Type | None:
    """The type without its metadata, or the member of a union that such a value is read as; None if none is."""
    if isinstance(kind, inspect.Metadata):
        return _matching(kind.type, value)
    if isinstance(kind, inspect.UnionType):
        return next((found for member in kind.types if (found := _matching(member, value)) is not None), None)
    wanted: tuple[type[inspect.Type], ...]
    if isinstance(value, dict):
        wanted = (*_RECORDS, inspect.DictType)
    elif isinstance(value, list):
        wanted = (*_LISTS, inspect.TupleType)
    else:
        wanted = (inspect.FloatType, inspect.IntType)
    return kind if isinstance(kind, wanted) else None


def _inner(kind: inspect.Type | None, key: str | int) -> inspect.Type | None:
    """Type of an entry of a record, mapping, list or tuple; None for one that there is not."""
    if isinstance(kind, _RECORDS):
        return next((field.type for field in kind.fields if field.encode_name == key), None)
    if isinstance(kind, inspect.DictType):
        return kind.value_type
    if isinstance(kind, _LISTS):
        return kind.item_type
    if isinstance(kind, inspect.TupleType) and isinstance(key, int) and key < len(kind.item_types):
        return kind.item_types[key]
    return None


def _explain(kind: type[Any], document: object, err: msgspec.ValidationError) -> tuple[Keys, str]:
    """Place and reason of msgspec's error."""
    keys = _place(kind, document, err)
    if isinstance(err.__cause__, FieldError):
        return (*keys, err.__cause__.key), str(err.__cause__)
    here: inspect.Type | None = inspect.type_info(kind)
    container: inspect.Type | None = None
    value: Any = document
    for key in keys:
        container = _matching(here, value)
        here, value = _inner(container, key), value[key]
    if "at `key` in" in str(err) and isinstance(container, inspect.DictType):
        return keys, f"unknown key; expected {_wanted(container.key_type)}"
    return keys, f"expected {_wanted(here)}, got {shown(value)}"


def _place(kind: type[Any], document: Any, err: msgspec.ValidationError) -> Keys:
    """Keys to the value that msgspec refuses. For a key of a mapping it writes ``[...]``: then each is tried alone."""
    keys: list[str | int] = []
    value = document
    of_key, place = found.groups() if (found := _PLACE.search(str(err))) else (None, "")
    for name, index in _STEP.findall(place + ("[...]" if of_key else "")):
        key: str | int = name or index
        if index == "...":
            key = next(
                (k for k, v in value.items() if _refused(kind, _changed(document, keys, {k: v})) == str(err)), index
            )
            if key == index:
                return tuple(keys)
        elif index:
            key = int(index)
        keys.append(key)
        value = value[key]
    return tuple(keys)


def _refused(kind: type[Any], document: object) -> str:
    try:
        msgspec.convert(document, kind)
    except msgspec.ValidationError as err:
        return str(err)
    return ""


def _changed(document: Any, keys: list[str | int], value: object) -> object:
    """The document with another value at a place."""
    if not keys:
        return value
    copy = document.copy()
    copy[keys[0]] = _changed(document[keys[0]], keys[1:], value)
    return copy


_NOUNS: Mapping[type, str] = {
    inspect.StrType: "a text",
    inspect.BoolType: "true or false",
    inspect.StructType: "a table",
    inspect.DataclassType: "a table",
    inspect.DictType: "a table",
}


def _wanted(kind: inspect.Type | None) -> str:
    """A type in words."""
    if isinstance(kind, inspect.Metadata):
        return str((kind.extra_json_schema or {}).get("description") or _wanted(kind.type))
    if isinstance(kind, inspect.UnionType):
        return " or ".join(_wanted(member) for member in kind.types if not isinstance(member, inspect.NoneType))
    if isinstance(kind, inspect.LiteralType):
        return f"{'one of ' if len(kind.values) > 1 else ''}{', '.join(map(str, kind.values))}"
    if isinstance(kind, inspect.FloatType):
        return f"a number{_bounds(kind)}"
    if isinstance(kind, inspect.IntType):
        return f"a whole number{_bounds(kind)}"
    if isinstance(kind, inspect.TupleType):
        return f"[{', '.join(_wanted(item) for item in kind.item_types)}]"
    if isinstance(kind, _LISTS):
        least, most = kind.min_length or 0, kind.max_length
        return f"a list of {least} to {most} entries" if most is not None else f"a list of at least {least} entries"
    return _NOUNS.get(type(kind), "a value")


def _bounds(kind: inspect.FloatType | inspect.IntType) -> str:
    if kind.ge is not None and kind.le is not None:
        return f" from {kind.ge:g} to {kind.le:g}"
    bounds = (("from", kind.ge), ("above", kind.gt), ("at most", kind.le), ("below", kind.lt))
    return ",".join(f" {words} {value:g}" for words, value in bounds if value is not None)


MAX_TOML_BYTES = 64 * 1024  # A bench file has a few KiB
MAX_DOTS = 500  # Most dots in a line: for a key of n parts tomllib takes time and memory that grow with n²
_MARK = "\ufeff"


def parse_toml(text: str) -> dict[str, Any]:
    """The document.

    Raises:
        ValueError: the text is not TOML, or too large; the message says what is wrong with it.
    """
    if text.startswith(_MARK):
        raise ValueError("it begins with a byte-order mark: save it as UTF-8 without one")
    if len(text) > MAX_TOML_BYTES:
        raise ValueError(f"expected at most {MAX_TOML_BYTES} characters, got {len(text)}")
    for number, line in enumerate(text.split("\n"), 1):
        if (dots := line.count(".")) > MAX_DOTS:
            raise ValueError(f"line {number}: expected at most {MAX_DOTS} dots, got {dots}")
    try:
        return tomllib.loads(text)
    except RecursionError as err:
        raise ValueError("not valid TOML: nested too deeply") from err
    except ValueError as err:  # TOMLDecodeError, and what tomllib lets through
        raise ValueError(f"not valid TOML: {err}") from err
