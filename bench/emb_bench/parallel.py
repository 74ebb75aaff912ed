"""Work shared out to processes of this machine or to Ray.

A process that dies, out of memory or in a fault of compiled code, costs its own piece of work and no other:
``concurrent.futures`` calls all pieces in flight broken then, pebble does not.
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
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import chdir, contextmanager, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from emb_bench import ONE_THREAD
from emb_runtime.errors import UsageError, needs

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

    The work raises nothing; it is a function that another process can import, or a ``functools.partial`` of one. A
    process that takes longer than the limit [s] is ended. Closed or interrupted, all are ended at once.
    """
    from pebble import ProcessPool

    limit = None if math.isinf(time_limit) else time_limit
    numbers: dict[Future[Any], int] = {}
    pool: Any = ProcessPool(min(jobs, len(pieces)) or 1, context=_SPAWN)  # its types do not say all
    try:
        with _environment():
            with _deaf():
                for number, piece in enumerate(pieces):
                    numbers[pool.schedule(work, args=[piece], timeout=limit)] = number
            for future in as_completed(numbers):
                yield numbers[future], _result(future, time_limit)
    finally:
        pool.stop()
        pool.join()


def processors() -> int:
    """Number of processors that this process may use, which taskset, a batch system or a container limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def processes() -> Iterator[Executor]:
    """Processes for many small pieces of work, as many as processors: deaf to Ctrl-C, ended with the context.

    Each of them has one thread for each library.
    """
    pool = ProcessPoolExecutor(processors(), mp_context=_SPAWN)
    try:
        with _environment(), _deaf():
            pool.submit(os.getpid).result()  # which begins all of them
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _result(future: Future[Any], time_limit: float) -> Any:
    from pebble import ProcessExpired

    try:
        return future.result()
    except TimeoutError:
        return Lost(f"not evaluated within {time_limit:g} s")
    except ProcessExpired as err:
        code = err.exitcode or 0
        how = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        return Lost(f"the process that evaluated it {how}")


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
