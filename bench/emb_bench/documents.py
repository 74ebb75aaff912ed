"""Records as JSON documents, whose keys are the names of the fields, and mappings that suggest the intended name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from emb_runtime.errors import UnknownNameError, near

Entry = TypeVar("Entry")


class ByName(dict[str, Entry]):
    """Records by their names; a name that is none of them is refused with those that are."""

    def __missing__(self, name: object) -> Entry:
        raise UnknownNameError(f"expected one of {', '.join(self)}, got {name!r}{near(str(name), self)}")


def to_json(value: Any) -> Any:
    """A record, or a structure of records, as the types of JSON; numbers may be infinite or NaN.

    A dataclass and a named tuple become objects, an array a list, a set a sorted one, an enumeration its value, a path
    its text.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "_asdict"):
        return to_json(value._asdict())
    if isinstance(value, Mapping):
        return {str(key): to_json(entry) for key, entry in value.items()}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, frozenset):
        return sorted(value)
    return [to_json(entry) for entry in value] if isinstance(value, list | tuple) else value
