"""A campaign in processes of this machine: one that dies, or takes too long, costs its own log and no other."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from functools import partial

from emb_bench.batch.evaluate import OUT_OF_TIME, limited_to
from emb_bench.batch.row import Row, Source, failed
from emb_bench.parallel.processes import Lost, shared_out

Evaluate = Callable[[Source], Row]
"""A function that another process can import; a ``functools.partial`` of one as well."""


def in_processes(
    evaluate: Evaluate, sources: Sequence[Source], jobs: int, time_limit: float
) -> Generator[tuple[int, Row], None, None]:
    """Evaluate logs, as many at a time as there are ``jobs``.

    Args:
        evaluate: what makes a row of a log.
        sources: the logs.
        jobs: processes.
        time_limit: longest time for one log [s].

    Yields:
        Each log's number and row, as they come.
    """
    with closing(shared_out(partial(_in_time, evaluate, time_limit), sources, jobs)) as rows:
        for number, row in rows:
            yield number, _failed(sources[number], row, time_limit) if isinstance(row, Lost) else row


def _in_time(evaluate: Evaluate, time_limit: float, source: Source) -> Row:
    with limited_to(time_limit):
        return evaluate(source)


def _failed(source: Source, lost: Lost, time_limit: float) -> Row:
    if lost.exit_code == OUT_OF_TIME and lost.seconds >= time_limit:
        return failed(source, f"{source.path}: not evaluated within {time_limit:g} s")
    return failed(source, f"{source.path}: the process that evaluated it {lost.how}")
