"""Trainings that differ by seed and first deviation, side by side: stacked networks, and one batch of brakes.

Four experiments and minibatches of 256 samples are so small that most of a training's time is spent between the
products. Each training gets the random numbers that :func:`emb_train.ppo.train` gives it alone; what differs is the
rounding of sums.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from emb_bench.config.bench import Bench
from emb_train.ppo import (
    Actor,
    Critic,
    Ppo,
    Rollout,
    Tanh,
    TrainingDivergedError,
    collect,
    exploration_noise,
    generalised_advantages,
    log_density,
    mean_return,
    random_numbers,
    surrogate,
)
from emb_train.training import Training, Validation, begin_training, validated, write_progress


class Stack(nn.Module):
    """K perceptrons of the same shape. Weights have shape [K, inputs, outputs], biases [K, 1, outputs]."""

    def __init__(self, networks: Sequence[nn.Sequential]) -> None:
        """Take the weights of K networks."""
        super().__init__()
        layers = list(zip(*([part for part in n if isinstance(part, nn.Linear)] for n in networks), strict=True))
        self.weights = nn.ParameterList(torch.stack([one.weight.detach().T for one in layer]) for layer in layers)
        self.biases = nn.ParameterList(torch.stack([one.bias.detach()[None] for one in layer]) for layer in layers)
        self.tanh = Tanh()

    def forward(self, x: Tensor) -> Tensor:
        """Outputs, shape [K, M, 1], for inputs of shape [K, M, inputs]."""
        *hidden, (to_output, bias) = zip(self.weights, self.biases, strict=True)
        for weight, shift in hidden:
            x = self.tanh(torch.baddbmm(shift, x, weight))
        # To a single output a product of matrices takes four times as long.
        output: Tensor = (x * to_output.mT).sum(2, keepdim=True) + bias
        return output

    def write(self, k: int, network: nn.Sequential) -> None:
        """Write the weights of the k-th into a network."""
        with torch.no_grad():
            for i, layer in enumerate(part for part in network if isinstance(part, nn.Linear)):
                layer.weight.copy_(self.weights[i][k].T)
                layer.bias.copy_(self.biases[i][k, 0])


class Actors(nn.Module):
    """K actors of currents. For :func:`emb_train.ppo.collect` they are one of K N experiments, N of each in turn."""

    def __init__(self, actors: Sequence[Actor]) -> None:
        """Take the weights and deviations of K actors of the same bench."""
        super().__init__()
        self.features, self.stack = actors[0].features, Stack([actor.layers for actor in actors])
        self.log_deviations = nn.Parameter(torch.stack([actor.log_deviation.detach()[None] for actor in actors]))
        self.part = actors[0].part
        self.log_deviation = torch.empty(0)  # Of each experiment, shape [K N, 1]; set by :meth:`exploring`

    def means(self, observation: Tensor) -> Tensor:
        """Means of the actions, shape [K, M, 1], for observations of shape [K, M, inputs]."""
        means: Tensor = self.stack(self.features(observation))
        return means

    def forward(self, observation: Tensor) -> Tensor:
        """Means of the actions, shape [K N, 1], for observations of shape [K N, inputs]."""
        return self.means(observation.view(len(self.log_deviations), -1, observation.shape[-1])).flatten(0, 1)

    def log_density_of(self, noise: Tensor) -> Tensor:
        """Log π of actions this many standard deviations from their means, shape [T, K N, 1] to [T, K N]."""
        return log_density(noise, self.log_deviation)

    def exploring(self, each: int) -> Actor:
        """As the actor of ``each`` experiments for every one of the K."""
        self.log_deviation = self.log_deviations.detach().repeat_interleave(each, 0)[:, 0]
        return cast(Actor, self)

    def write(self, k: int, actor: Actor) -> Actor:
        """Write the weights of the k-th into an actor."""
        self.stack.write(k, actor.layers)
        with torch.no_grad():
            actor.log_deviation.copy_(self.log_deviations[k, 0])
        return actor


class Member(NamedTuple):
    """One of several trainings, and its best actor so far."""

    training: Training
    validation: Validation
    actor: Actor
    best: Actor
    score: float


def train_together(trainings: Mapping[Path, Training], bench: Bench) -> Iterator[tuple[Path, Actor]]:
    """Train several actors, each with progress in its folder, which is made.

    Args:
        trainings: by folder, with the thesis's hyper-parameters: no pairs, no held noise, no final deviation. They
            differ by seed and first deviation alone.
        bench: limits, noise, timing.

    Yields:
        At the end, each folder and the actor that did best on the brakes of its validation.

    Raises:
        TrainingDivergedError: a weight is not finite any more.
        EmbError: a folder is not writable.
    """
    torch.set_num_threads(1)
    first = next(iter(trainings.values()))
    ppo, (env,) = first.ppo, first.environments(bench, len(trainings) * first.ppo.envs)
    size, members, critics = env.batch.critic_observation().shape[1], [], []
    for folder, training in trainings.items():
        begin_training(folder, training, bench)
        torch.manual_seed(training.seed)
        actor = training.untrained_actor(bench)
        critics.append(Critic(size, ppo.hidden).layers)
        members.append(Member(training, Validation(training, bench), actor, actor, -math.inf))
    actors, critic = Actors([member.actor for member in members]), Stack(critics)
    optimiser = torch.optim.Adam([*actors.parameters(), *critic.parameters()], eps=1e-5, fused=True)
    for iteration in range(ppo.iterations):
        drawn = [random_numbers(training.seed, iteration, ppo.envs) for training in trainings.values()]
        seeds, generators = [seed for seeds, _ in drawn for seed in seeds], [generator for _, generator in drawn]
        optimiser.param_groups[0]["lr"] = ppo.learning_rate * (1.0 - iteration / ppo.iterations)
        noise = [exploration_noise(ppo.rollout, ppo.envs, ppo.noise_memory, generator) for generator in generators]
        rollout = collect(env, actors.exploring(ppo.envs), torch.cat(noise, 1), seeds)
        improve(actors, critic, optimiser, rollout, ppo, generators)
        if not all(torch.isfinite(weight).all() for network in (actors, critic) for weight in network.parameters()):
            raise TrainingDivergedError(f"training diverged in iteration {iteration + 1}: a weight is not finite")
        for k, folder in enumerate(trainings):
            own = slice(k * ppo.envs, (k + 1) * ppo.envs)
            made = {name: getattr(rollout, name)[:, own] for name in ("rewards", "terminals", "strayed", "homes")}
            score, member = None, members[k]
            if validated(iteration + 1, ppo.iterations):
                score = member.validation.score(actors.write(k, member.actor))
                if score > member.score:
                    members[k] = member._replace(best=copy.deepcopy(member.actor), score=score)
            of_all = replace(rollout, **made, mean_return=mean_return(made["rewards"], made["terminals"], env.batch))
            counts = {"iteration": iteration + 1, "steps": (iteration + 1) * ppo.batch, **of_all.counts}
            deviation = float(actors.log_deviations[k].detach().exp())
            write_progress(folder, counts | {"mean_return": of_all.mean_return, "deviation": deviation, "score": score})
    for folder, member in zip(trainings, members, strict=True):
        yield folder, member.best


def improve(
    actors: Actors,
    critic: Stack,
    optimiser: torch.optim.Optimizer,
    rollout: Rollout,
    ppo: Ppo,
    generators: Sequence[torch.Generator],
) -> None:
    """Improve all networks as :func:`emb_train.ppo.improve` does each: a sum of losses that share no weight."""
    count = len(generators)

    def by_member(of_steps: Tensor) -> Tensor:
        """Shape [T, K N, ...] to [K, T N, ...]."""
        steps, width, *rest = of_steps.shape
        return of_steps.view(steps, count, width // count, *rest).transpose(0, 1).flatten(1, 2)

    with torch.no_grad():
        values = critic(by_member(rollout.states)).view(count, len(rollout.states), -1).transpose(0, 1).flatten(1)
    advantages = generalised_advantages(rollout.rewards, values, rollout.terminals, ppo.gamma, ppo.gae_lambda)
    returns, advantages = by_member(advantages + values[:-1]), by_member(advantages)
    advantages = (advantages - advantages.mean(1, keepdim=True)) / (advantages.std(1, keepdim=True) + 1e-8)
    numbers = torch.stack((by_member(rollout.log_densities), advantages, returns), 2)
    columns = (by_member(rollout.seen), by_member(rollout.actions), by_member(rollout.states[:-1]), numbers)
    samples, widths = torch.cat(columns, 2), [column.shape[2] for column in columns]
    rows = torch.arange(count)[:, None]
    for _ in range(ppo.epochs):
        order = torch.stack([torch.randperm(samples.shape[1], generator=generator) for generator in generators])
        for some in torch.split(samples[rows, order], ppo.minibatch, 1):
            seen, actions, states, rest = torch.split(some, widths, 2)
            before, advantage, value = rest.unbind(2)
            noise = (actions - actors.means(seen)) / actors.log_deviations.exp()
            policy_loss = surrogate(log_density(noise, actors.log_deviations) - before, advantage, ppo.clip)
            value_loss = 0.5 * (critic(states).squeeze(2) - value).square().mean()
            optimiser.zero_grad()
            torch.autograd.backward(count * (policy_loss + value_loss) - ppo.entropy * actors.log_deviations.sum())
            for network in (actors, critic):
                clip_each(list(network.parameters()), ppo.max_gradient)
            optimiser.step()


def clip_each(weights: Sequence[nn.Parameter], most: float) -> None:
    """Bound the norm of the gradient of each of K networks, whose weights have the first dimension K."""
    gradients: list[Any] = [weight.grad for weight in weights]
    norm = torch.stack([gradient.square().sum((1, 2)) for gradient in gradients]).sum(0).sqrt()
    factor = (most / (norm + 1e-6)).clamp(max=1.0)[:, None, None]
    for gradient in gradients:
        gradient *= factor
