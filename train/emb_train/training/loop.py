"""The loop of a training: one iteration after the other, each kept in the training's directory."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TextIO

import numpy as np
import torch

from emb_runtime.config.bench import Bench
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.ppo.networks import Actor, Critic
from emb_train.ppo.ppo import Learner, Metrics
from emb_train.ppo.rollout import collect
from emb_train.training.checkpoint import BEST, Progress, append_metrics, save_checkpoint, untrained_actor
from emb_train.training.configuration import Configuration

VALIDATION_BRAKES = 64  # In a validation
VALIDATIONS = 10  # Validations in a training, evenly spread
VALIDATION_STREAM = 0x6578616D  # Spawn key of the seeds of the validation; those of a training's iterations have none


def train(directory: Path, config: Configuration, bench: Bench, out: TextIO | None = None) -> None:
    """Train in a directory that was begun, until the configured steps are done.

    Raises:
        EmbError: see :class:`emb_train.ppo.ppo.Learner` and :mod:`emb_train.training.checkpoint`.
    """
    ppo, begun = config.ppo, time.monotonic()
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    env = EmbExcitationVectorEnv(
        ppo.envs, bench, config.ranges, config.parameters, config.reward, config.plant, config.conditions
    )
    actor = untrained_actor(config, bench)
    learner = Learner(env, actor, Critic(env.critic_size, ppo.hidden), ppo, config.seed)
    validation, best, said = Validation(config, bench), -np.inf, out or sys.stderr
    save_checkpoint(directory, Progress(0), actor)
    while not learner.finished:
        metrics = learner.iterate()
        score = validation.score(actor) if validation.due(learner.iteration) else None
        if score is not None and score > best:
            save_checkpoint(directory, Progress(learner.iteration, score), actor, BEST)
            best = score
        append_metrics(directory, asdict(metrics) | {"score": score})
        save_checkpoint(directory, Progress(learner.iteration), actor)
        said.write(f"{line(metrics, ppo.iterations)}, {metrics.steps / (time.monotonic() - begun):,.0f} steps/s\n")
        said.flush()


def line(metrics: Metrics, iterations: int) -> str:
    """One iteration in a line."""
    return (
        f"iteration {metrics.iteration}/{iterations}: return {metrics.mean_return:.3f}, information "
        f"{metrics.mean_fim:.3e}, violations {metrics.violations}, home {metrics.home}/{metrics.ended}"
    )


class Validation:
    """Scores an actor on brakes that no training draws, which decides which iteration is the best.

    The brakes and their noise are drawn once for a training.
    """

    def __init__(self, config: Configuration, bench: Bench) -> None:
        """Prepare for actors of this training."""
        self._env = EmbExcitationVectorEnv(
            VALIDATION_BRAKES, bench, config.ranges, config.parameters, config.reward, config.plant, config.conditions
        )
        seeds = np.random.SeedSequence(config.seed, spawn_key=(VALIDATION_STREAM,)).generate_state(
            VALIDATION_BRAKES, np.uint64
        )
        self._seeds = [int(seed) for seed in seeds]
        self._every = max(1, config.ppo.iterations // VALIDATIONS)
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
        return float(torch.where(over > 0.0, 0.0, seen.rewards).sum()) / VALIDATION_BRAKES
