"""Learn an excitation for any plant with the project's own learner, and play it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from emb_runtime.config.bench import load_bench
from emb_train.plants.experiments import Experiments, PlantVectorEnv
from emb_train.plants.interface import Floats, Plant
from emb_train.ppo.networks import Actor, Critic, DeployedActor
from emb_train.ppo.ppo import Learner, Metrics, PpoConfig

Control = Callable[[NDArray[np.float32]], Floats]
"""Function from observations, shape [N, o + 1], to inputs, shape [N]."""

STREAM = 0x706C61
"""Spawn key of the random numbers of :func:`play`, so that none of them is a training's."""


def learn(
    plant: Plant, ppo: PpoConfig, seed: int, report: Callable[[Metrics], None] = lambda metrics: None
) -> DeployedActor:
    """Train an actor; deterministic for a seed.

    Args:
        plant: what it is to excite.
        ppo: the hyper-parameters; a rollout of whole experiments.
        seed: of everything random.
        report: called with the metrics of every iteration.

    Raises:
        TrainingDivergedError: a loss or a weight is not finite any more.
        UsageError: see :class:`emb_train.plants.interface.Plant` and :mod:`emb_train.plants.kernel`.
    """
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    env = PlantVectorEnv(plant, ppo.envs)
    start = (ppo.hidden, ppo.initial_mean, ppo.initial_deviation)
    actor = Actor(load_bench(), *start, len(plant.outputs) + 1)
    low, high = np.array([*((o.low, o.high) for o in plant.outputs), (0.0, plant.horizon)]).T
    actor.centre.copy_(torch.from_numpy(0.5 * (low + high)))  # the plant's scales instead of a brake's
    actor.span.copy_(torch.from_numpy(0.5 * (high - low)))
    learner = Learner(env, actor, Critic(env.critic_size, ppo.hidden), ppo, seed)
    while not learner.finished:
        report(learner.iterate())
    return DeployedActor(actor, plant.input_limit)


@dataclass(frozen=True, eq=False)
class Played:
    """Results of N experiments."""

    growth: Floats
    """Growth of ln det of the information with the prior; of one that left the limits, until then. Shape [N]."""
    left: NDArray[np.bool_]
    """Mask of the experiments that left their limits, shape [N]."""


def play(plant: Plant, control: Control, count: int, seed: int) -> Played:
    """Play a control on plants drawn for it, which no training saw."""
    e = Experiments(plant, count)
    for i in range(count):
        e.begin(i, np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM, i))))
    growth, left = np.zeros(count), np.zeros(count, np.bool_)
    for _ in range(plant.horizon):
        e.advance(control(e.seen()))
        left |= e.left
        growth = np.where(left, growth, e.growth)
    return Played(growth, left)


def controlled_by(actor: DeployedActor) -> Control:
    """Control by a trained actor, without exploration."""

    def control(seen: NDArray[np.float32]) -> Floats:
        with torch.no_grad():
            inputs: torch.Tensor = actor(torch.from_numpy(seen))
        return inputs[:, 0].numpy().astype(np.float64)

    return control
