"""The environment of a process whose libraries calculate on one thread."""

from __future__ import annotations

from collections.abc import Mapping

ONE_THREAD: Mapping[str, str] = {
    f"{library}_NUM_THREADS": "1" for library in ("NUMBA", "OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
}
"""Threads of its own would only get into the way of others, and the order of a sum, and with it the last digit, would
depend on their number."""
