"""The Gymnasium environment ``EmbExcitation-v0``: experiments on brakes whose parameters the actor does not know.

* **Action**, shape [1]: the requested current as a part of the bench's limit, −1..1. The shield has the last word.
* **Observation**, shape [3]: measured angle [rad], measured velocity [rad/s], step (thesis Table 4.2, actor), raw;
  under conditions in which the actor sees everything (5.2), the critic's observation without the sensitivities.
* ``info["critic"]``: the critic's observation, see :func:`emb_train.envs.critic_view.describe`.
* ``info["heard"]``: True if this observation is a new one. Where samples get lost
  (:class:`emb_train.envs.conditions.Randomisation`) it is the last one with the step going on, and the action that
  answers it has no effect.
* **Reward**: see :mod:`emb_train.rewards`.
* **End**: leaving the limits and reaching the horizon are both terminal. The experiment is the horizon long by design
  and the step is observed, so nothing is truncated and nothing is bootstrapped there.

There is one class for one experiment, in plain Python, and one for many, with the same step compiled. Equal seeds give
equal episodes, step for step and bit for bit: row i of the second after ``reset(seed=s)`` is the first after
``reset(seed=s + i)``, and its automatic resets are the first's ``reset()`` without a seed.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import register
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emb_bench.compiled import compiled
from emb_runtime.config.bench import Bench, BrakeParameters, load_bench
from emb_runtime.config.plants import DEFAULT_PLANT
from emb_runtime.errors import UsageError
from emb_train.envs.batch import Batch
from emb_train.envs.conditions import BENCH_CONDITIONS, MEASURED, Conditions
from emb_train.rewards import Floats, InformationIncrement, Mark, Returning, Reward, Transition

ENV_ID = "EmbExcitation-v0"
DEFAULT_REWARD = InformationIncrement(scale=1e-6)

SCALED = 100.0  # Bound of an observation in scales of order one


def spaces_of(batch: Batch) -> tuple[gymnasium.spaces.Box[Any], gymnasium.spaces.Box[Any]]:
    """Observation and action space of one environment. The bounds leave room for noise and for the violating step."""
    low, high = batch.bench.limits.angle
    room, size = batch.bench.limits.velocity, batch.observation_size
    if batch.conditions.observes == MEASURED:
        least, greatest = [low - room, -2.0 * room, 0.0], [high + room, 2.0 * room, batch.setup.rules.horizon]
    else:
        least, greatest = [-SCALED] * size, [SCALED] * size
    observation = gymnasium.spaces.Box(np.array(least, np.float32), np.array(greatest, np.float32), dtype=np.float32)
    return observation, gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)


class Scoring:
    """Rewards of the steps of a batch, with the record from before a step that a reward needs."""

    def __init__(self, batch: Batch, reward: Reward) -> None:
        """Score the steps that :meth:`advance` makes, and no others."""
        self._batch = batch
        self._reward = reward
        self._outward = reward.outward if isinstance(reward, Returning) else 0
        self._mark = Mark(np.zeros_like(batch.x[:, :2]), np.zeros(len(batch.k)), np.zeros_like(batch.m))

    def advance(self, wanted: Floats) -> Floats:
        """One sample period with the requested currents [A], shape [N]; its rewards, shape [N].

        Raises:
            UsageError: see :meth:`emb_train.envs.batch.Batch.advance`.
        """
        batch, mark = self._batch, self._mark
        before, velocity = batch.m.copy(), batch.x[:, 1].copy()
        batch.advance(wanted)
        sample_time = batch.setup.rules.sample_time
        turning = batch.k == self._outward
        if turning.any():
            mark.x[turning] = batch.x[turning, :2]
            mark.acceleration[turning] = (batch.x[turning, 1] - velocity[turning]) / sample_time
            mark.m[turning] = batch.m[turning]
        state = batch.x[:, :2]
        return self._reward(
            Transition(before, batch.m, state, batch.k, batch.violated, mark, batch.setup.rules.horizon, sample_time)
        )


class EmbExcitationEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One experiment at a time, in plain Python. ``reset(options={"brake": BrakeParameters})`` chooses the brake."""

    metadata = {"render_modes": []}  # noqa: RUF012  # Gymnasium declares it as an instance attribute

    def __init__(
        self,
        bench: Bench | None = None,
        ranges: str = "viscous",
        parameters: Sequence[str] = ("f_v",),
        reward: Reward = DEFAULT_REWARD,
        plant: str = DEFAULT_PLANT,
        conditions: Conditions = BENCH_CONDITIONS,
    ) -> None:
        """Set up one experiment.

        Args:
            bench: the bench; without one, the shipped one.
            ranges: name of the set of the bench that brakes are drawn from.
            parameters: whose Fisher information is collected.
            reward: reward of a step.
            plant: which of the bench's plants the brakes are.
            conditions: shield or none, number of steps, observation, kind of information.

        Raises:
            UsageError: the parameters are not the reward's, or the shield does not cover the ranges.
            BenchFileError: the bench has no such set, or no such plant.
        """
        bench = bench or load_bench()
        reward.check(tuple(parameters))
        self._batch = Batch(bench, bench.range_set(ranges), parameters, 1, plant=plant, conditions=conditions)
        self._scoring = Scoring(self._batch, reward)
        self._limit = bench.limits.current
        self.observation_space, self.action_space = spaces_of(self._batch)

    @property
    def state(self) -> NDArray[np.float64]:
        """True angle [rad] and velocity [rad/s]: for evaluation, not for the actor."""
        return np.array(self._batch.x[0, :2])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin a new experiment with a new brake and new noise."""
        super().reset(seed=None if seed is None else operator.index(seed))
        self._batch.begin(0, self.np_random, chosen_brake(options))
        return self._batch.observation()[0], self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Apply the shielded current for one sample period."""
        reward = self._scoring.advance(wanted_current(action, self._limit))
        terminated = bool(self._batch.terminated[0])
        return self._batch.observation()[0], float(reward[0]), terminated, False, self._info()

    def _info(self) -> dict[str, Any]:
        return {name: v[0] if v.ndim > 1 else v[0].item() for name, v in self._batch.info().items()}


def wanted_current(action: NDArray[np.float32], limit: float) -> NDArray[np.float64]:
    """Currents [A], shape [N], of actions, shape [N, 1] or [1]: parts of the limit, clipped to −1..1; NaN stays NaN."""
    return limit * np.clip(np.asarray(action, np.float64).reshape(-1), -1.0, 1.0)


def chosen_brake(options: dict[str, Any] | None) -> BrakeParameters | None:
    """The brake that the caller of ``reset`` requests.

    Raises:
        UsageError: there is another option, or it is no brake.
    """
    if not options:
        return None
    brake = options.get("brake")
    if set(options) != {"brake"} or not isinstance(brake, BrakeParameters):
        raise UsageError(f"reset knows the option 'brake' with BrakeParameters, got {options!r}")
    return brake


class EmbExcitationVectorEnv(
    gymnasium.vector.VectorEnv[NDArray[np.float32], NDArray[np.float32], NDArray[Any]],
):
    """N experiments that begin again by themselves, in the step in which they end (``AutoresetMode.SAME_STEP``).

    In such a step the observation and ``info["critic"]`` are those of the new experiment; the old one's last are in
    ``info["final_obs"]`` and ``info["final_info"]``, valid where ``info["_final_obs"]`` is True.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  # as above

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
        """Set up N experiments; arguments and errors as for :class:`EmbExcitationEnv`."""
        bench = bench or load_bench()
        reward.check(tuple(parameters))
        self.num_envs = num_envs
        self.batch = Batch(bench, bench.range_set(ranges), parameters, num_envs, compiled, plant, conditions)
        self.reward, self._scoring = reward, Scoring(self.batch, reward)
        self._limit = bench.limits.current
        self._generators: list[np.random.Generator] = []
        self.single_observation_space, self.single_action_space = spaces_of(self.batch)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)

    @property
    def critic_size(self) -> int:
        """Length of one critic observation."""
        return self.batch.critic_size

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
            self.batch.begin(i, rng, brakes[i] if brakes else None)
        return self.batch.observation(), self.batch.info()

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Apply the shielded currents, parts of the limit, shape [N, 1], for one sample period."""
        batch = self.batch
        rewards = self._scoring.advance(wanted_current(actions, self._limit))
        terminated = batch.terminated
        info = {} if not terminated.any() else self.begin_again(terminated)
        observation = batch.observation()
        return observation, rewards, terminated, np.zeros_like(terminated), {**self.batch.info(), **info}

    def begin_again(self, terminated: NDArray[np.bool_]) -> dict[str, Any]:
        """Begin new experiments in these rows; gives the part of ``info`` on the old ones."""
        final = {"final_obs": self.batch.observation(), "final_info": self.batch.info()}
        for i in np.flatnonzero(terminated):
            self.batch.begin(int(i), self._generators[i])
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


register(id=ENV_ID, entry_point=f"{__name__}:EmbExcitationEnv", vector_entry_point=f"{__name__}:EmbExcitationVectorEnv")
