"""Learn an excitation for any plant with the project's own learner, and play it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from emb_runtime.config.bench import load_bench
from emb_runtime.errors import UsageError
from emb_train.plants.experiments import Experiments
from emb_train.plants.interface import Floats, Plant
from emb_train.ppo.networks import Actor, Critic, DeployedActor
from emb_train.ppo.ppo import Learner, Metrics, PpoConfig
from emb_train.ppo.rollout import Rollout, exploration_noise

Control = Callable[[NDArray[np.float32]], Floats]  # Function from observations, shape [N, o + 1], to inputs, shape [N]

STREAM = 0x706C61  # Spawn key of the random numbers of :func:`play`, so that none of them is a training's


class PlantVectorEnv:
    """N experiments that follow an actor and begin again by themselves.

    The action is a part of the input's limit. The reward is what a step adds to ln det of the information with the
    prior; an experiment that leaves the limits gives back all that it had.
    """

    def __init__(self, plant: Plant, num_envs: int, scale: float = 0.1) -> None:
        """N experiments on a plant; ``scale`` brings the return to a number that a network fits."""
        self.num_envs = num_envs
        self._experiments = Experiments(plant, num_envs)
        self._scale = scale
        self._growth = np.zeros(num_envs)
        self._generators: list[np.random.Generator] = []

    @property
    def critic_size(self) -> int:
        """Length of one critic observation."""
        return int(self._experiments.everything().shape[1])

    def reset(self, seeds: Sequence[int]) -> None:
        """Begin N new experiments, with one seed for each.

        Raises:
            UsageError: the number of seeds is not N.
        """
        if len(seeds) != self.num_envs:
            raise UsageError(f"expected {self.num_envs} seeds, got {len(seeds)}")
        self._generators = [np.random.default_rng(s) for s in seeds]
        for i in range(self.num_envs):
            self._begin(i)

    def step(self, actions: NDArray[np.float32]) -> tuple[Floats, NDArray[np.bool_], NDArray[np.bool_]]:
        """One sample period with these parts of the limit, shape [N]: rewards, which ended, which left the limits.

        Those that ended have begun again, each of the three of shape [N].
        """
        e = self._experiments
        e.advance(e.plant.input_limit * np.clip(actions.astype(np.float64), -1.0, 1.0))
        left = e.left.copy()
        growth = np.where(left, 0.0, e.growth)
        rewards, self._growth = self._scale * (growth - self._growth), growth
        ended = left | (e.k >= e.plant.horizon)
        for i in np.flatnonzero(ended):
            self._begin(int(i))
        return rewards, ended, left

    def collect(
        self, actor: Actor, steps: int, noise_memory: float, seeds: list[int], generator: torch.Generator, threads: int
    ) -> Rollout:
        """See :func:`emb_train.ppo.rollout.collect`; ``threads`` are not needed.

        An experiment that ends in time is home.
        The information that is reported is ln det with the prior, instead of an element of the matrix.
        """
        self.reset(seeds)
        e, n = self._experiments, self.num_envs
        actor_seen = np.empty((steps, *e.seen().shape), np.float32)
        critic_seen = np.empty((steps, *e.everything().shape), np.float32)
        rewards, ended = np.empty((steps, n), np.float32), np.empty((steps, n), np.bool_)
        left, growth = np.empty((steps, n), np.bool_), np.empty((steps, n))
        actions = exploration_noise(steps, n, noise_memory, generator)
        with torch.no_grad():
            actions *= actor.log_deviation.exp()
            for t in range(steps):
                actor_seen[t], critic_seen[t], growth[t] = e.seen(), e.everything(), self._growth
                actions[t] += actor(torch.from_numpy(actor_seen[t]))
                rewards[t], ended[t], left[t] = self.step(actions[t, :, 0].clamp(-1.0, 1.0).numpy())
        final = growth[ended] + rewards[ended] / self._scale
        return Rollout(
            torch.from_numpy(actor_seen),
            torch.from_numpy(critic_seen),
            actions,
            torch.from_numpy(rewards),
            torch.from_numpy(ended.astype(np.float32)),
            torch.from_numpy(e.everything()),
            float(final.mean()) if len(final) else math.nan,
            int(ended.sum()),
            int(left.sum()),
            int((ended & ~left).sum()),
        )

    def _begin(self, i: int) -> None:
        self._experiments.begin(i, self._generators[i])
        self._growth[i] = 0.0


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
        UsageError: see :class:`emb_train.plants.interface.Plant` and :mod:`emb_train.plants.experiments`.
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
    left: NDArray[np.bool_]  # Mask of the experiments that left their limits, shape [N]


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
