"""Comparison of policies with excitations that need no learning, by the estimates to come: paired by new brake.

    python benchmarks/policies.py [POLICY ...] [--draws 500] [--plant exact,observer] [--seed 4040]

A POLICY is ``actor`` for the shipped one, an ONNX file, the ``plan.json`` of a training, or the folder of a training of
``studies.thesis``. Beside them: excitations that need no estimate, and random currents, each held for 10 samples. All
are behind the shield; the offsets of encoder and current are drawn from the bench's priors, brakes within ±50 %. An
agent of the thesis that sees the parameters plays the currents that it gives the thesis's brake with these parameters.

A row has the means of T, I and D, and of the time until the record so far tells all four parameters to 1.3 % (95 %; the
whole time where it does not), with the difference from the first policy and its 95 % interval; for each parameter, how
many times the first policy's interval between runs is narrower, median with its 95 % interval (bootstrap); then how
many left the limits, or were not home. docs/explanation/two-informations.md says what T and I are.
"""

from __future__ import annotations

import argparse
import sys
from array import array
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from emb_bench.config.bench import Bench, load_bench
from emb_bench.estimate.expected import Interval
from emb_bench.excitation import ACTOR, parse_excitation
from emb_bench.information.symmetric import Floats
from emb_bench.parallel import processes
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.policy.contract import SAMPLE
from emb_runtime.policy.policy import Inference, Policy, load_policy, shipped_actor_path
from emb_train.closed_loop import Conditions, Integers
from emb_train.intervals import finite, intervals
from emb_train.play import (
    MEASURES,
    STEP,
    Draw,
    Excitation,
    Outcome,
    Planned,
    fresh_draws,
    mean_score,
    of_actor,
    of_law,
    play,
)
from emb_train.rewards import PRECISION, SHORTEST
from emb_train.training import load_plan
from studies.thesis.trainings import Trainings

CLASSICAL = ("square:period=0.36", "constant-speed:turn=0.15", "chirp", "multisine")
RANDOM, HELD = "random currents", 10  # [samples]
RESAMPLED = 1000


def excitation(name: str, bench: Bench, draws: Sequence[Draw]) -> Excitation:
    """The excitation of a name, for some brakes."""
    horizon = bench.timing.horizon
    if name == RANDOM:
        rng = np.random.default_rng(0)
        levels = rng.uniform(-bench.limits.current, bench.limits.current, (len(draws), -(-horizon // HELD)))
        return of_currents(levels.repeat(HELD, axis=1)[:, :horizon])
    if name in CLASSICAL:
        return of_law(parse_excitation(name, bench).law)
    if name.endswith(".json"):
        return of_actor(Planned(load_plan(Path(name)).speeds, bench), bench)
    if Path(name).is_dir():
        return thesis_agent(Path(name), bench, draws)
    return of_actor(load_policy(shipped_actor_path() if name == ACTOR else Path(name), bench), bench)


def of_currents(currents: Floats) -> Excitation:
    """Currents that are known beforehand [A], shape [N, horizon]."""
    return lambda seen: currents[np.arange(len(currents)), seen[:, STEP].astype(int)]


def thesis_agent(folder: Path, bench: Bench, draws: Sequence[Draw]) -> Excitation:
    """An agent of the thesis: it answers measurements, or its currents are known beforehand if it sees everything."""
    preset, _, seed = folder.name.rpartition("-")
    training = Trainings(folder.parent, bench, (int(seed),), None, print).first(preset)
    if training.config.conditions.observes == "measured":
        return lambda seen: training.actor(torch.from_numpy(seen[:, : len(SAMPLE)])).detach()[:, 0].double().numpy()
    sent = np.nan_to_num(training.run(draws).current.T)
    return of_currents(np.pad(sent, ((0, 0), (0, bench.timing.horizon - sent.shape[1]))))


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


class Told(NamedTuple):
    """Measures of the experiments of a policy, one for each brake."""

    measures: Mapping[str, Floats]  # By the heading of their column
    between: Floats  # Relative deviations between runs, shape [N, 4]


def told(bench: Bench, plant: str, draws: Sequence[Draw], outcome: Outcome, pool: Executor) -> Told:
    """The measures of the outcome of a policy."""

    def of_first(lengths: Integers) -> list[Interval]:
        """The intervals of the records up to these lengths."""
        records = [row[:length] for row, length in zip(outcome.currents, lengths, strict=True)]
        return intervals(bench, plant, PARAMETER_NAMES, [draw.brake for draw in draws], records, pool)

    low, high = np.full(len(draws), SHORTEST), np.full(len(draws), bench.timing.horizon)
    found = of_first(high)
    while (high - low > 1).any():
        middle = (low + high) // 2
        largest = [one.repeatability[: one.count].max() for one in of_first(middle)]
        reached = np.array(largest) <= PRECISION.repeatability
        low, high = np.where(reached, low, middle), np.where(reached, middle, high)
    measures = {
        "T [nat]": finite([one.of_comparison for one in found]),
        "I [nat]": finite([one.of_repeatability for one in found]),
        "D [nat]": MEASURES["D"].values(outcome.matrices),
        "known after [ms]": 1e3 * bench.timing.sample_time * high,
    }
    return Told(measures, np.array([one.between_runs[: one.count] for one in found]))


def row(name: str, one: Told, first: Told, outcome: Outcome) -> str:
    """A line of the table."""
    rng, cells = np.random.default_rng(0), [Path(name).name]
    for heading, values in one.measures.items():
        ahead = mean_score(values - first.measures[heading])
        behind = "" if one is first else f" ({ahead.value:+.2f} ± {ahead.high - ahead.value:.2f})"
        cells.append(f"{values.mean():.2f}{behind}")
    for ratio in (one.between / first.between).T:
        low, high = np.quantile(
            np.median(rng.choice(ratio, (RESAMPLED, len(ratio))), axis=1), [0.025, 0.975], method="nearest"
        )
        cells.append(f"{np.median(ratio):.3g} ({low:.3g} to {high:.3g})")
    return f"| {' | '.join([*cells, str(outcome.violated.sum()), str((~outcome.home).sum())])} |"


def main() -> None:
    """Print a table for each plant."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("policies", nargs="*", default=[ACTOR])
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--plant", default="exact,observer")
    parser.add_argument("--seed", type=int, default=4040)
    arguments = parser.parse_args()
    bench, conditions = load_bench(), Conditions(information="physical", systematic=True)
    ranges = bench.range_set("pm50")
    draws = fresh_draws(ranges, arguments.seed, arguments.draws)
    with processes() as pool:
        for plant in arguments.plant.split(","):
            print(f"\nplant {plant}, {len(draws)} brakes\n")
            first = None
            for name in (*arguments.policies, *CLASSICAL, RANDOM):
                played = excitation(name, bench, draws)
                outcome = play(bench, ranges, PARAMETER_NAMES, played, draws, plant, conditions)
                one = told(bench, plant, draws, outcome, pool)
                if first is None:
                    first, headings = one, ["policy", *one.measures, *PARAMETER_NAMES, "left", "not home"]
                    print(f"| {' | '.join(headings)} |\n|{'---|' * len(headings)}")
                print(row(name, one, first, outcome), flush=True)


if __name__ == "__main__":
    main()
