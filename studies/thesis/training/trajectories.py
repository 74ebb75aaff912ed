"""Experiments under a training's conditions, step by step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from emb_bench.compiled import compiled
from emb_runtime.config.bench import Bench
from emb_train.envs.batch import Batch
from emb_train.envs.env import Scoring
from emb_train.envs.play import Draw, begin_all
from emb_train.ppo.networks import DeployedActor
from emb_train.training.configuration import Configuration

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Wanted = Callable[[Batch], Floats]  # Currents [A], shape [N], for the experiments of a batch as they are


@dataclass(frozen=True)
class Trajectories:
    """N experiments of up to T steps; NaN after the step in which one left the limits."""

    x: Floats  # True angle [rad] and velocity [rad/s] at all instants, shape [T + 1, N, 2]
    current: Floats  # Sent in each step [A], shape [T, N]
    reward: Floats  # Reward of each step, in its own unit, shape [T, N]
    information: Floats  # Packed FIM after each step, shape [T, N, n (n + 1) / 2]
    violated: Bools  # Experiments that left the limits, shape [N]
    brakes: tuple[str, ...]  # Values of the parameters in question as text, N of them

    @property
    def returns(self) -> Floats:
        """Sum of the rewards of each, shape [N]."""
        total: Floats = np.nansum(self.reward, axis=0)
        return total

    @property
    def last(self) -> Floats:
        """Packed FIM of each at its end, shape [N, n (n + 1) / 2]."""
        steps = (~np.isnan(self.information[:, :, 0])).sum(axis=0)
        last: Floats = self.information[steps - 1, np.arange(len(steps))]
        return last


def asked(actor: DeployedActor) -> Wanted:
    """Returns the policy of a trained actor, without exploration."""

    def wanted(batch: Batch) -> Floats:
        with torch.no_grad():
            currents: torch.Tensor = actor(torch.from_numpy(batch.observation()))
        return currents[:, 0].numpy().astype(np.float64)

    return wanted


def run(config: Configuration, bench: Bench, wanted: Wanted, draws: Sequence[Draw]) -> Trajectories:
    """Run an excitation on brakes, under a training's conditions and with its reward, unscaled.

    Args:
        config: of the training.
        bench: its bench.
        wanted: excitation, requests the current.
        draws: brakes and the seeds of their noise.
    """
    ranges = bench.range_set(config.ranges)
    batch = Batch(bench, ranges, config.parameters, len(draws), compiled, config.plant, config.conditions)
    reward: Any = config.reward
    scoring = Scoring(batch, replace(reward, scale=1.0))
    begin_all(batch, draws)
    over = np.zeros(len(draws), np.bool_)
    x: list[Floats] = [batch.x[:, :2].copy()]
    current: list[Floats] = []
    rewards: list[Floats] = []
    information: list[Floats] = []
    for _ in range(batch.setup.rules.horizon):
        worth = scoring.advance(wanted(batch))
        for kept, now in ((x, batch.x[:, :2]), (current, batch.past[:, 0]), (rewards, worth), (information, batch.m)):
            kept.append(np.where(over if now.ndim == 1 else over[:, None], np.nan, now))
        over |= batch.violated
    brakes = tuple(", ".join(f"{p} = {getattr(d.brake, p):.3g}" for p in config.parameters) for d in draws)
    return Trajectories(np.array(x), np.array(current), np.array(rewards), np.array(information), over, brakes)
