"""An actor with a memory: its gradients are autograd's, its rollouts the environment's, its file says what it says."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from emb_export.export import main as emb_export
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import load_bench
from emb_runtime.errors import UsageError
from emb_runtime.policy.policy import load_policy
from emb_train import CHECKPOINT
from emb_train.cli.train import main
from emb_train.envs.conditions import EVERYTHING, Conditions, Randomisation
from emb_train.envs.play import fresh_draws, play
from emb_train.envs.vector_env import EmbExcitationVectorEnv
from emb_train.evaluation.actors import open_subject
from emb_train.ppo.gradients import as_one_vector
from emb_train.ppo.learning import Study
from emb_train.ppo.networks import Critic, DeployedRecurrentActor, RecurrentActor
from emb_train.ppo.ppo import CLIPPED, SQUASHED, Learner, Metrics, PpoConfig
from emb_train.ppo.recurrence import Recurrence
from emb_train.ppo.recurrent import NONE, RecurrentStudent, experiments_of
from emb_train.ppo.remembering import experience
from emb_train.ppo.rollout import Rollout, exploration_noise
from emb_train.presets import load_preset, single_viscous
from emb_train.rewards import InformationIncrement
from emb_train.training.checkpoint import BEST, METRICS, load_actor
from emb_train.training.configuration import Configuration
from tests.train.trainings import HORIZON, ITERATION, TINY, short_bench

BENCH = load_bench()
SHORT = dataclasses.replace(BENCH, timing=dataclasses.replace(BENCH.timing, horizon=HORIZON))
REWARD = InformationIncrement(1e-3)
PPO = PpoConfig(total_steps=3 * ITERATION, envs=8, rollout=HORIZON, minibatch=160, epochs=2, hidden=(6,), memory=5)


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def recurrent(bench: Any = SHORT, squashed: bool = False) -> RecurrentActor:
    """An actor that listens to its memory from the start."""
    torch.manual_seed(0)
    actor = RecurrentActor(bench, 5, (6,), 0.2, 0.5, squashed)
    torch.nn.init.normal_(actor.layers[-1].weight)  # type: ignore[arg-type]  # the last layer is Linear
    return actor


def learner(config: PpoConfig = PPO, seed: int = 0) -> Learner:
    torch.manual_seed(seed)
    env = EmbExcitationVectorEnv(config.envs, SHORT, reward=REWARD)
    actor = RecurrentActor(SHORT, config.memory, config.hidden, config.initial_mean, config.initial_deviation)
    return Learner(env, actor, Critic(env.critic_size, config.hidden), config, seed)


def weights(one: Learner) -> list[torch.Tensor]:
    return [*one.actor.state_dict().values(), *one.critic.state_dict().values()]


# Gradients ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("size", "steps", "count"), [(5, 13, 3), (8, 1, 1), (1, 30, 2)])
def test_what_a_unit_remembers_and_its_gradients_are_those_of_torch(size: int, steps: int, count: int) -> None:
    torch.manual_seed(0)
    unit, layer = torch.nn.GRUCell(4, size), torch.nn.GRU(4, size)
    layer.load_state_dict({f"{name}_l0": value for name, value in unit.state_dict().items()})
    seen, slope = torch.randn(steps, count, 4), torch.randn(steps, count, size)
    expected, _ = layer(seen)
    torch.autograd.backward(expected, slope)
    as_one_vector(unit)
    recurrence = Recurrence(unit)
    for _ in range(2):  # nothing is left over from the first time
        torch.testing.assert_close(recurrence.forward(seen), expected.detach(), rtol=1e-4, atol=1e-5)
        recurrence.backward(slope)
    for own, other in zip(unit.parameters(), layer.parameters(), strict=True):
        torch.testing.assert_close(own.grad, other.grad, rtol=1e-3, atol=1e-4)


def test_a_rollout_falls_into_its_experiments() -> None:
    # Row 0 ends after its 2nd step, row 1 after its 4th, the last; what row 1 should have heard at step 1 was lost.
    ends = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]])
    heard = torch.ones(4, 2, dtype=torch.bool)
    heard[1, 1] = False
    assert experiments_of(ends, heard).T.tolist() == [[0, 2, NONE], [4, 6, NONE], [1, 5, 7]]


def made_up(steps: int, rows: int) -> Rollout:
    """A rollout in which experiments end anywhere and samples are lost."""
    torch.manual_seed(1)
    seen = torch.randn(steps, rows, 4) * torch.tensor([50.0, 300.0, 30.0, 4.0])
    seen[torch.rand(steps, rows) < 0.1] = math.nan
    ends = (torch.rand(steps, rows) < 0.05).float()
    noise, nothing = torch.randn(steps, rows, 1), torch.zeros(steps, rows)
    return Rollout(seen, nothing, noise, nothing, ends, torch.zeros(rows), 0.0, 0, 0, 0)


def means_by_torch(actor: RecurrentActor, rollout: Rollout) -> torch.Tensor:
    """Of the actions, shape [T, N], one step after the other."""
    remembers, rows = torch.zeros(rollout.rewards.shape[1], actor.memory), []
    for seen, ends in zip(rollout.actor_seen, rollout.terminals, strict=True):
        mean, then = actor(seen.nan_to_num(), remembers)
        remembers = torch.where(seen[:, :1].isnan(), remembers, then) * (1.0 - ends[:, None])
        rows.append(mean[:, 0])
    return torch.stack(rows)


def density_by_torch(actor: RecurrentActor, rollout: Rollout) -> torch.Tensor:
    normal: Any = torch.distributions.Normal(means_by_torch(actor, rollout), actor.log_deviation.exp())
    density: torch.Tensor = normal.log_prob(rollout.actions[..., 0])
    return density


@pytest.mark.parametrize("squashed", [False, True])
def test_a_step_of_learning_is_that_of_autograd_through_all_steps_of_every_experiment(squashed: bool) -> None:
    rollout = made_up(40, 3)
    own, textbook = recurrent(squashed=squashed), recurrent(squashed=squashed)
    heard = ~rollout.actor_seen[..., 0].isnan()
    old = density_by_torch(textbook, rollout).detach() + 0.3 * torch.randn(40, 3)  # some ratios are clipped
    advantages = torch.randn(40, 3)
    optimiser = torch.optim.Adam(textbook.parameters(), lr=0.01, eps=1e-5)
    ratio = (density_by_torch(textbook, rollout) - old).exp()
    gain = torch.minimum(ratio * advantages, ratio.clamp(0.8, 1.2) * advantages)[heard].mean()
    entropy = textbook.log_deviation.sum()
    if squashed:  # E ln(1 − tanh² u) by the trapezoidal rule
        z = torch.linspace(-8.0, 8.0, 1601)
        u = means_by_torch(textbook, rollout)[heard][:, None] + textbook.log_deviation.exp() * z
        weight = torch.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
        entropy = entropy + torch.trapezoid(torch.log1p(-u.tanh().square() + 1e-12) * weight, z).mean()
    torch.autograd.backward(-gain - 0.1 * entropy)
    torch.nn.utils.clip_grad_norm_(textbook.parameters(), 0.5)
    student = RecurrentStudent(own, Study(10_000, 0.5, 0.2, 0.1), 0.01, 40)
    torch.testing.assert_close(student.log_densities(rollout).view(40, 3)[heard], density_by_torch(own, rollout)[heard])
    student.learn([torch.randperm(120)], rollout, old.flatten(), advantages.flatten())
    for mine, independent in zip(own.parameters(), textbook.parameters(), strict=True):
        torch.testing.assert_close(mine.grad, independent.grad, rtol=2e-2 if squashed else 1e-3, atol=1e-4)
    optimiser.step()
    first = {name: value.clone() for name, value in recurrent().named_parameters()}
    for (name, mine), independent in zip(own.named_parameters(), textbook.parameters(), strict=True):
        torch.testing.assert_close(mine, independent, rtol=1e-3, atol=2e-3)
        assert not torch.equal(mine, first[name])


def test_every_experiment_is_learned_from_once_in_an_epoch() -> None:
    rollout = made_up(40, 3)
    student = RecurrentStudent(recurrent(), Study(90, 0.5, 0.2, 0.0), 0.01, 40)
    lesson = student._lesson(rollout)
    count = lesson.samples.shape[1]
    shuffle = torch.randperm(120, generator=torch.Generator().manual_seed(3))
    parts = list(student._parts(lesson, shuffle[shuffle < count]))
    assert len(parts) > 2
    assert all(samples.numel() <= 90 and bool(there.any(1).all()) for samples, there in parts)
    learned = torch.cat([samples[there] for samples, there in parts])
    assert sorted(learned.tolist()) == (~rollout.actor_seen[..., 0].isnan()).flatten().nonzero().flatten().tolist()


# Rollouts -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("squashed", [False, True])
@pytest.mark.parametrize("shielded", [True, False])
def test_a_rollout_is_the_environment_s_and_follows_what_the_actor_remembers(shielded: bool, squashed: bool) -> None:
    conditions = Conditions(shielded=shielded)
    bench, steps = (SHORT, 2 * HORIZON) if shielded else (BENCH, 400)
    envs = [EmbExcitationVectorEnv(4, bench, reward=REWARD, conditions=conditions) for _ in range(2)]
    actor = recurrent(bench, squashed)
    torch.nn.init.constant_(actor.layers[-1].bias, 0.9)  # type: ignore[arg-type]  # the last layer is Linear
    rollout = experience(envs[0], actor, steps, 0.9, list(range(4)), torch.Generator().manual_seed(0))
    _, info = envs[1].reset(seed=list(range(4)))
    ended = violations = home = 0
    for t in range(steps):
        assert np.array_equal(envs[1].batch.seen(), rollout.actor_seen[t].numpy())
        assert np.array_equal(info["critic"], rollout.critic_seen[t].numpy())
        u = rollout.actions[t]
        part = (torch.tanh(u) if squashed else u.clamp(-1.0, 1.0)).numpy()
        _, rewards, over, _, info = envs[1].step(part)
        assert np.array_equal(rewards.astype(np.float32), rollout.rewards[t].numpy())
        assert np.array_equal(over, rollout.terminals[t].numpy() == 1.0)
        if over.any():
            ended, violations = ended + int(over.sum()), violations + int(info["final_info"]["violated"][over].sum())
            home += int(info["final_info"]["home"][over].sum())
    assert (rollout.ended, rollout.violations, rollout.home) == (ended, violations, home)
    assert ended >= 4
    assert (violations == 0) == shielded
    noise = exploration_noise(steps, 4, 0.9, torch.Generator().manual_seed(0))[..., 0]
    with torch.no_grad():
        expected = means_by_torch(actor, rollout) + 0.5 * noise
    torch.testing.assert_close(rollout.actions[..., 0], expected, rtol=1e-5, atol=1e-5)


def test_where_a_sample_is_lost_an_actor_remembers_what_it_did_before() -> None:
    conditions = Conditions(randomised=Randomisation(frame_loss=(0.2, 0.2)))
    env = EmbExcitationVectorEnv(4, SHORT, reward=REWARD, conditions=conditions)
    actor = recurrent()
    rollout = experience(env, actor, HORIZON, 0.0, list(range(4)), torch.Generator(), exploration=0.0)
    lost = rollout.actor_seen[..., 0].isnan()
    assert 10 < int(lost.sum()) < 120
    with torch.no_grad():
        torch.testing.assert_close(
            rollout.actions[..., 0][~lost], means_by_torch(actor, rollout)[~lost], rtol=1e-5, atol=1e-5
        )


# Trainings ------------------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_weights_bit_for_bit_with_any_number_of_threads() -> None:
    runs = [learner(dataclasses.replace(PPO, threads=n), seed) for n, seed in ((1, 3), (2, 3), (1, 4))]
    for run in runs:
        run._threads = run._config.threads  # also where the tests have one processor
    metrics = [[run.iterate() for _ in range(2)] for run in runs]
    assert metrics[0] == metrics[1]
    assert all(torch.equal(a, b) for a, b in zip(weights(runs[0]), weights(runs[1]), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(weights(runs[0]), weights(runs[2]), strict=True))


def test_training_with_a_memory_improves_the_return() -> None:
    config = dataclasses.replace(
        PPO, total_steps=60 * 64 * 12, envs=64, minibatch=960, learning_rate=1e-2, gae_lambda=1.0
    )
    one, returns = learner(config), []
    while not one.finished:
        returns.append(one.iterate().mean_return)
    assert sum(returns[-3:]) > 2.0 * sum(returns[:3])


def test_what_cannot_have_a_memory_is_refused() -> None:
    env, actor = EmbExcitationVectorEnv(8, SHORT), recurrent()
    critic = Critic(env.critic_size, (6,))
    with pytest.raises(UsageError, match="--device cpu"):
        Learner(env, actor, critic, PPO, 0, torch.device("cuda"))
    with pytest.raises(UsageError, match="sees everything"):
        dataclasses.replace(TINY, ppo=PPO, conditions=Conditions(shielded=False, observes=EVERYTHING))


@pytest.mark.parametrize("change", [{"memory": -1}, {"actions": "beta"}, {"actions": SQUASHED, "initial_mean": 1.0}])
def test_hyper_parameters_of_an_actor_that_cannot_be_are_refused_by_name(change: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=list(change)[-1]):
        dataclasses.replace(PPO, **change)


def test_a_configuration_writes_what_the_actor_is_only_if_it_is_not_what_it_always_was() -> None:
    assert '"memory"' not in TINY.to_json()
    for ppo in (PPO, dataclasses.replace(PPO, memory=0, actions=SQUASHED)):
        config = dataclasses.replace(TINY, ppo=ppo)
        assert Configuration.from_json(config.to_json()) == config
        assert config.identity != TINY.identity
    assert Configuration.from_json(TINY.to_json()).ppo.actions == CLIPPED


def test_the_preset_differs_from_best_four_d_in_its_memory_alone() -> None:
    plain, remembering = load_preset("best-four-d"), load_preset("best-four-d-gru")
    assert remembering.ppo == dataclasses.replace(plain.ppo, memory=32)
    alike = dataclasses.replace(remembering, preset=plain.preset, summary=plain.summary, ppo=plain.ppo)
    assert alike == plain


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of two iterations, in one go."""
    folder = tmp_path_factory.mktemp("recurrent")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(single_viscous, "PRESET", dataclasses.replace(TINY, ppo=PPO))
        bench = short_bench(folder)
        arguments = ["--preset", "single-viscous", "--bench", str(bench), "--out", str(folder / "run")]
        assert main([*arguments, "--steps", str(2 * ITERATION)]) == 0
    return folder / "run"


def test_a_training_with_a_memory_resumes_bit_for_bit(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(single_viscous, "PRESET", dataclasses.replace(TINY, ppo=PPO))
    parts, iterate = tmp_path / "parts", Learner.iterate

    def interrupted(self: Learner) -> Metrics:
        if self.iteration == 1:
            raise KeyboardInterrupt
        return iterate(self)

    arguments = ["--preset", "single-viscous", "--bench", str(trained / "bench.toml"), "--out", str(parts)]
    with monkeypatch.context() as patch:
        patch.setattr(Learner, "iterate", interrupted)
        assert main([*arguments, "--steps", str(2 * ITERATION)]) == 130
    assert main(["--resume", str(parts)]) == 0
    for name in (CHECKPOINT, BEST, METRICS):
        assert (parts / name).read_bytes() == (trained / name).read_bytes(), name


def test_the_exported_file_plays_what_the_network_plays(trained: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert emb_export([str(trained)]) == 0
    assert "within" in capfd.readouterr().out
    subject = open_subject(str(trained), None)
    assert subject.network is not None
    assert subject.file is not None
    ranges = subject.bench.range_set(subject.ranges)
    draws = fresh_draws(ranges, 0, 3)
    outcomes = [
        play(subject.bench, ranges, subject.parameters, make(), draws) for make in (subject.network, subject.file)
    ]
    assert outcomes[0].matrices == pytest.approx(outcomes[1].matrices, rel=1e-3)
    assert outcomes[0].home.all()
    contract = load_policy(trained / "actor.onnx", subject.bench).contract
    assert contract.initial_state == (0.0,) * 5
    assert [quantity.name for quantity in contract.observation] == ["angle", "velocity", "step", "applied_current"]
    assert [len(sequence) for sequence in contract.sequences] == [HORIZON] * 2


def test_the_runtime_runs_the_exported_file(trained: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert emb_export([str(trained), "--out", str(tmp_path / "actor.onnx")]) == 0
    arguments = ["--policy", str(tmp_path / "actor.onnx"), "--bench", str(trained / "bench.toml")]
    assert emb_run(["--iface", "sim", *arguments, "--log", str(tmp_path / "run.mcap")]) == 0
    assert "home" in capfd.readouterr().out


def test_a_training_with_a_memory_is_not_taken_for_one_without(trained: Path) -> None:
    with pytest.raises(UsageError, match="without a memory, got one of 5 numbers"):
        load_actor(trained)


def test_a_deployed_actor_stays_within_the_limit_and_begins_with_nothing() -> None:
    actor = recurrent(BENCH)
    torch.nn.init.constant_(actor.layers[-1].bias, 30.0)  # type: ignore[arg-type]  # the last layer is Linear
    deployed = DeployedRecurrentActor(actor, 6.0)
    current, state, estimate = deployed(torch.zeros(2, 4), deployed.initial_state.repeat(2, 1))
    assert current.tolist() == [[6.0], [6.0]]
    assert (state.dtype, tuple(state.shape), tuple(estimate.shape)) == (torch.float64, (2, 5), (2, 0))
    assert deployed.initial_state.tolist() == [0.0] * 5
