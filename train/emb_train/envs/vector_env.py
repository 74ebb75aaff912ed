"""The environment for many brakes at once: the step compiled from the functions that the scalar one runs.

Equal seeds give equal episodes, step for step and bit for bit: row i of ``reset(seed=s)`` is the scalar environment
after ``reset(seed=s + i)``, and its automatic resets are the scalar environment's ``reset()`` without a seed.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emb_bench.compiled import compiled
from emb_bench.sim.plant_spec import DEFAULT_PLANT
from emb_runtime.config.bench import Bench, BrakeParameters, load_bench
from emb_runtime.errors import UsageError
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import BENCH_CONDITIONS, Conditions
from emb_train.envs.env import DEFAULT_REWARD, Scoring, spaces_of, wanted_current
from emb_train.rewards import Reward


class EmbExcitationVectorEnv(
    gymnasium.vector.VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]],
):
    """N experiments that begin again by themselves, in the step in which they end (``AutoresetMode.SAME_STEP``).

    In such a step the observation and ``info["critic"]`` are those of the new experiment; the old one's last are in
    ``info["final_obs"]`` and ``info["final_info"]``, valid where ``info["_final_obs"]`` is True.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  # see EmbExcitationEnv

    def __init__(
        self,
        num_envs: int = 1,
        bench: Bench | None = None,
        ranges: str = "viscous",
        parameters: Sequence[str] = ("f_v",),
        reward: Reward = DEFAULT_REWARD,
        plant: str = DEFAULT_PLANT,
        conditions: Conditions = BENCH_CONDITIONS,
    ) -> None:
        """Set up N experiments; arguments and errors as for :class:`emb_train.envs.env.EmbExcitationEnv`."""
        bench = bench or load_bench()
        reward.check(tuple(parameters))
        self.num_envs = num_envs
        self._batch = Batch(bench, bench.range_set(ranges), parameters, num_envs, compiled, plant, conditions)
        self.batch, self.reward, self._scoring = self._batch, reward, Scoring(self._batch, reward)
        self._limit = bench.limits.current
        self._generators: list[np.random.Generator] = []
        self.single_observation_space, self.single_action_space = spaces_of(self._batch)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)

    @property
    def critic_size(self) -> int:
        """Length of one critic observation."""
        return self._batch.critic_size

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin N new experiments.

        Args:
            seed: of row 0 (row i gets ``seed + i``), or one for each row; without one the generators go on.
            options: ``{"brakes": [BrakeParameters, ...]}`` chooses the N brakes.

        Raises:
            UsageError: the number of seeds or brakes is not N, one of the brakes is none, or there is another option.
        """
        self._seed(seed)
        brakes = self._chosen_brakes(options)
        for i, rng in enumerate(self._generators):
            self._batch.begin(i, rng, brakes[i] if brakes else None)
        return self._batch.observation(), self._batch.info()

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Apply the shielded currents, parts of the limit, shape [N, 1], for one sample period."""
        batch = self._batch
        rewards = self._scoring.advance(wanted_current(actions, self._limit))
        terminated = batch.terminated
        info = {} if not terminated.any() else self.begin_again(terminated)
        observation = batch.observation()
        return observation, rewards, terminated, np.zeros_like(terminated), {**self._batch.info(), **info}

    def begin_again(self, terminated: NDArray[np.bool_]) -> dict[str, Any]:
        """Begin new experiments in these rows; gives the part of ``info`` on the old ones."""
        final = {"final_obs": self._batch.observation(), "final_info": self._batch.info()}
        for i in np.flatnonzero(terminated):
            self._batch.begin(int(i), self._generators[i])
        return {**final, "_final_obs": terminated, "_final_info": terminated}

    def _seed(self, seed: int | Sequence[int] | None) -> None:
        if seed is None:
            seeds: list[int | None] = [None] * (self.num_envs if not self._generators else 0)
        elif isinstance(seed, int | np.integer):
            seeds = [operator.index(seed) + i for i in range(self.num_envs)]
        else:
            seeds = [operator.index(s) for s in seed]
            if len(seeds) != self.num_envs:
                raise UsageError(f"expected {self.num_envs} seeds, got {len(seeds)}")
        if seeds:
            self._generators = [seeding.np_random(s)[0] for s in seeds]

    def _chosen_brakes(self, options: dict[str, Any] | None) -> list[BrakeParameters] | None:
        if not options:
            return None
        brakes = options.get("brakes")
        known = set(options) == {"brakes"} and isinstance(brakes, list)
        if not known or [isinstance(b, BrakeParameters) for b in brakes or ()] != [True] * self.num_envs:
            raise UsageError(f"reset knows the option 'brakes' with {self.num_envs} BrakeParameters, got {options!r}")
        return brakes
