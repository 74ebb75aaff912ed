"""A topic of a log as a table, a picture of the run, or its brake as a model."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from emb_bench.analysis.options import ExportOptions
from emb_bench.export.c_source import write_c
from emb_bench.export.dcm import write_dcm
from emb_bench.export.fmu import write_fmu
from emb_bench.export.identified import identified
from emb_bench.export.mjcf import write_mjcf
from emb_bench.export.picture import draw_run
from emb_bench.figures import PICTURES
from emb_bench.logs.log import UNIX_TIME, RunLog
from emb_bench.logs.mcap_file import Column
from emb_bench.output import replacing, require_place, text_cells
from emb_runtime.errors import UsageError, needs

if TYPE_CHECKING:
    from emb_bench.analysis.study import Study


def arrow_batches(log: RunLog, topic: str) -> tuple[Any, Iterator[Any]]:
    """One topic as a schema and Arrow tables, whose rows follow each other.

    Units are in the fields' metadata, the run's identity and completeness in the schema's.
    """
    with needs("an Arrow table", "bench"):
        import pyarrow as pa
    table = log.describe(topic)

    def kind(column: Column) -> Any:
        if column is UNIX_TIME:
            return pa.timestamp("ns", tz="UTC")
        if column.choices is not None or column.kind == "text":
            return pa.string()
        return pa.binary() if column.kind == "bytes" else pa.from_numpy_dtype(column.kind)

    def array(column: Column, part: NDArray[Any]) -> Any:
        plain = column.labels(part) if column.choices is not None else part
        return pa.array(plain, kind(column), from_pandas=True)  # what is not a number has no value

    about = {
        "emb.log": log.path.name,
        "emb.topic": topic,
        "emb.complete": str(log.complete).lower(),
        "emb.missing": log.missing,
        "emb.run": json.dumps(dict(log.run)),
    }
    units = [{"unit": column.unit} if column.unit else None for column in table]
    fields = [pa.field(column.name, kind(column), metadata=unit) for column, unit in zip(table, units, strict=True)]
    schema = pa.schema(fields, metadata=about)
    rows = (
        pa.table([array(column, log.values(batch[topic], column)) for column in table], schema=schema)
        for batch in log.batches(topic)  # some at a time: a log may be longer than the memory
    )
    return schema, rows


def write_parquet(log: RunLog, topic: str, path: Path) -> str:
    """Write one topic as Parquet, see :func:`arrow_batches`; describes the content."""
    schema, tables = arrow_batches(log, topic)
    from pyarrow import parquet

    with replacing(path) as beside, parquet.ParquetWriter(beside, schema) as writer:
        for table in tables:
            writer.write_table(table)
    return f"{log.counts[topic]} rows of {topic}"


def write_csv(log: RunLog, topic: str, path: Path) -> str:
    """Write one topic as CSV: units in the head, bytes as hex, times in nanoseconds since 1970; says what it holds."""
    schema, tables = arrow_batches(log, topic)
    import pyarrow as pa
    from pyarrow import csv

    def plain(column: Any) -> Any:
        if pa.types.is_binary(column.type):
            return pa.array([value.as_py().hex() for value in column], pa.string())
        if pa.types.is_string(column.type):
            return text_cells(column)
        return column.cast(pa.int64()) if pa.types.is_timestamp(column.type) else column

    titles = text_cells(pa.array([column.title for column in log.describe(topic)], pa.string())).to_pylist()
    head = pa.table([plain(column) for column in schema.empty_table()], titles)
    with replacing(path) as beside, csv.CSVWriter(beside, head.schema) as writer:
        for table in tables:
            writer.write_table(pa.table([plain(column) for column in table], titles))
    return f"{log.counts[topic]} rows of {topic}"


TABLES = {".csv": write_csv, ".parquet": write_parquet}
MODELS = {".fmu": write_fmu, ".c": write_c, ".dcm": write_dcm, ".xml": write_mjcf, ".mjcf": write_mjcf}
FORMATS = (*PICTURES, *TABLES, *MODELS)  # Endings of what is written
CYCLE = "/cycle"


def write(log: RunLog, path: Path, asked: ExportOptions, estimate: Callable[[], Study]) -> str:
    """Write a picture, a topic as a table, or the brake as a model, by the ending of the file; says what it holds.

    The ``estimate`` is made for a model that has no other parameters.
    """
    ending = path.suffix.lower()
    require_place("--output", path, FORMATS)
    for one in fields(asked):
        endings = TABLES if one.name == "topic" else MODELS
        if getattr(asked, one.name) != one.default and ending not in endings:
            raise UsageError(f"--{one.name}: expected with a file that ends in {' or '.join(endings)}, got {path}")
    if ending in MODELS:
        return MODELS[ending](identified(log, asked, estimate), path)
    return TABLES[ending](log, asked.topic or CYCLE, path) if ending in TABLES else draw_run(log, path)
