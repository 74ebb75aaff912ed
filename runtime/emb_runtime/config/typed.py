"""Documents of unknown origin, read into records: TOML and JSON, types, bounds, no unknown key.

A record is a frozen ``msgspec.Struct``, dataclass or named tuple whose fields carry their bounds,
``Annotated[float, Meta(gt=0)]``.
An error is one line: document, key, what was expected, what came.
"""

from __future__ import annotations

import functools
import math
import tomllib
from collections.abc import Callable, Mapping
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import msgspec
from msgspec import inspect

from emb_runtime.errors import EmbError, near

Record = TypeVar("Record")
SMALLEST, LARGEST = 1e-30, 1e30  # Sizes of a number that is not 0; beyond them arithmetic overflows
Positive = Annotated[float, msgspec.Meta(gt=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]

LONGEST_TEXT = 200  # Characters of a text
LONGEST_VALUE = 120  # Characters of a foreign value that a message repeats
MAX_TOML_BYTES = 64 * 1024  # A bench file has a few KiB
MAX_DOTS = 500  # Most dots in a line: for a key of n parts tomllib takes time and memory that grow with n²
_RECORDS = (inspect.StructType, inspect.DataclassType, inspect.NamedTupleType)

Keys = tuple[str | int, ...]  # Keys and indices that lead to a value


class FieldError(ValueError):
    """Raised by a record's ``__post_init__``: the value of a key contradicts another."""

    def __init__(self, key: str, reason: str) -> None:
        super().__init__(reason)
        self.key = key


class _RefusedError(Exception):
    """A value that is refused: its keys, and the reason."""

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
) -> Record:
    """Convert a document, as a TOML or JSON parser returns it, into a record.

    Args:
        kind: the record's type.
        document: all texts are printable, and none is empty.
        source: name of the document in messages.
        error: makes the error of a key that is missing or unknown, or a value of another type or out of bounds.
        at: place of the value in the document, where it is part of one.
        remedy: advice where a key is missing.
    """
    reader = _Reader()
    try:
        record = reader.convert(document, kind, ())
        if reader.missing:
            raise _RefusedError((), _missing(reader.missing, remedy))
        return cast("Record", record)
    except _RefusedError as err:
        reason = ": ".join(filter(None, (source, key_text((*at, *err.keys)), str(err))))
    raise error(reason)


def parse_toml(text: str, source: str, error: Callable[[str], EmbError]) -> dict[str, Any]:
    """The document of a text of unknown origin, read within bounds of time and memory; source and error as above."""
    if text.startswith("\ufeff"):
        raise error(f"{source}: it begins with a byte-order mark: save it as UTF-8 without one")
    if len(text) > MAX_TOML_BYTES:
        raise error(f"{source}: expected at most {MAX_TOML_BYTES} characters, got {len(text)}")
    for number, line in enumerate(text.split("\n"), 1):
        if (dots := line.count(".")) > MAX_DOTS:
            raise error(f"{source}: line {number}: expected at most {MAX_DOTS} dots, got {dots}")
    try:
        return tomllib.loads(text)
    except (RecursionError, ValueError) as err:  # of the latter TOMLDecodeError, and what tomllib lets through
        reason = "nested too deeply" if isinstance(err, RecursionError) else err
        raise error(f"{source}: not valid TOML: {reason}") from err


def key_text(keys: Keys) -> str:
    """The place of a value, as ``plants.rough.f_l`` or ``sequences[3].action``."""
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in keys).removeprefix(".")
    return text if text.isprintable() and len(text) <= LONGEST_VALUE else excerpt(text)


def excerpt(value: object) -> str:
    """A foreign value for a message: printable ASCII in one line, shortened."""
    try:
        text = ascii(value)
    except ValueError:  # an integer of more digits than Python turns into text
        return "a number of too many digits"
    return text if len(text) <= LONGEST_VALUE else f"{text[: LONGEST_VALUE - 3]}..."


@functools.cache
def _fields(kind: type[Any]) -> dict[str, tuple[Any, bool]] | None:
    """Type of each field of a record, and whether it is required; None of another type."""
    info = inspect.type_info(kind)
    if not isinstance(info, _RECORDS):
        return None
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: (hints[field.name], field.required) for field in info.fields}


class _Reader:
    """Converts tables and lists part by part; msgspec converts each value in them."""

    def __init__(self) -> None:
        self.missing: list[tuple[Keys, Any]] = []  # Required keys that are not there; then no record is made

    def convert(self, value: Any, kind: Any, keys: Keys) -> Any:
        """A value as a type has it; raises _RefusedError if it does not fit."""
        plain = get_args(kind)[0] if get_origin(kind) is Annotated else kind
        if get_origin(plain) in (Union, UnionType):
            kind = plain = next((one for one in get_args(plain) if _takes(one, value)), kind)
        if plain is Any:
            return value
        if isinstance(value, dict) and (fields := _fields(plain)) is not None:
            return self._record(value, plain, fields, keys)
        if isinstance(value, dict) and get_origin(plain) in (dict, Mapping):
            named, inner = get_args(plain)
            return {self._key(key, named, keys): self.convert(v, inner, (*keys, key)) for key, v in value.items()}
        if isinstance(value, list) and get_origin(plain) in (list, tuple):
            return self._list(value, kind, get_args(plain), keys)
        if problem := _problem(value, kind):
            raise _RefusedError(keys, problem)
        return _by_msgspec(value, kind, keys)

    def _record(self, value: dict[str, Any], kind: Any, fields: dict[str, tuple[Any, bool]], keys: Keys) -> Any:
        for key in value:
            if key not in fields:
                names = f"{', '.join(sorted(fields))}{near(key, fields)}"
                raise _RefusedError((*keys, key), f"unknown key; expected some of {names}")
        self.missing += [((*keys, n), hint) for n, (hint, required) in fields.items() if required and n not in value]
        converted = {key: self.convert(inner, fields[key][0], (*keys, key)) for key, inner in value.items()}
        if self.missing:
            return None
        try:
            return kind(**converted)
        except FieldError as err:
            raise _RefusedError((*keys, err.key), str(err)) from err

    def _key(self, key: str, kind: Any, keys: Keys) -> str:
        try:
            return cast("str", msgspec.convert(key, kind))
        except msgspec.ValidationError:
            expected = _expected(inspect.type_info(kind))
            raise _RefusedError((*keys, key), f"unknown key; expected {expected}") from None

    def _list(self, value: list[Any], kind: Any, kinds: tuple[Any, ...], keys: Keys) -> Any:
        if kinds[-1] is ... or len(kinds) == 1:
            kinds = (kinds[0],) * len(value)
        if len(kinds) == len(value):
            value = [self.convert(v, k, (*keys, i)) for i, (v, k) in enumerate(zip(value, kinds, strict=True))]
        return value if self.missing else _by_msgspec(value, kind, keys)  # which looks at the length


def _takes(kind: Any, value: object) -> bool:
    """True if a member of a union is the one for such a table or list, or has no parts and takes the value."""
    if isinstance(value, dict):
        return get_origin(kind) in (dict, Mapping) or (isinstance(kind, type) and _fields(kind) is not None)
    if isinstance(value, list):
        return get_origin(kind) in (list, tuple)
    return False


def _problem(value: object, kind: Any) -> str:
    """Reason to refuse a text that is not printable or a number that is not finite, which msgspec takes."""
    if isinstance(value, str):
        if not value or not value.isprintable() or len(value) > LONGEST_TEXT:
            return f"expected a printable text of 1 to {LONGEST_TEXT} characters, got {excerpt(value)}"
    elif isinstance(value, int | float) and not isinstance(value, bool) and _is_number(inspect.type_info(kind)):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            return "expected a finite number"
        if number and not SMALLEST <= abs(number) <= LARGEST:
            return f"expected 0 or a size from {SMALLEST:g} to {LARGEST:g}, got {number:g}"
    return ""


def _by_msgspec(value: object, kind: Any, keys: Keys) -> Any:
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError:
        info = inspect.type_info(kind)
        raise _RefusedError(keys, f"expected {_expected(info)}, got {_got(value, info)}") from None


_KINDS: Mapping[type, tuple[str, tuple[str, ...]]] = {
    str: ("a text in quotes, ", ("text",)),
    int: ("a number, ", ("number",)),
    float: ("a number, ", ("number",)),
    list: ("a list, ", ("list", "[")),
}
"""Types of a value, how they are called, and words of what was expected that show that they are no surprise."""


def _got(value: object, kind: inspect.Type) -> str:
    """A value for a message, with its type where that is what is wrong: '0.02' may be taken for a number."""
    if isinstance(value, bool):
        return str(value).lower()  # as the file has it
    noun, words = _KINDS.get(type(value), ("", ()))
    literal = isinstance(kind, inspect.LiteralType) and type(value) in map(type, kind.values)
    return f"{'' if literal or any(word in _expected(kind) for word in words) else noun}{excerpt(value)}"


def _missing(missing: list[tuple[Keys, Any]], remedy: str) -> str:
    names = ", ".join(key_text(keys) for keys, _ in missing)
    expected = f": expected {_expected(inspect.type_info(missing[0][1]))}" if len(missing) == 1 else ""
    return f"{names}: missing{expected}; {remedy}"


def _is_number(kind: inspect.Type) -> bool:
    if isinstance(kind, inspect.Metadata):
        return _is_number(kind.type)
    if isinstance(kind, inspect.UnionType):
        return any(map(_is_number, kind.types))
    return isinstance(kind, inspect.FloatType | inspect.IntType)


_NOUNS: Mapping[type, str] = {
    inspect.StrType: "a text",
    inspect.BoolType: "true or false",
    **dict.fromkeys((*_RECORDS, inspect.DictType), "a table"),
}


def _expected(kind: inspect.Type) -> str:
    """A type in words."""
    if isinstance(kind, inspect.Metadata):
        return str((kind.extra_json_schema or {}).get("description") or _expected(kind.type))
    if isinstance(kind, inspect.UnionType):
        return " or ".join(_expected(member) for member in kind.types if not isinstance(member, inspect.NoneType))
    if isinstance(kind, inspect.LiteralType):
        return f"{'one of ' if len(kind.values) > 1 else ''}{', '.join(map(str, kind.values))}"
    if isinstance(kind, inspect.FloatType):
        return f"a number{_bounds(kind)}"
    if isinstance(kind, inspect.IntType):
        return f"a whole number{_bounds(kind)}"
    if isinstance(kind, inspect.TupleType):
        return f"[{', '.join(_expected(item) for item in kind.item_types)}]"
    if isinstance(kind, inspect.ListType | inspect.VarTupleType):
        least, most = kind.min_length or 0, kind.max_length
        return f"a list of {least} to {most} entries" if most is not None else f"a list of at least {least} entries"
    return _NOUNS.get(type(kind), "a value")


def _bounds(kind: inspect.FloatType | inspect.IntType) -> str:
    if kind.ge is not None and kind.le is not None:
        return f" from {kind.ge:g} to {kind.le:g}"
    bounds = (("from", kind.ge), ("above", kind.gt), ("at most", kind.le), ("below", kind.lt))
    return ",".join(f" {words} {value:g}" for words, value in bounds if value is not None)
