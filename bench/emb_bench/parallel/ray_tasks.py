"""Work shared out to the tasks of Ray, on this machine or on a cluster, in place of processes."""

from __future__ import annotations

import logging
import os
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Generator, Sequence
from typing import Any, TypeVar

from emb_bench.parallel.processes import Lost
from emb_bench.parallel.threads import ONE_THREAD
from emb_runtime.errors import UsageError

LOCAL = "local"  # Address that stands for a Ray started here, on this machine
_PATIENCE = 5.0  # s
_AGAIN = 1  # a machine of a cluster may be lost; a piece that ends its process may do so twice

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def shared_out_on_ray(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int | None, address: str, command: str
) -> Generator[tuple[int, Result | Lost], None, None]:
    """Do pieces of work, as many at a time as there are ``jobs``.

    Args:
        work: what is done with a piece. It raises nothing.
        pieces: they travel to the tasks, and the results back.
        jobs: tasks at a time; None is one for each processor.
        address: of a cluster's head, or ``LOCAL``.
        command: that needs Ray, for the message if it is not installed.

    Yields:
        Each piece's number and result, as they come; of a piece whose task was lost, Ray's name for that.

    Raises:
        UsageError: Ray is not installed, does not start, or is not at this address.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # else Ray reports to its makers that it is used
    try:
        import ray
    except ImportError as err:
        raise UsageError(f"{command} --ray needs ray: pip install 'emb-excite[ray]'") from err
    # The path of a socket may have 107 characters, and Ray's lie deep inside its folder.
    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp") if address == LOCAL else None
    own: dict[str, Any] = {"num_cpus": jobs, "include_dashboard": False, "_temp_dir": folder} if folder else {}
    environment = {"env_vars": dict(ONE_THREAD)}
    try:
        try:
            _knock(address)
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR, runtime_env=environment, **own)
        except (OSError, OverflowError, RuntimeError, ValueError) as err:
            raise UsageError(f"--ray: Ray at '{address}' cannot be used: {err}") from err
        yield from _done(ray, work, pieces, jobs)
    finally:
        ray.shutdown()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _knock(address: str) -> None:
    """Raise OSError if nobody answers at ``[ray://]HOST:PORT``: Ray itself would try for minutes."""
    host, _, port = address.rpartition("/")[2].rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _PATIENCE).close()


def _done(
    ray: Any, work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int | None
) -> Generator[tuple[int, Result | Lost], None, None]:
    task = ray.remote(lambda piece: work(piece)).options(max_retries=_AGAIN)
    most = jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))
    waiting, running = iter(enumerate(pieces)), dict[Any, tuple[int, float]]()
    while True:
        while len(running) < most and (job := next(waiting, None)) is not None:
            running[task.remote(job[1])] = job[0], time.monotonic()
        if not running:
            return
        ready, _ = ray.wait(list(running))
        for reference in ready:
            number, begun = running.pop(reference)
            try:
                yield number, ray.get(reference)
            except ray.exceptions.RayError as err:
                yield number, Lost(f"was lost ({type(err).__name__})", 1, time.monotonic() - begun)
