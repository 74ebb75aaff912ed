"""Work shared out to processes of this machine.

Each process has one piece of work at a time. So one that dies, out of memory or in a fault of compiled code, costs its
own piece and no other, and it is known which; another process takes its place. ``concurrent.futures`` would call all
pieces in flight broken, and would finish them before it answers a Ctrl-C. A process that nobody waits for any more,
whatever has happened, reads the end of its pipe and ends as well.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, TypeVar

from emb_bench.parallel.threads import ONE_THREAD
from emb_runtime.errors import EmbError

# Compiled code is not safe after a fork, and some of it has threads of its own.
_SPAWN = multiprocessing.get_context("spawn")

Piece = TypeVar("Piece")
Result = TypeVar("Result")


class Lost(NamedTuple):
    """Record of a piece of work whose process ended before the work was done."""

    how: str  # Manner of the process's end, in words that follow its name
    exit_code: int  # Of the process; a signal's number, negative
    seconds: float  # Time for which it had the piece [s]


def shared_out(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int
) -> Generator[tuple[int, Result | Lost], None, None]:
    """Do pieces of work, as many at a time as there are ``jobs``. Closed or interrupted, it ends its processes at once.

    Args:
        work: what is done with a piece: a function that another process can import, or a ``functools.partial`` of one.
        pieces: they travel to the processes, and the results back.
        jobs: processes.

    Yields:
        Each piece's number and result, as they come.

    Raises:
        EmbError: the work has raised it.
    """
    waiting = iter(enumerate(pieces))
    workers: set[_Worker] = set()
    busy: dict[Any, tuple[_Worker, int]] = {}

    def go_on(worker: _Worker | None) -> None:
        """Give the next piece to a worker, or to a new one."""
        if (piece := next(waiting, None)) is not None:
            if worker is None:
                workers.add(worker := _Worker(work))
            worker.give(piece[1])
            busy[worker.pipe] = worker, piece[0]

    try:
        for _ in range(jobs):
            go_on(None)
        while busy:
            for pipe in connection.wait(list(busy)):
                worker, number = busy.pop(pipe)
                result = worker.take()
                if not worker.alive:
                    workers.remove(worker)
                    worker.end()
                go_on(worker if worker.alive else None)
                yield number, result
    finally:
        for worker in workers:
            worker.end()


class _Worker:
    """A process that works."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self.pipe, theirs = _SPAWN.Pipe()
        self.alive = True
        self._begun = time.monotonic()
        self._process = _SPAWN.Process(target=_work, args=(theirs, work), daemon=True)
        if sys.platform != "win32":
            resource_tracker.ensure_running()  # started along with the first process, it would end the waiting
        with _start_settings():
            self._process.start()
        theirs.close()

    def give(self, piece: Any) -> None:
        """Begin with a piece."""
        self._begun = time.monotonic()
        with suppress(OSError):  # a process that has ended is noticed when the result is taken
            self.pipe.send(piece)

    def take(self) -> Any:
        """The result that has arrived, or :class:`Lost` if the process has ended; raises the error of the work."""
        try:
            result, error = self.pipe.recv()
        except (EOFError, OSError):
            self.alive = False
        else:
            if error is not None:
                raise error
            return result
        seconds = time.monotonic() - self._begun
        self._process.join()
        code = self._process.exitcode or 0
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return Lost(how, code, seconds)

    def end(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _work(pipe: Connection, work: Callable[[Any], Any]) -> None:
    """Main function of a process: works on each piece it receives, until its pipe is closed."""
    with suppress(EOFError, OSError):
        while True:
            piece = pipe.recv()
            result, error = None, None
            try:
                result = work(piece)
            except EmbError as err:
                error = err
            pipe.send((result, error))


@contextmanager
def _start_settings() -> Iterator[None]:
    """Start processes inside with one thread for each library, and without SIGINT, which is for the command alone."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT]) if hasattr(signal, "pthread_sigmask") else None
    try:
        yield
    finally:
        if mask is not None:  # it is not on Windows
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
