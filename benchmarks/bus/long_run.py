"""Bench with a longer experiment and longer timeouts, and an actor for it, for the benchmarks of the runtime."""

from __future__ import annotations

from pathlib import Path

from emb_runtime.config.bench import Bench, parse_bench, shipped_bench_text
from emb_runtime.policy.policy import shipped_actor_path

PATIENCE = {
    "soft_missed  = 5 ": "soft_missed  = 100 ",
    "stop_missed  = 20 ": "stop_missed  = 400 ",
    "rejected     = 5 ": "rejected     = 50 ",
    "start_timeout = 5.0": "start_timeout = 60.0",
    "heartbeat    = 0.005": "heartbeat    = 0.4",
    "watchdog         = 0.010": "watchdog         = 0.4",
}
"""A shared computer may be taken away for 100 ms at any moment; what is measured are the cycles that it was not."""


def long_bench(samples: int) -> Bench:
    """The shipped bench with an experiment of so many samples and longer time-outs.

    Raises:
        ValueError: the shipped bench file reads otherwise than this module expects.
    """
    text = shipped_bench_text()
    for old, new in {"horizon     = 500 ": f"horizon     = {samples} ", **PATIENCE}.items():
        if old not in text:
            raise ValueError(f"expected '{old}' in the shipped bench.toml")
        text = text.replace(old, new)
    return parse_bench(text, "benchmark")


def write_both(folder: Path, samples: int, actor: Path | None = None) -> tuple[Path, Path]:
    """``bench.toml`` and ``actor.onnx``, the shipped one or another, in a folder; gives their paths."""
    bench = long_bench(samples)
    paths = folder / "bench.toml", folder / "actor.onnx"
    paths[0].write_text(bench.text)
    paths[1].write_bytes((actor or shipped_actor_path()).read_bytes())
    return paths
