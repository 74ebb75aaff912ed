"""The result of a campaign as a Parquet file: one row for each log, units in the metadata of each column."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from emb_bench.batch.row import Options, Parameter, Row, unit_of


def write(path: Path, rows: Sequence[Row], options: Options) -> None:
    """Write the rows as they are ordered; the same rows give the same bytes.

    Args:
        path: the file.
        rows: one for each log.
        options: of their evaluation; they go into the file's metadata.

    Raises:
        ImportError: pyarrow is missing.
        OSError: the file cannot be written.
    """
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {
        "str": pa.string(),
        "str | None": pa.string(),
        "int | None": pa.int64(),
        "float | None": pa.float64(),
        "bool | None": pa.bool_(),
        "tuple[str, ...] | None": pa.list_(pa.string()),
    }
    columns, values = [], []
    for entry in fields(Row):
        if entry.name == "parameters":
            continue
        kind = pa.timestamp("ns", tz="UTC") if entry.name == "start_time" else kinds[str(entry.type)]
        columns.append(pa.field(entry.name, kind, metadata=_told(entry.metadata)))
        values.append(pa.array([getattr(row, entry.name) for row in rows], kind))
    for name in (*options.params, *options.nuisances):
        found = [next((p for p in row.parameters if p.name == name), Parameter(name)) for row in rows]
        for entry in fields(Parameter)[1:]:
            told = dict(entry.metadata) | {"unit": unit_of(name, entry.metadata["unit"])}
            kind = kinds[str(entry.type)]
            columns.append(pa.field(f"{name}_{entry.name}", kind, metadata=_told(told)))
            values.append(pa.array([getattr(p, entry.name) for p in found], kind))
    about = {
        "tool": f"emb-excite {metadata.version('emb-excite')}",
        "options": json.dumps(asdict(options)),
        "logs": str(len(rows)),
        "failed": str(sum(row.error is not None for row in rows)),
    }
    parquet.write_table(pa.table(values, schema=pa.schema(columns, metadata=about)), path)


def _told(entry: Mapping[str, Any]) -> dict[str, str]:
    return {key: text for key, text in entry.items() if text}
