"""Options of a campaign's evaluation, and the row of results of one log: columns with units, and their Parquet file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from emb_bench.brake.parameters import SI, UNITS
from emb_bench.estimate.records import STARTS
from emb_runtime.config.bench import PARAMETER_NAMES

ENDINGS = (".parquet", ".csv")  # Of the file of rows
NONE = "none"  # The method that estimates nothing: information alone


@dataclass(frozen=True)
class Source:
    """One log of a campaign."""

    path: str  # Path of the log
    root: str  # The folder, as given on the command line; of a log given by itself, the folder it is in
    log: str  # Path relative to it
    campaign: str  # Folder of the log, relative to ``root``
    trouble: str = ""  # Reason why it cannot be read, if that is known before it is opened; else empty


@dataclass(frozen=True)
class Options:
    """Options of the evaluation, equal for all logs."""

    method: str = "oem"  # Key of ``METHODS``, or ``none``
    params: tuple[str, ...] = PARAMETER_NAMES
    nuisances: tuple[str, ...] = ()
    model: str | None = None  # Plant to evaluate with; None is the one that each log was made with
    prior: str | None = None  # Set of ranges
    bench_text: str | None = None  # A bench file for all logs; None is the one in each log
    starts: int = STARTS  # Local searches
    seed: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """All unknowns, nuisances last."""
        return (*self.params, *self.nuisances)


def column(about: str, unit: str = "", default: Any = None) -> Any:
    """A field that becomes a column, with the unit of its numbers and the value of a log that does not have it."""
    return field(default=default, metadata={"about": about, "unit": unit})


RELATIVE = "1, or the unknown's unit"
"""Stands for 1 where a deviation is relative to the value, and for the unit of a parameter without a scale."""


@dataclass(frozen=True)
class Parameter:
    """Results of one log for one parameter."""

    name: str
    identified: bool | None = column(
        "identified, as the command estimate says; without an estimate, by the information at the nominal brake"
    )
    cramer_rao: float | None = column("least standard deviation, from the information at the nominal brake", RELATIVE)
    estimate: float | None = column("estimate", "SI")
    low: float | None = column("lower end of the 95 % interval", "SI")
    high: float | None = column("upper end of the 95 % interval", "SI")
    deviation: float | None = column("standard deviation of the estimate", RELATIVE)
    between_runs: float | None = column("the same without errors that all runs on one bench share", RELATIVE)
    repeatability: float | None = column("half of the 95 % interval that the sensors' noise alone would leave", "SI")
    true: float | None = column("what was simulated", "SI")
    error_sigmas: float | None = column("estimate less what was simulated, in its standard deviation", "1")


@dataclass(frozen=True)
class Row:
    """Results of one log; None where it has none."""

    root: str
    campaign: str
    log: str
    error: str | None = column("why the log could not be evaluated, in one line; null if it was")
    sha256: str | None = column("SHA-256 of the file")
    beginning: str | None = column("SHA-256 of the first samples of the experiment, which no two runs have in common")
    copy_of: str | None = column("log of the same run that counts in its place; null if this one counts")
    start_time: int | None = column("first message, Unix time", "ns")
    exit_reason: str | None = column("why the run ended")
    complete: bool | None = column("neither the log nor the experiment lacks anything")
    missing: str | None = column("what is missing, in words; empty if nothing is")
    warnings: tuple[str, ...] | None = column("what else to know before a number is used")
    planned: int | None = column("periods that the run was to have", "samples")
    periods: int | None = column("periods of the experiment that are in the log", "samples")
    measured: int | None = column("periods whose sample was received", "samples")
    command_delay: int | None = column("by which commands acted late", "samples")
    bench_name: str | None = column("bench that it was evaluated with")
    bench_hash: str | None = column("SHA-256 of that bench's contract")
    policy_sha256: str | None = column("SHA-256 of the policy; null if the log names none")
    model: str | None = column("plant of the bench that it was evaluated with")
    angle_min: float | None = column("lowest measured angle", "rad")
    angle_max: float | None = column("highest measured angle", "rad")
    speed_max: float | None = column("largest measured speed", "rad/s")
    current_max: float | None = column("largest commanded current, either sign", "A")
    violations: int | None = column("samples beyond the bench's limits of angle or speed", "samples")
    limited: int | None = column("commands that the shield changed", "samples")
    returning: int | None = column("commands of the shield's way home", "samples")
    clipped: int | None = column("commands clipped to the largest current", "samples")
    missed: int | None = column("periods missed by the loop", "samples")
    nominal_fits: bool | None = column("the model fits at the bench's nominal parameters")
    nominal_angle_sigmas: float | None = column("rms error of the angle at nominal parameters", "1")
    nominal_velocity_sigmas: float | None = column("rms error of the velocity at nominal parameters", "1")
    log_det: float | None = column("log det of the physical Fisher information, relative parameters", "1")
    lambda_min: float | None = column("its smallest eigenvalue", "1")
    trace_inverse: float | None = column("trace of its inverse", "1")
    fits: bool | None = column("the model with the estimated parameters explains the record; null without an estimate")
    chi2_per_freedom: float | None = column("chi2/n of the residuals at the estimate", "1")
    alarms: tuple[str, ...] | None = column("why the model does not explain the record")
    caveats: tuple[str, ...] | None = column("what to know about the method on this record")
    outside: tuple[str, ...] | None = column("parameters outside of the ranges for which the limits are guaranteed")
    parameters: tuple[Parameter, ...] = ()  # In the order of the question; one column for each field of each


def unit_of(name: str, unit: str) -> str:
    """Unit of a column of :class:`Parameter`, for the parameter of this name."""
    if unit == RELATIVE:
        return UNITS.get(name, "1")
    return SI[name] if unit == "SI" else unit


def failed(source: Source, why: str) -> Row:
    """The row of a log that could not be evaluated, with the reason."""
    return Row(printable(source.root), printable(source.campaign), printable(source.log), error=one_line(why))


def one_line(text: str) -> str:
    """A message in one line that every terminal and file takes."""
    return printable(" ".join(text.split()))


def printable(text: str) -> str:
    """Text that can be written as UTF-8: bytes of a file name that are none become backslash escapes."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def write_rows(path: Path, ending: str, rows: Sequence[Row], options: Options) -> None:
    """Writes a Parquet or CSV file: one row for each log.

    Parquet has units in the columns' metadata and the options in the file's. CSV has neither, and the entries of a list
    with ``"; "`` between them. The same rows give the same bytes.
    """
    import pyarrow as pa
    from pyarrow import compute, csv, parquet

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
        columns.append(pa.field(entry.name, kind, metadata=_metadata(entry.metadata)))
        values.append(pa.array([getattr(row, entry.name) for row in rows], kind))
    for name in options.names:
        found = [next((p for p in row.parameters if p.name == name), Parameter(name)) for row in rows]
        for entry in fields(Parameter)[1:]:
            described = dict(entry.metadata) | {"unit": unit_of(name, entry.metadata["unit"])}
            kind = kinds[str(entry.type)]
            columns.append(pa.field(f"{name}_{entry.name}", kind, metadata=_metadata(described)))
            values.append(pa.array([getattr(p, entry.name) for p in found], kind))
    about = {
        "tool": f"emb-excite {metadata.version('emb-excite')}",
        "options": json.dumps(asdict(options)),
        "logs": str(len(rows)),
        "failed": str(sum(row.error is not None for row in rows)),
    }
    table = pa.table(values, schema=pa.schema(columns, metadata=about))
    if ending == ".parquet":
        parquet.write_table(table, path)
        return
    for number, column in enumerate(table.schema):
        if pa.types.is_list(column.type):
            table = table.set_column(number, column.name, compute.binary_join(table[number], "; "))
    csv.write_csv(table, path)


def _metadata(entry: Mapping[str, Any]) -> dict[str, str]:
    return {key: text for key, text in entry.items() if text}
