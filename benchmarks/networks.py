"""Time that networks take in ONNX Runtime as the runtime opens them, in turns.

    python benchmarks/networks.py FIRST.onnx [OTHER.onnx ...] [--turns 60]

For each file its operators, the least and the median time of a run over the turns [us], and both over those of the
first. Another process on the computer makes the median longer, and the least hardly.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import onnx

from emb_runtime.policy.policy import open_session

RUNS = 300  # In a turn
TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}


def main() -> None:
    """Print a line for each file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--turns", type=int, default=60)
    arguments = parser.parse_args()
    sessions = [open_session(path.read_bytes()) for path in arguments.files]
    ports = [session.get_inputs()[0] for session in sessions]
    seen = [{port.name: np.zeros(port.shape, TYPES[port.type])} for port in ports]
    times = np.zeros((arguments.turns, len(sessions)))
    for turn in times:
        for i, (session, inputs) in enumerate(zip(sessions, seen, strict=True)):
            begin = time.perf_counter()
            for _ in range(RUNS):
                session.run(None, inputs)
            turn[i] = 1e6 * (time.perf_counter() - begin) / RUNS
    least, median = times.min(axis=0), np.median(times, axis=0)
    for i, path in enumerate(arguments.files):
        operators = len(onnx.load(path).graph.node)
        print(
            f"{path}: {operators} operators, {least[i]:.2f} and {median[i]:.2f} us, "
            f"{least[i] / least[0]:.2f} and {median[i] / median[0]:.2f} of the first"
        )


if __name__ == "__main__":
    main()
