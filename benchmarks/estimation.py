"""Is output error as good as its bound, are its intervals true, and does it notice a brake outside its model?

    python benchmarks/estimation.py [--draws 1000] [--wrong 40] [--starts 6]

A brake that is solved exactly, with more viscous friction than the nominal one at which each search begins, is driven
by three excitations: the shipped actor through ``emb-run`` on the simulated bus, a chirp under the shield, and the
D-optimal design for this very brake. What acted is replayed with many draws of the sensors' noise.

First table, for each parameter: variance of the estimate over the Cramér-Rao bound with its 95 % confidence interval,
bias in standard deviations, and how often the 95 % interval covers the truth. Second table: how often model validation
raises the alarm on the same currents and other brakes, estimated as the exact one. Last, the time of one estimate.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats

from emb_bench.brake.motion import Floats
from emb_bench.config.bench import Bench, load_bench
from emb_bench.design.problem import make_problem
from emb_bench.design.search import search
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.records import STARTS
from emb_bench.excitation.reference import parse_excitation, run_excitation
from emb_bench.experiment.experiment import Experiment
from emb_bench.experiment.from_log import read_experiment
from emb_bench.information.criteria import criterion
from emb_bench.information.fisher import fisher
from emb_bench.logs.log import read_log
from emb_bench.sim.instruments import MEMORY, measure, settle
from emb_bench.sim.open_loop import simulate
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import EXIT_DONE

F_V = 3e-5  # True f_v of the brake, nominal 2.16e-5 [N·m·s/rad]
AT_REST = 50  # Samples before the experiment
CHUNK = 25
RATIO, BIAS, COVER, ALARM, FALSE = (0.88, 1.15), 0.1, (0.93, 0.97), 0.95, 0.05  # Limits to be met


class Job(NamedTuple):
    """Some draws."""

    plant: str
    currents: Floats
    seeds: range


class Drawn(NamedTuple):
    """Result of one draw."""

    values: Floats
    intervals: Floats
    alarm: bool
    ratio: float


def brake_of(bench: Bench) -> BrakeParameters:
    """The true brake."""
    return bench.brake._replace(f_v=F_V)


def drawn(bench: Bench, name: str, currents: Floats, states: Floats, seed: int) -> Experiment:
    """One draw of what a plant's instruments show of a motion."""
    rng, instruments, t_s = np.random.default_rng(seed), bench.plant(name).instruments, bench.timing.sample_time
    errors = rng.standard_normal((len(currents), 2)) * [bench.noise.angle, bench.noise.velocity]
    late = instruments.clock_jitter * rng.standard_normal(len(currents))
    slack = bench.noise.angle / AT_REST**0.5
    seen = instruments.encoder_offset + slack * float(rng.standard_normal())
    memory = np.zeros(MEMORY)
    settle(instruments, memory, 0.0)
    accelerations = np.diff(states[:, 1]) / t_s
    samples = np.empty((len(currents), 2))
    rows = zip(states[1:].tolist(), accelerations.tolist(), late.tolist(), errors.tolist(), strict=True)
    for k, ((x1, x2), acceleration, tau, (e1, e2)) in enumerate(rows):
        samples[k] = measure(instruments, memory, t_s, x1, x2, acceleration, tau, e1, e2)
    return Experiment(f"draw {seed}", currents, samples, seen, 0.0, slack, abs(seen) <= 4.0 * slack)


def work(job: Job) -> list[Drawn]:
    """Estimate with the exact model from some draws."""
    bench = load_bench()
    mechanics, t_s = bench.plant(job.plant).mechanics, bench.timing.sample_time
    states = simulate(mechanics, brake_of(bench), job.currents, t_s).states
    found = []
    for seed in job.seeds:
        record = drawn(bench, job.plant, job.currents, states, seed)
        e = method_of("oem")(bench, bench.plant("exact"), starts=1).fit([record])
        found.append(Drawn(e.values, e.intervals(), not e.validation.fits, e.validation.ratio))
    return found


def excitations(bench: Bench, starts: int) -> dict[str, Floats]:
    """Currents that acted in each of them."""
    brake, plant = brake_of(bench), bench.plant("exact")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "actor.mcap"
        with contextlib.redirect_stdout(io.StringIO()):
            code = emb_run(["--iface", f"sim:plant=exact,f_v={F_V}", "--log", str(path)])
        assert code == EXIT_DONE, code
        actor = read_experiment(read_log(path)).currents
    chirp = run_excitation(bench, parse_excitation("chirp", bench), plant.mechanics, brake, shielded=True).currents
    goal = criterion("D", PARAMETER_NAMES)
    best = search(make_problem(bench, goal, PARAMETER_NAMES, brake=brake), starts=starts, seed=0).best
    return {"shipped actor": actor, "chirp": chirp, "D-optimal": best.currents}


def verdict(met: bool) -> str:
    """A mark behind a number."""
    return "met" if met else "MISSED"


def matched(bench: Bench, name: str, currents: Floats, found: list[Drawn]) -> None:
    """Print the rows of one excitation."""
    brake, n = brake_of(bench), len(found)
    true = np.array([getattr(brake, p) for p in PARAMETER_NAMES])
    plant = bench.plant("exact")
    bounds = fisher(bench, brake, currents, kind="physical", plant=plant).cramer_rao()
    errors = (np.array([d.values for d in found]) / true - 1.0) / list(bounds.values())
    ratios, biases = errors.var(axis=0, ddof=1), errors.mean(axis=0)
    high, low = (n - 1) / stats.chi2.ppf([0.025, 0.975], n - 1)
    covers = np.mean([(d.intervals[:, 0] <= true) & (true <= d.intervals[:, 1]) for d in found], axis=0)
    for i, parameter in enumerate(PARAMETER_NAMES):
        ok = RATIO[0] <= ratios[i] <= RATIO[1] and abs(biases[i]) < BIAS and COVER[0] <= covers[i] <= COVER[1]
        print(
            f"{name if i == 0 else '':15}{parameter:10}{100.0 * bounds[parameter]:11.3g} %"
            f"{ratios[i]:9.3f} [{low * ratios[i]:.3f}, {high * ratios[i]:.3f}]{biases[i]:+10.3f}"
            f"{100.0 * covers[i]:11.1f} %  {verdict(ok)}"
        )
    false = float(np.mean([d.alarm for d in found]))
    worst = max(d.ratio for d in found)
    print(f"{'':15}false alarms {100.0 * false:.1f} % ({verdict(false <= FALSE)}), largest chi2/n {worst:.2f}")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="output error against its bound, and against brakes it does not know")
    parser.add_argument("--draws", type=int, default=1000, help="of the noise, on the brake that is the model's")
    parser.add_argument("--wrong", type=int, default=40, help="of the noise, on each other brake")
    parser.add_argument("--starts", type=int, default=6, help="coarse searches of the optimal design")
    args = parser.parse_args()
    bench = load_bench()
    sequences = excitations(bench, args.starts)
    jobs = {
        (name, "exact"): [Job("exact", u, range(s, min(s + CHUNK, args.draws))) for s in range(0, args.draws, CHUNK)]
        for name, u in sequences.items()
    }
    others = [plant for plant in bench.plants if plant != "exact"]
    jobs |= {(name, other): [Job(other, u, range(args.wrong))] for other in others for name, u in sequences.items()}
    with ProcessPoolExecutor(os.cpu_count(), mp_context=get_context("spawn")) as pool:
        futures = {key: [pool.submit(work, job) for job in chunks] for key, chunks in jobs.items()}
        found = {key: [one for f in chunks for one in f.result()] for key, chunks in futures.items()}

    print(f"{args.draws} draws on the exact brake, f_v = {F_V:g}, each search from the nominal brake")
    print(f"{'excitation':15}{'parameter':10}{'bound':>13}{'variance over bound':>25}{'bias/sigma':>12}{'covered':>12}")
    for name, currents in sequences.items():
        matched(bench, name, currents, found[name, "exact"])
    print(f"\nalarms in {args.wrong} draws on other brakes, estimated as the exact one, and median chi2/n")
    print(f"{'plant':12}" + "".join(f"{name:>26}" for name in sequences))
    for other in others:
        rates = {name: float(np.mean([d.alarm for d in found[name, other]])) for name in sequences}
        ratios = {name: float(np.median([d.ratio for d in found[name, other]])) for name in sequences}
        cells = "".join(f"{100.0 * rates[name]:12.0f} %{ratios[name]:12.4g}" for name in sequences)
        print(f"{other:12}{cells}  {verdict(min(rates.values()) >= ALARM)}")

    plant, times = bench.plant("exact"), []
    for seed in range(11):
        currents = sequences["shipped actor"]
        states = simulate(plant.mechanics, brake_of(bench), currents, bench.timing.sample_time).states
        record = drawn(bench, "exact", currents, states, seed)
        begun = time.perf_counter()
        method_of("oem")(bench, plant).fit([record])
        times.append(time.perf_counter() - begun)
    median = 1e3 * float(np.median(times))
    print(f"\none estimate of 4 parameters from 500 samples, {STARTS} starts: median {median:.0f} ms")


if __name__ == "__main__":
    main()
