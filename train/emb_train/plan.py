"""Search for a plan of speeds for brakes that nobody knows: a few levels and their times, by CMA-ES.

A plan holds n levels of speed, for a time each, and then the shield brings the brake home; it depends on no
measurement. Its 2 n numbers lie within ±1: the signed root of each level, so that a creep of some rad/s is as wide as
a full stroke, and the logarithm of each time, so that the levels keep their order. The landscape has many tops, and
most plans say nothing at all: the best of some hundred at random begins, and CMA-ES (Hansen and Ostermeier, Completely
derandomized self-adaptation in evolution strategies, Evolutionary Computation 9, 2001) improves it with the same brakes
in each step, one set for each environment.
"""

from __future__ import annotations

import copy
import operator
from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import cma
import msgspec
import numpy as np

from emb_bench.information.symmetric import Floats
from emb_train.closed_loop import Count, Positive
from emb_train.env import EmbExcitationVectorEnv
from emb_train.ppo import at_once

BOUND = 1.05  # Beyond the ends of the numbers, so that full speed is inside
NEAR = 0.3  # Half the levels drawn are this much smaller, for a creep
WIDTHS = 3.0  # Logarithm of the longest time over the mean
STREAM = 0x706C616E  # Spawn key of the brakes on which plans are compared


class PlanSearch(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The search for the plan that an actor begins with."""

    drawn: Count = 1600  # Plans at random, rounded up
    starts: Count = 2  # Of these, from which CMA-ES begins
    steps: Count = 60  # Of CMA-ES from each, and from the best of them on
    population: Annotated[int, msgspec.Meta(ge=4, le=1000)] = 16  # Plans of a step
    brakes: Count = 3  # Of each plant, on which they are compared
    levels: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 9  # Of a plan; seven nearly suffice
    spread: Positive = 0.15  # First standard deviation of its numbers, -1 to 1, in CMA-ES

    @property
    def rounds(self) -> int:
        """Times that plans are compared."""
        return -(-self.drawn // (self.population * self.brakes)) + 1 + (self.starts + 1) * self.steps


class Found(NamedTuple):
    """State of a search."""

    plans: int  # Played so far
    best: float  # Greatest mean return of a plan
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
    speeds: Floats = np.einsum("...i,...ik->...k", np.sign(of_levels) * of_levels**2, within)
    return speeds


class Compared:
    """Brakes of several environments on which plans are compared, some plans at a time."""

    def __init__(self, environments: Sequence[EmbExcitationVectorEnv], plans: int, steps: int, seed: int) -> None:
        """Draw the brakes: as many in each environment as leave room for ``plans`` of these steps at a time."""
        self._environments, self.plans, self._steps = environments, plans, steps
        streams = np.random.SeedSequence(seed, spawn_key=(STREAM,)).spawn(len(environments))
        self._seeds = [
            stream.generate_state(env.num_envs // plans, np.uint64).tolist()
            for stream, env in zip(streams, environments, strict=True)
        ]

    def screening(self) -> Compared:
        """Gives the same with the first brake of each environment alone, for as many more plans at a time."""
        screening = copy.copy(self)
        screening.plans = self._environments[0].num_envs
        screening._seeds = [seeds[:1] for seeds in self._seeds]
        return screening

    def returns(self, plans: Floats) -> Floats:
        """Mean return of each plan, shape [plans, 2 n] to [plans]."""
        speeds = speeds_of(plans, self._steps)

        def of_env(env: EmbExcitationVectorEnv, seeds: list[int]) -> Floats:
            returns = play(env, seeds * len(plans), np.repeat(speeds, len(seeds), axis=0))
            of_plans: Floats = returns.reshape(len(plans), -1).mean(axis=1)
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
    asked: PlanSearch,
    rng: np.random.Generator,
    show: Callable[[Found], object] = lambda found: None,
) -> Floats:
    """Finds a plan.

    Args:
        compared: brakes, as many plans at a time as a step of CMA-ES has.
        asked: how far to look; the best of the plans at random are compared on all brakes.
        rng: of the plans.
        show: called after each comparison.

    Returns:
        The best of all plans on these brakes; shape [2 n].
    """
    found, levels = Found(0, -np.inf, np.zeros(2 * asked.levels)), asked.levels

    def note(plans: Floats, by: Compared, counts: bool = True) -> Floats:
        nonlocal found
        returns = by.returns(plans)
        at = int(np.argmax(returns))
        better = counts and returns[at] > found.best
        best = (float(returns[at]), plans[at].copy()) if better else (found.best, found.numbers)
        found = Found(found.plans + len(plans), *best)
        show(found)
        return returns

    def improve(strategy: Any) -> float:
        """A step of CMA-ES after the other; gives the best return of the last."""
        last = -np.inf
        for _ in range(asked.steps):
            plans = np.array(strategy.ask())
            returns = note(plans, compared)
            strategy.tell(list(plans), (-returns).tolist())
            last = float(returns.max())
        return last

    screening, plans, returns = compared.screening(), [], []
    for _ in range(-(-asked.drawn // screening.plans)):
        some = rng.uniform(-1.0, 1.0, (screening.plans, 2 * levels))
        some[:, :levels] *= np.where(rng.random((len(some), levels)) < 0.5, NEAR, 1.0)
        plans.append(some)
        returns.append(note(some, screening, counts=False))
    best, searches = _best(np.concatenate(plans), np.concatenate(returns), compared.plans), []
    for begin in _best(best, note(best, compared), asked.starts):
        options: dict[str, Any] = {
            "popsize": compared.plans, "bounds": [-BOUND, BOUND], "verbose": -9, "seed": np.nan,
            "randn": lambda *shape: rng.standard_normal(shape),
        }  # fmt: skip
        strategy = cma.CMAEvolutionStrategy(begin, asked.spread, options)
        searches.append((improve(strategy), strategy))
    improve(max(searches, key=operator.itemgetter(0))[1])
    return np.clip(found.numbers, -1.0, 1.0)


def _best(plans: Floats, returns: Floats, count: int) -> Floats:
    chosen: Floats = plans[np.argsort(-returns)[:count]]
    return chosen
