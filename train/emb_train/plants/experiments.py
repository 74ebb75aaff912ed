"""Experiments on any plant, N side by side, and the environment that the learner needs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from emb_bench.information.symmetric import packed_size, unpack
from emb_runtime.errors import UsageError
from emb_train.plants.interface import Floats, Plant
from emb_train.plants.kernel import compile_plant
from emb_train.ppo.networks import Actor
from emb_train.ppo.rollout import Rollout, exploration_noise


class Experiments:
    """N experiments on a plant.

    Attributes:
        p: parameters, shape [N, p].
        x: states, shape [N, S].
        s: sensitivities of the states to the relative unknown parameters, shape [N, n, S].
        m: packed physical Fisher information, shape [N, n (n + 1) / 2].
        y: measured outputs, shape [N, o].
        k: steps, shape [N].
        left: whether an output has left its limits, shape [N].
    """

    def __init__(self, plant: Plant, count: int) -> None:
        """Prepare for ``count`` experiments; every row needs a :meth:`begin`."""
        n, outputs = len(plant.unknown), plant.outputs
        self.plant = plant
        self._advance = compile_plant(plant)
        self._unknown = np.array(plant.unknown, np.int64)
        self._deviations = np.array([o.deviation for o in outputs])
        self._low, self._high = np.array([o.low for o in outputs]), np.array([o.high for o in outputs])
        self._ranges = np.array([(p.low, p.high) for p in plant.parameters])
        self.p, self.x = np.zeros((count, len(plant.parameters))), np.zeros((count, len(plant.states)))
        self.s, self.m = np.zeros((count, n, len(plant.states))), np.zeros((count, packed_size(n)))
        self.y, self.k = np.zeros((count, len(outputs))), np.full(count, plant.horizon)
        self.left = np.zeros(count, np.bool_)
        self._noise = np.zeros((plant.horizon + 1, count, len(outputs)))

    def begin(self, i: int, rng: np.random.Generator, parameters: Floats | None = None) -> None:
        """Begin anew in row ``i``, at rest. ``rng`` draws parameters, also if they are given, and then the noise."""
        drawn = rng.uniform(self._ranges[:, 0], self._ranges[:, 1])
        self.p[i] = drawn if parameters is None else parameters
        self._noise[:, i] = rng.standard_normal(self._noise.shape[::2]) * self._deviations
        self.x[i], self.s[i], self.m[i], self.k[i], self.left[i] = 0.0, 0.0, 0.0, 0, False
        self.plant.observe(self.p[i], self.x[i], self.y[i])
        self.y[i] += self._noise[0, i]

    def advance(self, u: Floats) -> None:
        """One sample period with inputs, shape [N], clipped to the limit; one that is not finite counts as 0.

        Raises:
            UsageError: an experiment is over, or was not begun.
        """
        if (self.k >= self.plant.horizon).any():
            raise UsageError("expected experiments that go on, got one that is over or was not begun: call reset first")
        self.k += 1
        noise = self._noise[self.k, np.arange(len(self.k))]
        weights, limit = self._deviations**-2.0, self.plant.input_limit
        applied = np.clip(np.where(np.isfinite(u), u, 0.0), -limit, limit)
        self._advance(
            self._unknown,
            weights,
            self._low,
            self._high,
            self.plant.sample_time,
            self.p,
            self.x,
            self.s,
            self.m,
            self.y,
            noise,
            applied,
            self.left,
        )

    @property
    def information(self) -> Floats:
        """Fisher information without a prior, shape [N, n, n]."""
        return unpack(self.m, len(self._unknown))

    @property
    def growth(self) -> Floats:
        """Growth of ln det of the information with the prior, shape [N]."""
        prior = np.diag(self.plant.prior)
        grown: Floats = np.linalg.slogdet(self.information + prior)[1] - np.linalg.slogdet(prior)[1]
        return grown

    def seen(self) -> NDArray[np.float32]:
        """Observation of the actor: measured outputs and the step, raw, shape [N, o + 1]."""
        return np.column_stack((self.y, self.k)).astype(np.float32)

    def everything(self) -> NDArray[np.float32]:
        """Observation of the critic, in scales of order one: states, step, unknown parameters, FIM, sensitivities."""
        sizes = np.array(self.plant.states)
        low, high = self._ranges[self._unknown].T
        parameters = (2.0 * self.p[:, self._unknown] - low - high) / (high - low)
        fim = 0.1 * np.copysign(np.log1p(np.abs(self.m)), self.m)
        parts = (self.x / sizes, (self.k / self.plant.horizon)[:, None], parameters, fim)
        return np.column_stack((*parts, (self.s / sizes).reshape(len(self.k), -1))).astype(np.float32)


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
