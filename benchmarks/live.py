"""Cost of ``emb-run --live`` for the loop: periods missed and times of a cycle, with and without it, in turns.

    python benchmarks/live.py [--seconds 5] [--turns 3]

As benchmarks/cycle.py: ``emb-run`` as it is at 1 kHz on a pair of local sockets. With ``--live`` a viewer, which is a
process of its own, subscribes to every topic and counts. Exit code 0 if the viewers got every message, no turn with a
viewer missed more periods than the worst without, and the medians differ by at most a tenth.
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.cycle import run_once
from emb_runtime.errors import EXIT_CHECK_FAILED, EXIT_DONE
from emb_runtime.system import compiled_core

MOST_MORE = 1.1  # Limit of the median with a viewer over that without
PATIENCE = 60.0  # Longest wait of a viewer for the server [s]


class Turn(NamedTuple):
    """One run."""

    missed: int
    median: float  # Of the time from the pair in hand to the command sent [s]
    tail: float  # 99.9 % of them [s]
    served: int | None  # Messages that the viewer got; None without one
    messages: int  # In the log


def main() -> int:
    """Measure and print; gives the exit code."""
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--seconds", type=float, default=5.0, metavar="S", help="of each run (default: %(default)g)")
    p.add_argument("--turns", type=int, default=3, metavar="N", help="runs of each kind (default: %(default)d)")
    p.add_argument("--viewer", type=int, metavar="PORT", help=argparse.SUPPRESS)
    args = p.parse_args()
    if args.viewer is not None:
        print(_received(args.viewer))
        return EXIT_DONE
    print(f"core: {compiled_core.running().text}")
    print(f"{'':10}{'missed':>8}{'median':>12}{'99.9 %':>12}{'served':>10}{'in the log':>12}")
    turns: dict[bool, list[Turn]] = {False: [], True: []}
    for _ in range(args.turns):
        for live in turns:
            turn = _turn(round(args.seconds * 1000), live)
            turns[live].append(turn)
            print(
                f"{'live' if live else 'alone':10}{turn.missed:8d}{1e6 * turn.median:9.1f} us{1e6 * turn.tail:9.1f} us"
                f"{'-' if turn.served is None else turn.served:>10}{turn.messages:12d}",
                flush=True,
            )
    ratio = float(np.median([t.median for t in turns[True]]) / np.median([t.median for t in turns[False]]))
    print(f"median with a viewer over that without: {ratio:.3f}")
    met = (
        all(t.served == t.messages for t in turns[True])
        and max(t.missed for t in turns[True]) <= max(t.missed for t in turns[False])
        and ratio <= MOST_MORE
    )
    return EXIT_DONE if met else EXIT_CHECK_FAILED


def _turn(samples: int, live: bool) -> Turn:
    if not live:
        run = run_once(samples)
        return Turn(run.missed, *_quantiles(run.work), None, run.messages)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, __file__, "--viewer", str(port)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as viewer:
        run = run_once(samples, options=("--live", str(port)))
        served = int(viewer.communicate(timeout=PATIENCE)[0])
    return Turn(run.missed, *_quantiles(run.work), served, run.messages)


def _quantiles(work: np.ndarray) -> tuple[float, float]:
    median, tail = np.percentile(work, (50.0, 99.9))
    return float(median), float(tail)


def _received(port: int) -> int:
    """Messages that a viewer of the Foxglove WebSocket protocol gets until the server ends."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            viewer = connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None)  # type: ignore[list-item]
            break
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)
    count = 0
    with viewer:
        while True:
            try:
                said = viewer.recv(PATIENCE)
            except ConnectionClosed:
                return count
            if isinstance(said, bytes):
                count += said[0] == 1
            elif (document := json.loads(said)).get("op") == "advertise":
                new = [{"id": channel["id"], "channelId": channel["id"]} for channel in document["channels"]]
                viewer.send(json.dumps({"op": "subscribe", "subscriptions": new}))


if __name__ == "__main__":
    sys.exit(main())
