"""The same campaign on Ray: one task for each log, on this machine or on a cluster.

A log is opened where its task runs: on a cluster, all machines have to have the logs at the same paths, and emb-excite
installed.
"""

from __future__ import annotations

import logging
import os
import shutil
import socket
import tempfile
from collections.abc import Generator, Sequence
from typing import Any

from emb_bench.campaign.evaluate import limited_to
from emb_bench.campaign.processes import Evaluate
from emb_bench.campaign.row import Row, Source, failed
from emb_bench.workers import ONE_THREAD
from emb_runtime.errors import UsageError

LOCAL = "local"
"""The address of a Ray of one's own, on this machine."""
_PATIENCE = 5.0  # s
_AGAIN = 1  # a machine of a cluster may be lost; a log that ends its process may do so twice


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
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"  # else it tells its makers that it is used
    try:
        import ray
    except ImportError as err:
        raise UsageError("emb-replay campaign --ray needs ray: pip install 'emb-excite[ray]'") from err
    # The path of a socket may have 107 characters, and Ray's lie deep inside its folder.
    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp") if address == LOCAL else None
    try:
        _start(ray, address, jobs, folder)
        yield from _evaluated(ray, evaluate, sources, jobs, time_limit)
    finally:
        ray.shutdown()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _start(ray: Any, address: str, jobs: int | None, folder: str | None) -> None:
    own: dict[str, Any] = {"num_cpus": jobs, "include_dashboard": False, "_temp_dir": folder} if folder else {}
    try:
        _knock(address)
        ray.init(
            address,
            log_to_driver=False,
            logging_level=logging.ERROR,
            runtime_env={"env_vars": dict(ONE_THREAD)},
            **own,
        )
    except (OSError, OverflowError, RuntimeError, ValueError) as err:
        raise UsageError(f"--ray: Ray at '{address}' cannot be used: {err}") from err


def _knock(address: str) -> None:
    """Raise OSError if nobody answers at ``[ray://]HOST:PORT``: Ray itself would try for minutes."""
    host, _, port = address.rpartition("/")[2].rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _PATIENCE).close()


def _evaluated(
    ray: Any, evaluate: Evaluate, sources: Sequence[Source], jobs: int | None, time_limit: float
) -> Generator[tuple[int, Row], None, None]:
    def in_time(source: Source) -> Row:
        with limited_to(time_limit):
            return evaluate(source)

    task = ray.remote(in_time).options(max_retries=_AGAIN)
    most = jobs or max(1, int(ray.cluster_resources().get("CPU", 1)))
    waiting, running = iter(enumerate(sources)), dict[Any, int]()
    while True:
        while len(running) < most and (job := next(waiting, None)) is not None:
            running[task.remote(job[1])] = job[0]
        if not running:
            return
        ready, _ = ray.wait(list(running))
        for reference in ready:
            number = running.pop(reference)
            path = sources[number].path
            try:
                row = ray.get(reference)
            except ray.exceptions.RayError as err:
                why = f"{type(err).__name__}; out of memory, a fault, or longer than {time_limit:g} s"
                row = failed(sources[number], f"{path}: the process that evaluated it ended ({why})")
            yield number, row
