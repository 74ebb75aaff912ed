"""The algorithm's parts against numbers worked by hand and independent formulas; then the whole on a tiny task."""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from emb_bench.compiled import compiled
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import UsageError
from emb_train.envs.conditions import EVERYTHING, Conditions
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.ppo.gradients import PerceptronTrainer, as_one_vector
from emb_train.ppo.networks import Actor, Critic, DeployedActor
from emb_train.ppo.ppo import (
    EARLY_AT_LEAST,
    Learner,
    PpoConfig,
    TrainingDivergedError,
    generalised_advantages,
    log_density,
    normalised,
    surrogate,
)
from emb_train.ppo.rollout import Rollout, collect, exploration_noise
from emb_train.ppo.rollout_kernel import tanh
from emb_train.rewards import InformationIncrement, LogDeterminant, Reward, TrajectoryReturn, Transition

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
    loss, derivative = surrogate(log_ratio, tensor(advantage), 0.2)
    torch.autograd.backward(loss)
    assert -loss.item() == pytest.approx(objective)
    assert log_ratio.grad is not None
    assert -log_ratio.grad.item() == pytest.approx(slope)
    assert -derivative.item() == pytest.approx(slope)


def test_the_surrogate_is_a_mean() -> None:
    log_ratio = torch.log(tensor(1.1, 1.5))
    loss, derivative = surrogate(log_ratio, tensor(2.0, 2.0), 0.2)
    assert loss.item() == pytest.approx(-(2.2 + 2.4) / 2)
    assert derivative.tolist() == pytest.approx([-2.2 / 2, 0.0])


@given(mean=st.floats(-3, 3), deviation=st.floats(0.01, 10), action=st.floats(-5, 5))
def test_the_density_is_that_of_a_gaussian(mean: float, deviation: float, action: float) -> None:
    log_deviation = torch.log(tensor(deviation))
    own = log_density(tensor((action - mean) / deviation), log_deviation)
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


@pytest.mark.parametrize(("mean", "current"), [(0.5, 3.0), (7.0, 6.0), (-7.0, -6.0)])
def test_a_deployed_actor_scales_and_clips_to_the_limit(mean: float, current: float) -> None:
    actor = Actor(BENCH, (4,), mean, 1.0)
    last = actor.layers[-1]
    assert isinstance(last, torch.nn.Linear)
    torch.nn.init.zeros_(last.weight)
    assert DeployedActor(actor, 6.0)(torch.zeros(1, 3)).item() == pytest.approx(current, rel=1e-5)


# Gradients ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hidden", [(), (5,), (7, 6), (4, 4, 4)])
@pytest.mark.parametrize("count", [1, 10])
def test_a_perceptron_s_outputs_and_gradients_are_those_of_autograd(hidden: tuple[int, ...], count: int) -> None:
    torch.manual_seed(0)
    critic = Critic(3, hidden)
    independent = copy.deepcopy(critic)
    seen, slope = torch.randn(count, 3), torch.randn(count, 1)
    trainer = PerceptronTrainer(critic, critic.layers, 10, 1e-3, 0.5)
    with torch.no_grad():
        outputs = trainer.forward(seen).clone()
        trainer.backward(slope)
    expected = independent.layers(seen)
    torch.autograd.backward(expected, slope)
    torch.testing.assert_close(outputs, expected.detach())
    for own, other in zip(critic.parameters(), independent.parameters(), strict=True):
        torch.testing.assert_close(own.grad, other.grad)
    assert trainer.vector.grad is not None
    torch.testing.assert_close(
        trainer.vector.grad, torch.cat([p.grad.flatten() for p in independent.parameters() if p.grad is not None])
    )


def test_other_layers_are_refused() -> None:
    layers = torch.nn.Sequential(torch.nn.Linear(1, 1), torch.nn.ReLU(), torch.nn.Linear(1, 1))
    with pytest.raises(UsageError):
        PerceptronTrainer(layers, layers, 1, 1e-3, 0.5)


def test_parameters_stay_views_of_their_vector_when_a_state_is_loaded() -> None:
    critic, other = Critic(3, (4,)), Critic(3, (4,))
    vector = as_one_vector(critic)
    critic.load_state_dict(other.state_dict())
    assert torch.equal(vector.detach(), torch.cat([p.detach().flatten() for p in other.parameters()]))


def test_the_rollout_s_tanh_is_the_tangent_to_two_millionths() -> None:
    own: Any = compiled(tanh)
    x = np.linspace(-20.0, 20.0, 4001).astype(np.float32)
    assert np.array([own(v) for v in x]) == pytest.approx(np.tanh(x.astype(np.float64)), abs=2e-6)


def by_autograd(one: Learner, rollout: Rollout, generator: torch.Generator) -> tuple[Actor, Critic]:
    """The textbook's way: a graph for each minibatch, one Adam for all parameters, torch's own clipping."""
    config, actor, critic = one._config, copy.deepcopy(one.actor), copy.deepcopy(one.critic)
    assert isinstance(actor, Actor)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=config.learning_rate, eps=1e-5)
    seen, actions = rollout.actor_seen.flatten(0, 1), rollout.actions.flatten(0, 1)
    critic_seen = rollout.critic_seen.flatten(0, 1)
    distributions: Any = torch.distributions

    def density(index: torch.Tensor) -> torch.Tensor:
        gaussian = distributions.Normal(actor(seen[index]), actor.log_deviation.exp())
        result: torch.Tensor = gaussian.log_prob(actions[index])
        return result.squeeze(-1)

    with torch.no_grad():
        values, last = critic(critic_seen).view_as(rollout.rewards), critic(rollout.last_critic_seen)
        old = density(torch.arange(len(seen)))
        raw = generalised_advantages(rollout.rewards, values, rollout.terminals, last, config.gamma, config.gae_lambda)
        advantages, returns = normalised(raw.flatten()), (raw + values).flatten()
    for shuffle in [torch.randperm(len(seen), generator=generator) for _ in range(config.epochs)]:
        for index in torch.split(shuffle, config.minibatch):
            ratio = (density(index) - old[index]).exp()
            clipped = ratio.clamp(1 - config.clip, 1 + config.clip)
            gain = torch.minimum(ratio * advantages[index], clipped * advantages[index]).mean()
            error = 0.5 * (critic(critic_seen[index]) - returns[index]).square().mean()
            loss = error - gain - config.entropy * actor.log_deviation.sum()
            optimiser.zero_grad()
            torch.autograd.backward(loss)
            for network in (actor, critic):
                torch.nn.utils.clip_grad_norm_(network.parameters(), config.max_gradient)
            optimiser.step()
    return actor, critic


def test_an_improvement_is_that_of_autograd() -> None:
    one = learner(dataclasses.replace(TINY, entropy=0.01, minibatch=100))
    rollout = collect(one._env, one.actor, 60, 0.5, list(range(8)), torch.Generator().manual_seed(1), 1)
    actor, critic = by_autograd(one, rollout, torch.Generator().manual_seed(2))
    one.improve(rollout, torch.Generator().manual_seed(2))
    for own, other in ((one.actor, actor), (one.critic, critic)):
        for mine, independent in zip(own.parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(mine, independent, rtol=1e-3, atol=1e-5)


# Rollouts -------------------------------------------------------------------------------------------------------------

THESIS = Conditions(shielded=False, observes=EVERYTHING)


@pytest.mark.parametrize(
    ("parameters", "reward", "conditions", "hidden", "steps"),
    [
        (("f_v",), REWARD, Conditions(), (8, 8), 150),
        (("k_1", "f_v"), LogDeterminant(0.1), Conditions(information="physical"), (6,), 150),
        (("k_1", "f_v"), TrajectoryReturn(1e-6, outward=20), THESIS, (9, 7, 5), 150),
        (("f_v",), TrajectoryReturn(1e-6, outward=1), THESIS, (8, 8), 150),
        # Whole experiments, some of which end early: rows that are done wait for the others.
        (("f_v",), TrajectoryReturn(1e-6, outward=1), THESIS, (8, 8), 3 * SHORT.timing.horizon),
    ],
)
def test_a_rollout_is_what_the_environment_gives_step_by_step_bit_for_bit(
    parameters: tuple[str, ...],
    reward: Reward,
    conditions: Conditions,
    hidden: tuple[int, ...],
    steps: int,
) -> None:
    envs = [EmbExcitationVectorEnv(5, SHORT, "viscous", parameters, reward, conditions=conditions) for _ in range(2)]
    torch.manual_seed(0)
    actor = Actor(SHORT, hidden, 0.9, 0.5, conditions.observation_size(len(parameters)))
    rollout = collect(envs[0], actor, steps, 0.9, list(range(5)), torch.Generator().manual_seed(0), threads=2)
    seen, info = envs[1].reset(seed=list(range(5)))
    ended = violations = home = 0
    for t in range(steps):
        assert np.array_equal(seen, rollout.actor_seen[t].numpy())
        assert np.array_equal(info["critic"], rollout.critic_seen[t].numpy())
        seen, rewards, terminated, _, info = envs[1].step(rollout.actions[t].numpy())
        assert np.array_equal(rewards.astype(np.float32), rollout.rewards[t].numpy())
        assert np.array_equal(terminated, rollout.terminals[t].numpy() == 1.0)
        if terminated.any():
            ended += int(terminated.sum())
            violations += int(info["final_info"]["violated"].sum())
            home += int(info["final_info"]["home"][terminated].sum())
    assert (rollout.ended, rollout.violations, rollout.home) == (ended, violations, home)
    assert rollout.ended >= 10
    goes_on = rollout.terminals[-1].numpy() == 0.0
    assert np.array_equal(info["critic"][goes_on], rollout.last_critic_seen.numpy()[goes_on])


def test_unshielded_experiments_of_a_rollout_end_early_and_begin_again() -> None:
    env = EmbExcitationVectorEnv(4, BENCH, conditions=Conditions(shielded=False))
    actor = Actor(BENCH, (8, 8), 1.0, 0.01)
    rollout = collect(env, actor, 500, 0.0, list(range(4)), torch.Generator().manual_seed(0))
    assert rollout.violations == rollout.ended > 8
    assert (rollout.actor_seen[..., 2] == 0.0).sum() >= rollout.ended


def test_a_rollout_follows_the_actor_plus_the_exploration_asked_for() -> None:
    env, actor = EmbExcitationVectorEnv(6, SHORT), Actor(SHORT, (10, 7), 0.1, 0.5)
    torch.nn.init.normal_(actor.layers[-1].weight)  # type: ignore[arg-type]  # the last layer is Linear
    noise = exploration_noise(60, 6, 0.9, torch.Generator().manual_seed(0))
    for exploration in (0.0, 1.0):
        rollout = collect(
            env, actor, 60, 0.9, list(range(6)), torch.Generator().manual_seed(0), exploration=exploration
        )
        with torch.no_grad():
            mean = actor(rollout.actor_seen.flatten(0, 1)).view(60, 6, 1)
        torch.testing.assert_close(rollout.actions, mean + 0.5 * exploration * noise, rtol=1e-4, atol=1e-4)


# The whole ------------------------------------------------------------------------------------------------------------


def test_a_rollout_is_made_of_whole_experiments_with_a_terminal_at_each_horizon() -> None:
    one = learner()
    rollout = collect(one._env, one.actor, 120, 0.0, list(range(8)), torch.Generator().manual_seed(0), 1)
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


def test_the_number_of_threads_changes_no_bit() -> None:
    runs = [learner(dataclasses.replace(TINY, threads=n)) for n in (1, 2)]
    for run in runs:
        run._threads = run._config.threads  # also where the tests have one processor
    metrics = [[run.iterate() for _ in range(3)] for run in runs]
    assert metrics[0] == metrics[1]
    assert all(torch.equal(a, b) for a, b in zip(weights(runs[0]), weights(runs[1]), strict=True))


def test_training_improves_the_return() -> None:
    config = dataclasses.replace(
        TINY, total_steps=60 * 64 * 30, envs=64, minibatch=960, learning_rate=1e-2, gae_lambda=1.0
    )
    one = learner(config)
    returns = []
    while not one.finished:
        returns.append(one.iterate().mean_return)
    assert len(returns) == 30
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


def test_a_training_whose_experiments_all_end_early_for_long_is_given_up() -> None:
    config = dataclasses.replace(TINY, total_steps=240 * 16, envs=4, minibatch=240, epochs=1, learning_rate=1e-9)
    env = EmbExcitationVectorEnv(4, SHORT, conditions=Conditions(shielded=False))
    one = Learner(env, Actor(SHORT, (8, 8), 1.0, 0.1), Critic(env.critic_size, (8, 8)), config, 0)
    for _ in range(EARLY_AT_LEAST):
        assert one.iterate().violations > 0
    with pytest.raises(TrainingDivergedError, match="every experiment left the limits"):
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
