"""Asymmetric proximal policy optimisation (thesis Algorithm 1; Schulman et al., 2017, arXiv:1707.06347).

The actor sees what the bench measures, the critic sees the true state. Each iteration begins N new experiments,
collects T steps of each, and then improves both networks, which share nothing, on those N T steps. All randomness of
iteration i comes from (seed, i). The gradient of the networks is in :mod:`emb_train.ppo.gradients`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from emb_runtime.errors import EmbError, UsageError
from emb_train.envs.env import EmbExcitationVectorEnv
from emb_train.ppo.gradients import PerceptronTrainer
from emb_train.ppo.networks import Actor, Critic
from emb_train.ppo.rollout import Rollout, collect, usable

First = TypeVar("First")
Second = TypeVar("Second")

EARLY_AT_LEAST = 10
"""Training is given up after more iterations in a row than this, and than a quarter of the training, in which every
experiment ended early."""
LARGEST = 2**63 - 1  # Largest integer that torch and NumPy count with


class TrainingDivergedError(EmbError):
    """A loss, reward or weight is not finite any more: what follows would be worthless."""

    exit_code = 1


@dataclass(frozen=True)
class PpoConfig:
    """The hyper-parameters."""

    total_steps: int  # Environment steps of the whole training; rounded up to whole iterations
    envs: int = 256  # N, experiments that run side by side
    rollout: int = 500
    """T, steps of each in one iteration: a multiple of the horizon, so that it is made of whole experiments."""
    minibatch: int = 8192  # Samples per gradient step
    epochs: int = 4  # K, passes over the N T samples
    learning_rate: float = 1e-3  # Learning rate of Adam for both networks at the start; falls linearly to zero
    gamma: float = 1.0  # Discount. The horizon is a true end and the step is observed: 1 optimises what is evaluated.
    gae_lambda: float = 0.95  # λ of the generalised advantage estimate (Schulman et al., 2016, arXiv:1506.02438)
    clip: float = 0.2  # ε of the surrogate objective (eq. 4.48).
    entropy: float = 0.0  # Weight of the entropy bonus
    max_gradient: float = 0.5  # Largest norm of the gradient, for each network separately
    hidden: tuple[int, ...] = (64, 64)  # Widths of the hidden layers of both networks
    initial_mean: float = 0.0  # Mean action of the untrained actor, part of the current limit
    initial_deviation: float = 0.5  # The untrained action's standard deviation, part of the current limit
    noise_memory: float = 0.0
    """Correlation of the exploration noise from one step to the next, see :func:`exploration_noise`."""
    threads: int = 2
    """Largest number of threads, for experiments and for actor and critic. Results do not depend on it."""

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises:
            UsageError: a value is out of its range.
        """
        for name in ("total_steps", "envs", "rollout", "minibatch", "epochs", "threads"):
            if not 1 <= getattr(self, name) <= LARGEST:
                raise UsageError(f"{name}: expected an integer from 1 to {LARGEST}, got {getattr(self, name)}")
        if not all(1 <= width <= LARGEST for width in self.hidden):
            raise UsageError(f"hidden: expected widths from 1 to {LARGEST}, got {self.hidden}")
        for name in ("learning_rate", "clip", "max_gradient", "initial_deviation"):
            if not 0.0 < getattr(self, name) <= sys.float_info.max:
                raise UsageError(f"{name}: expected a positive number, got {getattr(self, name)}")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"{name}: expected a number from 0 to 1, got {getattr(self, name)}")
        if not 0.0 <= self.noise_memory < 1.0:
            raise UsageError(f"noise_memory: expected a number from 0 to below 1, got {self.noise_memory}")
        for name in ("initial_mean", "entropy"):
            if not abs(getattr(self, name)) <= sys.float_info.max:  # written so that NaN fails
                raise UsageError(f"{name}: expected a finite number, got {getattr(self, name)}")

    @property
    def batch(self) -> int:
        """N T."""
        return self.envs * self.rollout

    @property
    def iterations(self) -> int:
        """Whole iterations that make at least the steps of the whole training."""
        return -(-self.total_steps // self.batch)


@dataclass(frozen=True)
class Metrics:
    """Results of one iteration."""

    iteration: int
    steps: int  # Environment steps so far
    mean_return: float  # Undiscounted sum of rewards per experiment, as far as this rollout saw it
    mean_fim: float  # See :attr:`Rollout.final_fim`
    violations: int
    home: int
    ended: int
    policy_loss: float
    value_loss: float
    entropy: float
    kl: float  # Approximate divergence between the policies before and after, mean over the last epoch
    clipped: float  # Share of samples whose ratio was clipped, mean over the last epoch
    explained: float  # Share of the variance of the returns that the critic explains
    deviation: float  # Standard deviation of the action, part of the limit
    learning_rate: float


class Learner:
    """The two networks, their optimisers, and how far the training is.

    Attributes:
        actor: the network that will be exported.
        critic: needed for training only.
        iteration: iterations done.
        early: of these, the last ones in a row in which every experiment ended early.
    """

    def __init__(
        self,
        env: EmbExcitationVectorEnv,
        actor: Actor,
        critic: Critic,
        config: PpoConfig,
        seed: int,
    ) -> None:
        """Begin a training that :meth:`iterate` carries on."""
        self.actor, self.critic = actor, critic
        settings = (config.minibatch, config.learning_rate, config.max_gradient)
        self._policy, self._value = (PerceptronTrainer(n, n.layers, *settings) for n in (self.actor, self.critic))
        self.iteration = 0
        self.early = 0
        self._env = env
        self._config = config
        self._seed = seed
        self._threads = usable(config.threads)

    @property
    def finished(self) -> bool:
        """True if the configured steps have been made."""
        return self.iteration >= self._config.iterations

    def iterate(self) -> Metrics:
        """One rollout and the improvement that it allows.

        Raises:
            TrainingDivergedError: something is not finite any more, or for long every experiment has ended early.
        """
        config = self._config
        draws = np.random.SeedSequence([self._seed, self.iteration]).generate_state(config.envs + 1, np.uint64)
        generator = torch.Generator().manual_seed(int(draws[-1] >> np.uint64(1)))
        learning_rate = config.learning_rate * (1.0 - self.iteration / config.iterations)
        for network in (self._policy, self._value):
            network.adam.param_groups[0]["lr"] = learning_rate
        seeds = [int(d) for d in draws[:-1]]
        torch.set_num_threads(1)  # networks this small lose more by sharing out a product than they win
        rollout = collect(self._env, self.actor, config.rollout, config.noise_memory, seeds, generator, self._threads)
        if not bool(torch.isfinite(rollout.rewards).all() and torch.isfinite(rollout.critic_seen).all()):
            raise TrainingDivergedError(self._not_finite("a reward or a state of the environment"))
        self._count_early(rollout)
        losses = self.improve(rollout, generator)
        if not all(math.isfinite(v) for v in losses.values()) or not self._finite_weights():
            raise TrainingDivergedError(self._not_finite("a loss or a weight"))
        self.iteration += 1
        return Metrics(
            iteration=self.iteration,
            steps=self.iteration * config.batch,
            mean_return=float(rollout.rewards.sum()) / max(rollout.ended, 1),
            mean_fim=rollout.final_fim,
            violations=rollout.violations,
            home=rollout.home,
            ended=rollout.ended,
            deviation=float(self.actor.log_deviation.detach().exp()),
            learning_rate=learning_rate,
            **losses,
        )

    def _not_finite(self, what: str) -> str:
        return (
            f"training diverged in iteration {self.iteration}: {what} is not finite; the last checkpoint is good: "
            "lower the learning rate or the reward's scale"
        )

    def _finite_weights(self) -> bool:
        return all(bool(torch.isfinite(s.vector).all()) for s in (self._policy, self._value))

    def _count_early(self, rollout: Rollout) -> None:
        self.early = self.early + 1 if rollout.ended == rollout.violations > 0 else 0
        if self.early > max(EARLY_AT_LEAST, self._config.iterations // 4):
            raise TrainingDivergedError(
                f"training diverged in iteration {self.iteration}: in the last {self.early} iterations every "
                "experiment left the limits; the best checkpoint is from before: lower the "
                "learning rate, raise the penalty, or train with the shield"
            )

    def improve(self, rollout: Rollout, generator: torch.Generator) -> dict[str, float]:
        """Improve both networks on a rollout; ``generator`` shuffles. Returns the losses of :class:`Metrics`."""
        config, batch = self._config, rollout.rewards.numel()
        seen = self.actor.normalised(rollout.actor_seen.flatten(0, 1))
        actions, critic_seen = rollout.actions.flatten(0, 1), rollout.critic_seen.flatten(0, 1)
        shuffles = [torch.randperm(batch, generator=generator) for _ in range(config.epochs)]
        old, values = side_by_side(
            self._threads,
            lambda: self._log_densities(seen, actions),
            lambda: self._value.outputs(critic_seen).view_as(rollout.rewards),
        )
        last_values = self._value.outputs(rollout.last_critic_seen).squeeze(-1)
        advantages = generalised_advantages(
            rollout.rewards, values, rollout.terminals, last_values, config.gamma, config.gae_lambda
        )
        returns = (advantages + values).flatten()
        explained = 1.0 - float((returns - values.flatten()).var() / (returns.var() + 1e-12))
        wanted, targets = normalised(advantages.flatten()), returns
        losses, value_loss = side_by_side(
            self._threads,
            lambda: self._improve_actor(shuffles, seen, actions, old, wanted),
            lambda: self._improve_critic(shuffles, critic_seen, targets),
        )
        return {**losses, "value_loss": value_loss, "explained": explained}

    @torch.no_grad()
    def _log_densities(self, seen: Tensor, actions: Tensor) -> Tensor:
        """Log densities of actions under the policy as it is, shape [B]."""
        log_deviation = self.actor.log_deviation
        return log_density(deviations(actions, self._policy.outputs(seen), log_deviation), log_deviation)

    @torch.no_grad()
    def _improve_actor(
        self, shuffles: list[Tensor], seen: Tensor, actions: Tensor, old: Tensor, advantages: Tensor
    ) -> dict[str, float]:
        """Ascend the clipped surrogate objective with the entropy bonus (eq. 4.48)."""
        config, log_deviation, records = self._config, self.actor.log_deviation, []
        assert log_deviation.grad is not None
        for last, (s, a, o, advantage) in self._minibatches(shuffles, seen, actions, old, advantages):
            mean = self._policy.forward(s)
            z = deviations(a, mean, log_deviation)
            log_ratio = log_density(z, log_deviation) - o
            loss, slope = surrogate(log_ratio, advantage, config.clip)
            if last:
                records.append(torch.stack([loss, *statistics(log_ratio, log_deviation, config.clip)]))
            # log π = −z²/2 − ln σ + constant with z = (a − μ)/σ: d log π/dμ = z/σ, d log π/d ln σ = z² − 1.
            pull = slope * z
            log_deviation.grad.copy_(pull.dot(z) - slope.sum() - config.entropy)
            self._policy.step(pull.mul_(torch.exp(-log_deviation)).unsqueeze(-1))
        names = ("policy_loss", "entropy", "kl", "clipped")
        return dict(zip(names, torch.stack(records).mean(0).tolist(), strict=True))

    @torch.no_grad()
    def _improve_critic(self, shuffles: list[Tensor], seen: Tensor, returns: Tensor) -> float:
        """Descend half the mean squared error (eq. 4.46); returns its mean over the last epoch."""
        records = []
        for last, (s, target) in self._minibatches(shuffles, seen, returns):
            error = self._value.forward(s) - target.unsqueeze(-1)
            if last:
                records.append(0.5 * error.square().mean())
            self._value.step(error.div_(len(error)))
        return float(torch.stack(records).mean())

    def _minibatches(self, shuffles: list[Tensor], *columns: Tensor) -> Iterator[tuple[bool, list[Tensor]]]:
        """Yields whether it is the last epoch, and the columns of each minibatch, gathered once for an epoch."""
        for epoch, shuffle in enumerate(shuffles):
            gathered = [torch.split(column[shuffle], self._config.minibatch) for column in columns]
            for parts in zip(*gathered, strict=True):
                yield epoch == len(shuffles) - 1, list(parts)


def generalised_advantages(
    rewards: Tensor, values: Tensor, terminals: Tensor, last_value: Tensor, gamma: float, lam: float
) -> Tensor:
    """Â_t = Σ_l (γλ)^l δ_{t+l} with δ_t = r_t + γ V_{t+1} − V_t, and nothing from beyond the end of an experiment.

    Args:
        rewards: shape [T, N].
        values: V of the states in which the actions were taken, shape [T, N].
        terminals: 1 where a step ended its experiment, shape [T, N].
        last_value: V of the states after the last step, shape [N].
        gamma: discount.
        lam: λ.

    Returns:
        Advantages, shape [T, N].
    """
    goes_on = gamma * (1.0 - terminals)
    advantages = rewards - values
    advantages += goes_on * torch.cat((values[1:], last_value[None]))
    rows, shares = advantages.unbind(), (lam * goes_on).unbind()
    for t in range(len(rows) - 2, -1, -1):
        rows[t].addcmul_(shares[t], rows[t + 1])
    return advantages


def deviations(actions: Tensor, mean: Tensor, log_deviation: Tensor) -> Tensor:
    """Returns z = (a − μ)/σ, shape [M], of actions around their means, shape [M, 1] each."""
    return ((actions - mean) * torch.exp(-log_deviation)).squeeze(-1)


def log_density(z: Tensor, log_deviation: Tensor) -> Tensor:
    """Log density of a Gaussian, ``z`` of its standard deviations away from its mean; shape of ``z``."""
    return z.square().mul_(-0.5).sub_(log_deviation + 0.5 * math.log(2.0 * math.pi))


def surrogate(log_ratio: Tensor, advantages: Tensor, clip: float) -> tuple[Tensor, Tensor]:
    """−J^CLIP: minus the mean of min(ρ Â, clip(ρ, 1 − ε, 1 + ε) Â) (eq. 4.48), and its derivative.

    Args:
        log_ratio: log π_θ(a|s) − log π_θ_old(a|s), shape [M].
        advantages: shape [M].
        clip: ε.

    Returns:
        The loss, and its derivative with respect to ``log_ratio``, shape [M]: zero where the clipped one is smaller.
    """
    ratio = torch.exp(log_ratio)
    free, bound = ratio * advantages, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages
    loss = -torch.minimum(free, bound).mean()
    return loss, torch.where(free <= bound, free, 0.0).mul_(-1.0 / len(free))


def statistics(log_ratio: Tensor, log_deviation: Tensor, clip: float) -> tuple[Tensor, Tensor, Tensor]:
    """Entropy of the policy, approximate divergence from the one before, share of clipped ratios."""
    ratio = log_ratio.exp()
    entropy = log_deviation.sum() + 0.5 * math.log(2.0 * math.pi * math.e)
    return entropy, (ratio - 1.0 - log_ratio).mean(), ((ratio - 1.0).abs() > clip).float().mean()


def normalised(advantages: Tensor) -> Tensor:
    """Mean 0 and standard deviation 1 over the whole batch."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def side_by_side(threads: int, first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Results of two functions, run at the same time if there are two threads; the results do not depend on it."""
    if threads < 2:
        return first(), second()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(second)
        return first(), other.result()
