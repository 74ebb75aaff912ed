"""Small errors of the model: are they noticed, named, or at least inside the intervals?

    python benchmarks/near_misses.py [--draws 4] [--seed 1] [--method oem]

Half of the records are of the brake that the model describes, half of one with a small error of one of ``KINDS`` in one
of three sizes, all with random parameters within ±50 %, random excitations and the bench's noise, simulated by
``benchmarks.independent_simulator``. Reported are

- of the records that are said to be usable, the share with a parameter further off than 3 stated deviations;
- false alarms: right records that are said not to fit;
- of the misfits that are noticed, how often the suspect that is named first is the right one;
- the median width of the intervals over that of a perfectly known bench, for right records;

each with its 95 % interval.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import Brake, simulate
from benchmarks.intervals import share
from emb_bench.estimate.methods import run_method
from emb_bench.estimate.records import Estimate, EstimationProblem, Record, with_systematic
from emb_bench.information.identifiability import Spectrum
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, load_bench

FAR = 3.0  # Stated deviations beyond which a value that is said to be usable is wrong


class Kind(NamedTuple):
    """One small error of the model."""

    error: str  # Number of the simulated brake that is not as the model has it
    sizes: tuple[float, float, float]
    unit: str
    named: tuple[str, ...]  # Suspects that lead to the remedy
    params: tuple[str, ...] = PARAMETER_NAMES  # Parameters that are estimated


KINDS: Mapping[str, Kind] = {
    "encoder offset": Kind("encoder_offset", (0.002, 0.01, 0.05), "rad", ("offset", "contact")),
    "current offset": Kind("current_offset", (0.002, 0.01, 0.05), "A", ("current_offset",)),
    "delay": Kind("delay", (0.005, 0.03, 0.2), "samples", ("delay",)),
    "velocity gain": Kind("velocity_gain", (0.0005, 0.003, 0.02), "1", ("velocity_gain",)),
    "quadratic stiffness": Kind("quadratic", (3e-6, 1e-5, 1e-4), "1/rad", ("quadratic",)),
    "cubic stiffness": Kind("cubic", (3e-8, 3e-7, 3e-6), "1/rad²", ("cubic", "quadratic")),
    "play": Kind("play", (0.01, 0.05, 0.2), "rad", ("play", "hysteresis")),
    "Stribeck friction": Kind("stribeck", (0.003, 0.02, 0.1), "1", ("stribeck", "break_away")),
    "hysteresis": Kind("hysteresis", (0.0003, 0.002, 0.01), "1", ("hysteresis",)),
    "current lag": Kind("current_lag", (1e-5, 5e-5, 3e-4), "s", ("current_lag",)),
    "friction by direction": Kind("asymmetry", (0.001, 0.01, 0.05), "1", ("current_offset", "asymmetry")),
    "held stiffness": Kind("k_1", (1e-4, 1e-3, 1e-2), "1", ("k_1",), ("k_m", "T_c", "f_v")),
    "drift of k_m": Kind("k_m_drift", (0.0003, 0.003, 0.03), "1", ("k_m_drift",)),
    "drift of k_1": Kind("k_1_drift", (0.0003, 0.003, 0.03), "1", ("k_1_drift",)),
    "drift of T_c": Kind("t_c_drift", (0.003, 0.03, 0.1), "1", ("T_c_drift",)),
    "drift of f_v": Kind("f_v_drift", (0.003, 0.03, 0.1), "1", ("f_v_drift",)),
}


def draw(bench: Bench, kind: str | None, size: float, rng: np.random.Generator) -> Brake:
    """A random brake within ±50 %; ``kind`` and ``size`` say what is wrong with the model."""
    factors = rng.uniform(0.5, 1.5, 4)
    error = "" if kind is None else KINDS[kind].error
    if error in PARAMETER_NAMES:  # it is held at its nominal value
        factors[PARAMETER_NAMES.index(error)] = 1.0 + size
    p = bench.brake
    brake = Brake(p.k_m * factors[0], p.k_1 * factors[1], p.T_c * factors[2], p.f_v * factors[3], p.J, p.gamma)
    return Brake(**(vars(brake) | {error: size})) if error and error not in PARAMETER_NAMES else brake


class Outcome(NamedTuple):
    """Answer to one record beside the truth."""

    kind: str | None
    size: float
    fits: bool
    farthest: float  # Largest error of a parameter, in stated deviations
    covered: float  # Share of the parameters inside their 95 % intervals
    suspect: str
    wider: float  # Median stated deviation over the Cramér-Rao bound of the parameters alone
    seconds: float


def judge(bench: Bench, brake: Brake, record: Record, kind: str | None, size: float, method: str) -> Outcome:
    """Estimates, and compares what is said with what is true."""
    params = PARAMETER_NAMES if kind is None else KINDS[kind].params
    begun = time.perf_counter()
    e = estimated(bench, record, params, method)
    seconds = time.perf_counter() - begun
    true = {"k_m": brake.k_m, "k_1": brake.k_1, "T_c": brake.t_c, "f_v": brake.f_v}
    index = [i for i, u in enumerate(e.unknowns) if u.name in params]
    errors = np.array([e.values[i] / true[e.unknowns[i].name] - 1.0 for i in index])
    deviations, intervals = e.deviations()[index], e.intervals()[index]
    truths = np.array([true[e.unknowns[i].name] for i in index])
    covered = float(np.mean((intervals[:, 0] <= truths) & (truths <= intervals[:, 1])))
    alone = np.sqrt(np.diag(Spectrum(e.information[np.ix_(index, index)]).inverse()))  # inf where nothing is told
    suspects = e.validation.suspects
    farthest = float(np.max(np.abs(errors) / deviations))
    name = suspects[0].name if suspects else ""
    return Outcome(
        kind, size, e.validation.fits, farthest, covered, name, float(np.nanmedian(deviations / alone)), seconds
    )


def estimated(bench: Bench, record: Record, params: tuple[str, ...], method: str) -> Estimate:
    """The estimate as the command makes it."""
    plant = bench.plant("exact")
    return run_method(method, bench, plant, [record], with_systematic(EstimationProblem(params), bench, plant))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="small errors of the model: noticed, named, or inside the intervals?")
    parser.add_argument("--draws", type=int, default=4, help="records of each kind and size (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the first record (default: %(default)s)")
    parser.add_argument("--method", default="oem", choices=("oem", "pem", "ensemble"), help="default: %(default)s")
    args = parser.parse_args()
    bench, outcomes, seed = load_bench(), [], args.seed
    jobs = [(kind, size) for kind, k in KINDS.items() for size in k.sizes for _ in range(args.draws)]
    print(f"seeds {args.seed} to {args.seed + 2 * len(jobs) - 1}, method {args.method}")
    for wrong, size in jobs:
        for kind in (wrong, None):
            rng = np.random.default_rng(seed)
            brake = draw(bench, kind, size, rng)
            record = simulate(brake, bench, rng, f"seed {seed}")
            outcomes.append(judge(bench, brake, record, kind, size, args.method))
            seed += 1
    report(outcomes)


def report(outcomes: list[Outcome]) -> None:
    """The tables."""
    print(f"\n{'kind':22}{'size':>9} {'':8}{'noticed':>9}{'named':>7}{'usable':>8}{'off > 3':>9}{'worst':>8}")
    for kind, k in KINDS.items():
        for size in k.sizes:
            own = [o for o in outcomes if o.kind == kind and o.size == size]
            noticed = [o for o in own if not o.fits]
            usable = [o for o in own if o.fits]
            named = sum(o.suspect in k.named for o in noticed)
            far = sum(o.farthest > FAR for o in usable)
            worst = max((o.farthest for o in usable), default=0.0)
            print(
                f"{kind:22}{size:9.2g} {k.unit:8}{len(noticed):9}{named:7}{len(usable):8}{far:9}{worst:8.1f}  "
                + ", ".join(sorted({o.suspect for o in noticed}))
            )
    right, near = [o for o in outcomes if o.kind is None], [o for o in outcomes if o.kind is not None]
    usable, noticed = [o for o in outcomes if o.fits], [o for o in near if not o.fits]
    near_usable = [o for o in near if o.fits]
    named = sum(o.suspect in KINDS[str(o.kind)].named for o in noticed)
    print(f"\n{len(right)} right records, {len(near)} near misses")
    print("usable, but a parameter is beyond 3 deviations:", share(sum(o.farthest > FAR for o in usable), len(usable)))
    far = sum(o.farthest > FAR for o in near_usable)
    print("  of the near misses alone:                    ", share(far, len(near_usable)))
    print("false alarms:                                  ", share(sum(not o.fits for o in right), len(right)))
    print("near misses that are noticed:                  ", share(len(noticed), len(near)))
    print("suspect named first is right, where noticed:   ", share(named, len(noticed)))
    print(f"95 % intervals cover, right records:            {100 * np.mean([o.covered for o in right]):.1f} %")
    if near_usable:
        print(
            f"95 % intervals cover, usable near misses:       {100 * np.mean([o.covered for o in near_usable]):.1f} %"
        )
    found = np.array([o.wider for o in right])
    wider = found[np.isfinite(found)]
    print(f"deviation over that of a known bench, right:    median {np.median(wider):.2f}, largest {np.max(wider):.2f}")
    print(f"seconds an estimate takes:                      median {np.median([o.seconds for o in outcomes]):.3f}")


if __name__ == "__main__":
    main()
