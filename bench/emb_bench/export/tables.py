"""A log as tables: one topic as CSV or Parquet, all of them as ASAM MDF 4."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emb_bench.logs.columns import Column
from emb_bench.logs.log import TIME, UNIX_TIME, RunLog, Table
from emb_bench.output import new_file
from emb_runtime.errors import UsageError
from emb_runtime.log.mcap_schema import CAN_RX, CAN_TX

LONGEST_FRAME = 8  # Bytes of a classical CAN frame
_OF_A_FRAME = ("publish_time", "id", "is_extended", "data", "is_rtr", "is_error")
_BUS_FRAME = np.dtype(
    [
        ("CAN_DataFrame.BusChannel", "<u1"),
        ("CAN_DataFrame.ID", "<u4"),
        ("CAN_DataFrame.IDE", "<u1"),
        ("CAN_DataFrame.DLC", "<u1"),
        ("CAN_DataFrame.DataLength", "<u1"),
        ("CAN_DataFrame.DataBytes", "<u1", (LONGEST_FRAME,)),
        ("CAN_DataFrame.Dir", "<u1"),
    ]
)


def _parts(log: RunLog, topic: str, table: tuple[Column, ...]) -> Iterator[Table]:
    """The topic's messages, some at a time: a log may be longer than the memory."""
    names = [column.name for column in table[2:]]  # behind the two times
    for batch in log.batches({topic: names}):
        yield batch[topic]


def write_csv(log: RunLog, topic: str, path: Path) -> str:
    """One topic as comma-separated values.

    The head has the units. Enumerated values are names, bytes are hex, a value that does not exist (NaN) is empty.

    Returns:
        A description of the file's content.

    Raises:
        UsageError: the log has no such topic, or the file exists or cannot be written.
        LogError: the topic cannot be decoded.
    """
    table = log.describe(topic)
    with new_file(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([column.title for column in table])
        for part in _parts(log, topic, table):
            writer.writerows(zip(*(_cells(column, log.values(part, column)) for column in table), strict=True))
        text.detach()
    return f"{log.counts[topic]} rows of {topic}"


def _cells(column: Column, part: NDArray[Any]) -> list[Any]:
    if column.choices is not None:
        return column.labels(part)
    plain: list[Any] = part.tolist()
    match part.dtype.kind:
        case "f":
            return ["" if math.isnan(value) else repr(value) for value in plain]
        case "b":
            return [int(value) for value in plain]
        case _:
            return [value.hex() if isinstance(value, bytes) else value for value in plain]


def arrow_batches(log: RunLog, topic: str) -> tuple[Any, Iterator[Any]]:
    """One topic as Arrow tables: units in the fields' metadata, the run's identity and completeness in the schema's.

    Returns:
        The schema, and the tables, whose rows follow each other.

    Raises:
        UsageError: the log has no such topic, or pyarrow is missing.
        LogError: the topic cannot be decoded.
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
    rows = (
        pa.table([array(column, log.values(part, column)) for column in table], schema=schema)
        for part in _parts(log, topic, table)
    )
    return schema, rows


def write_parquet(log: RunLog, topic: str, path: Path) -> str:
    """One topic as Parquet, see :func:`arrow_batches`.

    Returns:
        A description of the file's content.

    Raises:
        UsageError: the log has no such topic, pyarrow is missing, or the file exists or cannot be written.
        LogError: the topic cannot be decoded.
    """
    schema, tables = arrow_batches(log, topic)
    import pyarrow.parquet as pq

    with new_file(path) as file, pq.ParquetWriter(file, schema) as writer:
        for table in tables:
            writer.write_table(table)
    return f"{log.counts[topic]} rows of {topic}"


def write_mf4(log: RunLog, path: Path) -> str:
    """Every topic as a channel group of an ASAM MDF 4.10 file, ``/cycle.angle`` [rad] over time [s], and a bus log.

    Returns:
        A description of the file's content.

    Raises:
        UsageError: asammdf is missing, or the file exists or cannot be written.
        LogError: a topic cannot be decoded.
    """
    try:
        from asammdf import MDF, Signal
    except ImportError as err:
        raise UsageError("--to mf4 needs asammdf: pip install 'emb-excite[mdf]'") from err
    topics = [topic for topic, count in log.counts.items() if count]
    with new_file(path) as file, MDF(version="4.10") as mdf:
        mdf.start_time = datetime.fromtimestamp(log.span[0] / 1e9, UTC)
        mdf.header.comment = f"{log.path.name}: {log.missing or 'complete'}"
        for topic in topics:
            table = log.tables[topic]
            # A master has to go forward; the kernel's stamps of two frames need not.
            order = np.argsort(table["publish_time"], kind="stable")
            time = log.values(table, TIME)[order]
            signals = [
                Signal(
                    samples=(samples := _samples(log.values(table, column)[order])),
                    timestamps=time,
                    name=f"{topic}.{column.name}",
                    unit=column.unit,
                    conversion=_conversion(column),
                    encoding="utf-8" if samples.dtype.kind == "S" else None,
                )
                for column in log.describe(topic)
                if column is not TIME
            ]
            mdf.append(signals, acq_name=topic, comment=topic, common_timebase=True)
        _append_frames(mdf, log)
        sink: Any = file  # any file will do; the annotation asks for more than is used
        mdf.save(sink)
    return f"{len(topics)} topics"


def _append_frames(mdf: Any, log: RunLog) -> None:
    """Data frames as a group of bus events (ASAM MDF bus logging), as tools for CAN look for them."""
    from asammdf import Signal
    from asammdf.blocks import v4_constants as v4
    from asammdf.blocks.source_utils import Source

    parts = [(log.tables[topic], sent) for topic, sent in ((CAN_RX.name, 0), (CAN_TX.name, 1)) if topic in log.topics]
    rows = [
        (when, identifier, extended, data[:LONGEST_FRAME], sent)
        for table, sent in parts
        for when, identifier, extended, data, remote, error in zip(
            *(table[n].tolist() for n in _OF_A_FRAME), strict=True
        )
        if not (remote or error)
    ]
    if not rows:
        return
    rows.sort(key=lambda row: row[0])
    samples = np.zeros(len(rows), _BUS_FRAME)
    samples["CAN_DataFrame.BusChannel"] = 1
    samples["CAN_DataFrame.ID"] = [row[1] for row in rows]
    samples["CAN_DataFrame.IDE"] = [row[2] for row in rows]
    for name in ("DLC", "DataLength"):
        samples[f"CAN_DataFrame.{name}"] = [len(row[3]) for row in rows]
    padded = b"".join(row[3].ljust(LONGEST_FRAME, b"\0") for row in rows)
    samples["CAN_DataFrame.DataBytes"] = np.frombuffer(padded, np.uint8).reshape(len(rows), LONGEST_FRAME)
    samples["CAN_DataFrame.Dir"] = [row[4] for row in rows]
    time = (np.array([row[0] for row in rows], np.int64) - log.span[0]) / 1e9
    source = Source(
        name="CAN1", path="CAN1", comment=log.run.get("iface", ""), source_type=v4.SOURCE_BUS, bus_type=v4.BUS_TYPE_CAN
    )
    frames = Signal(samples=samples, timestamps=time, name="CAN_DataFrame", source=source)
    mdf.append([frames], acq_name="CAN1", acq_source=source, comment="CAN frames", common_timebase=True)
    mdf.groups[-1].channel_group.flags |= v4.FLAG_CG_BUS_EVENT | v4.FLAG_CG_PLAIN_BUS_EVENT


def _samples(part: NDArray[Any]) -> NDArray[Any]:
    """Numbers as they are; text, and bytes as hex, as text of fixed length."""
    match part.dtype.kind:
        case "O":
            return np.array([v.hex().encode() if isinstance(v, bytes) else v.encode() for v in part], dtype=np.bytes_)
        case "b":
            return part.astype(np.uint8)
        case _:
            return part


def _conversion(column: Column) -> dict[str, Any] | None:
    """Names of values as MDF has them."""
    if column.choices is None:
        return None
    rows: dict[str, Any] = {}
    for n, (value, name) in enumerate(sorted(column.choices.items())):
        rows |= {f"val_{n}": value, f"text_{n}": name.encode()}
    return rows
