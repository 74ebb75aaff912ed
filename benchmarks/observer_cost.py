"""The price of declaring an observer on a bench whose velocity is measured: the ratio of the intervals of ``estimate``.

    python benchmarks/observer_cost.py [--brakes 400] [--bandwidth 1520] [--workers 2]

Each random brake within ±50 % (plant ``exact``) is run twice with the shipped actor, on a bench with a sensor and on
one that declares an observer, and each log is estimated as its bench says: the shield keeps more distance, and the
analysis counts the angle alone. A row has the ratio of the repeatability with and without the observer, the median of
the pairs and the ratio of the medians, with 95 % bootstrap intervals.
"""

from __future__ import annotations

import argparse
import re
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from emb_bench import api
from emb_bench.config.bench import load_bench
from emb_runtime.config.bench import PARAMETER_NAMES, shipped_bench_text

RESAMPLES = 4000


def bench_texts(bandwidth: float) -> tuple[str, str]:
    """Texts of the shipped bench file with a sensor of the velocity, and with an observer of a bandwidth [rad/s]."""
    sensor = re.sub(r"^\[sensors\](\n|.)*?(?=^\[)", "", shipped_bench_text(), flags=re.MULTILINE)
    declared = f'[sensors]\nvelocity = "observer"\nobserver_bandwidth = {bandwidth!r}\n\n'
    return sensor, sensor.replace("[timing]", declared + "[timing]", 1)


def repeatabilities(seed: int, bandwidth: float) -> list[list[float]] | str:
    """Repeatability of each parameter as a share of it, with a sensor and with an observer; else why there is none."""
    factors = np.random.default_rng(seed).uniform(0.5, 1.5, len(PARAMETER_NAMES))
    nominal = load_bench().brake
    true = {name: float(getattr(nominal, name) * f) for name, f in zip(PARAMETER_NAMES, factors, strict=True)}
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for i, text in enumerate(bench_texts(bandwidth)):
            bench, log = Path(folder) / f"{i}.toml", Path(folder) / f"{i}.mcap"
            bench.write_text(text, encoding="utf-8")
            run = api.simulate(log, parameters=true, seed=seed, bench=bench)
            if run.exit_reason != "DONE":
                return run.exit_reason
            study = api.estimate(log, bench=bench)
            found.append([one.repeatability / abs(one.value) for one in study.conclusions][: len(PARAMETER_NAMES)])
    return found


def main() -> None:
    """Print a row for each parameter."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--brakes", type=int, default=400)
    p.add_argument("--first", type=int, default=381000, help="seed of the first brake (default: %(default)s)")
    p.add_argument("--bandwidth", type=float, default=1520.0, help="declared [rad/s] (default: %(default)s)")
    p.add_argument("--workers", type=int, default=2)
    a = p.parse_args()
    seeds = range(a.first, a.first + a.brakes)
    with ProcessPoolExecutor(a.workers, mp_context=get_context("spawn")) as pool:
        results = list(pool.map(partial(repeatabilities, bandwidth=a.bandwidth), seeds))
    pairs = np.array([r for r in results if not isinstance(r, str)])
    ended = sorted({r for r in results if isinstance(r, str)})
    print(f"{len(pairs)} of {a.brakes} brakes with both runs done" + (f"; others ended {ended}" if ended else ""))
    rows = np.random.default_rng(0).integers(0, len(pairs), (RESAMPLES, len(pairs)))
    for i, name in enumerate(PARAMETER_NAMES):
        sensor, observer = pairs[:, 0, i], pairs[:, 1, i]
        for what, value, drawn in (
            ("median of pairs", np.median(observer / sensor), np.median((observer / sensor)[rows], axis=1)),
            (
                "ratio of medians",
                np.median(observer) / np.median(sensor),
                np.median(observer[rows], axis=1) / np.median(sensor[rows], axis=1),
            ),
        ):
            low, high = np.quantile(drawn, (0.025, 0.975))
            print(f"{name} {what:17} {value:.3f} ({low:.3f} to {high:.3f})", flush=True)


if __name__ == "__main__":
    main()
