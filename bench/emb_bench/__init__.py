"""The brake: its physics, its Fisher information, the simulated CAN node, and the reading of logs."""

from __future__ import annotations

from collections.abc import Mapping

ONE_THREAD: Mapping[str, str] = {
    f"{library}_NUM_THREADS": "1" for library in ("NUMBA", "OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
}
"""Environment of a process whose libraries calculate on one thread: the last digit of a sum depends on their number."""


def __getattr__(name: str) -> str:
    if name == "__version__":  # read on demand: commands have no use for it
        from importlib import metadata

        return metadata.version("emb-excite")
    raise AttributeError(f"module 'emb_bench' has no attribute '{name}'")
