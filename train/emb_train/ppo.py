"""Asymmetric proximal policy optimisation (thesis Algorithm 1; Schulman et al., 2017, arXiv:1707.06347).

The actor sees what the bench measures, the critic sees the truth. Each iteration begins N new experiments, collects T
steps of each, and then improves both networks on those N T steps. All randomness of iteration i comes from (seed, i):
a run that was stopped and resumed is the run that was not.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from emb_runtime.errors import EmbError, UsageError
from emb_train.networks import Actor, Critic
from emb_train.vector_env import EmbExcitationVectorEnv

LARGEST = 2**63 - 1
"""Of the integers that torch and NumPy count with."""


class TrainingDivergedError(EmbError):
    """A loss, reward or weight is not finite any more: what follows would be worthless."""

    exit_code = 1


@dataclass(frozen=True)
class PpoConfig:
    """The hyper-parameters."""

    total_steps: int
    """Environment steps of the whole training; rounded up to whole iterations."""
    envs: int = 256
    """N, experiments that run side by side."""
    rollout: int = 500
    """T, steps of each in one iteration: a multiple of the horizon, so that it is made of whole experiments."""
    minibatch: int = 8192
    """Samples per gradient step."""
    epochs: int = 4
    """K, passes over the N T samples."""
    learning_rate: float = 1e-3
    """Of Adam, both networks, at the start; falls linearly to zero."""
    gamma: float = 1.0
    """Discount. The horizon is a true end and the step is observed: 1 optimises what is evaluated."""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimate (Schulman et al., 2016, arXiv:1506.02438)."""
    clip: float = 0.2
    """ε of the surrogate objective (eq. 4.48)."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    max_gradient: float = 0.5
    """Largest norm of the gradient, for each network apart."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of both networks."""
    initial_mean: float = 0.0
    """The untrained actor's action, part of the current limit."""
    initial_deviation: float = 0.5
    """The untrained action's standard deviation, part of the current limit."""
    noise_memory: float = 0.0
    """Correlation of the exploration noise from one step to the next, see :func:`exploration_noise`."""
    threads: int = 1
    """Of torch. Results are bit-identical for the same seed and the same number."""

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
        """Iterations of the whole training."""
        return self.iterations_for(self.total_steps)

    def iterations_for(self, steps: int) -> int:
        """Whole iterations that make at least this many environment steps."""
        return -(-steps // self.batch)


@dataclass(frozen=True)
class Rollout:
    """N T steps. Time is the first axis, experiments the second."""

    actor_seen: Tensor
    """Shape [T, N, 3]."""
    critic_seen: Tensor
    """Shape [T, N, C]."""
    actions: Tensor
    """As sampled, before the environment's clip, shape [T, N, 1]."""
    rewards: Tensor
    """Shape [T, N]."""
    terminals: Tensor
    """1 where the step ended its experiment, shape [T, N]."""
    last_critic_seen: Tensor
    """What the critic sees after the last step, shape [N, C]."""
    final_fim: float
    """Mean of the first diagonal element of the FIM over the experiments that ended; NaN if none did."""
    ended: int
    """Experiments that ended."""
    violations: int
    """Of these: that left the limits."""
    home: int
    """Of these: that ended at home."""


@dataclass(frozen=True)
class Metrics:
    """One iteration in numbers."""

    iteration: int
    steps: int
    """Environment steps so far."""
    mean_return: float
    """Undiscounted sum of rewards per experiment, as far as this rollout saw it."""
    mean_fim: float
    """See :attr:`Rollout.final_fim`."""
    violations: int
    home: int
    ended: int
    policy_loss: float
    value_loss: float
    entropy: float
    kl: float
    """Approximate divergence between the policies before and after, mean over the last epoch."""
    clipped: float
    """Share of samples whose ratio was clipped, mean over the last epoch."""
    explained: float
    """Share of the variance of the returns that the critic explains."""
    deviation: float
    """Standard deviation of the action, part of the limit."""
    learning_rate: float


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
    advantages = torch.empty_like(rewards)
    following, next_value = torch.zeros_like(last_value), last_value
    for t in range(len(rewards) - 1, -1, -1):
        goes_on = 1.0 - terminals[t]
        delta = rewards[t] + gamma * goes_on * next_value - values[t]
        following = delta + gamma * lam * goes_on * following
        advantages[t] = following
        next_value = values[t]
    return advantages


def log_density(mean: Tensor, log_deviation: Tensor, action: Tensor) -> Tensor:
    """Log density of Gaussian actions with one component, shape [M], from shapes [M, 1]."""
    z = (action - mean) * torch.exp(-log_deviation)
    return (-0.5 * z * z - log_deviation - 0.5 * math.log(2.0 * math.pi)).squeeze(-1)


def surrogate_loss(log_ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """−J^CLIP: minus the mean of min(ρ Â, clip(ρ, 1 − ε, 1 + ε) Â) (eq. 4.48).

    Args:
        log_ratio: log π_θ(a|s) − log π_θ_old(a|s), shape [M].
        advantages: shape [M].
        clip: ε.
    """
    ratio = torch.exp(log_ratio)
    return -torch.minimum(ratio * advantages, torch.clamp(ratio, 1.0 - clip, 1.0 + clip) * advantages).mean()


def normalised(advantages: Tensor) -> Tensor:
    """Mean 0 and standard deviation 1 over the whole batch."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


class Learner:
    """The two networks, their optimiser, and how far they are.

    Attributes:
        actor: what will be exported.
        critic: needed for training only.
        optimiser: Adam of both.
        iteration: iterations done.
    """

    def __init__(self, env: EmbExcitationVectorEnv, actor: Actor, critic: Critic, config: PpoConfig, seed: int) -> None:
        """Begin a training that :meth:`iterate` carries on.

        Args:
            env: with ``config.envs`` experiments.
            actor: untrained, or from a checkpoint.
            critic: the same.
            config: the hyper-parameters.
            seed: of everything random in the iterations.
        """
        self.actor, self.critic = actor, critic
        self.optimiser = torch.optim.Adam(
            [*actor.parameters(), *critic.parameters()], lr=config.learning_rate, eps=1e-5
        )
        self.iteration = 0
        self._env = env
        self._config = config
        self._seed = seed

    @property
    def finished(self) -> bool:
        """Whether the configured steps have been made."""
        return self.iteration >= self._config.iterations

    def iterate(self) -> Metrics:
        """One rollout and the improvement that it allows.

        Raises:
            TrainingDivergedError: something is not finite any more.
        """
        config = self._config
        draws = np.random.SeedSequence([self._seed, self.iteration]).generate_state(config.envs + 1, np.uint64)
        generator = torch.Generator().manual_seed(int(draws[-1] >> np.uint64(1)))
        learning_rate = config.learning_rate * (1.0 - self.iteration / config.iterations)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate
        rollout = collect(
            self._env, self.actor, config.rollout, config.noise_memory, [int(d) for d in draws[:-1]], generator
        )
        if not bool(torch.isfinite(rollout.rewards).all() and torch.isfinite(rollout.critic_seen).all()):
            raise TrainingDivergedError(self._not_finite("a reward or a state of the environment"))
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
        return all(bool(torch.isfinite(p).all()) for p in (*self.actor.parameters(), *self.critic.parameters()))

    def improve(self, rollout: Rollout, generator: torch.Generator) -> dict[str, float]:
        """Improve both networks on a rollout; ``generator`` shuffles. Returns the losses of :class:`Metrics`."""
        config = self._config
        actor_seen, actions = rollout.actor_seen.flatten(0, 1), rollout.actions.flatten(0, 1)
        critic_seen = rollout.critic_seen.flatten(0, 1)
        with torch.no_grad():
            values = self.critic(critic_seen).view_as(rollout.rewards)
            old_log_density = log_density(self.actor(actor_seen), self.actor.log_deviation, actions)
            advantages = generalised_advantages(
                rollout.rewards,
                values,
                rollout.terminals,
                self.critic(rollout.last_critic_seen),
                config.gamma,
                config.gae_lambda,
            )
            returns = (advantages + values).flatten()
            explained = 1.0 - float((returns - values.flatten()).var() / (returns.var() + 1e-12))
            advantages = normalised(advantages.flatten())
        for _ in range(config.epochs):
            records = []
            shuffled = torch.randperm(len(returns), generator=generator)
            for start in range(0, len(returns), config.minibatch):
                index = shuffled[start : start + config.minibatch]
                log_ratio = log_density(self.actor(actor_seen[index]), self.actor.log_deviation, actions[index])
                log_ratio = log_ratio - old_log_density[index]
                policy_loss = surrogate_loss(log_ratio, advantages[index], config.clip)
                value_loss = 0.5 * (self.critic(critic_seen[index]) - returns[index]).square().mean()  # eq. 4.46
                entropy = (self.actor.log_deviation + 0.5 * math.log(2.0 * math.pi * math.e)).sum()
                self.optimiser.zero_grad(set_to_none=True)
                (policy_loss + value_loss - config.entropy * entropy).backward()
                torch.nn.utils.clip_grad_norm_(self.actor.parameters(), config.max_gradient)
                torch.nn.utils.clip_grad_norm_(self.critic.parameters(), config.max_gradient)
                self.optimiser.step()
                with torch.no_grad():
                    ratio = log_ratio.exp()
                    kl = (ratio - 1.0 - log_ratio).mean()
                    clipped = ((ratio - 1.0).abs() > config.clip).float().mean()
                    records.append(torch.stack([policy_loss, value_loss, entropy, kl, clipped]))
        means = torch.stack(records).mean(0).tolist()
        return dict(zip(("policy_loss", "value_loss", "entropy", "kl", "clipped"), means, strict=True)) | {
            "explained": explained
        }


def exploration_noise(steps: int, envs: int, memory: float, generator: torch.Generator) -> Tensor:
    """Gaussian noise with standard deviation 1 at every step and correlation ``memory`` from step to step.

    White noise at 1 kHz averages out before the brake notices. Each step's own density is unchanged, and the policy's
    gradient estimated with it is the true one of the smoothed objective times the noise's covariance over time: an
    ascent direction that moves neighbouring steps together.

    Returns:
        Shape [steps, envs, 1].
    """
    noise = torch.randn(steps, envs, 1, generator=generator)
    fresh = math.sqrt(1.0 - memory * memory)
    for t in range(1, steps):
        noise[t].mul_(fresh).add_(noise[t - 1], alpha=memory)
    return noise


def collect(
    env: EmbExcitationVectorEnv, actor: Actor, steps: int, memory: float, seeds: list[int], generator: torch.Generator
) -> Rollout:
    """Begin new experiments with these seeds and follow the actor, with exploration, for ``steps`` steps."""
    n = env.num_envs
    seen, info = env.reset(seed=seeds)
    actor_seen, critic_seen = torch.empty(steps, n, 3), torch.empty(steps, n, env.critic_size)
    actions = exploration_noise(steps, n, memory, generator)
    rewards, terminals = torch.empty(steps, n), torch.zeros(steps, n)
    final_fim, ended, violations, home = 0.0, 0, 0, 0
    with torch.no_grad():
        deviation = actor.log_deviation.exp()
        for t in range(steps):
            actor_seen[t], critic_seen[t] = torch.from_numpy(seen), torch.from_numpy(info["critic"])
            actions[t].mul_(deviation).add_(actor(actor_seen[t]))
            seen, reward, terminated, _, info = env.step(actions[t].numpy())
            rewards[t] = torch.from_numpy(reward)
            if terminated.any():
                terminals[t] = torch.from_numpy(terminated)
                final = info["final_info"]
                ended += int(terminated.sum())
                final_fim += float(final["fim"][terminated, 0].sum())
                violations += int(final["violated"].sum())
                home += int(final["home"][terminated].sum())
    return Rollout(
        actor_seen,
        critic_seen,
        actions,
        rewards,
        terminals,
        torch.from_numpy(info["critic"]),
        final_fim / ended if ended else math.nan,
        ended,
        violations,
        home,
    )
