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
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import gymnasium
import msgspec
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import DEFAULT_PLANT
from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError
from emb_train import register_environments
from emb_train.closed_loop import BENCH_CONDITIONS, ESTIMATE, MEASURED, SPEED, Batch, Conditions, Positive, Price, Share
from emb_train.intervals import finite, intervals
from emb_train.lies import shown
from emb_train.rewards import OUTWARD, Reward, Transition, Turn, information_increment, require_defined

ENV_ID = "EmbExcitation-v0"
SCALED = 100.0  # Bound of an observation in scales of order one
UNKNOWN = 1e9  # Times a deviation is too large before the first sample
SHORTEST = 20  # Samples of a record below which nothing counts as known

Observations = NDArray[np.float32]
Steps = tuple[Observations, Floats, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class Demands(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Demands on an experiment besides telling much, and what it pays where it does not meet them.

    A sensor that lies moves a brake by some radians before it is found out: there is to be room on the side of the
    release. And the motion is to show that a node lies (:mod:`emb_train.lies`).
    """

    astray: Price = 20.0  # Price of limits left, or of an end away from home [nat]
    release: Share = 0.3  # Part of the way to the lowest angle that is free
    beyond: Price = 1.0  # Price of each radian beyond it [nat]
    shown: Price = 1.15  # How clearly the motion shows each lie; above 1 a run is ended
    hidden: Price = 10.0  # Price of what a lie is short of that [nat]


DEMANDS = Demands()


@dataclass(frozen=True)
class ExpectedInterval:
    """Reward of a whole experiment, in its last step [nat]: the criterion of the interval that an estimate will have.

    Without a discount it is the sum of the criterion's increments. What the experiment pays is taken off.
    """

    criterion: IntervalCriterion
    demands: Demands = DEMANDS
    pool: Executor | None = None  # Of processes that share the work

    def __call__(self, batch: Batch, rows: NDArray[np.bool_], acted: Floats, motion: Floats) -> Floats:
        """The reward of the experiments of some rows.

        Args:
            batch: of N experiments.
            rows: mask of the R experiments that have ended, shape [N].
            acted: currents that acted [A], 0 after the end, shape [N, horizon].
            motion: true angles and velocities at each sample [rad, rad/s], 0 after the end, shape [N, horizon + 1, 2].

        Returns:
            Shape [R].
        """
        brakes = [BrakeParameters(*brake) for brake in batch.experiments.brakes[rows].tolist()]
        found = intervals(batch.bench, batch.plant.name, batch.parameters, brakes, acted[rows], self.pool)
        values = finite([self.criterion.of(one) for one in found])
        demands, free = self.demands, self.demands.release * batch.bench.limits.angle[0]
        told = shown(batch.bench, brakes, motion[rows], acted[rows])
        told[batch.experiments.violated[rows]] = 0.0  # it was stopped in the middle
        hidden = np.maximum(demands.shown - told, 0.0)
        beyond = np.maximum(free - motion[rows, :, 0].min(axis=1), 0.0)
        prices = demands.astray * ~batch.home[rows] + demands.beyond * beyond + demands.hidden * hidden.sum(axis=1)
        left: Floats = values - prices
        return left


class Precision(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Precision to be reached, as relative standard deviations; 95 % of the estimates are within twice that."""

    repeatability: Positive = 0.0065  # Of the running estimates, which ends an experiment
    interval: Positive = 0.0025  # Between runs, of the whole record
    price: Price = 10.0  # Of an interval that is e times as wide [periods]


PRECISION = Precision()


@dataclass(frozen=True)
class TimeToPrecision:
    """Reward of a step: minus the share of the period in which a running estimate was less precise than asked for.

    So the return is minus the number of periods until all four are known. The experiment has ended then, and its way
    home begins, as in the runtime. What the interval of the whole record is wider than asked for is taken off: when it
    has ended for the record so far, and what is won on the way is given back at the first sample at home.
    """

    precision: Precision = PRECISION
    pool: Executor | None = None  # Of processes that share the work

    def missing(self, batch: Batch) -> Floats:
        """Greatest ratio of a relative deviation to the one asked for, shape [N]."""
        told, asked = batch.estimate(), self.precision.repeatability
        missing: Floats = np.minimum((told[:, 4:] / (asked * told[:, :4])).max(axis=1), UNKNOWN)
        return missing

    def __call__(self, before: Floats, after: Floats) -> Floats:
        """The reward of a step, from what was missing before and is after it; continuous in the time. Shape [N]."""
        first, second = np.log(np.maximum(before, 1e-9)), np.log(np.maximum(after, 1e-9))
        share = np.where(second <= 0.0, first / np.maximum(first - second, 1e-9), 1.0)
        rewards: Floats = np.where(first <= 0.0, 0.0, -np.clip(share, 0.0, 1.0))
        return rewards

    def price(self, batch: Batch, rows: NDArray[np.bool_], acted: Floats) -> Floats:
        """Price of the interval of the records so far of some rows; arguments as for the expected interval, [R]."""
        at = np.flatnonzero(rows)
        long = np.flatnonzero(batch.experiments.k[at] >= SHORTEST)
        brakes = [BrakeParameters(*brake) for brake in batch.experiments.brakes[at[long]].tolist()]
        records = [acted[row, : batch.experiments.k[row]] for row in at[long]]
        found = intervals(batch.bench, batch.plant.name, batch.parameters, brakes, records, self.pool)
        wide = np.full((len(at), len(batch.parameters)), UNKNOWN)
        for i, one in zip(long, found, strict=True):
            wide[i] = np.nan_to_num(one.between_runs[: one.count], nan=UNKNOWN) / self.precision.interval
        prices: Floats = self.precision.price * np.log(np.clip(wide, 1.0, UNKNOWN)).sum(axis=1)
        return prices


class Scoring:
    """Rewards of the steps of a batch, with the state from before a step that a reward needs."""

    def __init__(self, batch: Batch, reward: AnyReward) -> None:
        """Score the steps that :meth:`advance` makes, and no others."""
        self._batch, self._reward = batch, reward
        e, count = batch.experiments, len(batch.experiments.k)
        self._missing, self._price, self._acted = np.full(count, UNKNOWN), np.zeros(count), np.zeros_like(e.late[:, 1:])
        self._motion = np.zeros((*e.late.shape, 2))
        self._turn = Turn(np.zeros_like(e.x[:, :2]), np.zeros(count), np.zeros_like(e.m))

    def advance(self, wanted: Floats) -> Floats:
        """One sample period with requested currents [A] or target speeds [rad/s], shape [N]; its rewards, shape [N].

        Raises:
            UsageError: see :meth:`emb_train.closed_loop.Batch.advance`.
        """
        if isinstance(self._reward, ExpectedInterval):
            return self._at_the_end(wanted, self._reward)
        if isinstance(self._reward, TimeToPrecision):
            return self._until_known(wanted, self._reward)
        batch, turn, rules = self._batch, self._turn, self._batch.setup.rules
        e = batch.experiments
        before, velocity = batch.information(), e.x[:, 1].copy()
        batch.advance(wanted)
        after, x, now = batch.information(), e.x[:, :2], e.k == OUTWARD
        if now.any():
            turn.x[now], turn.m[now] = x[now], after[now]
            turn.acceleration[now] = (x[now, 1] - velocity[now]) / rules.sample_time
        constants = rules.horizon, rules.sample_time, batch.conditions.tracking
        return self._reward(Transition(before, after, x, e.k, e.violated, turn, *constants))

    def _advance_noted(self, wanted: Floats) -> None:
        """One sample period whose currents are noted."""
        e = self._batch.experiments
        self._acted[e.k == 0] = 0.0
        self._batch.advance(wanted)
        self._acted[np.arange(len(e.k)), e.k - 1] = e.applied

    def _at_the_end(self, wanted: Floats, reward: ExpectedInterval) -> Floats:
        e, begun = self._batch.experiments, self._batch.experiments.k == 0
        self._motion[begun] = 0.0
        self._motion[begun, 0] = e.x[begun, :2]
        self._advance_noted(wanted)
        self._motion[np.arange(len(e.k)), e.k] = e.x[:, :2]
        rewards, over = np.zeros(len(e.k)), self._batch.terminated
        if over.any():
            rewards[over] = reward(self._batch, over, self._acted, self._motion)
        return rewards

    def _until_known(self, wanted: Floats, reward: TimeToPrecision) -> Floats:
        batch, returning = self._batch, self._batch.experiments.returning
        begun = batch.experiments.k == 0
        self._missing[begun], self._price[begun] = UNKNOWN, 0.0
        self._advance_noted(wanted)
        before, self._missing = self._missing, np.minimum(self._missing, reward.missing(batch))
        rewards = reward(before, self._missing)
        ended, arrived = ~returning & (self._missing <= 1.0), (self._price > 0.0) & returning & batch.home
        returning |= ended
        for rows, more in ((ended, 1.0), (arrived, 0.0)):
            if rows.any():
                price = reward.price(batch, rows, self._acted)
                rewards[rows] += self._price[rows] - price
                self._price[rows] = more * price
        return rewards


AnyReward = Reward | ExpectedInterval | TimeToPrecision


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
            reward: reward of a step, or of a whole experiment; a time needs conditions with the estimate.
            scale: its factor, which brings a return to a number that a network fits.
            plant: which of the bench's plants the brakes are.
            conditions: shield or none, number of steps, observation, kind of information.

        Raises:
            UsageError: the reward is not defined for the parameters, or the shield does not cover the ranges.
            BenchFileError: the bench has no such set, or no such plant.
        """
        bench = bench or load_bench()
        if not isinstance(reward, ExpectedInterval | TimeToPrecision):
            require_defined(reward, tuple(parameters))
        self.num_envs = num_envs
        self.batch = Batch(bench, bench.range_set(ranges), parameters, num_envs, plant, conditions)
        self._scoring, self._scale = Scoring(self.batch, reward), scale
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
            UsageError: the number of seeds or brakes is not N, one of the brakes is none, or there is another option.
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
        limit = limits.velocity if self.batch.conditions.acts == SPEED else limits.current
        wanted: Floats = limit * np.clip(np.asarray(actions, np.float64).reshape(-1), -1.0, 1.0)  # NaN stays NaN
        rewards = self._scale * self._scoring.advance(wanted)
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
        return np.array(self._rows.batch.experiments.x[0, :2])

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
    if batch.conditions.observes == MEASURED:
        least, greatest = [low - room, -2.0 * room, 0.0], [high + room, 2.0 * room, batch.setup.rules.horizon]
    elif batch.conditions.observes == ESTIMATE:
        least = [low - room, -2.0 * room, 0.0, *[0.0] * len(batch.most)]
        greatest = [high + room, 2.0 * room, batch.setup.rules.horizon, *batch.most]
    return gymnasium.spaces.Box(np.array(least, np.float32), np.array(greatest, np.float32), dtype=np.float32)


register_environments()
