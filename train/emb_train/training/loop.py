"""The loop of a training: one iteration after the other, each kept in the training's directory."""

from __future__ import annotations

import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import TextIO

import numpy as np
import torch

from emb_runtime.config.bench import Bench
from emb_runtime.errors import UsageError
from emb_train import CHECKPOINT
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.ppo.networks import Actor, Critic
from emb_train.ppo.ppo import Learner, PpoConfig
from emb_train.ppo.rollout import collect
from emb_train.training.checkpoint import (
    BEST,
    CONFIG,
    Progress,
    append_metrics,
    best_score,
    load_checkpoint,
    save_checkpoint,
    trim_metrics,
    untrained_actor,
    write_text,
)
from emb_train.training.configuration import Configuration
from emb_train.training.progress import TENSORBOARD, Board, open_display

WIDE = 512  # Units of a hidden layer from which a GPU is worth its launches and copies; a rule of thumb

VALIDATION_BRAKES = 64  # In a validation
VALIDATIONS = 10  # Validations in a training, evenly spread
VALIDATION_STREAM = 0x6578616D  # Spawn key of the seeds of the validation; those of a training's iterations have none


def train(
    directory: Path,
    config: Configuration,
    bench: Bench,
    *,
    device: str = "auto",
    tensorboard: bool = False,
    out: TextIO | None = None,
) -> bool:
    """Train in a directory that was begun, from its checkpoint if it has one, until the configured steps are done.

    Args:
        directory: of the training.
        config: of the training.
        bench: of the training.
        device: see :func:`chosen_device`.
        tensorboard: True to write for TensorBoard as well.
        out: where the progress is shown; standard error if nothing is given.

    Returns:
        True if anything was left to do.

    Raises:
        EmbError: more steps are done than configured; see :class:`emb_train.ppo.ppo.Learner`,
            :func:`chosen_device` and :mod:`emb_train.training.checkpoint`.
    """
    ppo = config.ppo
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    env = EmbExcitationVectorEnv(
        ppo.envs, bench, config.ranges, config.parameters, config.reward, config.plant, config.conditions
    )
    actor = untrained_actor(config, bench)
    critic = Critic(env.critic_size, ppo.hidden)
    learner = Learner(env, actor, critic, ppo, config.seed, chosen_device(device, ppo))
    kept = (learner.actor, learner.critic, *learner.optimisers)
    if (directory / CHECKPOINT).exists():
        progress = load_checkpoint(directory, config, bench, learner.actor, learner.critic, learner.optimisers)
        if progress.iteration > ppo.iterations:
            done = progress.iteration * ppo.batch
            raise UsageError(f"{directory}: expected more --steps than are done, {done}, got {ppo.total_steps}")
        learner.iteration, learner.early = progress.iteration, progress.early
        progress = progress.towards(ppo.total_steps)
        trim_metrics(directory, learner.iteration)
    else:
        progress = Progress(0, ((0, ppo.total_steps),))
        save_checkpoint(directory, config, bench, progress, *kept)
    write_text(directory / CONFIG, config.to_json())  # only now: a resume that is refused changes nothing
    if learner.iteration >= ppo.iterations:
        return False
    validation, best = Validation(config, bench), best_score(directory)
    display = open_display(out or sys.stderr, learner.iteration * ppo.batch, ppo.iterations * ppo.batch)
    with Board(display, directory / TENSORBOARD) if tensorboard else display as shown:
        while not learner.finished:
            metrics = learner.iterate()
            progress = replace(progress, iteration=learner.iteration, early=learner.early)
            score = validation.score(learner.acting) if validation.due(learner.iteration) else None
            if score is not None and (best is None or score > best):
                # Before the checkpoint: a training that is stopped in between makes the same iteration again.
                save_checkpoint(directory, config, bench, replace(progress, score=score), *kept, name=BEST)
                best = score
            append_metrics(directory, asdict(metrics) | {"score": score})
            save_checkpoint(directory, config, bench, progress, *kept)
            shown.show(metrics)
    return True


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


def chosen_device(name: str, ppo: PpoConfig) -> torch.device:
    """The device that a name means for networks of this shape: ``auto``, ``cpu`` or ``cuda``.

    ``auto`` is the CPU, which is deterministic, unless there is a GPU and the networks are wide.

    Raises:
        UsageError: it is cuda, and torch has none.
    """
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        raise UsageError("--device cuda: torch finds no CUDA device; use --device cpu, or a torch built for CUDA")
    worth = there and max(ppo.hidden, default=0) >= WIDE
    return torch.device("cuda" if name == "cuda" or (name == "auto" and worth) else "cpu")
