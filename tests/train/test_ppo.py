"""The algorithm's parts against numbers worked by hand and independent formulas; then the whole on a tiny task."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_runtime.bench import load_bench
from emb_runtime.errors import UsageError
from emb_train.networks import Actor, Critic, DeployedActor
from emb_train.ppo import (
    Learner,
    PpoConfig,
    TrainingDivergedError,
    collect,
    exploration_noise,
    generalised_advantages,
    log_density,
    normalised,
    surrogate_loss,
)
from emb_train.rewards import InformationIncrement, Reward, Transition
from emb_train.vector_env import EmbExcitationVectorEnv

BENCH = load_bench()
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=60))
TINY = PpoConfig(total_steps=60 * 8 * 3, envs=8, rollout=60, minibatch=160, epochs=2, hidden=(8, 8))


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


def tensor(*rows: Any) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


REWARD = InformationIncrement(1e-3)


def learner(config: PpoConfig = TINY, seed: int = 0, reward: Reward = REWARD) -> Learner:
    torch.manual_seed(seed)
    env = EmbExcitationVectorEnv(config.envs, SHORT, reward=reward)
    actor = Actor(SHORT, config.hidden, config.initial_mean, config.initial_deviation)
    return Learner(env, actor, Critic(env.critic_size, config.hidden), config, seed)


def weights(one: Learner) -> list[torch.Tensor]:
    return [*one.actor.state_dict().values(), *one.critic.state_dict().values()]


# Advantages -----------------------------------------------------------------------------------------------------------


def test_advantages_of_three_steps_worked_by_hand() -> None:
    # γ = 0.5, λ = 0.5; δ = [1 + 0.5·2 − 1, 2 + 0.5·3 − 2, 3 + 0.5·4 − 3] = [1, 1.5, 2]
    # Â_3 = 2, Â_2 = 1.5 + 0.25·2 = 2, Â_1 = 1 + 0.25·2 = 1.5
    result = generalised_advantages(
        tensor([1.0], [2.0], [3.0]), tensor([1.0], [2.0], [3.0]), torch.zeros(3, 1), tensor(4.0), 0.5, 0.5
    )
    assert result.flatten().tolist() == [1.5, 2.0, 2.0]


def test_nothing_from_beyond_a_terminal_reaches_an_advantage() -> None:
    # The second step ends its experiment: δ_2 = 2 − 2 = 0, Â_2 = 0, Â_1 = 1 + 0.5·2 − 1 + 0.25·0 = 1; Â_3 as before.
    result = generalised_advantages(
        tensor([1.0], [2.0], [3.0]), tensor([1.0], [2.0], [3.0]), tensor([0.0], [1.0], [0.0]), tensor(4.0), 0.5, 0.5
    )
    assert result.flatten().tolist() == [1.0, 0.0, 2.0]


def test_a_terminal_last_step_does_not_bootstrap() -> None:
    result = generalised_advantages(tensor([3.0]), tensor([1.0]), tensor([1.0]), tensor(1e6), 1.0, 1.0)
    assert result.item() == 2.0


@given(
    rewards=st.lists(st.floats(-10, 10), min_size=1, max_size=20),
    gamma=st.floats(0.0, 1.0),
    data=st.data(),
)
@settings(max_examples=50)
def test_with_lambda_one_an_advantage_is_the_discounted_return_minus_the_value(
    rewards: list[float], gamma: float, data: st.DataObject
) -> None:
    n = len(rewards)
    values = data.draw(st.lists(st.floats(-10, 10), min_size=n, max_size=n))
    ends = data.draw(st.lists(st.booleans(), min_size=n, max_size=n))
    last = data.draw(st.floats(-10, 10))
    result = generalised_advantages(
        tensor(*[[r] for r in rewards]),
        tensor(*[[v] for v in values]),
        tensor(*[[float(e)] for e in ends]),
        tensor(last),
        gamma,
        1.0,
    )
    for t in range(n):
        total, factor = 0.0, 1.0
        for later in range(t, n):
            total += factor * rewards[later]
            factor *= gamma
            if ends[later]:
                break
        else:
            total += factor * last
        assert result[t].item() == pytest.approx(total - values[t], abs=1e-9)


def test_experiments_side_by_side_do_not_mix() -> None:
    torch.manual_seed(0)
    rewards, values, ends = torch.randn(7, 3), torch.randn(7, 3), (torch.rand(7, 3) < 0.3).float()
    last = torch.randn(3)
    together = generalised_advantages(rewards, values, ends, last, 0.9, 0.8)
    for i in range(3):
        alone = generalised_advantages(
            rewards[:, i : i + 1], values[:, i : i + 1], ends[:, i : i + 1], last[i : i + 1], 0.9, 0.8
        )
        torch.testing.assert_close(together[:, i : i + 1], alone)


def test_normalised_advantages_have_mean_zero_and_deviation_one() -> None:
    result = normalised(torch.tensor([1.0, 2.0, 3.0, 10.0]))
    assert result.mean().item() == pytest.approx(0.0, abs=1e-6)
    assert result.std().item() == pytest.approx(1.0, abs=1e-6)
    assert normalised(torch.ones(5)).tolist() == [0.0] * 5


# The surrogate --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ratio", "advantage", "objective", "slope"),
    [
        (1.1, 2.0, 2.2, 2.2),  # inside: ρ Â, and its derivative with respect to log ρ is itself
        (0.9, -2.0, -1.8, -1.8),
        (1.5, 2.0, 2.4, 0.0),  # a good action is already likelier: clipped, no gradient
        (0.5, 2.0, 1.0, 1.0),  # a good action became rarer: not clipped
        (0.5, -2.0, -1.6, 0.0),  # a bad action is already rarer: clipped
        (1.5, -2.0, -3.0, -3.0),  # a bad action became likelier: not clipped
    ],
)
def test_each_branch_of_the_clipped_surrogate(ratio: float, advantage: float, objective: float, slope: float) -> None:
    log_ratio = torch.tensor([math.log(ratio)], dtype=torch.float64, requires_grad=True)
    loss = surrogate_loss(log_ratio, tensor(advantage), 0.2)
    torch.autograd.backward(loss)
    assert -loss.item() == pytest.approx(objective)
    assert log_ratio.grad is not None
    assert -log_ratio.grad.item() == pytest.approx(slope)


def test_the_surrogate_is_a_mean() -> None:
    log_ratio = torch.log(tensor(1.1, 1.5))
    assert surrogate_loss(log_ratio, tensor(2.0, 2.0), 0.2).item() == pytest.approx(-(2.2 + 2.4) / 2)


@given(mean=st.floats(-3, 3), deviation=st.floats(0.01, 10), action=st.floats(-5, 5))
def test_the_density_is_that_of_a_gaussian(mean: float, deviation: float, action: float) -> None:
    log_deviation = torch.log(tensor(deviation))
    own = log_density(tensor([mean]), log_deviation, tensor([action]))
    normal: Any = torch.distributions.Normal(tensor(mean), tensor(deviation))  # its methods have no types
    independent = normal.log_prob(torch.tensor(action, dtype=torch.float64))
    assert own.item() == pytest.approx(independent.item(), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("memory", [0.0, 0.9])
def test_exploration_noise_has_unit_deviation_at_every_step_and_the_asked_memory(memory: float) -> None:
    noise = exploration_noise(200, 2000, memory, torch.Generator().manual_seed(0))[..., 0]
    assert noise.std(dim=1).numpy() == pytest.approx(np.ones(200), abs=0.08)
    correlation = (noise[1:] * noise[:-1]).mean() / noise.square().mean()
    assert correlation.item() == pytest.approx(memory, abs=0.01)


# Networks -------------------------------------------------------------------------------------------------------------


def test_an_untrained_actor_asks_for_its_initial_mean_everywhere() -> None:
    actor = Actor(BENCH, (64, 64), 0.5, 1.0)
    seen = torch.tensor([[0.0, 0.0, 0.0], [90.0, -400.0, 499.0]])
    assert actor(seen).detach().numpy() == pytest.approx(0.5 * np.ones((2, 1)), abs=0.1)


def test_the_normaliser_maps_the_ranges_of_the_bench_to_one() -> None:
    actor = Actor(BENCH, (4,), 0.0, 1.0)
    corners = torch.tensor([[-10.0, -500.0, 0.0], [100.0, 500.0, 500.0]])
    assert ((corners - actor.centre) / actor.span).tolist() == [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]


def test_a_deployed_actor_scales_and_clips_to_the_limit() -> None:
    for mean, current in ((0.5, 3.0), (7.0, 6.0), (-7.0, -6.0)):
        actor = Actor(BENCH, (4,), mean, 1.0)
        last = actor.layers[-1]
        assert isinstance(last, torch.nn.Linear)
        torch.nn.init.zeros_(last.weight)
        assert DeployedActor(actor, 6.0)(torch.zeros(1, 3)).item() == pytest.approx(current)


# The whole ------------------------------------------------------------------------------------------------------------


def test_a_rollout_is_made_of_whole_experiments_with_a_terminal_at_each_horizon() -> None:
    one = learner()
    rollout = collect(one._env, one.actor, 120, 0.0, list(range(8)), torch.Generator().manual_seed(0))
    assert rollout.terminals.sum(dim=1).nonzero().flatten().tolist() == [59, 119]
    assert (rollout.ended, rollout.violations, rollout.home) == (16, 0, 16)
    assert rollout.actor_seen[:, 0, 2].tolist() == [*range(60), *range(60)]
    per_experiment = rollout.rewards.sum(dim=0) / 1e-3
    assert per_experiment.sum().item() / 16 == pytest.approx(rollout.final_fim, rel=1e-4)


def test_the_same_seed_gives_the_same_weights_bit_for_bit_and_another_seed_others() -> None:
    runs = [learner(seed=s) for s in (3, 3, 4)]
    metrics = [[run.iterate() for _ in range(3)] for run in runs]
    assert metrics[0] == metrics[1]
    assert all(torch.equal(a, b) for a, b in zip(weights(runs[0]), weights(runs[1]), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(weights(runs[0]), weights(runs[2]), strict=True))


def test_training_improves_the_return() -> None:
    config = dataclasses.replace(
        TINY, total_steps=60 * 64 * 12, envs=64, minibatch=960, learning_rate=1e-2, gae_lambda=1.0
    )
    one = learner(config)
    returns = []
    while not one.finished:
        returns.append(one.iterate().mean_return)
    assert len(returns) == 12
    assert sum(returns[-3:]) > 2.0 * sum(returns[:3])


def test_the_learning_rate_falls_to_zero_over_the_whole_training() -> None:
    one = learner()
    rates = [one.iterate().learning_rate for _ in range(3)]
    assert rates == pytest.approx([1e-3, 2e-3 / 3, 1e-3 / 3])
    assert one.finished


class BrokenReward(InformationIncrement):
    """Becomes NaN at some point."""

    def __call__(self, transition: Transition) -> Any:
        return np.where(transition.after[:, 0] > 0.0, np.nan, 0.0)


def test_a_reward_that_is_not_finite_stops_the_training_before_a_weight_changes() -> None:
    one = learner(reward=BrokenReward(1.0))
    before = [w.clone() for w in weights(one)]
    with pytest.raises(TrainingDivergedError, match="a reward or a state") as caught:
        one.iterate()
    assert "\n" not in str(caught.value)
    assert all(torch.equal(a, b) for a, b in zip(before, weights(one), strict=True))


def test_a_loss_that_is_not_finite_stops_the_training() -> None:
    one = learner()
    with torch.no_grad():
        one.critic.layers[-1].bias.fill_(math.inf)  # type: ignore[operator]  # the last layer is Linear
    with pytest.raises(TrainingDivergedError, match="a loss or a weight"):
        one.iterate()


@pytest.mark.parametrize(
    "change",
    [
        {"envs": 0},
        {"total_steps": 0},
        {"total_steps": 10**400},
        {"epochs": -1},
        {"learning_rate": 0.0},
        {"learning_rate": 10**400},
        {"gamma": 1.1},
        {"clip": math.nan},
        {"noise_memory": 1.0},
        {"noise_memory": -0.1},
        {"hidden": (8, 0)},
        {"initial_mean": math.nan},
        {"entropy": math.inf},
    ],
)
def test_hyper_parameters_that_cannot_work_are_refused_by_name(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=next(iter(change))):
        dataclasses.replace(TINY, **change)
