"""The four methods of estimation on the same records: who is right, and whose intervals are true?

    python benchmarks/estimators.py [--draws 60] [--ensembles 12]

A brake that is solved exactly, with more viscous friction than the nominal one at which each search begins, follows a
chirp under the shield. Once nothing disturbs it, once a random walk of its velocity does (white torque), of which no
bench file states. For each method: root mean square error of each parameter over the Cramér-Rao bound of the brake that
nothing disturbs, how often the 95 % intervals cover the truth, how often model validation raises the alarm, and the
median time of one estimate.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from emb_bench.brake.motion import Floats
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.records import METHODS, EstimationProblem, Record
from emb_bench.excitation.reference import parse_excitation, run_excitation
from emb_bench.information.fisher import fisher
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters, load_bench
from tests.bench.measurements import disturbed

F_V = 3e-5  # True f_v of the brake, nominal 2.16e-5 [N·m·s/rad]
WALKS = (0.0, 10.0)
"""Standard deviation of the velocity's random walk after one second [rad/s]: 10 is 0.3 rad/s after one sample."""
FINE = 10  # Steps of the walk per sample
AT_REST = 50  # Samples before the experiment


class Job(NamedTuple):
    """One method on some draws."""

    method: str
    walk: float
    currents: Floats
    seeds: range


class Drawn(NamedTuple):
    """Result of one draw."""

    errors: Floats  # Relative
    covered: NDArray[np.bool_]
    alarm: bool
    seconds: float


def brake_of(bench: Bench) -> BrakeParameters:
    """The true brake."""
    return bench.brake._replace(f_v=F_V)


def drawn(bench: Bench, currents: Floats, walk: float, seed: int) -> Record:
    """Samples of a brake with a disturbance."""
    slack = bench.noise.angle / AT_REST**0.5
    angle = slack * float(np.random.default_rng((seed, 1)).standard_normal())
    record = disturbed(bench, currents, brake_of(bench), seed, walk, FINE)
    return replace(record, name=f"draw {seed}", angle=angle, slack=slack)


def work(job: Job) -> list[Drawn]:
    """Estimate with one method from some draws."""
    bench = load_bench()
    true = np.array([getattr(brake_of(bench), name) for name in PARAMETER_NAMES])
    found = []
    run_method(
        job.method, bench, bench.plant("exact"), [drawn(bench, job.currents, 0.0, 0)], EstimationProblem(), starts=1
    )
    for seed in job.seeds:
        record = drawn(bench, job.currents, job.walk, seed)
        begun = time.perf_counter()
        e = run_method(job.method, bench, bench.plant("exact"), [record], EstimationProblem(), starts=2, seed=seed)
        seconds, intervals = time.perf_counter() - begun, e.intervals()
        covered = (intervals[:, 0] <= true) & (true <= intervals[:, 1])
        found.append(Drawn(e.values / true - 1.0, covered, not e.validation.fits, seconds))
    return found


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="the methods of estimation on the same records")
    parser.add_argument("--draws", type=int, default=60, help="of the noise, and of what disturbs")
    parser.add_argument("--ensembles", type=int, default=12, help="of these draws that the ensemble gets: it is slow")
    args = parser.parse_args()
    bench = load_bench()
    brake, plant = brake_of(bench), bench.plant("exact")
    chirp = parse_excitation("chirp", bench)
    currents = run_excitation(bench, chirp, plant.mechanics, brake, shielded=True).currents
    bounds = fisher(bench, brake, currents, kind="physical", normalise_by="true", plant=plant).cramer_rao()
    jobs = [
        Job(method, walk, currents, range(args.ensembles if method == "ensemble" else args.draws))
        for walk in WALKS
        for method in METHODS
        if method != "windows"  # for recordings that are longer
    ]
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        results = list(pool.map(work, jobs))
    print("bound        " + ", ".join(f"{name} {100.0 * bound:.3g} %" for name, bound in bounds.items()))
    columns = "".join(f"{name:>8}" for name in PARAMETER_NAMES)
    print(f"\n{'':33}{'error over bound':^32} {'covered [%]':^32}")
    print(f"{'disturbed by':14}{'method':12}{'draws':>7}{columns} {columns}{'alarm':>8}{'time':>10}")
    for job, found in zip(jobs, results, strict=True):
        errors = np.sqrt(np.mean([d.errors**2 for d in found], axis=0)) / list(bounds.values())
        covered = 100.0 * np.mean([d.covered for d in found], axis=0)
        alarms, seconds = float(np.mean([d.alarm for d in found])), float(np.median([d.seconds for d in found]))
        disturbance = f"{job.walk:g} rad/s" if job.walk else "nothing"
        print(
            f"{disturbance:14}{job.method:12}{len(found):7}"
            + "".join(f"{value:8.3g}" for value in errors)
            + " "
            + "".join(f"{value:8.0f}" for value in covered)
            + f"{100.0 * alarms:6.0f} %{seconds:8.2f} s"
        )


if __name__ == "__main__":
    main()
