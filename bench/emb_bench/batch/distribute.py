"""A campaign shared out to processes or to Ray: one that dies, or takes too long, costs its own log and no other."""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from functools import partial

from emb_bench.batch.evaluate import OUT_OF_TIME, limited_to
from emb_bench.batch.row import Row, Source, failed
from emb_bench.parallel import Lost, shared_out, shared_out_on_ray

Evaluate = Callable[[Source], Row]  # A function that another process can import; a ``functools.partial`` of one as well


def in_processes(
    evaluate: Evaluate, sources: Sequence[Source], jobs: int, time_limit: float
) -> Generator[tuple[int, Row], None, None]:
    """Evaluates logs in processes of this machine.

    Args:
        evaluate: makes a row of a log.
        sources: the logs.
        jobs: processes at a time.
        time_limit: longest time for one log [s].

    Yields:
        Each log's number and row, as they come.
    """
    with closing(shared_out(partial(_in_time, evaluate, time_limit), sources, jobs)) as rows:
        for number, row in rows:
            yield number, _failed(sources[number], row, time_limit) if isinstance(row, Lost) else row


def on_ray(
    evaluate: Evaluate, sources: Sequence[Source], jobs: int | None, time_limit: float, address: str
) -> Generator[tuple[int, Row], None, None]:
    """Evaluates logs on Ray, one task for each; each is opened where its task runs, under the same path.

    Args:
        evaluate: makes a row of a log.
        sources: the logs.
        jobs: tasks at a time; None is one for each processor.
        time_limit: longest time for one log [s].
        address: of a cluster's head, or ``LOCAL``.

    Yields:
        Each log's number and row, as they come.

    Raises:
        UsageError: Ray is not installed, does not start, or is not at this address.
    """
    in_time = partial(_in_time, evaluate, time_limit)
    for number, row in shared_out_on_ray(in_time, sources, jobs, address, "emb-replay campaign"):
        if isinstance(row, Lost):
            why = f"it {row.how}: out of memory, a fault, or longer than {time_limit:g} s"
            row = failed(sources[number], f"{sources[number].path}: the process that evaluated it ended ({why})")
        yield number, row


def _in_time(evaluate: Evaluate, time_limit: float, source: Source) -> Row:
    with limited_to(time_limit):
        return evaluate(source)


def _failed(source: Source, lost: Lost, time_limit: float) -> Row:
    if lost.exit_code == OUT_OF_TIME and lost.seconds >= time_limit:
        return failed(source, f"{source.path}: not evaluated within {time_limit:g} s")
    return failed(source, f"{source.path}: the process that evaluated it {lost.how}")
