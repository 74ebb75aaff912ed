"""Work shared out to processes of this machine or to Ray.

Each process has one piece of work at a time: one that dies, out of memory or in a fault of compiled code, costs its own
piece and no other. ``concurrent.futures`` calls all pieces in flight broken then, and finishes them before it answers a
Ctrl-C. A process whose parent has died reads the end of its pipe and ends as well.
"""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from typing import Any, NamedTuple, TypeVar

from emb_bench import ONE_THREAD
from emb_runtime.errors import UsageError

LOCAL = "local"  # Address that stands for a Ray started here, on this machine

_SPAWN = multiprocessing.get_context("spawn")  # Compiled code is not safe after a fork, and some of it has threads
_PATIENCE = 5.0  # Time for a cluster to answer [s]
_RETRIES = 1  # Of a Ray task: a machine of a cluster may be lost; a piece that ends its process may do so twice

Piece = TypeVar("Piece")
Result = TypeVar("Result")


class Lost(NamedTuple):
    """A piece of work that was not done, and why, in words that follow its name."""

    why: str


def shared_out(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int, time_limit: float
) -> Generator[tuple[int, Result | Lost], None, None]:
    """Each piece's number and result, as they come, with at most ``jobs`` processes at work.

    The work raises nothing and returns something; it is a function that another process can import, or a
    ``functools.partial`` of one. A process that takes longer than the limit [s] is ended. Closed or interrupted, all
    are ended at once.
    """
    waiting, busy = iter(enumerate(pieces)), dict[Any, tuple[_Worker, int]]()

    def give_next(worker: _Worker | None) -> None:
        if (piece := next(waiting, None)) is not None:
            worker = worker or _Worker(work)
            busy[worker.pipe] = worker, piece[0]
            worker.give(piece[1])
        elif worker is not None:
            worker.end()

    try:
        for _ in range(jobs):
            give_next(None)
        while busy:
            left = min(worker.begun for worker, _ in busy.values()) + time_limit - time.monotonic()
            ready = connection.wait(list(busy), None if math.isinf(left) else max(left, 0.0))
            for pipe, (worker, number) in [*busy.items()]:
                result: Any = None
                if pipe in ready:
                    result = worker.take()
                elif time.monotonic() >= worker.begun + time_limit:
                    result = Lost(f"not evaluated within {time_limit:g} s")
                if result is not None:
                    del busy[pipe]
                    if isinstance(result, Lost):
                        worker.end()
                    give_next(None if isinstance(result, Lost) else worker)
                    yield number, result
    finally:
        for worker, _ in busy.values():
            worker.end()


class _Worker:
    """A process that works on one piece at a time."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        self.pipe, theirs = _SPAWN.Pipe()
        self.begun = math.inf  # Monotonic time since which it works on its piece [s]
        self._process = _SPAWN.Process(target=_work, args=(theirs, work), daemon=True)
        if sys.platform != "win32":
            resource_tracker.ensure_running()  # started along with the first process, it would end the waiting
        with _start_settings():
            self._process.start()
        theirs.close()

    def give(self, piece: Any) -> None:
        self.begun = math.inf
        with suppress(OSError):  # a process that has ended is noticed when the result is taken
            self.pipe.send(piece)

    def take(self) -> Any:
        """The result that has arrived, or None where the work on it begins; :class:`Lost` if the process has ended."""
        try:
            result = self.pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            code = self._process.exitcode or 0
            how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            return Lost(f"the process that evaluated it {how}")
        if result is None:
            self.begun = time.monotonic()
        return result

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
            pipe.send(None)  # it begins
            pipe.send(work(piece))


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
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def shared_out_on_ray(
    work: Callable[[Piece], Result],
    pieces: Sequence[Piece],
    jobs: int | None,
    time_limit: float,
    address: str,
) -> Generator[tuple[int, Result | Lost], None, None]:
    """Each piece's number and result, as they come, of tasks of Ray at an address, or of one started here (``LOCAL``).

    The work raises nothing. A task that takes longer than the limit [s] is ended.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # else Ray reports to its makers that it is used
    try:
        import ray
    except ImportError as err:
        raise UsageError("--ray needs ray: pip install 'emb-excite[ray]'") from err
    # The path of a socket may have 107 characters, and Ray's lie deep inside its folder.
    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp") if address == LOCAL else None
    own: dict[str, Any] = {"num_cpus": jobs, "include_dashboard": False, "_temp_dir": folder} if folder else {}
    environment = {"env_vars": dict(ONE_THREAD)}
    try:
        try:
            _require_answer(address)
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, runtime_env=environment, **own)
        except (OSError, OverflowError, RuntimeError, ValueError) as err:
            raise UsageError(f"--ray: Ray at '{address}' cannot be used: {err}") from err
        yield from _run_tasks(ray, work, pieces, jobs, time_limit)
    finally:
        ray.shutdown()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _require_answer(address: str) -> None:
    """Raise OSError if nobody answers at ``[ray://]HOST:PORT``: Ray itself would try for minutes."""
    host, _, port = address.rpartition("/")[2].rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _PATIENCE).close()


def _run_tasks(
    ray: Any, work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int | None, time_limit: float
) -> Generator[tuple[int, Result | Lost], None, None]:
    task = ray.remote(lambda piece: work(piece)).options(max_retries=_RETRIES)
    most = jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))
    waiting, running = iter(enumerate(pieces)), dict[Any, tuple[int, float]]()
    while True:
        while len(running) < most and (job := next(waiting, None)) is not None:
            running[task.remote(job[1])] = job[0], time.monotonic() + time_limit
        if not running:
            return
        ready, _ = ray.wait(list(running), timeout=max(0.0, min(end for _, end in running.values()) - time.monotonic()))
        late = [one for one, (_, end) in running.items() if one not in ready and time.monotonic() >= end]
        for reference in late:
            ray.cancel(reference, force=True)
            yield running.pop(reference)[0], Lost(f"not evaluated within {time_limit:g} s")
        for reference in ready:
            number, _ = running.pop(reference)
            try:
                yield number, ray.get(reference)
            except ray.exceptions.RayError as err:
                yield number, Lost(f"the process that evaluated it was lost ({type(err).__name__})")
