"""The Gymnasium environment ``EmbExcitation-v0``: experiments on brakes whose parameters the actor does not know.

* **Action**, shape [1]: the requested current as a part of the bench's limit, −1..1; under conditions in which it acts
  by ``speed``, the target speed as a part of that limit, which the runtime's speed loop follows by the running
  estimate. The shield has the last word.
* **Observation**, shape [3]: measured angle [rad], measured velocity [rad/s], step (thesis Table 4.2, actor), raw;
  where it observes the ``estimate``, shape [11], k_m, k_1, T_c and f_v in SI units and their deviations follow; where
  it sees everything (5.2), it is the critic's observation without the sensitivities.
* ``info["critic"]``: the critic's observation, see :meth:`emb_train.closed_loop.Batch.critic_observation`.
* **Reward**: see :mod:`emb_train.rewards`.
* **End**: leaving the limits and reaching the horizon are both terminal. The experiment is the horizon long by design
  and the step is observed, so nothing is truncated and nothing is bootstrapped there.

``gymnasium.make("emb_train:EmbExcitation-v0")`` makes it; after ``import emb_train`` the name alone does.

Equal seeds give equal episodes, bit for bit: row i of ``make_vec`` after ``reset(seed=s)`` is ``make`` after
``reset(seed=s + i)``, and its automatic resets are resets without a seed.
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

from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.information.symmetric import Floats
from emb_bench.sim.simulated_brake import check_near_nominal
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError
from emb_train import register_environments
from emb_train.closed_loop import BENCH_CONDITIONS, Batch, Conditions
from emb_train.rewards import AnyReward, information_increment, require_defined, worth

ENV_ID = "EmbExcitation-v0"
SCALED = 100.0  # Bound of an observation in scales of order one

Observations = NDArray[np.float32]
Steps = tuple[Observations, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class EmbExcitationVectorEnv(gymnasium.vector.VectorEnv[Observations, Observations, NDArray[Any]]):
    """N experiments that begin again by themselves, in the step in which they end (``AutoresetMode.SAME_STEP``).

    In such a step the observation and ``info["critic"]`` are those of the new experiment; the old one's last are in
    ``info["final_obs"]`` and ``info["final_info"]``, valid where ``info["_final_obs"]`` is True.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012  # as in Gymnasium

    def __init__(
        self,
        num_envs: int = 1,
        bench: Bench | None = None,
        ranges: str = "viscous",
        parameters: Sequence[str] = ("f_v",),
        reward: AnyReward = information_increment,
        scale: float = 1e-6,
        plant: str = DEFAULT_PLANT,
        conditions: Conditions = BENCH_CONDITIONS,
    ) -> None:
        """Set up N experiments.

        Args:
            num_envs: N.
            bench: the bench; without one, the shipped one.
            ranges: name of the set of the bench that brakes are drawn from.
            parameters: whose Fisher information is collected.
            reward: of a step, or of an experiment at its end; a time needs conditions with the estimate.
            scale: its factor, which brings a return to a number that a network fits.
            plant: which of the bench's plants the brakes are.
            conditions: shield or none, number of steps, observation, kind of information.

        Raises:
            UsageError: the reward is not defined for the parameters, or the shield does not cover the ranges.
            BenchFileError: the bench has no such set, or no such plant.
        """
        bench = bench or load_bench()
        require_defined(reward, parameters)
        self.num_envs = num_envs
        self.batch = Batch(bench, bench.range_set(ranges), parameters, num_envs, plant, conditions)
        self._reward, self._scale = reward, scale
        self._generators: list[np.random.Generator] = []
        self.single_observation_space = _observation_space(self.batch)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.observation_space = gymnasium.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gymnasium.vector.utils.batch_space(self.single_action_space, num_envs)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin N new experiments.

        Args:
            seed: of row 0 (row i gets ``seed + i``), or one for each row; without one the generators go on.
            options: ``{"brakes": [BrakeParameters, ...]}`` chooses the N brakes.

        Raises:
            UsageError: the number of seeds or brakes is not N, one of the brakes is none, or farther from the
                nominal one than a factor of 100, or there is another option.
        """
        if seed is not None or not self._generators:
            self._generators = [seeding.np_random(s)[0] for s in self._seeds(seed)]
        return self.begin(self._generators, options)

    def begin(
        self, generators: Sequence[np.random.Generator], options: dict[str, Any] | None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin N new experiments, each with its generator; ``options`` as for :meth:`reset`."""
        brakes = self._chosen_brakes(options)
        for i, rng in enumerate(generators):
            self.batch.begin(i, rng, brakes[i])
        return self.batch.observation(), self.batch.info()

    def step(self, actions: Observations) -> Steps:
        """Apply the shielded currents for one sample period; an experiment that ends begins again.

        Args:
            actions: parts of the limit of the current, or of the speed, shape [N, 1].
        """
        observation, rewards, terminated, truncated, info = self.advance(actions)
        if terminated.any():
            for i in np.flatnonzero(terminated):
                self.batch.begin(int(i), self._generators[i])
            final = {"final_obs": observation, "_final_obs": terminated, "final_info": info, "_final_info": terminated}
            observation, info = self.batch.observation(), {**self.batch.info(), **final}
        return observation, rewards, terminated, truncated, info

    def advance(self, actions: Observations) -> Steps:
        """:meth:`step` without a new beginning: an experiment that is over has to begin before the next step."""
        limits = self.batch.bench.limits
        limit = limits.velocity if self.batch.conditions.acts == "speed" else limits.current
        requested: Floats = limit * np.clip(np.asarray(actions, np.float64).reshape(-1), -1.0, 1.0)  # NaN stays NaN
        self.batch.advance(requested)
        rewards = self._scale * worth(self._reward, self.batch)
        terminated = self.batch.terminated
        return self.batch.observation(), rewards, terminated, np.zeros_like(terminated), self.batch.info()

    def _seeds(self, seed: int | Sequence[int] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [operator.index(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise UsageError(f"expected {self.num_envs} seeds, got {len(seed)}")
        return [operator.index(s) for s in seed]

    def _chosen_brakes(self, options: dict[str, Any] | None) -> Sequence[BrakeParameters | None]:
        if not options:
            return [None] * self.num_envs
        brakes = options.get("brakes")
        listed = set(options) == {"brakes"} and isinstance(brakes, list) and len(brakes) == self.num_envs
        if listed and brakes is not None and all(isinstance(brake, BrakeParameters) for brake in brakes):
            for name, value in (item for brake in brakes for item in brake._asdict().items()):
                check_near_nominal(self.batch.bench, name, value, "reset: brakes: ")
            return list(brakes)
        raise UsageError(f"reset: expected the option 'brakes' with {self.num_envs} BrakeParameters, got {options!r}")


class EmbExcitationEnv(gymnasium.Env[Observations, Observations]):
    """One experiment: the only row of an :class:`EmbExcitationVectorEnv`, which begins again at a reset alone."""

    metadata = {"render_modes": []}  # noqa: RUF012  # as in Gymnasium

    def __init__(self, **settings: Any) -> None:
        """Set up one experiment; arguments and errors as for :class:`EmbExcitationVectorEnv`, without ``num_envs``."""
        self._rows = EmbExcitationVectorEnv(1, **settings)
        self.observation_space, self.action_space = self._rows.single_observation_space, self._rows.single_action_space

    @property
    def state(self) -> Floats:
        """True angle [rad] and velocity [rad/s]: for evaluation, not for the actor."""
        return np.array(self._rows.batch.x[0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Begin a new experiment with a new brake and new noise; options as for N experiments."""
        super().reset(seed=None if seed is None else operator.index(seed))
        observation, info = self._rows.begin([self.np_random], options)
        return observation[0], _first(info)

    def step(self, action: Observations) -> tuple[Observations, float, bool, bool, dict[str, Any]]:
        """Apply the shielded current for one sample period."""
        observation, reward, terminated, _, info = self._rows.advance(action)
        return observation[0], float(reward[0]), bool(terminated[0]), False, _first(info)


def _first(info: dict[str, Any]) -> dict[str, Any]:
    return {name: values[0] if values.ndim > 1 else values[0].item() for name, values in info.items()}


def _observation_space(batch: Batch) -> gymnasium.spaces.Box[Any]:
    """Observations of one experiment. The bounds leave room for noise and for the violating step."""
    low, high = batch.bench.limits.angle
    room, size = batch.bench.limits.velocity, batch.conditions.observation_size(len(batch.parameters))
    least, greatest = [-SCALED] * size, [SCALED] * size
    if batch.conditions.observes == "measured":
        least, greatest = [low - room, -2.0 * room, 0.0], [high + room, 2.0 * room, batch.bench.timing.horizon]
    elif batch.conditions.observes == "estimate":
        least = [low - room, -2.0 * room, 0.0, *[0.0] * len(batch.most)]
        greatest = [high + room, 2.0 * room, batch.bench.timing.horizon, *batch.most]
    return gymnasium.spaces.Box(np.array(least, np.float32), np.array(greatest, np.float32), dtype=np.float32)


register_environments()
