"""Validation: the score of an actor on brakes that no training draws, which decides which iteration is the best."""

from __future__ import annotations

import numpy as np
import torch

from emb_runtime.config.bench import Bench
from emb_train.envs.vector_env import EmbExcitationVectorEnv
from emb_train.ppo.networks import Actor
from emb_train.ppo.rollout import collect
from emb_train.training.configuration import Configuration

BRAKES = 64
TIMES = 10
"""Validations in a training, evenly spread."""
STREAM = 0x6578616D
"""Spawn key of the seeds here; those of a training's iterations have none."""


class Validation:
    """A fixed set of brakes with fixed noise, drawn once for a training."""

    def __init__(self, config: Configuration, bench: Bench) -> None:
        """Prepare for actors of this training."""
        self._env = EmbExcitationVectorEnv(
            BRAKES, bench, config.ranges, config.parameters, config.reward, config.plant, config.conditions
        )
        seeds = np.random.SeedSequence(config.seed, spawn_key=(STREAM,)).generate_state(BRAKES, np.uint64)
        self._seeds = [int(seed) for seed in seeds]
        self._every = max(1, config.ppo.iterations // TIMES)
        self._last = config.ppo.iterations
        self._threads = config.ppo.threads

    def due(self, iteration: int) -> bool:
        """Returns True if a validation follows this iteration."""
        return iteration % self._every == 0 or iteration == self._last

    def score(self, actor: Actor) -> float:
        """Mean return of an experiment without exploration, in the training's own reward."""
        steps, generator = self._env.batch.setup.rules.horizon, torch.Generator()
        seen = collect(self._env, actor, steps, 0.0, self._seeds, generator, self._threads, exploration=0.0)
        over = seen.terminals.cumsum(0) - seen.terminals
        return float(torch.where(over > 0.0, 0.0, seen.rewards).sum()) / BRAKES
