"""Options of a campaign's evaluation, and the row of results of one log: columns with units, and their Parquet file."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from emb_bench.analysis.options import SearchOptions
from emb_bench.brake.parameters import SI, UNITS
from emb_bench.config.bench import Bench
from emb_bench.estimate.records import METHODS
from emb_bench.options import option
from emb_bench.output import text_cells
from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import escaped

ENDINGS = (".parquet", ".csv")  # Of the file of rows
NONE = "none"  # The method that estimates nothing: information alone


@dataclass(frozen=True)
class Source:
    """One log of a campaign."""

    path: str  # Path of the log
    root: str  # The folder, as given on the command line; of a log given by itself, the folder it is in
    log: str  # Path relative to it
    campaign: str  # Folder of the log, relative to ``root``
    trouble: str = ""  # Reason why it is not opened; empty if it is


@dataclass(frozen=True, eq=False)
class CampaignOptions(SearchOptions):
    """Options of a campaign, equal for all logs."""

    method: str = option("oem", "see above, or 'none' for information alone (default: oem)", choices=(NONE, *METHODS))
    jobs: int | None = option(None, "logs at a time (default: one for each processor)", "N", kind=int, least=1)
    time_limit: float = option(
        600.0, "longest time for one log [s]; a log that takes longer fails (default: 600)", "X", kind=float
    )
    ray: str | None = option(
        None,
        "address of a Ray cluster, or 'local' for a Ray of this machine (default: processes of this machine)",
        "ADDRESS",
    )
    chart: str | Path | None = option(
        None,
        "picture to write, .png, .svg or .pdf: each parameter against time, temperature and supply voltage, with "
        "control limits",
        "FILE",
        kind=Path,
    )

    def __post_init__(self) -> None:
        """Check all that needs no bench."""
        super().__post_init__()
        if self.chart is not None and self.method == NONE:
            raise UsageError(f"--chart: expected estimates to draw, and --method is '{NONE}'")
        if not 1e-3 <= self.time_limit <= 1e6:
            raise UsageError(f"--time-limit: expected 0.001 to 1e6 s, got {self.time_limit:g}")

    def unknowns_on(self, bench: Bench | None) -> tuple[str, ...]:
        """All unknowns, nuisances last."""
        params, nuisances = self.names_on(bench)
        return (*params, *nuisances)

    def origin_on(self, bench: Bench | None) -> dict[str, Any]:
        """Options that the rows depend on, for the file that has them."""
        params, nuisances = self.names_on(bench)
        others = {name: getattr(self, name) for name in ("model", "prior", "starts", "seed")}
        text = None if bench is None else bench.text
        return {"method": self.method, "params": params, "nuisances": nuisances, "bench_text": text, **others}


class Column(NamedTuple):
    """One column of the file."""

    kind: str  # ``text``, ``texts``, ``truth``, ``count``, ``number`` or ``time`` [ns]
    about: str  # What it is
    unit: str = ""  # Of its numbers


Row = dict[str, Any]
"""Results of one log by column; without an entry where the log has none."""

RELATIVE = "1, or the unknown's unit"
"""Stands for 1 where a deviation is relative to the value, and for the unit of a parameter without a scale."""

COLUMNS = {
    "root": Column("text", ""),
    "campaign": Column("text", ""),
    "log": Column("text", ""),
    "error": Column("text", "why the log could not be evaluated, in one line; null if it was"),
    "sha256": Column("text", "SHA-256 of the file"),
    "beginning": Column("text", "SHA-256 of the first samples of the experiment, which no two runs have in common"),
    "copy_of": Column("text", "log of the same run that counts in its place; null if this one counts"),
    "start_time": Column("time", "first message, Unix time", "ns"),
    "temperature": Column("number", "mean temperature of the motor; null if the node does not send it", "degC"),
    "supply_voltage": Column("number", "mean supply voltage; null if the node does not send it", "V"),
    "simulated": Column("truth", "the log is of no real machine"),
    "exit_reason": Column("text", "why the run ended"),
    "complete": Column("truth", "neither the log nor the experiment lacks anything"),
    "missing": Column("text", "what is missing, in words; empty if nothing is"),
    "warnings": Column("texts", "what else to know before a number is used"),
    "planned": Column("count", "periods that the run was to have", "samples"),
    "periods": Column("count", "periods of the experiment that are in the log", "samples"),
    "measured": Column("count", "periods whose sample was received", "samples"),
    "command_delay": Column("count", "by which commands acted late", "samples"),
    "bench_name": Column("text", "bench that it was evaluated with"),
    "bench_hash": Column("text", "SHA-256 of that bench's contract"),
    "policy_sha256": Column("text", "SHA-256 of the policy; null if the log names none"),
    "model": Column("text", "plant of the bench that it was evaluated with"),
    "angle_min": Column("number", "lowest measured angle", "rad"),
    "angle_max": Column("number", "highest measured angle", "rad"),
    "speed_max": Column("number", "largest measured speed", "rad/s"),
    "current_max": Column("number", "largest commanded current, either sign", "A"),
    "violations": Column("count", "samples beyond the bench's limits of angle or speed", "samples"),
    "limited": Column("count", "commands that the shield changed", "samples"),
    "returning": Column("count", "commands of the shield's way home", "samples"),
    "clipped": Column("count", "commands clipped to the largest current", "samples"),
    "missed": Column("count", "periods missed by the loop", "samples"),
    "nominal_fits": Column("truth", "the model fits at the bench's nominal parameters"),
    "nominal_angle_sigmas": Column("number", "rms error of the angle at nominal parameters", "1"),
    "nominal_velocity_sigmas": Column("number", "rms error of the velocity at nominal parameters", "1"),
    "log_det": Column("number", "log det of the physical Fisher information, relative parameters", "1"),
    "lambda_min": Column("number", "its smallest eigenvalue", "1"),
    "trace_inverse": Column("number", "trace of its inverse", "1"),
    "T": Column("number", "between-run interval expected of an estimate: sum of -2 ln of it", "1"),
    "I": Column("number", "the same of the repeatability", "1"),
    "fits": Column("truth", "the model with the estimated parameters explains the record; null without an estimate"),
    "chi2_per_freedom": Column("number", "chi2/n of the residuals at the estimate", "1"),
    "alarms": Column("texts", "why the model does not explain the record"),
    "caveats": Column("texts", "what to know about the method on this record"),
    "outside": Column("texts", "parameters outside of the ranges for which the limits are guaranteed"),
}
OF_A_PARAMETER = {
    "identified": Column(
        "truth",
        "identified, as the command estimate says; without an estimate, by the information at the nominal brake",
    ),
    "cramer_rao": Column("number", "least standard deviation, from the information at the nominal brake", RELATIVE),
    "estimate": Column("number", "estimate", "SI"),
    "low": Column("number", "lower end of the 95 % interval", "SI"),
    "high": Column("number", "upper end of the 95 % interval", "SI"),
    "deviation": Column("number", "standard deviation of the estimate", RELATIVE),
    "between_runs": Column("number", "the same without errors that all runs on one bench share", RELATIVE),
    "repeatability": Column("number", "half of the 95 % interval that the sensors' noise alone would leave", "SI"),
    "true": Column("number", "what was simulated", "SI"),
    "error_sigmas": Column("number", "estimate less what was simulated, in its standard deviation", "1"),
}
"""Columns of each parameter, behind its name and an underscore."""


def row_columns(names: Sequence[str]) -> dict[str, Column]:
    """All columns of a file about some parameters."""
    return COLUMNS | {
        f"{name}_{key}": one._replace(unit=unit_of(name, one.unit))
        for name in names
        for key, one in OF_A_PARAMETER.items()
    }


def unit_of(name: str, unit: str) -> str:
    """Unit of a column of ``OF_A_PARAMETER``, for the parameter of this name."""
    if unit == RELATIVE:
        return UNITS.get(name, "1")
    return SI[name] if unit == "SI" else unit


def failed(source: Source, why: str) -> Row:
    """The row of a log that could not be evaluated, with the reason."""
    places = {name: escaped(getattr(source, name)) for name in ("root", "campaign", "log")}
    return {**places, "error": escaped(" ".join(why.split()))}


def write_rows(
    path: Path, ending: str, rows: Sequence[Row], options: CampaignOptions, bench: Bench | None = None
) -> None:
    """Writes a Parquet or CSV file: one row for each log. ``bench`` is None if each has its own.

    Parquet has units in the columns' metadata and the options in the file's. CSV has neither, and the entries of a list
    with ``"; "`` between them. The same rows give the same bytes.
    """
    import pyarrow as pa
    from pyarrow import compute, csv, parquet

    kinds = {
        "text": pa.string(),
        "texts": pa.list_(pa.string()),
        "truth": pa.bool_(),
        "count": pa.int64(),
        "number": pa.float64(),
        "time": pa.timestamp("ns", tz="UTC"),
    }
    about = {
        "tool": f"emb-excite {metadata.version('emb-excite')}",
        "options": json.dumps(options.origin_on(bench)),
        "logs": str(len(rows)),
        "failed": str(sum(row["error"] is not None for row in rows)),
    }
    described = [
        pa.field(name, kinds[one.kind], metadata={k: v for k, v in (("about", one.about), ("unit", one.unit)) if v})
        for name, one in row_columns(options.unknowns_on(bench)).items()
    ]
    table = pa.Table.from_pylist(list(rows), pa.schema(described, metadata=about))
    if ending == ".parquet":
        parquet.write_table(table, path)
        return
    for number, column in enumerate(table.schema):
        if pa.types.is_list(column.type):
            table = table.set_column(number, column.name, compute.binary_join(table[number], "; "))
        if pa.types.is_string(table.schema[number].type):
            table = table.set_column(number, column.name, text_cells(table[number]))
    csv.write_csv(table, path)
