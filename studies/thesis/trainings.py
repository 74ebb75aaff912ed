"""The thesis's trainings, made once and taken from disk after that; and experiments with what they learned."""

from __future__ import annotations

import json
import math
import pickle
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from emb_bench.config.bench import Bench, load_bench
from emb_runtime.config.bench import Ranges
from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import json_document
from emb_train.closed_loop import Batch
from emb_train.play import Draw, begin_all, middle_of
from emb_train.ppo import DeployedActor
from emb_train.rewards import REWARDS, Reward, transition
from emb_train.training import BENCH, CONFIGURATION, METRICS, load_preset
from emb_train.training import Training as Configuration
from studies.thesis.stacked import train_together

Floats = NDArray[np.float64]
AGENT = "agent.pt"  # File of a training: what was learned
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
        batch = Batch(self.bench, ranges, config.parameters, len(draws), config.plants[0], config.conditions)
        reward = reward or REWARDS[config.reward]
        begin_all(batch, draws)
        over = np.zeros(len(draws), np.bool_)
        series: tuple[list[Floats], ...] = ([batch.x], [], [], [])
        for _ in range(batch.bench.timing.horizon):
            batch.advance((wanted or self.agent)(batch))
            made = transition(batch)
            now_all = (batch.x, batch.experiments.past[:, 0], reward(made), made.after)
            for kept, now in zip(series, now_all, strict=True):
                kept.append(np.where(over if now.ndim == 1 else over[:, None], np.nan, now))
            over |= batch.experiments.violated
        x, current, rewards, information = map(np.array, series)
        return Trajectories(x, current, rewards, information, over)


GRID = 40  # Brakes on the grid (5.2.3)


def grid_draws(ranges: Ranges, parameter: str, seed: int) -> list[Draw]:
    """Brakes with ``parameter`` equally spaced over its range, both ends included; the others at mid-range.

    Brake i has noise from ``seed + i``.
    """
    values = np.linspace(getattr(ranges.low, parameter), getattr(ranges.high, parameter), GRID)
    return [Draw(seed + i, middle_of(ranges)._replace(**{parameter: float(v)})) for i, v in enumerate(values)]


class Choice(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Values that the thesis does not print, or prints in two ways; the defaults are those of the presets."""

    deviation: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 1.0  # First standard deviation of the action [A]
    tracking: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0  # Factor of the weights of the deviation from the quintic
    draws: Literal["uniform", "normal"] = "uniform"  # Table 6.1 says uniform, the text beside it normal
    normalised_by: Literal["true", "nominal"] = "true"  # Eq. 4.17 has the nominal values

    def applied(self, config: Configuration, limit: float) -> Configuration:
        """A preset with these values, for a bench with this largest current [A]."""
        conditions = msgspec.structs.replace(
            config.conditions, tracking=self.tracking, draws=self.draws, normalised_by=self.normalised_by
        )
        if config.reward not in TRACKING:
            conditions = msgspec.structs.replace(conditions, tracking=1.0)
        ppo = msgspec.structs.replace(config.ppo, initial_deviation=self.deviation / limit)
        return msgspec.structs.replace(config, ppo=ppo, conditions=conditions)

    def folder(self, config: Configuration) -> str:
        """Name of the folder of the trainings that differ by nothing else."""
        values = msgspec.structs.asdict(self) | {"tracking": self.tracking if config.reward in TRACKING else 1.0}
        return ",".join(f"{name}={value}" for name, value in values.items() if value != getattr(PRESETS, name))


TRACKING = ("trajectory_return", "hybrid_return")  # Rewards that follow a quintic
PRESETS = Choice()


class SpentError(UsageError):
    """The time for trainings is over before all are made."""


class Trainings:
    """A folder with a training for each preset and seed that was requested."""

    def __init__(
        self,
        folder: Path,
        bench: Bench,
        seeds: Sequence[int],
        most: int | None,
        tell: Callable[[str], object],
        choice: Choice = PRESETS,
        until: float = math.inf,
        beside: Sequence[tuple[Choice, int]] = (),
    ) -> None:
        """Keep trainings in a folder.

        Args:
            folder: where they are and come to be.
            bench: what they train on.
            seeds: of trainings that are repeated; the first is that of all others.
            most: steps of a training, if that is fewer than its preset's.
            tell: called with a line of text before trainings begin.
            choice: values that the thesis leaves open.
            until: time of :func:`time.monotonic` from which no training begins [s].
            beside: choices and seeds of trainings that will be needed, too, and that are made at the same time.
        """
        self._folder, self._bench, self._most, self._tell = folder, bench, most, tell
        self._choice, self._until, self._beside = choice, until, tuple(beside)
        self.seeds = tuple(seeds)

    def first(self, preset: str) -> Training:
        """The training with the first seed."""
        return self._of(preset, self.seeds[:1])[0]

    def all(self, preset: str) -> list[Training]:
        """One training for each seed."""
        return self._of(preset, self.seeds)

    def _of(self, preset: str, seeds: Sequence[int]) -> list[Training]:
        needed = [self._configured(preset, self._choice, seed) for seed in seeds]
        missing = {folder: config for folder, config in needed if _to_be_made(folder, config)}
        if missing:
            conditions = needed[0][1].conditions
            others = [self._configured(preset, *one) for one in self._beside]
            missing |= {f: c for f, c in others if c.conditions == conditions and _to_be_made(f, c)}
            self._make(missing)
        return [self._read(folder, config) for folder, config in needed]

    def _configured(self, preset: str, choice: Choice, seed: int) -> tuple[Path, Configuration]:
        """Folder and configuration of a training."""
        config = load_preset(preset, seed=seed)
        if self._most is not None and self._most < config.ppo.total_steps:
            config = load_preset(preset, seed=seed, total_steps=self._most)
        config = choice.applied(config, self._bench.limits.current)
        return self._folder / choice.folder(config) / f"{preset}-{seed}", config

    def _make(self, trainings: Mapping[Path, Configuration]) -> None:
        if time.monotonic() > self._until:
            raise SpentError("--minutes: the time is over before all trainings are made: the next call goes on")
        names = ", ".join(str(folder.relative_to(self._folder)) for folder in trainings)
        ppo = next(iter(trainings.values())).ppo
        self._tell(f"training {names}, {ppo.iterations * ppo.batch} steps each")
        for folder in trainings:
            if folder.exists():
                shutil.rmtree(folder)
        for folder, actor in train_together(trainings, self._bench):
            torch.save(actor.state_dict(), folder / AGENT)

    def _read(self, folder: Path, config: Configuration) -> Training:
        """A finished training.

        Raises:
            UsageError: the folder holds another one, or a file of it is damaged.
        """
        if not _is_of(folder, config) or load_bench(folder / BENCH).identity_hash != self._bench.identity_hash:
            raise UsageError(f"{folder}: holds another training, of other steps or bench: choose another --output")
        records = _records(folder)
        horizon = config.conditions.applied(self._bench).timing.horizon
        rewards, violations = np.array(
            [(r["mean_return"] * max(r["ended"], 1), r["violations"]) for r in records], np.float64
        ).T
        actor = config.untrained_actor(self._bench)
        try:
            actor.load_state_dict(torch.load(folder / AGENT, weights_only=True))
        except (OSError, RuntimeError, ValueError, pickle.UnpicklingError) as err:
            raise UsageError(f"{folder / AGENT}: not a trained agent, remove {folder}: {err}") from err
        curve = rewards * horizon / (config.ppo.batch * config.scale)
        return Training(config, self._bench, DeployedActor(actor, self._bench.limits.current), curve, violations)


def _records(folder: Path) -> list[dict[str, float]]:
    """Results of the iterations of a training.

    Raises:
        UsageError: a line of them is none.
    """
    wanted = {"mean_return", "ended", "violations"}
    try:
        records = [json.loads(line) for line in (folder / METRICS).read_text(encoding="utf-8").splitlines()]
        if any(not all(isinstance(record[name], int | float) for name in wanted) for record in records):
            raise ValueError("a line without numbers")
    except (OSError, ValueError, LookupError, TypeError) as err:
        raise UsageError(f"{folder}: not a finished training, remove it: {err}") from err
    return records


def _is_of(folder: Path, config: Configuration) -> bool:
    """True for the folder of a training of this configuration."""
    try:
        begun = msgspec.json.decode((folder / CONFIGURATION).read_bytes())
    except (OSError, msgspec.DecodeError):
        return False
    same: bool = begun == msgspec.json.decode(json_document(msgspec.to_builtins(config)))
    return same


def _to_be_made(folder: Path, config: Configuration) -> bool:
    """True where there is no folder, or one of this training that was interrupted."""
    if not folder.exists():
        return True
    finished = (folder / AGENT).exists() and len(_records(folder)) == config.ppo.iterations
    return _is_of(folder, config) and not finished
