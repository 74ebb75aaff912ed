"""The thesis's trainings, made once and taken from disk after that; and experiments with what they learned."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_runtime.errors import UsageError
from emb_train.closed_loop import Batch
from emb_train.env import Scoring
from emb_train.play import Draw, begin_all
from emb_train.ppo import DeployedActor
from emb_train.rewards import REWARDS, Reward
from emb_train.training import METRICS, begin_training, load_preset, load_training, run_training
from emb_train.training import Training as Configuration

Floats = NDArray[np.float64]
Wanted = Callable[[Batch], Floats]  # Currents [A], shape [N], for the experiments of a batch as they are


@dataclass(frozen=True)
class Trajectories:
    """N experiments of up to T steps; NaN after the step in which one left the limits."""

    x: Floats  # True angle [rad] and velocity [rad/s] at all instants, shape [T + 1, N, 2]
    current: Floats  # Sent in each step [A], shape [T, N]
    reward: Floats  # Reward of each step, in its own unit, shape [T, N]
    information: Floats  # Packed FIM after each step, shape [T, N, n (n + 1) / 2]
    violated: NDArray[np.bool_]  # Experiments that left the limits, shape [N]

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


@dataclass(frozen=True)
class Training:
    """A finished training."""

    config: Configuration
    bench: Bench
    actor: DeployedActor
    curve: Floats  # Rewards of each iteration per length of an experiment, in the reward's own unit, shape [I]
    violations: Floats  # Experiments that left the limits in each iteration, shape [I]

    def agent(self, batch: Batch) -> Floats:
        """Currents that the trained actor requests, without exploration [A], shape [N]."""
        with torch.no_grad():
            currents: torch.Tensor = self.actor(torch.from_numpy(batch.observation()))
        return currents[:, 0].numpy().astype(np.float64)

    def run(self, draws: Sequence[Draw], wanted: Wanted | None = None, reward: Reward | None = None) -> Trajectories:
        """Experiments under the conditions of the training.

        Args:
            draws: brakes and the seeds of their noise.
            wanted: requests the current; the trained actor without.
            reward: of a step, unscaled; the training's without.
        """
        config, ranges = self.config, self.bench.range_set(self.config.ranges)
        batch = Batch(self.bench, ranges, config.parameters, len(draws), config.plant, config.conditions)
        scoring = Scoring(batch, reward or REWARDS[config.reward])
        begin_all(batch, draws)
        over = np.zeros(len(draws), np.bool_)
        series: tuple[list[Floats], ...] = ([batch.x[:, :2].copy()], [], [], [])
        for _ in range(batch.setup.rules.horizon):
            worth = scoring.advance((wanted or self.agent)(batch))
            for kept, now in zip(series, (batch.x[:, :2], batch.past[:, 0], worth, batch.m), strict=True):
                kept.append(np.where(over if now.ndim == 1 else over[:, None], np.nan, now))
            over |= batch.violated
        x, current, rewards, information = map(np.array, series)
        return Trajectories(x, current, rewards, information, over)


class Trainings:
    """A folder with a training for each preset and seed that was requested."""

    def __init__(
        self, folder: Path, bench: Bench, seeds: Sequence[int], most: int | None, tell: Callable[[str], object]
    ) -> None:
        """Keep trainings in a folder.

        Args:
            folder: where they are and come to be.
            bench: what they train on.
            seeds: of trainings that are repeated; the first is that of all others.
            most: steps of a training, if that is fewer than its preset's.
            tell: called with a line of text before a training begins.
        """
        self._folder, self._bench, self._most, self._tell = folder, bench, most, tell
        self.seeds = tuple(seeds)

    def first(self, preset: str) -> Training:
        """The training with the first seed."""
        return self._one(preset, self.seeds[0])

    def all(self, preset: str) -> list[Training]:
        """One training for each seed."""
        return [self._one(preset, seed) for seed in self.seeds]

    def _one(self, preset: str, seed: int) -> Training:
        folder, config = self._folder / f"{preset}-{seed}", load_preset(preset, seed=seed)
        if self._most is not None and self._most < config.ppo.total_steps:
            config = load_preset(preset, seed=seed, total_steps=self._most)
        if not folder.exists():
            self._tell(f"training {preset}, seed {seed}, {config.ppo.iterations * config.ppo.batch} steps")
            begin_training(folder, config, self._bench)
            run_training(folder, config, self._bench)
        trained = load_training(folder)
        if (trained.training, trained.bench.identity_hash) != (config, self._bench.identity_hash):
            raise UsageError(f"{folder}: holds another training, of other steps or bench: choose another --output")
        try:
            records = [json.loads(line) for line in (folder / METRICS).read_text(encoding="utf-8").splitlines()]
            returns = [(r["mean_return"] * max(r["ended"], 1), r["violations"]) for r in records]
        except (OSError, ValueError, LookupError, TypeError) as err:
            raise UsageError(f"{folder}: not a finished training, remove it: {err}") from err
        if len(records) < config.ppo.iterations:
            raise UsageError(f"{folder}: not a finished training, remove it: it was interrupted")
        horizon = config.conditions.applied(self._bench).timing.horizon
        rewards, violations = np.array(returns, np.float64).T
        actor = DeployedActor(trained.actor, self._bench.limits.current)
        curve = rewards * horizon / (config.ppo.batch * config.scale)
        return Training(config, self._bench, actor, curve, violations)
