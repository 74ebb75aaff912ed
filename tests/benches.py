"""The shipped bench with a sensor of the velocity: it declares no observer."""

from __future__ import annotations

import re

from emb_bench.config.bench import parse_bench
from emb_runtime.config.bench import shipped_bench_text


def measured(text: str) -> str:
    """The text of a bench file without ``[sensors]``: its velocity is measured."""
    return re.sub(r"^\[sensors\].*?(?=^\[)", "", text, flags=re.DOTALL | re.MULTILINE)


SENSOR_TEXT = measured(shipped_bench_text())
SENSOR_BENCH = parse_bench(SENSOR_TEXT, "the shipped bench file without [sensors]")
