"""The algorithm's parts against numbers worked by hand and independent formulas; then the whole on a tiny task."""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import Any

import msgspec
import numpy as np
import pytest
import torch

from emb_bench.config.bench import load_bench
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_train.closed_loop import Conditions
from emb_train.env import EmbExcitationVectorEnv
from emb_train.ppo import (
    Actor,
    Critic,
    DeployedActor,
    Metrics,
    Ppo,
    Rollout,
    TrainingDivergedError,
    against_mean,
    clone,
    collect,
    collect_all,
    exploration_noise,
    generalised_advantages,
    improve,
    surrogate,
    train,
)
from emb_train.rewards import Reward, information_increment

BENCH = load_bench()
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=60))
TINY = Ppo(total_steps=60 * 8 * 3, envs=8, rollout=60, minibatch=160, epochs=2, hidden=(8, 8))
OPEN = Conditions(shielded=False)


def tensor(*rows: Any) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def begun(mean: float, *hidden: int) -> Ppo:
    """Hyper-parameters of a network that begins with this mean action."""
    return msgspec.structs.replace(TINY, initial_mean=mean, hidden=hidden)


def trained(ppo: Ppo = TINY, seed: int = 0, reward: Reward = information_increment) -> tuple[Actor, list[Metrics]]:
    torch.manual_seed(seed)
    env = EmbExcitationVectorEnv(ppo.envs, SHORT, reward=reward, scale=1e-3)
    actor = Actor(SHORT, ppo)
    return actor, list(train([env], actor, ppo, seed))


def test_advantages_of_three_steps_worked_by_hand() -> None:
    # γ = 0.5, λ = 0.5; δ = [1 + 0.5·2 − 1, 2 + 0.5·3 − 2, 3 + 0.5·4 − 3] = [1, 1.5, 2]
    # Â_3 = 2, Â_2 = 1.5 + 0.25·2 = 2, Â_1 = 1 + 0.25·2 = 1.5. Where the second step ends its experiment: δ_2 = 0,
    # Â_2 = 0, Â_1 = 1 + 0.5·2 − 1 + 0.25·0 = 1. Where the last one does: Â_3 = 3 − 3 = 0, Â_2 = 1.5, Â_1 = 1.375.
    rewards, values = tensor([1.0], [2.0], [3.0]), tensor([1.0], [2.0], [3.0], [4.0])
    for ends, expected in (
        ([0.0, 0.0, 0.0], [1.5, 2.0, 2.0]),
        ([0.0, 1.0, 0.0], [1.0, 0.0, 2.0]),
        ([0.0, 0.0, 1.0], [1.375, 1.5, 0.0]),
    ):
        found = generalised_advantages(rewards, values, tensor(*ends)[:, None], 0.5, 0.5)
        assert found.flatten().tolist() == expected, ends


def test_each_branch_of_the_clipped_surrogate() -> None:
    for ratio, advantage, objective, slope in (
        (1.1, 2.0, 2.2, 2.2),  # inside: ρ Â, and its derivative with respect to log ρ is itself
        (0.9, -2.0, -1.8, -1.8),
        (1.5, 2.0, 2.4, 0.0),  # a good action is already likelier: clipped, no gradient
        (0.5, 2.0, 1.0, 1.0),  # a good action became rarer: not clipped
        (0.5, -2.0, -1.6, 0.0),  # a bad action is already rarer: clipped
        (1.5, -2.0, -3.0, -3.0),  # a bad action became likelier: not clipped
    ):
        log_ratio = torch.tensor([math.log(ratio)], dtype=torch.float64, requires_grad=True)
        loss = surrogate(log_ratio, tensor(advantage), 0.2)
        torch.autograd.backward(loss)
        assert log_ratio.grad is not None
        assert (-loss.item(), -log_ratio.grad.item()) == pytest.approx((objective, slope)), (ratio, advantage)
    assert surrogate(torch.log(tensor(1.1, 1.5)), tensor(2.0, 2.0), 0.2).item() == pytest.approx(-(2.2 + 2.4) / 2)


def test_exploration_noise_has_unit_deviation_at_every_step_and_the_asked_memory() -> None:
    for memory in (0.0, 0.9):
        noise = exploration_noise(200, 2000, memory, torch.Generator().manual_seed(0))[..., 0]
        assert noise.std(dim=1).numpy() == pytest.approx(np.ones(200), abs=0.08)
        correlation = (noise[1:] * noise[:-1]).mean() / noise.square().mean()
        assert correlation.item() == pytest.approx(memory, abs=0.01)


def test_noise_is_held_for_some_steps() -> None:
    noise = exploration_noise(23, 4, 0.5, torch.Generator().manual_seed(0), 5)
    other = exploration_noise(5, 4, 0.5, torch.Generator().manual_seed(0))
    assert len(noise) == 23
    torch.testing.assert_close(noise, other.repeat_interleave(5, 0)[:23])


def test_the_networks_begin_and_end_as_configured() -> None:
    actor = Actor(BENCH, begun(0.5, 64, 64))
    seen = torch.tensor([[0.0, 0.0, 0.0], [90.0, -400.0, 499.0]])
    assert actor(seen).detach().numpy() == pytest.approx(0.5 * np.ones((2, 1)), abs=0.1)
    corners = torch.tensor([[-10.0, -500.0, 0.0], [100.0, 500.0, 500.0]])
    assert actor.features(corners).tolist() == [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
    for mean, current in ((0.5, 3.0), (7.0, 6.0), (-7.0, -6.0)):
        actor = Actor(BENCH, begun(mean, 4))
        torch.nn.init.zeros_(actor.layers[-1].weight)  # type: ignore[arg-type]  # the last layer is Linear
        assert DeployedActor(actor, 6.0)(torch.zeros(1, 3)).item() == pytest.approx(current, rel=1e-5)


def by_the_textbook(actor: Actor, critic: Critic, rollout: Rollout, ppo: Ppo, seed: int) -> tuple[Actor, Critic]:
    """Torch's own density and minimum; an index for each part of a sample."""
    actor, critic = copy.deepcopy(actor), copy.deepcopy(critic)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3, eps=1e-5)
    seen, actions, states = (part.flatten(0, 1) for part in (rollout.seen, rollout.actions, rollout.states[:-1]))
    distributions: Any = torch.distributions

    def density(index: torch.Tensor) -> torch.Tensor:
        gaussian = distributions.Normal(actor(seen[index]), actor.log_deviation.exp())
        result: torch.Tensor = gaussian.log_prob(actions[index])
        return result.squeeze(-1)

    with torch.no_grad():
        values, old = critic(rollout.states), density(torch.arange(len(seen)))
        raw = generalised_advantages(rollout.rewards, values, rollout.terminals, ppo.gamma, ppo.gae_lambda)
        returns = (raw + values[:-1]).flatten()
        advantages = ((raw - raw.mean()) / raw.std()).flatten()
    generator = torch.Generator().manual_seed(seed)
    for _ in range(ppo.epochs):
        for index in torch.split(torch.randperm(len(seen), generator=generator), ppo.minibatch):
            ratio = (density(index) - old[index]).exp()
            clipped = ratio.clamp(1 - ppo.clip, 1 + ppo.clip)
            gain = torch.minimum(ratio * advantages[index], clipped * advantages[index]).mean()
            error = 0.5 * (critic(states[index]) - returns[index]).square().mean()
            loss = error - gain - ppo.entropy * actor.log_deviation.sum()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            for network in (actor, critic):
                torch.nn.utils.clip_grad_norm_(network.parameters(), ppo.max_gradient)
            optimiser.step()
    return actor, critic


def test_an_improvement_is_that_of_the_textbook() -> None:
    ppo = msgspec.structs.replace(TINY, entropy=0.01, minibatch=100)
    torch.manual_seed(0)
    env, actor = EmbExcitationVectorEnv(8, SHORT, scale=1e-3), Actor(SHORT, TINY)
    critic = Critic(env.batch.critic_observation().shape[1], (8, 8))
    noise = exploration_noise(60, 8, 0.5, torch.Generator().manual_seed(1))
    rollout = collect(env, actor, noise, list(range(8)))
    others = by_the_textbook(actor, critic, rollout, ppo, 2)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3, eps=1e-5)
    improve(actor, critic, optimiser, rollout, ppo, torch.Generator().manual_seed(2))
    for own, other in zip((actor, critic), others, strict=True):
        for mine, independent in zip(own.parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(mine, independent, rtol=1e-3, atol=1e-5)


def test_a_rollout_is_made_of_whole_experiments_that_follow_the_actor_plus_the_exploration() -> None:
    env, actor = EmbExcitationVectorEnv(6, SHORT, scale=1e-3), Actor(SHORT, begun(0.1, 10, 7))
    torch.nn.init.normal_(actor.layers[-1].weight)  # type: ignore[arg-type]  # the last layer is Linear
    noise = exploration_noise(120, 6, 0.9, torch.Generator().manual_seed(0))
    for exploration in (0.0, 1.0):
        rollout = collect(env, actor, exploration * noise, list(range(6)))
        with torch.no_grad():
            mean = actor(rollout.seen.flatten(0, 1)).view(120, 6, 1)
        torch.testing.assert_close(rollout.actions, mean + 0.5 * exploration * noise, rtol=1e-4, atol=1e-4)
    assert rollout.terminals.sum(dim=1).nonzero().flatten().tolist() == [59, 119]
    assert rollout.counts == {"ended": 12, "violations": 0, "home": 12}
    assert rollout.seen[:, 0, 2].tolist() == [*range(60), *range(60)]


def test_experiments_of_a_pair_differ_in_their_exploration_alone_and_count_by_what_one_returns_more() -> None:
    ppo, limit = msgspec.structs.replace(TINY, pairs=True, noise_memory=0.9), 1e-9
    envs = [EmbExcitationVectorEnv(4, SHORT, scale=limit) for _ in range(2)]
    torch.manual_seed(0)
    actor = Actor(SHORT, ppo)
    rollout = collect_all(envs, actor, ppo, list(range(8)), torch.Generator().manual_seed(1))
    assert rollout.rewards.shape == (60, 8)
    for first in (0, 1, 4, 5):  # with the third and the fourth of its environment
        pair = slice(first, first + 3, 2)
        assert (rollout.states[0, first] == rollout.states[0, first + 2]).all()
        explored = rollout.actions[0, pair, 0] - actor(rollout.seen[0, pair]).detach()[:, 0]
        assert explored.sum().item() == pytest.approx(0.0, abs=1e-6)
        assert explored[0].item() != 0.0
        assert rollout.rewards[:, pair].sum(dim=1).abs().max().item() == pytest.approx(0.0, abs=1e-9)
        assert rollout.rewards[:, first].abs().max().item() > 0.0
    assert len({*rollout.states[0, :, 3].tolist()}) == 4
    alone = dataclasses.replace(
        rollout,
        rewards=torch.tensor([[0.3, 9.0, 0.1, -9.0]]),
        terminals=torch.ones(1, 4),
        strayed=torch.zeros(1, 4),
    )
    assert against_mean(alone).rewards.flatten().tolist() == pytest.approx([0.1, 1.0, -0.1, -1.0])


def test_of_a_pair_of_which_one_leaves_the_limits_it_counts_least_and_what_follows_counts_for_nothing() -> None:
    none = torch.zeros(4, 1)
    rewards, ends, left = (torch.zeros(4, 6) for _ in range(3))  # the pairs are columns 0 and 3, 1 and 4, 2 and 5
    ends[3] = 1.0
    rewards[1:, 0], rewards[:, 3] = torch.tensor([0.1, 7.0, 7.0]), 0.2  # 0 leaves in step 1 and begins again
    ends[1, 0] = left[1, 0] = 1.0
    ends[0, 1] = left[0, 1] = ends[2, 4] = left[2, 4] = 1.0  # both leave
    rewards[:, 1], rewards[:, 4] = 5.0, 6.0
    rewards[2, 2], rewards[2, 5] = 0.3, 0.1  # none leaves
    found = against_mean(Rollout(none, none, none, none, rewards, ends, left, none, 0.0)).rewards
    expected = torch.zeros(4, 6)
    expected[1, 0], expected[3, 3] = -1.0, 1.0
    expected[0, 1] = expected[2, 4] = -1.0
    expected[2, 2], expected[2, 5] = 0.1, -0.1
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(("steps", "count"), [(30, 6), (60, 6), (120, 12), (90, 6)])
def test_the_mean_return_is_that_of_experiments_that_ended_or_of_those_that_began_where_none_is_whole(
    steps: int, count: int
) -> None:
    env = EmbExcitationVectorEnv(6, SHORT, scale=1e-3)
    rollout = collect(env, Actor(SHORT, TINY), torch.zeros(steps, 6, 1), list(range(6)))
    assert rollout.mean_return == pytest.approx(rollout.rewards.sum().item() / count)


def test_one_that_leaves_the_limits_early_is_not_all_that_a_short_rollout_returns() -> None:
    env, steps = EmbExcitationVectorEnv(2, BENCH, conditions=OPEN), 400
    noise = torch.zeros(steps, 2, 1)
    noise[:, 0] = 2.0  # full current
    rollout = collect(env, Actor(BENCH, begun(0.0, 4)), noise, [1, 2])
    counts = rollout.counts
    assert counts["violations"] == counts["ended"] > 0
    assert rollout.terminals[:, 1].sum() == 0.0
    assert rollout.mean_return == pytest.approx(rollout.rewards.sum().item() / (2 + counts["ended"]))


def test_an_actor_that_was_cloned_follows_the_plan_whatever_else_it_sees() -> None:
    speeds = [*[0.9] * 20, *[-0.2] * 25, *[0.004] * 15]
    ppo = msgspec.structs.replace(TINY, hidden=(32,), clone_steps=1500, clone_rate=1e-2)
    torch.manual_seed(0)
    actor = Actor(SHORT, ppo, 11, speed=True)
    clone(actor, speeds, SHORT, ppo, torch.Generator().manual_seed(1))
    rng, nominal = np.random.default_rng(2), np.array([getattr(SHORT.brake, name) for name in PARAMETER_NAMES])
    deployed = DeployedActor(actor, SHORT.limits.velocity, SHORT.timing.sample_time)
    at = [k for k in range(60) if k % 20 > 4 and abs(k - 45) > 4]  # beside the switches
    for _ in range(20):
        rest = np.concatenate([nominal * rng.uniform(0.5, 1.5, 4), rng.uniform(0.0, 1.0, 4)])
        seen = np.array(
            [[rng.uniform(-5.0, 50.0), rng.uniform(-300.0, 300.0), 1e-3 * k, *rest] for k in at], np.float32
        )
        with torch.no_grad():
            found = deployed(torch.from_numpy(seen)).numpy()[:, 0]
        wanted = SHORT.limits.velocity * np.array(speeds)[at]
        np.testing.assert_allclose(np.arcsinh(found), np.arcsinh(wanted), atol=2.0)  # an action of 0.2
        assert (np.sign(found) == np.sign(wanted)).mean() > 0.9


def test_a_speed_is_finer_near_zero_and_clipped_at_the_limit() -> None:
    actor = Actor(SHORT, TINY, 11, speed=True)
    found = actor.part(torch.tensor([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0])).tolist()
    middle = math.sinh(4.5) / math.sinh(9.0)
    assert found == pytest.approx([-1.0, -1.0, -middle, 0.0, middle, 1.0, 1.0], rel=1e-5)


def test_training_improves_the_return() -> None:
    changes = {"total_steps": 60 * 64 * 30, "envs": 64, "minibatch": 960, "learning_rate": 1e-2, "gae_lambda": 1.0}
    returns = [metrics.mean_return for metrics in trained(msgspec.structs.replace(TINY, **changes))[1]]
    assert len(returns) == 30
    assert sum(returns[-3:]) > 2.0 * sum(returns[:3])


def test_a_training_whose_experiments_all_end_early_for_long_is_given_up() -> None:
    changes = {"total_steps": 960 * 16, "envs": 4, "rollout": 240, "minibatch": 960, "epochs": 1, "learning_rate": 1e-9}
    env = EmbExcitationVectorEnv(4, BENCH, conditions=OPEN)
    iterations = train([env], Actor(BENCH, begun(1.0, 8, 8)), msgspec.structs.replace(TINY, **changes), 0)
    with pytest.raises(TrainingDivergedError):
        list(iterations)
