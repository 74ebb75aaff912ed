"""How each of the two networks improves on a rollout. They share nothing, so they can do it side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

from emb_train.ppo.gradients import Chain, as_one_vector
from emb_train.ppo.networks import Actor, Critic
from emb_train.ppo.objective import log_density, surrogate
from emb_train.ppo.rollout import Rollout

First = TypeVar("First")
Second = TypeVar("Second")


class Study(NamedTuple):
    """What both networks have in common while they learn."""

    minibatch: int
    """Samples per gradient step."""
    max_gradient: float
    """Largest norm of the gradient."""
    clip: float
    """ε of the surrogate objective (eq. 4.48)."""
    entropy: float
    """Weight of the entropy bonus."""


class Losses(NamedTuple):
    """Means over the minibatches of the last epoch."""

    policy_loss: float
    entropy: float
    kl: float
    clipped: float


class Student:
    """A network that learns, with its gradient and Adam."""

    def __init__(self, network: nn.Module, study: Study, learning_rate: float) -> None:
        """Prepare to train all parameters of ``network``."""
        self.vector = as_one_vector(network)
        self.adam = torch.optim.Adam([self.vector], lr=learning_rate, eps=1e-5, fused=True)
        self.study = study

    def descend(self) -> None:
        """One step along the gradient that has been written."""
        gradient = self.vector.grad
        assert gradient is not None
        gradient.mul_((self.study.max_gradient / (gradient.norm() + 1e-6)).clamp_(max=1.0))
        self._adam_step(gradient)

    def _adam_step(self, gradient: Tensor) -> None:
        """What ``self.adam.step()`` does, without its hooks, which cost more than all the rest of a small step."""
        if not (state := self.adam.state[self.vector]):
            self.adam.step()  # which makes the state
            return
        group = self.adam.param_groups[0]
        adam(
            [self.vector],
            [gradient],
            [state["exp_avg"]],
            [state["exp_avg_sq"]],
            [],
            [state["step"]],
            fused=True,
            amsgrad=False,
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            lr=group["lr"],
            weight_decay=0.0,
            eps=group["eps"],
            maximize=False,
        )


class LayeredStudent(Student):
    """A network of layers that answers each sample by itself."""

    def __init__(self, network: nn.Module, layers: nn.Sequential, study: Study, learning_rate: float) -> None:
        """Prepare to train all parameters of ``network``, whose outputs are those of ``layers``."""
        super().__init__(network, study, learning_rate)
        self._chain = Chain(layers, study.minibatch)

    @torch.no_grad()
    def outputs(self, seen: Tensor) -> Tensor:
        """Outputs for any number of samples, shape [B, 1]."""
        return torch.cat([self._chain.forward(part).clone() for part in torch.split(seen, self.study.minibatch)])

    def minibatches(self, shuffles: list[Tensor], *columns: Tensor) -> Iterator[tuple[bool, list[Tensor]]]:
        """Whether it is the last epoch, and the columns of each minibatch, gathered once for an epoch."""
        for epoch, shuffle in enumerate(shuffles):
            gathered = [torch.split(column[shuffle], self.study.minibatch) for column in columns]
            for parts in zip(*gathered, strict=True):
                yield epoch == len(shuffles) - 1, list(parts)

    def forward(self, seen: Tensor) -> Tensor:
        """Outputs of a minibatch, shape [M, 1], until the next ones."""
        return self._chain.forward(seen)

    def step(self, slope: Tensor) -> None:
        """One gradient step, from the loss's derivative with respect to the last outputs, shape [M, 1]."""
        self._chain.backward(slope)
        self.descend()


class Improvement:
    """The clipped surrogate and the entropy bonus of an actor's actions, with their derivatives."""

    def __init__(self, actor: Actor, study: Study) -> None:
        """Of this actor, whose log standard deviation has a gradient to write to."""
        self._log_deviation, self._study = actor.log_deviation, study

    def log_density(self, mean: Tensor, actions: Tensor) -> Tensor:
        """Of actions, shape [M, 1], around their means, the same; shape [M]."""
        return log_density(self._away(mean, actions), self._log_deviation)

    def slope(self, mean: Tensor, actions: Tensor, old: Tensor, advantages: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Write the derivative with respect to the log standard deviation.

        Args:
            mean: of the actions, shape [M, 1].
            actions: shape [M, 1].
            old: log densities of the actions under the policy that chose them, shape [M].
            advantages: shape [M].

        Returns:
            The derivative with respect to ``mean``, shape [M, 1]; the loss; the logarithms of the ratios, shape [M].
        """
        z = self._away(mean, actions)
        log_ratio = log_density(z, self._log_deviation) - old
        loss, slope = surrogate(log_ratio, advantages, self._study.clip)
        pull = slope * z
        assert self._log_deviation.grad is not None
        self._log_deviation.grad.copy_(pull.dot(z) - slope.sum() - self._study.entropy)
        pull.mul_(torch.exp(-self._log_deviation))
        return pull.unsqueeze(-1), loss, log_ratio

    def record(self, loss: Tensor, log_ratio: Tensor) -> Tensor:
        """The numbers of :class:`Losses`, shape [4]; to be taken before the step."""
        ratio = log_ratio.exp()
        kl, clipped = (ratio - 1.0 - log_ratio).mean(), ((ratio - 1.0).abs() > self._study.clip).float().mean()
        entropy = self._log_deviation.sum() + 0.5 * math.log(2.0 * math.pi * math.e)
        return torch.stack([loss, entropy, kl, clipped])

    def _away(self, mean: Tensor, actions: Tensor) -> Tensor:
        """How many standard deviations actions are from their mean, shape [M]."""
        return ((actions - mean) * torch.exp(-self._log_deviation)).squeeze(-1)


class ActorStudent(LayeredStudent):
    """The actor."""

    def __init__(self, actor: Actor, study: Study, learning_rate: float) -> None:
        """Prepare to train ``actor``."""
        super().__init__(actor, actor.layers, study, learning_rate)
        self._actor, self._improvement = actor, Improvement(actor, study)

    @torch.no_grad()
    def log_densities(self, rollout: Rollout) -> Tensor:
        """Of a rollout's B actions, shape [B]."""
        seen, actions = self._lesson(rollout)
        return self._improvement.log_density(self.outputs(seen), actions)

    @torch.no_grad()
    def learn(self, shuffles: list[Tensor], rollout: Rollout, old: Tensor, advantages: Tensor) -> Losses:
        """One gradient step for each minibatch of each epoch.

        Args:
            shuffles: an order of the B samples for each epoch.
            rollout: these samples.
            old: log densities of the actions under the policy that chose them, shape [B].
            advantages: shape [B].
        """
        records = []
        for last, (s, a, o, advantage) in self.minibatches(shuffles, *self._lesson(rollout), old, advantages):
            mean = self.forward(s)
            slope, loss, log_ratio = self._improvement.slope(mean, a, o, advantage)
            if last:
                records.append(self._improvement.record(loss, log_ratio))
            self.step(slope)
        return Losses(*torch.stack(records).mean(0).tolist())

    def _lesson(self, rollout: Rollout) -> tuple[Tensor, Tensor]:
        """Normalised observations, shape [B, I], and actions, shape [B, 1]."""
        device = self.vector.device
        seen = self._actor.normalised(rollout.actor_seen.flatten(0, 1).to(device))
        return seen, rollout.actions.flatten(0, 1).to(device)


class CriticStudent(LayeredStudent):
    """The critic: half the mean squared error (eq. 4.46)."""

    def __init__(self, critic: Critic, study: Study, learning_rate: float) -> None:
        """Prepare to train ``critic``."""
        super().__init__(critic, critic.layers, study, learning_rate)

    @torch.no_grad()
    def learn(self, shuffles: list[Tensor], seen: Tensor, returns: Tensor) -> float:
        """One gradient step for each minibatch of each epoch; the mean loss over the last one.

        Args:
            shuffles: an order of the B samples for each epoch.
            seen: shape [B, C].
            returns: shape [B].
        """
        records = []
        for last, (s, target) in self.minibatches(shuffles, seen, returns):
            error = self.forward(s) - target.unsqueeze(-1)
            if last:
                records.append(0.5 * error.square().mean())
            self.step(error.div_(len(error)))
        return float(torch.stack(records).mean())


def side_by_side(threads: int, first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Two pieces of work, at the same time if there are two threads; what they give does not depend on it."""
    if threads < 2:
        return first(), second()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(second)
        return first(), other.result()
