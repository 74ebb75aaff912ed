"""Asymmetric proximal policy optimisation (thesis Algorithm 1; Schulman et al., 2017, arXiv:1707.06347).

The actor sees what the bench measures, the critic sees the truth. Each iteration begins N new experiments, collects T
steps of each, and then improves both networks on those N T steps. All randomness of iteration i comes from (seed, i):
a run that was stopped and resumed is the run that was not.
"""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch

from emb_runtime.errors import EmbError, UsageError
from emb_train.envs.vector_env import EmbExcitationVectorEnv
from emb_train.ppo.collecting import Collects
from emb_train.ppo.learning import ActorStudent, CriticStudent, Study, side_by_side
from emb_train.ppo.networks import Actor, Critic
from emb_train.ppo.objective import generalised_advantages, normalised
from emb_train.ppo.rollout import Rollout, collect, usable

CPU = torch.device("cpu")
EARLY_AT_LEAST = 10
"""Iterations in a row in which every experiment ends early, and as many as a quarter of the training has: given up."""
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
    """What the untrained actor asks for, part of the current limit."""
    initial_deviation: float = 0.5
    """The untrained action's standard deviation, part of the current limit."""
    noise_memory: float = 0.0
    """Correlation of the exploration noise from one step to the next, see :func:`exploration_noise`."""
    threads: int = 2
    """Most at a time, for experiments side by side, and for actor and critic. Results do not depend on it."""

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


class Learner:
    """The two networks, their optimisers, and how far they are.

    Attributes:
        actor: what will be exported.
        critic: needed for training only.
        optimisers: Adam of the actor, and of the critic.
        iteration: iterations done.
        early: of these, the last ones in a row in which every experiment ended early.
    """

    def __init__(
        self,
        env: EmbExcitationVectorEnv | Collects,
        actor: Actor,
        critic: Critic,
        config: PpoConfig,
        seed: int,
        device: torch.device = CPU,
    ) -> None:
        """Begin a training that :meth:`iterate` carries on.

        Args:
            env: with ``config.envs`` experiments.
            actor: untrained, or from a checkpoint.
            critic: the same.
            config: the hyper-parameters.
            seed: of everything random in the iterations.
            device: where the networks learn; experiments always run on the CPU.
        """
        self.actor, self.critic = actor.to(device), critic.to(device)
        study = Study(config.minibatch, config.max_gradient, config.clip, config.entropy)
        self._learns = ActorStudent(actor, study, config.learning_rate)
        self._judges = CriticStudent(critic, study, config.learning_rate)
        self.optimisers = (self._learns.adam, self._judges.adam)
        self.iteration = 0
        self.early = 0
        self._acting = actor if device == CPU else copy.deepcopy(actor).cpu()
        self._collect: Callable[..., Rollout]
        self._collect = partial(collect, env) if isinstance(env, EmbExcitationVectorEnv) else env.collect
        self._config = config
        self._seed = seed
        self._device = device
        self._threads = usable(config.threads)

    @property
    def finished(self) -> bool:
        """Whether the configured steps have been made."""
        return self.iteration >= self._config.iterations

    @property
    def acting(self) -> Actor:
        """The actor as it is now, on the CPU."""
        if self._acting is not self.actor:
            self._acting.load_state_dict(self.actor.state_dict())
        return self._acting

    def iterate(self) -> Metrics:
        """One rollout and the improvement that it allows.

        Raises:
            TrainingDivergedError: something is not finite any more, or for long every experiment has ended early.
        """
        config = self._config
        draws = np.random.SeedSequence([self._seed, self.iteration]).generate_state(config.envs + 1, np.uint64)
        generator = torch.Generator().manual_seed(int(draws[-1] >> np.uint64(1)))
        learning_rate = config.learning_rate * (1.0 - self.iteration / config.iterations)
        for optimiser in self.optimisers:
            optimiser.param_groups[0]["lr"] = learning_rate
        seeds = [int(d) for d in draws[:-1]]
        torch.set_num_threads(1)  # networks this small lose more by sharing out a product than they win
        rollout = self._collect(self.acting, config.rollout, config.noise_memory, seeds, generator, self._threads)
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
        return all(bool(torch.isfinite(s.vector).all()) for s in (self._learns, self._judges))

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
        config, device, batch = self._config, self._device, rollout.rewards.numel()
        critic_seen = rollout.critic_seen.flatten(0, 1).to(device)
        shuffles = [torch.randperm(batch, generator=generator).to(device) for _ in range(config.epochs)]
        old, values = side_by_side(
            self._threads,
            lambda: self._learns.log_densities(rollout),
            lambda: self._judges.outputs(critic_seen).cpu().view_as(rollout.rewards),
        )
        last_values = self._judges.outputs(rollout.last_critic_seen.to(device)).cpu().squeeze(-1)
        advantages = generalised_advantages(
            rollout.rewards, values, rollout.terminals, last_values, config.gamma, config.gae_lambda
        )
        returns = (advantages + values).flatten()
        explained = 1.0 - float((returns - values.flatten()).var() / (returns.var() + 1e-12))
        wanted, targets = normalised(advantages.flatten()).to(device), returns.to(device)
        losses, value_loss = side_by_side(
            self._threads,
            lambda: self._learns.learn(shuffles, rollout, old, wanted),
            lambda: self._judges.learn(shuffles, critic_seen, targets),
        )
        return {**losses._asdict(), "value_loss": value_loss, "explained": explained}
