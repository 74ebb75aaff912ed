"""``emb-replay export``: a topic of a log as a table, a picture of the run, or its brake as a model of MuJoCo."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from emb_bench.export.mjcf import write_mjcf
from emb_bench.export.picture import ENDINGS, draw_run
from emb_bench.logs.log import UNIX_TIME, RunLog, read_log
from emb_bench.logs.mcap_file import Column
from emb_bench.output import replacing
from emb_runtime.errors import EXIT_DONE, UsageError
from emb_runtime.system.terminal import as_json, show


def arrow_batches(log: RunLog, topic: str) -> tuple[Any, Iterator[Any]]:
    """One topic as a schema and Arrow tables, whose rows follow each other.

    Units are in the fields' metadata, the run's identity and completeness in the schema's.
    """
    try:
        import pyarrow as pa
    except ImportError as err:
        raise UsageError("Arrow and Parquet need pyarrow: pip install 'emb-excite[bench]'") from err
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
    names = [column.name for column in table[2:]]  # behind the two times
    rows = (
        pa.table([array(column, log.values(batch[topic], column)) for column in table], schema=schema)
        for batch in log.batches({topic: names})  # some at a time: a log may be longer than the memory
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
        return column.cast(pa.int64()) if pa.types.is_timestamp(column.type) else column

    titles = [column.title for column in log.describe(topic)]
    head = pa.table([plain(column) for column in schema.empty_table()], titles)
    with replacing(path) as beside, csv.CSVWriter(beside, head.schema) as writer:
        for table in tables:
            writer.write_table(pa.table([plain(column) for column in table], titles))
    return f"{log.counts[topic]} rows of {topic}"


TABLES = {"csv": write_csv, "parquet": write_parquet}  # Formats of one topic as a table
FORMATS = (*TABLES, "plot", "mjcf")
MODEL_ENDINGS = (".xml", ".mjcf")
CYCLE = "/cycle"

HELP = "a topic of the log as CSV or Parquet, a picture of the run, or the brake for MuJoCo"
DESCRIPTION = """\
Write a part of a log for another tool.

  csv parquet  one topic as a table, with units: the control cycles, or --topic
  plot         a picture of the run, PNG, SVG or PDF by the ending of FILE
  mjcf         the brake as a model of MuJoCo, .xml, with the parameters that --theta names

A table's FILE ends as its format is called. The frames on the bus go to BLF, ASC and others by can_logconvert LOG FILE.
"""


def add_arguments(p: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    p.add_argument("log", type=Path, metavar="LOG", help="MCAP file of emb-run")
    p.add_argument("--to", choices=FORMATS, required=True, help="what to write")
    p.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="file to write")
    p.add_argument("--topic", metavar="TOPIC", help=f"for {' and '.join(TABLES)}: which one (default: {CYCLE})")
    p.add_argument(
        "--theta", metavar="THETA",
        help="for mjcf: parameters of the brake: log for the running estimate, nominal, true, name=value,..., or the "
        "JSON of an estimate or report (default: log, and nominal where it has no estimate)",
    )  # fmt: skip
    p.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Export a log; returns the exit code."""
    if args.topic is not None and args.to not in TABLES:
        raise UsageError(f"--topic: expected with --to {' or '.join(TABLES)}, got it with --to {args.to}")
    if args.theta is not None and args.to != "mjcf":
        raise UsageError(f"--theta: expected with --to mjcf, got it with --to {args.to}")
    endings = {"plot": ENDINGS, "mjcf": MODEL_ENDINGS}.get(args.to, (f".{args.to}",))
    if args.output.suffix.lower() not in endings:
        raise UsageError(f"{args.output}: expected a file that ends in {', '.join(endings)} with --to {args.to}")
    log = read_log(args.log)
    if args.to == "plot":
        written = draw_run(log, args.output)
    elif args.to == "mjcf":
        written = write_mjcf(log, args.theta or "", args.output)
    else:
        written = TABLES[args.to](log, args.topic or CYCLE, args.output)
    if args.json:
        show(as_json({"log": str(args.log), "file": str(args.output), "holds": written, "missing": log.missing}))
    else:
        show("\n".join([f"WARNING: {log.missing}"] * bool(log.missing) + [f"{args.output}: {written}"]))
    return EXIT_DONE
