"""Intervals that estimates will have after the experiments of policies, on fresh brakes, paired by brake.

    python benchmarks/policies.py [POLICY ...] [--draws 500] [--plant exact,observer] [--seed 4040]

A POLICY is ``actor`` for the shipped one, an ONNX file, or the ``plan.json`` of a training. Beside them: excitations
that need no estimate, and random currents, each held for 10 samples. All are behind the shield; the offsets of encoder
and current are drawn from the bench's priors, brakes within ±50 %.

A row has the medians of T and I [nat], and of the interval between runs of each parameter [%], and how many times the
first policy's is narrower, with its 95 % interval over the brakes (bootstrap); then how many left the limits, or were
not home. docs/explanation/two-informations.md says what T and I are.
"""

from __future__ import annotations

import argparse
import sys
from array import array
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from emb_bench.config.bench import Bench, load_bench
from emb_bench.excitation import ACTOR, parse_excitation
from emb_bench.information.symmetric import Floats
from emb_bench.parallel import processes
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.policy.policy import Inference, Policy, load_policy, shipped_actor_path
from emb_train.closed_loop import Conditions
from emb_train.intervals import intervals
from emb_train.play import STEP, Excitation, Planned, fresh_draws, of_actor, of_law, play
from emb_train.training import load_plan

CLASSICAL = ("square:period=0.36", "constant-speed:turn=0.15", "chirp", "multisine")
RANDOM, HELD = "random currents", 10  # [samples]
RESAMPLED = 1000


def excitation(name: str, bench: Bench, count: int) -> Excitation:
    """The excitation of a name, for some brakes."""
    if name == RANDOM:
        rng, horizon = np.random.default_rng(0), bench.timing.horizon
        levels = rng.uniform(-bench.limits.current, bench.limits.current, (count, -(-horizon // HELD)))
        return lambda seen: levels[np.arange(count), seen[:, STEP].astype(int) // HELD]
    if name in CLASSICAL:
        return of_law(parse_excitation(name, bench).law)
    if name.endswith(".json"):
        return of_actor(Planned(load_plan(Path(name)).speeds, bench), bench)
    return of_actor(load_policy(shipped_actor_path() if name == ACTOR else Path(name), bench), bench)


def target_speeds(policy: Policy, bench: Bench) -> Floats:
    """Speeds that a policy asks for at each step [rad/s], at rest with the nominal estimate, shape [horizon]."""
    inference, timing = Inference(policy.data, policy.contract), bench.timing
    nominal, speeds = [getattr(bench.brake, name) for name in PARAMETER_NAMES], np.zeros(timing.horizon)
    for k in range(timing.horizon):
        seen = [0.0, 0.0, k * timing.sample_time, *nominal, *[0.0] * len(nominal)]
        inference.inputs[:] = array(inference.inputs.typecode, seen[: len(inference.inputs)])
        inference.run()
        speeds[k] = inference.outputs[0]
    return speeds


def main() -> None:
    """Print a table for each plant."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("policies", nargs="*", default=[ACTOR])
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--plant", default="exact,observer")
    parser.add_argument("--seed", type=int, default=4040)
    arguments = parser.parse_args()
    bench, rng = load_bench(), np.random.default_rng(arguments.seed)
    ranges, conditions = bench.range_set("pm50"), Conditions(information="physical", systematic=True)
    draws = fresh_draws(ranges, arguments.seed, arguments.draws)
    with processes() as pool:
        for plant in arguments.plant.split(","):
            print(f"plant {plant}, {len(draws)} brakes")
            first = None
            for name in (*arguments.policies, *CLASSICAL, RANDOM):
                played = excitation(name, bench, len(draws))
                outcome = play(bench, ranges, PARAMETER_NAMES, played, draws, plant, conditions)
                brakes = [draw.brake for draw in draws]
                found = intervals(bench, plant, PARAMETER_NAMES, brakes, outcome.currents, pool)
                between = np.array([one.between_runs[: len(PARAMETER_NAMES)] for one in found])
                first = between if first is None else first
                t, i = (np.median([getattr(one, n) for one in found]) for n in ("of_comparison", "of_repeatability"))
                print(f"  {name}: T {t:.2f}, I {i:.2f}; left {outcome.left.sum()}, not home {(~outcome.home).sum()}")
                for at, parameter in enumerate(PARAMETER_NAMES):
                    ratio = between[:, at] / first[:, at]
                    again = [np.median(rng.choice(ratio, len(ratio))) for _ in range(RESAMPLED)]
                    low, high = np.quantile(again, [0.025, 0.975])
                    middle = 100.0 * np.median(between[:, at])
                    print(f"    {parameter} {middle:.4g} %, {np.median(ratio):.3g} ({low:.3g} to {high:.3g}) times")


if __name__ == "__main__":
    main()
