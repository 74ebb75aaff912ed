"""Work distributed over processes of this machine or over Ray.

A process that dies, out of memory or in a fault of compiled code, costs its own piece of work and no other: each has a
pipe of its own and one piece at a time, so that it is known which one that was, whenever the process died.
"""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import shutil
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import chdir, contextmanager, suppress
from itertools import islice
from multiprocessing import connection, resource_tracker
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from emb_bench import ONE_THREAD
from emb_runtime.errors import UsageError, needs

LOCAL = "local"  # Address that stands for a Ray started here, on this machine

_SPAWN = multiprocessing.get_context("spawn")  # Compiled code is not safe after a fork, and some of it has threads
_PATIENCE = 5.0  # Time for a cluster to answer, and for a process whose pipe has ended to end [s]
_RETRIES = 1  # Of a Ray task: a machine of a cluster may be lost; a piece that ends its process may do so twice

_NONE = object()  # No answer yet

Piece = TypeVar("Piece")
Result = TypeVar("Result")


class Lost(NamedTuple):
    """A piece of work that was not done, and why, in words that follow its name."""

    why: str


def shared_out(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int, time_limit: float
) -> Generator[tuple[int, Result | Lost], None, None]:
    """Each piece's number and result, as they come, with at most ``jobs`` processes at work.

    The work raises nothing; it is a function that another process can import, or a ``functools.partial`` of one. A
    process that takes longer than the limit [s] is ended. Closed or interrupted, all are ended at once.
    """
    waiting = enumerate(pieces)
    most = min(jobs, 60) if os.name == "nt" else jobs  # Windows waits for 63 pipes at most
    busy: list[_Worker] = []
    try:
        for number, piece in islice(waiting, most):
            busy.append(_Worker(work, time_limit))
            busy[-1].begin(number, piece)
        while busy:
            left = min(worker.end for worker in busy) - time.monotonic()
            connection.wait([worker.pipe for worker in busy], None if math.isinf(left) else max(0.0, left))
            for worker in list(busy):
                if (found := worker.answer()) is _NONE:
                    continue
                number, job = worker.number, next(waiting, None)
                if job is None:
                    worker.close()
                    busy.remove(worker)
                else:
                    worker.begin(*job)
                yield number, found
    finally:
        for worker in busy:
            worker.close()


class _Worker:
    """A process that does one piece of work after another; in place of one that has ended, a new one."""

    def __init__(self, work: Callable[[Any], object], time_limit: float) -> None:
        self._work, self._time_limit = work, time_limit
        self._process: Any = None

    def begin(self, number: int, piece: object) -> None:
        """Hand a piece over; its time begins when the process has it."""
        if self._process is None:
            self.pipe, other = _SPAWN.Pipe()
            self._process = _SPAWN.Process(target=_serve, args=(self._work, other), daemon=True)
            with _environment(), _deaf():
                self._process.start()
            other.close()  # so that the end of the process is the end of the pipe
        self.number, self.end, self._begun = number, math.inf, False
        with suppress(OSError):  # of a process that has died: the pipe ends
            self.pipe.send(piece)

    def answer(self) -> Any:
        """The result of the piece, or why there will be none; ``_NONE`` while neither is there."""
        if not self.pipe.poll():
            if time.monotonic() < self.end:
                return _NONE
            self.close()
            return Lost(f"not evaluated within {self._time_limit:g} s")
        try:
            sent = self.pipe.recv()
        except (EOFError, OSError):
            self._process.join(_PATIENCE)
            code = self.close()
            how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
            return Lost(f"the process that evaluated it {how}")
        if self._begun:
            return sent
        self._begun, self.end = True, time.monotonic() + self._time_limit
        return _NONE

    def close(self) -> int:
        """End the process at once; its exit code."""
        process, self._process = self._process, None
        if process is None:
            return 0
        process.kill()
        process.join()
        self.pipe.close()
        return int(process.exitcode)


def _serve(work: Callable[[Any], object], pipe: Any) -> None:
    """Do what comes through a pipe, until nothing more does."""
    with suppress(EOFError):
        while True:
            piece = pipe.recv()
            pipe.send(None)
            pipe.send(work(piece))


def processors() -> int:
    """Number of processors that this process may use, which taskset, a batch system or a container limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def processes() -> Iterator[Executor]:
    """Processes for many small pieces of work, as many as processors: deaf to Ctrl-C, ended with the context.

    Each of them has one thread for each library, and ends if this process is killed.
    """
    pool = ProcessPoolExecutor(processors(), mp_context=_SPAWN, initializer=_end_with_parent)
    try:
        with _environment(), _deaf():
            for begun in [pool.submit(os.getpid) for _ in range(processors())]:  # each begins one while none is idle
                begun.result()
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _end_with_parent() -> None:
    """Let a process of a pool end with its parent: the pool's pipes do not, as its other processes hold them open.

    Nor would ``emb_runtime.system.child_process.end_with``: its signal is Linux's, and comes when the thread ends that
    began the process.
    """

    def wait(sentinel: int) -> None:
        connection.wait([sentinel])
        os._exit(1)

    if (parent := multiprocessing.parent_process()) is not None:
        threading.Thread(target=wait, args=(parent.sentinel,), daemon=True).start()


@contextmanager
def _deaf() -> Iterator[None]:
    """Have threads and processes that start inside hear no Ctrl-C, from their first line on: who waits for them does.

    They inherit the mask. The tracker of shared memory would take it off again, were it not there before.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _environment() -> Iterator[None]:
    """Give processes that start inside one thread for each library, and no modules of the working directory."""
    own = {**ONE_THREAD, "PYTHONSAFEPATH": "1"}
    before = {name: os.environ.get(name) for name in own}
    os.environ.update(own)
    try:
        yield
    finally:
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
    with needs("--ray", "ray"):
        import ray
    # The path of a socket may have 107 characters, and Ray's lie deep inside its folder.
    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp") if address == LOCAL else None
    own: dict[str, Any] = {"num_cpus": jobs, "include_dashboard": False, "_temp_dir": folder} if folder else {}
    environment = {"env_vars": dict(ONE_THREAD)}
    try:
        try:
            _require_answer(address)
            with chdir("/"), _deaf():  # Ray has its processes import from the folder in which it is started
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
    folder = Path.cwd()

    def there(piece: Piece) -> Result:
        with suppress(OSError):  # another machine may have no such folder
            os.chdir(folder)
        return work(piece)

    task = ray.remote(there).options(max_retries=_RETRIES)
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
