"""Search for a plan of speeds for unknown brakes: a few levels and their times, by CMA-ES.

A plan has n speed levels, each held for a time; then the shield brings the brake home. It does not depend on the
measurements. Its 2 n numbers are within ±1: the signed root of each level, so that slow motions of some rad/s have the
same width as full strokes, and the logarithm of each time, so that the levels keep their order. The return has many
local maxima, and most plans give no information at all. So plans of full strokes and slow motions are drawn, and CMA-ES
(Hansen and Ostermeier, Completely derandomized self-adaptation in evolution strategies, Evolutionary Computation 9,
2001) improves the best of them with the same brakes in each step, one set for each environment. Repeatedly the worse
half of the searches ends, and the others continue with twice as many brakes (Jamieson and Talwalkar, Non-stochastic
best arm identification and hyperparameter optimization, AISTATS 2016): the best plan for few brakes is not the best for
others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import cma
import msgspec
import numpy as np

from emb_bench.information.symmetric import Floats
from emb_train.closed_loop import Count, Positive, Price
from emb_train.env import EmbExcitationVectorEnv
from emb_train.ppo import at_once

BOUND = 1.05  # Beyond the ends of the numbers, so that full speed is inside
CREEP = 0.5  # Greatest root of a level that is drawn and is no full stroke
WIDTHS = 3.0  # Logarithm of the longest time over the mean
STREAM = 0x706C616E  # Spawn key of the brakes on which plans are compared


class PlanSearch(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The search for the plan that an actor begins with."""

    drawn: Count = 800  # Plans at random, each on one brake of each plant; rounded up
    starts: Count = 8  # Searches by CMA-ES that begin at the best of them
    steps: Count = 12  # Of each search, before the worse half of them ends; the last has as many
    population: Annotated[int, msgspec.Meta(ge=4, le=1000)] = 16  # Plans of a step
    brakes: Count = 16  # Of each plant, on which the plans of the last search are compared
    levels: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 9  # Of a plan; seven nearly suffice
    spread: Positive = 0.15  # First standard deviation of its numbers, -1 to 1, in CMA-ES
    hidden: Price | None = None  # Penalty for an undetected fault in the search [nat]; None: that of the demands

    @property
    def rounds(self) -> int:
        """Times that plans are compared."""
        return -(-self.drawn // (self.population * self.brakes)) + len(halvings(self.starts)) * self.steps


class Found(NamedTuple):
    """State of a search."""

    plans: int  # Played so far
    best: float  # Greatest mean return of a plan on the brakes of this round
    numbers: Floats  # Of that plan, shape [2 n]


def speeds_of(numbers: Floats, horizon: int) -> Floats:
    """Speeds of plans at each step as parts of the limit; shape [..., 2 n] to [..., horizon].

    In the period in which a level begins, the speed is the mean of both, by their shares of the period.
    """
    of_levels, of_times = np.split(np.clip(numbers, -1.0, 1.0), 2, axis=-1)
    times = np.cumsum(np.exp(WIDTHS * of_times), axis=-1)
    ends = np.concatenate([np.zeros_like(times[..., :1]), times / times[..., -1:]], axis=-1)
    passed = np.clip(np.arange(horizon + 1.0) - horizon * ends[..., None], 0.0, None)
    shares = np.diff(passed, axis=-1)
    within = shares[..., :-1, :] - shares[..., 1:, :]  # of each period in each level
    speeds = np.einsum("...i,...ik->...k", np.sign(of_levels) * of_levels**2, within)
    within_limit: Floats = np.clip(speeds, -1.0, 1.0)  # sums of shares are 1 but for rounding
    return within_limit


class Compared:
    """Brakes of several environments on which plans are compared: the fewer plans at a time, the more brakes."""

    def __init__(self, environments: Sequence[EmbExcitationVectorEnv], steps: int, seed: int) -> None:
        """Draw the brakes of each environment for experiments of these steps."""
        self._environments, self._steps = environments, steps
        streams = np.random.SeedSequence(seed, spawn_key=(STREAM,)).spawn(len(environments))
        self.most = environments[0].num_envs  # Plans at a time
        self._seeds = [stream.generate_state(self.most, np.uint64).tolist() for stream in streams]

    def returns(self, plans: Floats) -> Floats:
        """Mean return of each plan on the first brakes for which there is room, shape [plans, 2 n] to [plans]."""
        speeds, brakes = speeds_of(plans, self._steps), self.most // len(plans)

        def of_env(env: EmbExcitationVectorEnv, seeds: list[int]) -> Floats:
            played = speeds.repeat(brakes, axis=0)
            spare = self.most - len(played)  # the environment has that many more; they play the first plan again
            returns = play(env, seeds[:brakes] * len(plans) + seeds[:spare], np.concatenate([played, played[:spare]]))
            of_plans: Floats = returns[: len(played)].reshape(len(plans), brakes).mean(axis=1)
            return of_plans

        means: Floats = np.mean(at_once(of_env, self._environments, self._seeds), axis=0)
        return means


def play(env: EmbExcitationVectorEnv, seeds: Sequence[int], actions: Floats) -> Floats:
    """Returns of experiments with these seeds and actions, shape [N, steps] to [N], each until it is over."""
    env.reset(seed=seeds)
    returns, over = np.zeros(env.num_envs), np.zeros(env.num_envs, np.bool_)
    for k in range(actions.shape[1]):
        step = env.step if k + 1 < actions.shape[1] else env.advance
        _, rewards, ended, _, _ = step(actions[:, k : k + 1].astype(np.float32))
        returns += np.where(over, 0.0, rewards)
        over |= ended
    return returns


def search(
    compared: Compared,
    options: PlanSearch,
    rng: np.random.Generator,
    show: Callable[[Found], object] = lambda found: None,
) -> Floats:
    """Finds a plan.

    Args:
        compared: brakes.
        options: how far to look.
        rng: of the plans.
        show: called after each comparison.

    Returns:
        The best plan of the last search on its brakes; shape [2 n].
    """
    found, levels = Found(0, -np.inf, np.zeros(2 * options.levels)), options.levels

    def returns_of(plans: Floats) -> Floats:
        nonlocal found
        returns = compared.returns(plans)
        at = int(np.argmax(returns))
        best = (float(returns[at]), plans[at].copy()) if returns[at] > found.best else (found.best, found.numbers)
        found = Found(found.plans + len(plans), *best)
        show(found)
        return returns

    plans = rng.uniform(-1.0, 1.0, (-(-options.drawn // compared.most), compared.most, 2 * levels))
    of_levels = plans[..., :levels]
    plans[..., :levels] = np.where(rng.random(of_levels.shape) < 0.5, np.sign(of_levels), CREEP * of_levels)
    returns = np.concatenate([returns_of(some) for some in plans])
    cma_options: dict[str, Any] = {
        "popsize": options.population, "bounds": [-BOUND, BOUND], "verbose": -9, "seed": np.nan,
        "randn": lambda *shape: rng.standard_normal(shape),
    }  # fmt: skip
    best = plans.reshape(-1, 2 * levels)[np.argsort(-returns)[: options.starts]]
    searches: list[Any] = [cma.CMAEvolutionStrategy(begin, options.spread, cma_options) for begin in best]
    for count in halvings(options.starts):
        found = found._replace(best=-np.inf)  # there are more brakes now
        for _ in range(options.steps):
            asks = np.array([strategy.ask() for strategy in searches])
            returns = returns_of(asks.reshape(-1, 2 * levels)).reshape(len(searches), options.population)
            for strategy, candidates, values in zip(searches, asks, returns, strict=True):
                strategy.tell(list(candidates), (-values).tolist())
        best_first = np.argsort(-returns.max(axis=1), kind="stable")
        searches = [searches[k] for k in best_first[: -(-count // 2)]]
    return np.clip(found.numbers, -1.0, 1.0)


def halvings(starts: int) -> list[int]:
    """Number of searches in each round: all, half of them, ..., one."""
    return [starts, *halvings(-(-starts // 2))] if starts > 1 else [1]
