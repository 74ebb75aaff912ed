"""One run: its log, topics, pictures and exports, its rerun and its timing."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from weakref import WeakKeyDictionary, finalize

from numpy.typing import NDArray

from emb_bench.analysis.options import ExportOptions, FitOptions
from emb_bench.api.arguments import AnyRun, listed, opened, options_of
from emb_bench.figures import for_notebook
from emb_bench.logs.log import RunLog, read_log
from emb_runtime.errors import near, needs

if TYPE_CHECKING:  # matplotlib and pyarrow come with the extra [bench]
    from matplotlib.axes import Axes
    from pyarrow import Table

    from emb_bench.report.runs import RunTiming
    from emb_bench.rerun import Rerun

CYCLE = "/cycle"


class Run(RunLog):
    """An opened log, with what a notebook shows of it."""

    def __getitem__(self, topic: str) -> Mapping[str, Any]:
        """Columns of a topic as arrays, by name."""
        return self.tables[topic]

    def __getattr__(self, column: str) -> NDArray[Any]:
        """A column of the control cycles: ``run.angle``, ``run.sent_current``."""
        columns = {} if column.startswith("_") or CYCLE not in self.topics else self.tables[CYCLE]
        if column in columns:
            return columns[column]
        raise AttributeError(f"a run has no {column!r}, and no such column in {CYCLE}{near(column, columns)}")

    def __add__(self, other: Run) -> list[Run]:
        """Runs of one brake, to be taken together: ``estimate(first + second)``."""
        return [self, other]

    def __radd__(self, others: list[Run]) -> list[Run]:
        """One run more."""
        return [*others, self]

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy in another process reads the file again; a temporary one stays for it."""
        if (deletion := _TEMPORARY.pop(self, None)) is not None:
            deletion.detach()
        return open_run, (self.path,)

    def to_dataframe(self, name: str = CYCLE) -> Any:
        """One topic as a pandas frame, see :func:`topic`.

        Raises:
            UsageError: the run has no such topic, or pyarrow or pandas is missing.
            LogError: the topic cannot be decoded.
        """
        with needs("a frame", "notebook"):
            import pandas  # noqa: F401

            return topic(self, name).to_pandas()

    def plot(self) -> Any:
        """A figure of matplotlib, see :func:`draw`.

        Raises:
            UsageError: matplotlib is missing.
            LogError: the run has no control cycles.
        """
        figure, axes = for_notebook(5, (8.0, 9.5), sharex=True)
        draw(self, axes)
        return figure


_TEMPORARY: WeakKeyDictionary[Run, finalize[..., Run]] = WeakKeyDictionary()
"""Deletions of temporary logs, by their runs."""


def delete_with(run: Run, folder: Path) -> None:
    """Delete the folder of a temporary log when its run is not used any more."""
    _TEMPORARY[run] = finalize(run, shutil.rmtree, folder, ignore_errors=True)


def open_run(log: str | Path) -> Run:
    """Open a log.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is not a log, or too damaged.
    """
    opened = read_log(log)
    return Run(**{field.name: getattr(opened, field.name) for field in fields(RunLog)})


def topics(run: AnyRun) -> dict[str, int]:
    """Names of the topics of a run, each with its number of messages."""
    return opened(run).counts


def topic(run: AnyRun, name: str) -> Table:
    """One topic of a run as an Arrow table; enumerated values are names, a value that does not exist is null.

    ``.to_pandas()`` makes a pandas frame of it, ``polars.from_arrow(...)`` one of polars, ``.column(name).to_numpy()``
    an array. ``run.counts`` has the names; ``run.tables[name]`` the plain columns without any further library.

    Args:
        run: the run.
        name: of the topic: ``/cycle``, ``/estimate``, ``/emb/EMB_ANGLE``, ...

    Raises:
        UsageError: the run has no such topic, or pyarrow is missing.
        LogError: the topic cannot be decoded.
    """
    from emb_bench.export.export import arrow_batches

    schema, tables = arrow_batches(opened(run), name)
    import pyarrow as pa

    parts = list(tables)
    return cast("Table", pa.concat_tables(parts) if parts else schema.empty_table())


def draw(run: AnyRun, axes: Sequence[Axes]) -> None:
    """Draw a run on five axes of matplotlib: angle, velocity, currents, why currents were changed, states.

    Args:
        run: the run.
        axes: five, one above the other: ``plt.subplots(5, sharex=True)[1]``.

    Raises:
        UsageError: there are not five.
        LogError: the run has no control cycles.
    """
    from emb_bench.export.picture import draw_on

    draw_on(opened(run), axes)


def export(run: AnyRun, output: str | Path, options: ExportOptions | None = None, **more: Any) -> str:
    """A part of a run for another tool: a picture, one topic as a table with units, or the identified brake as a model.

    Models are an FMU (FMI 3.0, co-simulation), C source, a calibration file (DCM 2.0) and MJCF of MuJoCo. Their
    parameters are those of the estimate, which has to fit, each with its 95 % interval. The frames on the bus go to
    BLF, ASC and others by can_logconvert RUN FILE.

    Args:
        run: MCAP file of emb-run; for a model with a map, a recording of others.
        output: file to write: a picture (.png, .svg, .pdf), a table (.csv, .parquet) or a model (.fmu, .c, .dcm, .xml)
            by its ending.
        options: a record of options.
        more: its fields as keywords: ``export(run, "rows.csv", topic="/safety")``.

    Returns:
        A description of what the file holds.

    Raises:
        UsageError: an argument is wrong, a library is missing, or the file cannot be written.
        LogError: the topic cannot be decoded, or the run has no control cycles.
        CheckFailedError: the model of the estimate does not fit, or a parameter is not identified.
    """
    from emb_bench.api.estimates import estimate
    from emb_bench.export.export import write

    settings = options_of("export", ExportOptions, options, more)
    log = opened(run, settings.map)
    of_fit = {one.name: getattr(settings, one.name) for one in fields(FitOptions)}
    return write(log, Path(output), settings, lambda: estimate(log, **of_fit))


def rerun(run: AnyRun) -> Rerun:
    """Run the loop again from the log of a run, and compare what it decides.

    The core of the control loop runs again with the policy, bench file and DBC of the log. It gets the recorded inputs:
    the frames of each read, and the calls in ``/input``. Each decision (policy, clip, shield, sent current, its
    reason), each estimate, each sent frame, each safety event with its time and text, and the outcome must be the same,
    numbers to the last bit. A cut log is compared up to its end. Rounding may differ with another ONNX Runtime, numpy,
    Python or processor. If a decision differs, the versions of the log are printed too.

    Args:
        run: MCAP file of emb-run.

    Returns:
        The differences, and how much was compared.

    Raises:
        UsageError: the run only listened.
        LogError: the log has no ``/input``, does not begin with its run, or carries no policy.
        PolicyError: the policy in the log is refused.
    """
    from emb_bench.rerun import rerun_as_recorded

    return rerun_as_recorded(opened(run))


def info(run: AnyRun) -> dict[str, Any]:
    """Summary of a run: end, counts, largest values, completeness.

    Args:
        run: MCAP file of emb-run.

    Raises:
        UsageError: the file cannot be read.
        LogError: it is not a log, or too damaged.
    """
    from emb_bench.logs.info import info_document

    return info_document(opened(run))


def timing(runs: AnyRun | Sequence[AnyRun]) -> list[RunTiming]:
    """Timing of runs, compared with the budgets of their bench.

    How long each part of a control cycle took, by the time stamps in the log: sample to sample, sample to loop,
    decision, sending, sensor to command, and the time remaining before the answer would have been late. The times are
    compared with [budgets] of the bench file in the log. Simulated time gets no verdict.

    Args:
        runs: MCAP files of emb-run.

    Raises:
        UsageError: a file cannot be read.
        LogError: a log has no control cycles.
    """
    from emb_bench.report.runs import run_timing

    return [run_timing(opened(run)) for run in listed(runs)]
