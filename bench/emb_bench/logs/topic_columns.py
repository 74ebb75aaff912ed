"""The messages of one topic as columns with names, units and the names of their values, for tables of any kind."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from emb_bench.logs.log import RunLog, Table
from emb_bench.logs.protobuf_columns import column_of, field_names
from emb_runtime.errors import LogError, UsageError


@dataclass(frozen=True)
class Column:
    """What one column of a table is."""

    name: str
    kind: str
    """Name of numpy's type of its values, or ``text``, or ``bytes``."""
    unit: str = ""
    """SI unit, empty if it has none."""
    choices: Mapping[int, str] | None = None
    """Names of the values, where they are enumerated."""

    @property
    def title(self) -> str:
        """Name and unit, for a table's head."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def labels(self, values: NDArray[Any]) -> list[str]:
        """The names of enumerated values; of an unknown value its number."""
        choices = self.choices or {}
        return [choices.get(value, str(value)) for value in values.tolist()]


TIME = Column("time", "float64", "s")
"""Since the first thing in the log happened; all topics have the same zero."""
UNIX_TIME = Column("unix_time", "int64", "ns")


def describe(log: RunLog, topic: str) -> tuple[Column, ...]:
    """The columns of a topic, from what the file itself says of it: two times, then every field.

    Raises:
        UsageError: the log has no such topic.
        LogError: its units are not readable.
    """
    if topic not in log.topics:
        raise UsageError(f"expected a topic of {log.path}, {', '.join(log.topics)}; got {topic!r}")
    number, _, factory = log.topics[topic]
    try:
        units = json.loads(log.contents.channels[number].metadata.get("units", "{}"))
    except ValueError as err:
        raise LogError(f"{log.path}: the units of {topic} are not readable: {err}") from err
    fields = factory.DESCRIPTOR.fields_by_name
    columns = []
    for name in field_names(factory):
        field, enum = fields[name], fields[name].enum_type
        kind = {field.TYPE_STRING: "text", field.TYPE_BYTES: "bytes"}.get(field.type) or column_of(field, []).dtype.name
        choices = {value.number: value.name for value in enum.values} if enum is not None else None
        columns.append(Column(name, kind, units.get(name, ""), choices))
    return (TIME, UNIX_TIME, *columns)


def values(log: RunLog, table: Table, column: Column) -> NDArray[Any]:
    """One column of a topic's messages, of all of them or of a batch."""
    if column is TIME:
        return (table["publish_time"] - log.span[0]) / 1e9
    return table["publish_time" if column is UNIX_TIME else column.name]
