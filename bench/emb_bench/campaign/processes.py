"""A campaign in processes of this machine.

Each process has one log at a time. So one that dies, out of memory or in a fault of compiled code, costs its own log
and no other, and it is known which; another process takes its place. ``concurrent.futures`` would call all logs in
flight broken. A process whose campaign is gone, however it ended, reads the end of its pipe and ends as well.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from typing import Any, cast

from emb_bench.campaign.evaluate import OUT_OF_TIME, limited_to
from emb_bench.campaign.row import Row, Source, failed

Evaluate = Callable[[Source], Row]
"""A function that another process can import; a ``functools.partial`` of one as well."""

ONE_THREAD: Mapping[str, str] = {
    f"{library}_NUM_THREADS": "1" for library in ("NUMBA", "OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
}
"""Environment of a process that evaluates: threads of its own would only get into the others' way, and the order of a
sum, and with it the last digit, would depend on their number."""

# Compiled code is not safe after a fork, and some of it has threads of its own.
_SPAWN = multiprocessing.get_context("spawn")


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
    waiting = iter(enumerate(sources))
    workers: set[_Worker] = set()
    busy: dict[Any, tuple[_Worker, int]] = {}

    def go_on(worker: _Worker | None) -> None:
        """Give the next log to a worker, or to a new one."""
        if (job := next(waiting, None)) is not None:
            if worker is None:
                workers.add(worker := _Worker(evaluate, time_limit))
            worker.give(job[1])
            busy[worker.pipe] = worker, job[0]

    try:
        for _ in range(jobs):
            go_on(None)
        while busy:
            for pipe in connection.wait(list(busy)):
                worker, number = busy.pop(pipe)
                row = worker.take(sources[number])
                if not worker.alive:
                    workers.remove(worker)
                    worker.end()
                go_on(worker if worker.alive else None)
                yield number, row
    finally:
        for worker in workers:
            worker.end()


class _Worker:
    """A process that evaluates."""

    def __init__(self, evaluate: Evaluate, time_limit: float) -> None:
        self.pipe, theirs = _SPAWN.Pipe()
        self.alive = True
        self._begun = time.monotonic()
        self._limit = time_limit
        self._process = _SPAWN.Process(target=_work, args=(theirs, evaluate, time_limit), daemon=True)
        with _unreached_by_ctrl_c(), _environment(ONE_THREAD):
            self._process.start()
        theirs.close()

    def give(self, source: Source) -> None:
        """Begin with a log."""
        self._begun = time.monotonic()
        with suppress(OSError):  # that nobody is there any more shows when the row is taken
            self.pipe.send(source)

    def take(self, source: Source) -> Row:
        """The row that is there, or the one of a log whose process is no longer."""
        try:
            return cast("Row", self.pipe.recv())
        except (EOFError, OSError):
            self.alive = False
        self._process.join()
        code = self._process.exitcode or 0
        if code == OUT_OF_TIME and time.monotonic() - self._begun >= self._limit:
            return failed(source, f"{source.path}: not evaluated within {self._limit:g} s")
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return failed(source, f"{source.path}: the process that evaluated it {how}")

    def end(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _work(pipe: Connection, evaluate: Evaluate, time_limit: float) -> None:
    """What a process does: it evaluates what it is given until nobody gives it anything."""
    with suppress(EOFError, OSError):
        while True:
            source = pipe.recv()
            with limited_to(time_limit):
                row = evaluate(source)
            pipe.send(row)


@contextmanager
def _unreached_by_ctrl_c() -> Iterator[None]:
    """What is started inside never gets a Ctrl-C, which is for the campaign; here one comes a little later."""
    resource_tracker.ensure_running()  # started along with the first process, it would end the blocking
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _environment(variables: Mapping[str, str]) -> Iterator[None]:
    """The environment that processes started inside inherit."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
