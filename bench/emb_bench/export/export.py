"""A topic of a log as a table, a picture of the run, or its brake as a model."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from emb_bench.analysis.options import ExportOptions
from emb_bench.export.c_source import c_source
from emb_bench.export.dcm import dcm
from emb_bench.export.fmu import fmu
from emb_bench.export.identified import Identified, identified
from emb_bench.export.mjcf import mjcf
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


def write_table(log: RunLog, topic: str, path: Path) -> str:
    """Write one topic as Parquet or CSV, by the ending of the file; returns its content in words.

    Parquet is as :func:`arrow_batches` describes. CSV has units in its head, bytes as hex, times in nanoseconds since
    1970.
    """
    schema, tables = arrow_batches(log, topic)
    import pyarrow as pa
    from pyarrow import csv, parquet

    def plain(column: Any) -> Any:
        if pa.types.is_binary(column.type):
            return pa.array([value.as_py().hex() for value in column], pa.string())
        if pa.types.is_string(column.type):
            return text_cells(column)
        return column.cast(pa.int64()) if pa.types.is_timestamp(column.type) else column

    writer, empty = parquet.ParquetWriter, schema.empty_table()
    if path.suffix.lower() == ".csv":
        titles = text_cells(pa.array([column.title for column in log.describe(topic)], pa.string())).to_pylist()
        writer, tables = csv.CSVWriter, (pa.table([plain(column) for column in table], titles) for table in tables)
        empty = pa.table([plain(column) for column in empty], titles)
    with replacing(path) as beside, writer(beside, empty.schema) as file:
        for table in tables:
            file.write_table(table)
    return f"{log.counts[topic]} rows of {topic}"


def write_model(found: Identified, path: Path) -> str:
    """Write a brake as a model, by the ending of the file; returns its parameters in words."""
    content, what = MODELS[path.suffix.lower()](found)
    with replacing(path) as beside:
        beside.write_bytes(content)
    return f"{what}, parameters: {found.source}"


def _mjcf(found: Identified) -> tuple[bytes, str]:
    lacks = f", without {', '.join(found.features)}" if found.features else ""
    return mjcf(found.bench, found.brake).encode(), f"a MuJoCo model{lacks}"


TABLES = (".csv", ".parquet")
MODELS: Mapping[str, Callable[[Identified], tuple[bytes, str]]] = {
    ".fmu": fmu,
    ".c": lambda found: (c_source(found).encode(), "C source"),
    ".dcm": lambda found: (dcm(found).encode("ascii"), "a calibration file"),
    **dict.fromkeys((".xml", ".mjcf"), _mjcf),
}
"""Content of a model's file, and its description, by the file's ending."""
FORMATS = (*PICTURES, *TABLES, *MODELS)  # Endings of the files
CYCLE = "/cycle"


def write(log: RunLog, path: Path, options: ExportOptions, estimate: Callable[[], Study]) -> str:
    """Write a picture, a topic as a table, or the brake as a model, by the ending of the file.

    Returns its content in words. The ``estimate`` is made for a model that has no other parameters.
    """
    ending = path.suffix.lower()
    require_place("--output", path, FORMATS)
    for one in fields(options):
        endings = TABLES if one.name == "topic" else MODELS
        if getattr(options, one.name) != one.default and ending not in endings:
            raise UsageError(f"--{one.name}: expected with a file that ends in {' or '.join(endings)}, got {path}")
    if ending in MODELS:
        return write_model(identified(log, options, estimate), path)
    return write_table(log, options.topic or CYCLE, path) if ending in TABLES else draw_run(log, path)
