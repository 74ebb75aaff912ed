"""Remakes ``recording.csv`` beside it: ``python -m examples.recording``, in a clone.

It is what another test bench could have written: 1.5 s of a brake under random currents, by a simulator that shares no
code with the estimators.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.independent_simulator import Brake, simulate
from emb_bench.config.bench import load_bench

TRUTH = Brake(k_m=0.0245, k_1=19.8, t_c=0.0118, f_v=2.6e-5, inertia=4.624e-6, gamma=1.889e-5)
"""The brake of the recording, SI units."""


def main() -> None:
    """Write the file."""
    bench = load_bench(None)
    bench = replace(bench, timing=replace(bench.timing, horizon=1500))
    x = simulate(TRUTH, bench, np.random.default_rng(1), "recording")
    motion = np.degrees(np.vstack([[0.0, 0.0], x.samples[:-1]]))
    lines = ["Shaft position and motor current, rig 4", "time_ms;pos_deg;speed_deg_s;i_set_A"]
    rows = zip(motion.tolist(), x.currents.tolist(), strict=True)
    lines += [f"{k};{angle:.3f};{speed:.1f};{current:.3f}" for k, ((angle, speed), current) in enumerate(rows)]
    Path(__file__).with_suffix(".csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
