"""Evaluation of a campaign on Ray: one task for each log, on this machine or on a cluster.

A log is opened where its task runs: on a cluster, all machines have to have the logs at the same paths, and emb-excite
installed.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

from emb_bench.batch.evaluate import limited_to
from emb_bench.batch.in_processes import Evaluate
from emb_bench.batch.row import Row, Source, failed
from emb_bench.parallel.processes import Lost
from emb_bench.parallel.ray_tasks import shared_out_on_ray


def on_ray(
    evaluate: Evaluate, sources: Sequence[Source], jobs: int | None, time_limit: float, address: str
) -> Generator[tuple[int, Row], None, None]:
    """Evaluate logs, as many at a time as there are ``jobs``.

    Args:
        evaluate: what makes a row of a log.
        sources: the logs.
        jobs: tasks at a time; None is one for each processor.
        time_limit: longest time for one log [s].
        address: of a cluster's head, or ``LOCAL``.

    Yields:
        Each log's number and row, as they come.

    Raises:
        UsageError: Ray is not installed, does not start, or is not at this address.
    """

    def in_time(source: Source) -> Row:
        with limited_to(time_limit):
            return evaluate(source)

    for number, row in shared_out_on_ray(in_time, sources, jobs, address, "emb-replay campaign"):
        if isinstance(row, Lost):
            why = f"it {row.how}: out of memory, a fault, or longer than {time_limit:g} s"
            row = failed(sources[number], f"{sources[number].path}: the process that evaluated it ended ({why})")
        yield number, row
