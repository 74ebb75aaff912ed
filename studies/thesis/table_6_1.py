"""The bench of Table 6.1, whose brakes the shipped bench's shield does not cover: k_1 is 25 to 50 N/rad."""

from __future__ import annotations

import re

from emb_runtime.config.bench import shipped_bench_text

CHANGES = (
    (r'^name = ".*"', 'name = "drum brake, Guo 2024, Table 6.1"'),
    (r"^k_1 += [0-9.e+-]+", "k_1   = 3.75e1 "),  # the middle of the range: the nominal 23.04 lies outside
    (r'^ranges +(= "envelope" +)#', 'ranges        = "viscous-stiffness" #'),
    (r'^ranges (= "pm50" +)#', 'ranges = "viscous-stiffness" #'),
)
"""Lines of the shipped bench file, each there once, and what takes their place."""


def bench_text() -> str:
    """The shipped bench file with shield and estimator for Table 6.1; the nominal k_1 is the middle of its range."""
    text = shipped_bench_text()
    for line, changed in CHANGES:
        text, count = re.subn(line, changed, text, flags=re.MULTILINE)
        assert count == 1, line
    return text
