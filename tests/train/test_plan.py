"""The search for a plan, with few plans and brakes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from msgspec.structs import replace

from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.information.symmetric import Floats
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_train.closed_loop import Conditions
from emb_train.env import EmbExcitationEnv, EmbExcitationVectorEnv
from emb_train.plan import Compared, Found, PlanSearch, play, search, speeds_of
from emb_train.rewards import ExpectedInterval
from tests.benches import SENSOR_BENCH

BENCH = SENSOR_BENCH
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=60))
FOLLOWED = Conditions(acts="speed", observes="estimate", information="physical")
FINE = 2000  # Parts of a period
LEVELS, SPREAD = 9, 0.15
NUMBERS = arrays(np.float64, 2 * LEVELS, elements=st.floats(-1.05, 1.05))


@given(NUMBERS)
def test_a_plan_has_its_levels_in_their_order_each_for_its_time(numbers: Floats) -> None:
    levels, times = np.split(np.clip(numbers, -1.0, 1.0), 2)
    levels, ends = np.copysign(levels * levels, levels), np.cumsum(np.exp(3.0 * times))
    at = ends[-1] * (np.arange(40 * FINE) + 0.5) / (40 * FINE)
    means = levels[np.searchsorted(ends, at)].reshape(40, FINE).mean(axis=1)
    np.testing.assert_allclose(speeds_of(numbers, 40), means, atol=2.0 * LEVELS / FINE)


@given(NUMBERS, st.integers(1, 300))
@example(np.concatenate([np.ones(LEVELS), np.linspace(-0.7, 0.9, LEVELS)]), 300)
def test_a_plan_stays_within_the_limit_and_goes_as_far_as_its_levels_do(numbers: Floats, horizon: int) -> None:
    speeds = speeds_of(np.stack([numbers, -numbers]), horizon)
    assert speeds.shape == (2, horizon)
    assert (np.abs(speeds) <= 1.0).all()  # else evaluate refuses the plan.json of a full stroke
    levels, times = np.split(np.clip(numbers, -1.0, 1.0), 2)
    weights = np.exp(3.0 * times)
    assert speeds[0].mean() == pytest.approx(np.sign(levels) * levels**2 @ weights / weights.sum(), abs=1e-9)


class Landscape(Compared):
    """Plans that are worth what a function says, with what was asked."""

    def __init__(self, worth: Callable[[Floats], Floats]) -> None:
        self.most, self.asked, self._worth = 64, list[Floats](), worth

    def returns(self, plans: Floats) -> Floats:
        self.asked.append(plans.copy())
        return self._worth(plans)


def distance(plans: Floats) -> Floats:
    """A landscape with one top."""
    worth: Floats = -np.square(plans - 0.4).sum(axis=1)
    return worth


FOUR = PlanSearch(drawn=90, starts=4, steps=30, population=16, levels=LEVELS, spread=SPREAD)


def test_searches_begin_at_the_best_plans_drawn_and_the_better_half_goes_on_with_twice_the_brakes() -> None:
    landscape, shown = Landscape(distance), list[Found]()
    found = search(landscape, FOUR, np.random.default_rng(3), shown.append)
    assert [len(plans) for plans in landscape.asked] == [64, 64, *[64] * 30, *[32] * 30, *[16] * 30]
    assert len(landscape.asked) == replace(FOUR, brakes=4).rounds
    assert [one.plans for one in shown] == np.cumsum([len(plans) for plans in landscape.asked]).tolist()
    drawn = np.concatenate(landscape.asked[:2])
    levels = np.abs(drawn[:, :LEVELS])
    assert ((levels == 1.0) | (levels <= 0.5)).all()  # full strokes and creeps
    assert 0.4 < (levels == 1.0).mean() < 0.6
    best = drawn[np.argsort(-distance(drawn))[:4]]
    middles = landscape.asked[2].reshape(4, 16, -1).mean(axis=1)
    assert np.abs(middles - best).max() < 5.0 * SPREAD / np.sqrt(16)
    for before, after, left in ((31, 32, 2), (61, 62, 1)):
        ended = landscape.asked[before].reshape(-1, 16, 2 * LEVELS)
        order = np.argsort([-distance(plans).max() for plans in ended])[:left]
        begun = landscape.asked[after].reshape(-1, 16, 2 * LEVELS)
        for k, own in zip(order, begun, strict=True):
            assert np.abs(own.mean(axis=0) - ended[k].mean(axis=0)).max() < 5.0 * ended[k].std()  # where it ended
    last = np.concatenate(landscape.asked[62:])
    assert found.tolist() == np.clip(last[np.argmax(distance(last))], -1.0, 1.0).tolist()
    assert distance(found[None])[0] > 0.2 * distance(drawn).max()
    again = search(Landscape(distance), FOUR, np.random.default_rng(3))
    assert again.tolist() == found.tolist()


def test_the_best_plan_is_one_of_the_last_search_whatever_fewer_brakes_said() -> None:
    calls = 0

    def falling(plans: Floats) -> Floats:
        nonlocal calls
        calls += 1
        returns: Floats = np.arange(len(plans), dtype=np.float64) - 100.0 * calls
        return returns

    landscape = Landscape(falling)
    found = search(landscape, replace(FOUR, starts=2, steps=5), np.random.default_rng(3))
    assert found.tolist() == np.clip(landscape.asked[-5][-1], -1.0, 1.0).tolist()


def environments(count: int) -> list[EmbExcitationVectorEnv]:
    reward = ExpectedInterval(IntervalCriterion("T"))
    where = (count, SHORT, "pm50", PARAMETER_NAMES, reward, 1.0)
    return [EmbExcitationVectorEnv(*where, plant, FOLLOWED) for plant in ("exact", "stribeck")]


def test_plans_are_compared_on_the_same_brakes_of_each_plant_and_worth_the_mean() -> None:
    rng = np.random.default_rng(1)
    plans = rng.uniform(-1.0, 1.0, (3, 2 * LEVELS))
    plans[2] = plans[0]
    both = environments(7)
    found = Compared(both, 60, 5).returns(plans)
    assert found[0] == found[2] != found[1]
    for env in both:
        brakes = env.batch.experiments.brakes[:6].reshape(3, 2, -1)
        assert (brakes[0] == brakes[1]).all()
        assert (brakes[0, 0] != brakes[0, 1]).any()
    assert (both[0].batch.experiments.brakes[:6] != both[1].batch.experiments.brakes[:6]).any()
    many = Compared(environments(7), 60, 5)
    assert len({*many.returns(np.repeat(plans[:1], many.most, axis=0)).tolist()}) == 1
    apart = Compared(environments(7)[:1], 60, 5).returns(plans)
    assert found[0] != apart[0]
    assert Compared(environments(7), 60, 6).returns(plans)[0] != found[0]


def test_an_experiment_counts_until_it_is_over() -> None:
    settings = {"bench": BENCH, "ranges": "pm50", "scale": 1e-6}
    conditions = Conditions(acts="speed", observes="estimate", shielded=False)
    actions, seeds = np.full((2, 500), 1.0), [1, 2]
    actions[1] = 0.01
    env = EmbExcitationVectorEnv(2, conditions=conditions, **settings)  # type: ignore[arg-type]  # of several types
    found = play(env, seeds, actions)
    for seed, row, value in zip(seeds, actions, found, strict=True):
        one = EmbExcitationEnv(conditions=conditions, **settings)
        one.reset(seed=seed)
        total, steps, over = 0.0, 0, False
        while not over:
            _, reward, over, _, _ = one.step(row[steps : steps + 1].astype(np.float32))
            total, steps = total + reward, steps + 1
        assert value == pytest.approx(total)
        assert (steps < 500) == (seed == 1)
