"""Fails unless a log of the compiled core and one of its sources hold the same simulated run: ``same_run.py A B``."""

from __future__ import annotations

import sys

import numpy as np

from emb_bench.logs.log import RunLog, read_log


def complaint(compiled: str, plain: str) -> str | None:
    """Names the first difference; None if there is none."""
    one, other = read_log(compiled), read_log(plain)
    cores = one.run["core"], other.run["core"]
    if not (cores[0].startswith("compiled") and cores[1].startswith("Python")):
        return f"expected a log of the compiled core and one of its sources, got {cores}"
    if [frame._replace(time_ns=0) for frame in one.frames] != [frame._replace(time_ns=0) for frame in other.frames]:
        return "the frames differ"
    if [event[1:] for event in one.events] != [event[1:] for event in other.events]:
        return "the events differ"
    return next((f"/cycle {name} differs" for name in one.cycles if _bits(one, name) != _bits(other, name)), None)


def _bits(log: RunLog, name: str) -> bytes:
    """A column; times from the first one on, for the two runs began at different times."""
    column = log.cycles[name]
    if name.endswith(("time_ns", "_time")):
        column = np.where(column == 0, 0, column - column[0])
    return column.tobytes()


if __name__ == "__main__":
    sys.exit(complaint(*sys.argv[1:]))
