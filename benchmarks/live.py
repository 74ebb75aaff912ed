"""Cost of ``emb-run --live`` for the loop: periods missed and times of a cycle, with and without it, in turns.

    python benchmarks/live.py [--seconds 5] [--turns 3]

As benchmarks/cycle.py: ``emb-run`` as it is at 1 kHz on a pair of local sockets. With ``--live`` a viewer, which is a
process of its own, subscribes to every topic, takes what the page of a browser takes, and counts. Exit code 0 if it got
every message and every sample, no turn with a viewer missed more periods than the worst without, and the loop takes at
most 1.05 times the processor time.
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from websockets.sync.client import ClientConnection, connect

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.cycle import run_once
from emb_bench.live.page import SUBPROTOCOL
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE
from emb_runtime.system import compiled_core

MOST_MORE = 1.05  # Limit of the loop's processor time with a viewer over that without
PATIENCE = 60.0  # Longest wait of a viewer for the server [s]


class Turn(NamedTuple):
    """One run."""

    missed: int
    median: float  # Of the time from the pair in hand to the command sent [s]
    tail: float  # 99.9 % of them [s]
    busy: float  # Processor time of the loop for a sample [s]
    served: list[int] | None  # Messages that the viewer got, samples that the page got; None without one
    messages: int  # In the log


def main() -> int:
    """Measure and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--seconds", type=float, default=5.0, metavar="S", help="of each run (default: %(default)g)")
    p.add_argument("--turns", type=int, default=3, metavar="N", help="runs of each kind (default: %(default)d)")
    p.add_argument("--viewer", type=int, metavar="PORT", help=argparse.SUPPRESS)
    args = p.parse_args()
    if args.viewer is not None:
        with ThreadPoolExecutor() as threads:
            print(json.dumps(list(threads.map(lambda count: count(args.viewer), (_messages, _samples)))))
        return EXIT_DONE
    print(f"core: {compiled_core.running().text}")
    print(f"{'':10}{'missed':>8}{'median':>12}{'99.9 %':>12}{'processor':>12}{'served':>16}{'in the log':>12}")
    turns: dict[bool, list[Turn]] = {False: [], True: []}
    for _ in range(args.turns):
        for live in turns:
            turn = _turn(round(args.seconds * 1000), live)
            turns[live].append(turn)
            print(
                f"{'live' if live else 'alone':10}{turn.missed:8d}{1e6 * turn.median:9.1f} us{1e6 * turn.tail:9.1f} us"
                f"{1e6 * turn.busy:9.1f} us{'-' if turn.served is None else str(turn.served):>16}{turn.messages:12d}",
                flush=True,
            )
    ratio = float(np.median([t.busy for t in turns[True]]) / np.median([t.busy for t in turns[False]]))
    every = all(t.served == [t.messages, round(args.seconds * 1000) + 1] for t in turns[True])
    print(
        "| `emb-run --live` with a viewer of every topic and a page: processor time of the loop over that without; "
        f"messages and samples served | {MOST_MORE}; all | {ratio:.2f}; {'all' if every else 'not all, **not met**'} |"
    )
    met = every and max(t.missed for t in turns[True]) <= max(t.missed for t in turns[False]) and ratio <= MOST_MORE
    return EXIT_DONE if met else EXIT_CHECK_FAILED


def _turn(samples: int, live: bool) -> Turn:
    if not live:
        run = run_once(samples)
        return Turn(run.missed, *_quantiles(run.work), run.busy, None, run.messages)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, __file__, "--viewer", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewer:
        run = run_once(samples, options=("--live", str(port)))
        served = json.loads(viewer.communicate(timeout=PATIENCE)[0])
    return Turn(run.missed, *_quantiles(run.work), run.busy, served, run.messages)


def _quantiles(work: np.ndarray) -> tuple[float, float]:
    median, tail = np.percentile(work, (50.0, 99.9))
    return float(median), float(tail)


def _connected(port: int, protocol: Any) -> ClientConnection:
    """A connection, once there is a server."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, legacy=True)
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


def _messages(port: int) -> int:
    """Messages that a viewer of the Foxglove WebSocket protocol gets until the server ends."""
    count = 0
    with _connected(port, "foxglove.sdk.v1") as viewer:
        for text in viewer:
            if isinstance(text, bytes):
                count += text[0] == 1
            elif (document := json.loads(text)).get("op") == "advertise":
                new = [{"id": channel["id"], "channelId": channel["id"]} for channel in document["channels"]]
                viewer.send(json.dumps({"op": "subscribe", "subscriptions": new}))
    return count


def _samples(port: int) -> int:
    """Samples that the page of a browser gets until the server ends."""
    with _connected(port, SUBPROTOCOL) as page:
        return sum(len(json.loads(text).get("cycles", ())) for text in page)


if __name__ == "__main__":
    sys.exit(main())
