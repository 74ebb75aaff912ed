"""A campaign: many logs, each evaluated on its own, a file of rows, a summary, and a figure."""

from __future__ import annotations

import sys
import time
from collections.abc import Generator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path

from emb_bench.batch.distribute import in_processes, on_ray
from emb_bench.batch.evaluate import evaluate_one
from emb_bench.batch.find import find
from emb_bench.batch.row import ENDINGS as ROWS
from emb_bench.batch.row import Options, Row, write_rows
from emb_bench.batch.summary import Campaign, mark_copies, summarise
from emb_bench.figures import ENDINGS, require_place
from emb_bench.output import Progress, replacing, say_if_compiling
from emb_runtime.errors import UsageError
from emb_runtime.system.realtime import processors


def run_campaign(
    paths: Sequence[Path],
    output: Path,
    options: Options,
    *,
    jobs: int | None,
    time_limit: float,
    ray: str | None,
    plot: Path | None,
) -> Campaign:
    """Evaluate logs, and write their rows and the figure.

    Args:
        paths: logs and folders.
        output: file of rows.
        options: of the evaluation.
        jobs: logs at a time; None is one for each processor.
        time_limit: longest time for one log [s].
        ray: address of a Ray cluster; None for processes of this machine.
        plot: figure to write.

    Raises:
        UsageError: there is no log, a library is missing, or a file cannot be written.
    """
    require_place("--output", output, ROWS)
    require_place("--plot", plot, ENDINGS)
    try:
        import numba  # noqa: F401
        import pyarrow  # noqa: F401
        import scipy  # noqa: F401
    except ImportError as err:
        raise UsageError(f"a campaign needs {err.name}: pip install 'emb-excite[bench]'") from err
    sources, evaluate = find(paths), partial(evaluate_one, options=options)
    say_if_compiling()
    with replacing(output) as beside:
        if ray is None:
            numbered = in_processes(evaluate, sources, jobs or len(processors()), time_limit)
        else:
            numbered = on_ray(evaluate, sources, jobs, time_limit, ray)
        rows = mark_copies(_in_order(len(sources), numbered))
        write_rows(beside, output.suffix, rows, options)
    found = summarise(rows, options, str(output))
    if plot is not None:
        from emb_bench.batch.figure import draw

        draw(found, plot)
    return found


def _in_order(count: int, numbered: Generator[tuple[int, Row], None, None]) -> list[Row]:
    """All rows in the order of the logs; reports each as it comes."""
    progress, rows = Progress(sys.stderr, count, time.monotonic), dict[int, Row]()
    try:
        with closing(numbered):  # processes end here, whatever happens
            for number, row in numbered:
                rows[number] = row
                progress.took(row.error)
    finally:
        progress.end()
    return [rows[number] for number in range(count)]
