"""The trainings that a reproduction needs: made once, taken from disk after that."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from emb_runtime.config.bench import Bench
from emb_runtime.errors import UsageError
from emb_train.ppo.networks import DeployedActor
from emb_train.presets import load_preset
from emb_train.training.checkpoint import METRICS, begin_directory, load_actor, write_text
from emb_train.training.configuration import Configuration
from emb_train.training.loop import train

TIME = "seconds.json"

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Training:
    """A finished training."""

    config: Configuration
    bench: Bench
    actor: DeployedActor
    steps: Floats  # Environment steps after each iteration, shape [I]
    curve: Floats  # Rewards of each iteration per length of an experiment, in the reward's own unit, shape [I]
    violations: Floats  # Experiments that left the limits in each iteration, shape [I]
    seconds: float  # Duration [s]


class Trainings:
    """A folder with a training for each preset and seed that was requested."""

    def __init__(
        self, folder: Path, bench: Bench, seeds: Sequence[int], most: int | None, tell: Callable[[str], None]
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
        self._known: dict[tuple[str, int], Training] = {}

    def first(self, preset: str) -> Training:
        """The training with the first seed."""
        return self._one(preset, self.seeds[0])

    def all(self, preset: str) -> list[Training]:
        """One training for each seed."""
        return [self._one(preset, seed) for seed in self.seeds]

    def cut(self, presets: Sequence[str]) -> bool:
        """Returns True if any of these presets has more steps than its trainings here are given."""
        return self._most is not None and any(load_preset(name).ppo.total_steps > self._most for name in presets)

    @property
    def made(self) -> list[tuple[str, int, int, float]]:
        """All the trainings that were requested: preset, seed, environment steps, and how long it took [s]."""
        return [(preset, seed, int(t.steps[-1]), t.seconds) for (preset, seed), t in self._known.items()]

    def _one(self, preset: str, seed: int) -> Training:
        if (preset, seed) not in self._known:
            self._known[preset, seed] = self._made(preset, seed)
        return self._known[preset, seed]

    def _made(self, preset: str, seed: int) -> Training:
        directory = self._folder / f"{preset}-{seed}"
        config = load_preset(preset)
        steps = min(config.ppo.total_steps, self._most or config.ppo.total_steps)
        config = replace(config, seed=seed, ppo=replace(config.ppo, total_steps=steps))
        if not directory.exists():
            begin_directory(directory, config, self._bench)
            self._tell(f"training {preset}, seed {seed}, {config.ppo.iterations * config.ppo.batch} steps")
            began = time.perf_counter()
            train(directory, config, self._bench)
            write_text(directory / TIME, json.dumps({"seconds": time.perf_counter() - began}) + "\n")
        try:
            found = _read(directory)
        except (OSError, ValueError, LookupError, TypeError) as err:
            raise UsageError(f"{directory}: not a finished training, remove it: {err}") from err
        if (found.config, found.bench.contract_hash) != (config, self._bench.contract_hash):
            raise UsageError(f"{directory}: holds another training, of other steps or bench: choose another --out")
        return found


def _read(directory: Path) -> Training:
    config, bench, actor, _ = load_actor(directory)
    torch.set_num_threads(1)
    lines = (directory / METRICS).read_text(encoding="utf-8").splitlines()
    records = [json.loads(line) for line in lines]
    horizon = config.conditions.applied(bench).timing.horizon
    scale = config.reward.scale  # type: ignore[attr-defined]  # every reward of the thesis's presets has one
    per_length = horizon / (config.ppo.batch * scale)
    return Training(
        config,
        bench,
        DeployedActor(actor, bench.limits.current),
        np.array([r["steps"] for r in records], np.float64),
        np.array([r["mean_return"] * max(r["ended"], 1) * per_length for r in records], np.float64),
        np.array([r["violations"] for r in records], np.float64),
        float(json.loads((directory / TIME).read_text(encoding="utf-8"))["seconds"]),
    )
