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
    collect,
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


def trained(ppo: Ppo = TINY, seed: int = 0, reward: Reward = information_increment) -> tuple[Actor, list[Metrics]]:
    torch.manual_seed(seed)
    env = EmbExcitationVectorEnv(ppo.envs, SHORT, reward=reward, scale=1e-3)
    actor = Actor(SHORT, ppo.hidden, ppo.initial_mean, ppo.initial_deviation)
    return actor, list(train(env, actor, ppo, seed))


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


def test_the_networks_begin_and_end_as_configured() -> None:
    actor = Actor(BENCH, (64, 64), 0.5, 1.0)
    seen = torch.tensor([[0.0, 0.0, 0.0], [90.0, -400.0, 499.0]])
    assert actor(seen).detach().numpy() == pytest.approx(0.5 * np.ones((2, 1)), abs=0.1)
    corners = torch.tensor([[-10.0, -500.0, 0.0], [100.0, 500.0, 500.0]])
    assert ((corners - actor.centre) / actor.span).tolist() == [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]
    for mean, current in ((0.5, 3.0), (7.0, 6.0), (-7.0, -6.0)):
        actor = Actor(BENCH, (4,), mean, 1.0)
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
    env, actor = EmbExcitationVectorEnv(8, SHORT, scale=1e-3), Actor(SHORT, (8, 8), 0.0, 0.5)
    critic = Critic(env.batch.critic_size, (8, 8))
    rollout = collect(env, actor, 60, 0.5, list(range(8)), torch.Generator().manual_seed(1))
    others = by_the_textbook(actor, critic, rollout, ppo, 2)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-3, eps=1e-5)
    improve(actor, critic, optimiser, rollout, ppo, torch.Generator().manual_seed(2))
    for own, other in zip((actor, critic), others, strict=True):
        for mine, independent in zip(own.parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(mine, independent, rtol=1e-3, atol=1e-5)


def test_a_rollout_is_made_of_whole_experiments_that_follow_the_actor_plus_the_exploration() -> None:
    env, actor = EmbExcitationVectorEnv(6, SHORT, scale=1e-3), Actor(SHORT, (10, 7), 0.1, 0.5)
    torch.nn.init.normal_(actor.layers[-1].weight)  # type: ignore[arg-type]  # the last layer is Linear
    noise = exploration_noise(120, 6, 0.9, torch.Generator().manual_seed(0))
    for exploration in (0.0, 1.0):
        generator = torch.Generator().manual_seed(0)
        rollout = collect(env, actor, 120, 0.9, list(range(6)), generator, exploration=exploration)
        with torch.no_grad():
            mean = actor(rollout.seen.flatten(0, 1)).view(120, 6, 1)
        torch.testing.assert_close(rollout.actions, mean + 0.5 * exploration * noise, rtol=1e-4, atol=1e-4)
    assert rollout.terminals.sum(dim=1).nonzero().flatten().tolist() == [59, 119]
    assert (rollout.ended, rollout.violations, rollout.home) == (12, 0, 12)
    assert rollout.seen[:, 0, 2].tolist() == [*range(60), *range(60)]
    assert rollout.rewards.sum().item() / 1e-3 / 12 == pytest.approx(rollout.information, rel=1e-4)


def test_training_improves_the_return() -> None:
    changes = {"total_steps": 60 * 64 * 30, "envs": 64, "minibatch": 960, "learning_rate": 1e-2, "gae_lambda": 1.0}
    returns = [metrics.mean_return for metrics in trained(msgspec.structs.replace(TINY, **changes))[1]]
    assert len(returns) == 30
    assert sum(returns[-3:]) > 2.0 * sum(returns[:3])


def test_a_training_whose_experiments_all_end_early_for_long_is_given_up() -> None:
    changes = {"total_steps": 960 * 16, "envs": 4, "rollout": 240, "minibatch": 960, "epochs": 1, "learning_rate": 1e-9}
    env = EmbExcitationVectorEnv(4, BENCH, conditions=OPEN)
    iterations = train(env, Actor(BENCH, (8, 8), 1.0, 0.1), msgspec.structs.replace(TINY, **changes), 0)
    with pytest.raises(TrainingDivergedError):
        list(iterations)
