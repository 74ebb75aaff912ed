"""Asymmetric proximal policy optimisation (thesis Algorithm 1; Schulman et al., 2017, arXiv:1707.06347).

The actor sees what the bench measures, the critic sees the true state. Each iteration begins N new experiments,
collects T steps of each, and then improves both networks, which share nothing, on those N T steps. All randomness of
iteration i comes from (seed, i); the networks begin with torch's global random numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from emb_bench.config.bench import Bench
from emb_runtime.errors import EmbError
from emb_train.env import EmbExcitationVectorEnv

Count = Annotated[int, msgspec.Meta(ge=1, le=2**31)]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class TrainingDivergedError(EmbError):
    """A loss, reward or weight is not finite any more: what follows would be worthless."""

    exit_code = 1


class Ppo(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The hyper-parameters."""

    total_steps: Count  # Environment steps of the whole training; rounded up to whole iterations
    envs: Count = 256  # N, experiments that run side by side
    rollout: Count = 500  # T, steps of each in one iteration
    minibatch: Count = 8192  # Samples per gradient step
    epochs: Count = 4  # K, passes over the N T samples
    learning_rate: Positive = 1e-3  # Of Adam for both networks at the start; falls linearly to zero
    gamma: Share = 1.0  # Discount. The horizon is a true end and the step is observed: 1 optimises what is evaluated.
    gae_lambda: Share = 0.95  # λ of the generalised advantage estimate (Schulman et al., 2016, arXiv:1506.02438)
    clip: Positive = 0.2  # ε of the surrogate objective (eq. 4.48)
    entropy: float = 0.0  # Weight of the entropy bonus
    max_gradient: Positive = 0.5  # Largest norm of the gradient, for each network separately
    hidden: tuple[Count, ...] = (64, 64)  # Widths of the hidden layers of both networks
    initial_mean: float = 0.0  # Mean action of the untrained actor, part of the current limit
    initial_deviation: Positive = 0.5  # The untrained action's standard deviation, part of the current limit
    noise_memory: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.0
    """Correlation of the exploration noise from one step to the next, see :func:`exploration_noise`."""

    @property
    def batch(self) -> int:
        """N T."""
        return self.envs * self.rollout

    @property
    def iterations(self) -> int:
        """Whole iterations that make at least the steps of the whole training."""
        return -(-self.total_steps // self.batch)


class Actor(nn.Module):
    """Network from raw actor observations to the mean of the action, a part of the current limit.

    The normaliser has fixed constants from the bench (middle and half of each signal's range), is part of the network,
    and therefore of every file and of the exported graph. An action is Gaussian around the mean; the environment clips
    it to the limit.
    """

    centre: Tensor
    span: Tensor

    def __init__(
        self, bench: Bench, hidden: Sequence[int], initial_mean: float, initial_deviation: float, inputs: int = 3
    ) -> None:
        """Build the network.

        Args:
            bench: gives the ranges of the signals.
            hidden: widths of the hidden layers.
            initial_mean: mean of the untrained action, everywhere, as a part of the limit.
            initial_deviation: standard deviation of the untrained action.
            inputs: length of an observation; one of another length than the measured three has scales of order one.
        """
        super().__init__()
        (low, high), half = bench.limits.angle, 0.5 * bench.timing.horizon
        centre, span = torch.zeros(inputs), torch.ones(inputs)
        if inputs == 3:
            centre = torch.tensor([0.5 * (low + high), 0.0, half])
            span = torch.tensor([0.5 * (high - low), bench.limits.velocity, half])
        self.register_buffer("centre", centre)
        self.register_buffer("span", span)
        self.log_deviation = nn.Parameter(torch.full((1,), math.log(initial_deviation)))
        self.layers = perceptron(inputs, hidden, gain=0.01, bias=initial_mean)

    def forward(self, observation: Tensor) -> Tensor:
        """Means of the actions, shape [N, 1], for observations of shape [N, I]."""
        mean: Tensor = self.layers((observation - self.centre) / self.span)
        return mean

    def log_density(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log π(a | o) of actions, shape [N, 1], around their means: shape [N]."""
        return self.log_density_of((action - self(observation)) / self.log_deviation.exp())

    def log_density_of(self, noise: Tensor) -> Tensor:
        """Log π(a | o) of actions this many standard deviations from their means, shape [..., 1] to [...]."""
        density: Tensor = -0.5 * noise.square() - self.log_deviation - 0.5 * math.log(2.0 * math.pi)
        return density.squeeze(-1)

    def entropy(self) -> Tensor:
        """Of the policy, the same for every observation."""
        return self.log_deviation.sum() + 0.5 * math.log(2.0 * math.pi * math.e)


class Critic(nn.Module):
    """Network from the critic's observations, already of order one, to the value of the state."""

    def __init__(self, size: int, hidden: Sequence[int]) -> None:
        """Build the network for observations of length ``size``."""
        super().__init__()
        self.layers = perceptron(size, hidden, gain=1.0, bias=0.0)

    def forward(self, observation: Tensor) -> Tensor:
        """Values, shape [N], for observations of shape [N, size]."""
        value: Tensor = self.layers(observation).squeeze(-1)
        return value


class DeployedActor(nn.Module):
    """The network that is exported: raw observation in, current [A] out; normaliser, scaling and clip inside."""

    def __init__(self, actor: Actor, limit: float, sample_time: float = 1.0) -> None:
        """Wrap a trained actor for a bench with this current limit [A]; with a sample time [s] it is given the time."""
        super().__init__()
        self.actor, self.limit, self.sample_time = actor, limit, sample_time

    def forward(self, observation: Tensor) -> Tensor:
        """Currents [A] within ±limit, shape [N, 1], for raw observations, shape [N, I]."""
        if self.sample_time != 1.0:
            observation = torch.cat([observation[:, :2], observation[:, 2:] / self.sample_time], 1)
        return self.limit * torch.clamp(self.actor(observation), -1.0, 1.0)


class _Tanh(torch.autograd.Function):
    """tanh x = 2 σ(2 x) − 1, its derivative 1 − tanh² x."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = torch.rsub((2.0 * x).sigmoid_(), -1.0, alpha=-2.0)  # as few passes over memory as there can be
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        slope: Tensor = torch.ops.aten.tanh_backward(gradient, *ctx.saved_tensors)
        return slope


class Tanh(nn.Module):
    """tanh by the logistic function: torch takes several times as long for its own, a quarter of a training."""

    def forward(self, x: Tensor) -> Tensor:
        """Of each element."""
        apply: Any = _Tanh.apply  # without types
        y: Tensor = apply(x)
        return y


def perceptron(inputs: int, hidden: Sequence[int], gain: float, bias: float) -> nn.Sequential:
    """Linear layers with tanh between them and one output; orthogonal start, ``gain`` and ``bias`` for the last one."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [linear(inputs, width, math.sqrt(2.0), 0.0), Tanh()]
        inputs = width
    return nn.Sequential(*layers, linear(inputs, 1, gain, bias))


def linear(inputs: int, outputs: int, gain: float, bias: float) -> nn.Linear:
    """A linear layer with orthogonal weights."""
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.constant_(layer.bias, bias)
    return layer


@dataclass(frozen=True)
class Rollout:
    """N T steps. Time is the first axis, experiments the second."""

    seen: Tensor  # Observations of the actor, shape [T, N, I]
    states: Tensor  # Observations of the critic, shape [T + 1, N, C]; the last follow the last step
    actions: Tensor  # As sampled, before they are clipped, shape [T, N, 1]
    log_densities: Tensor  # Log π(a | o) of these actions, shape [T, N]
    rewards: Tensor  # Shape [T, N]
    terminals: Tensor  # 1 where the step ended its experiment, shape [T, N]
    ended: int  # Experiments that ended
    violations: int  # Experiments among these that left the limits
    home: int  # Experiments among these that ended at home
    information: float  # Mean of the first diagonal element of the FIM over the experiments that ended; NaN if none did


@dataclass(frozen=True)
class Metrics:
    """Results of one iteration."""

    iteration: int
    steps: int  # Environment steps so far
    mean_return: float  # Sum of rewards per experiment that ended
    information: float  # See :attr:`Rollout.information`
    violations: int
    home: int
    ended: int
    policy_loss: float
    value_loss: float
    kl: float  # Approximate divergence between the policies before and after, mean over the last epoch
    deviation: float  # Standard deviation of the action, part of the limit


def train(env: EmbExcitationVectorEnv, actor: Actor, ppo: Ppo, seed: int) -> Iterator[Metrics]:
    """Train an actor, in place (Algorithm 1).

    Yields:
        After each iteration, its results.

    Raises:
        TrainingDivergedError: something is not finite any more, or for long every experiment has left the limits.
    """
    torch.set_num_threads(1)  # networks this small lose more by sharing out a product than they win
    critic = Critic(env.batch.critic_size, ppo.hidden)
    optimiser = torch.optim.Adam([*actor.parameters(), *critic.parameters()], eps=1e-5, fused=True)
    early = 0
    for iteration in range(ppo.iterations):
        draws = np.random.SeedSequence([seed, iteration]).generate_state(ppo.envs + 1, np.uint64).tolist()
        generator = torch.Generator().manual_seed(draws.pop() >> 1)
        optimiser.param_groups[0]["lr"] = ppo.learning_rate * (1.0 - iteration / ppo.iterations)
        rollout = collect(env, actor, ppo.rollout, ppo.noise_memory, draws, generator)
        losses = improve(actor, critic, optimiser, rollout, ppo, generator)
        if not all(torch.isfinite(w).all() for network in (actor, critic) for w in network.parameters()):
            raise TrainingDivergedError(
                f"training diverged in iteration {iteration + 1}: a weight is not finite: lower the learning rate or "
                "the reward's scale"
            )
        early = early + 1 if rollout.ended == rollout.violations > 0 else 0
        if early > max(10, ppo.iterations // 4):
            raise TrainingDivergedError(
                f"training diverged in iteration {iteration + 1}: for {early} iterations every experiment has left "
                "the limits: lower the learning rate, raise the penalty, or train with the shield"
            )
        yield Metrics(
            iteration=iteration + 1,
            steps=(iteration + 1) * ppo.batch,
            mean_return=float(rollout.rewards.sum()) / max(rollout.ended, 1),
            information=rollout.information,
            violations=rollout.violations,
            home=rollout.home,
            ended=rollout.ended,
            **losses,
            deviation=float(actor.log_deviation.detach().exp()),
        )


@torch.no_grad()
def collect(
    env: EmbExcitationVectorEnv,
    actor: Actor,
    steps: int,
    noise_memory: float,
    seeds: Sequence[int],
    generator: torch.Generator,
    exploration: float = 1.0,
) -> Rollout:
    """Begin new experiments with these seeds and follow the actor for ``steps`` steps.

    An experiment that ends begins again with another brake.

    Args:
        env: with N experiments.
        actor: on the CPU.
        steps: T.
        noise_memory: see :func:`exploration_noise`.
        seeds: of the N experiments.
        generator: of the exploration.
        exploration: times the policy's own standard deviation; 0 for the mean action.
    """
    observation, info = env.reset(seed=seeds)
    seen = torch.empty(steps, *observation.shape)
    states = torch.empty(steps + 1, *info["critic"].shape)
    rewards, terminals = torch.empty(steps, env.num_envs), torch.empty(steps, env.num_envs)
    actions = exploration_noise(steps, env.num_envs, noise_memory, generator)
    log_densities = actor.log_density_of(actions)
    actions *= exploration * actor.log_deviation.exp()
    ended, violations, home, gathered = 0, 0, 0, 0.0
    for t in range(steps):
        seen[t], states[t] = torch.from_numpy(observation), torch.from_numpy(info["critic"])
        actions[t] += actor(seen[t])
        step = env.step if t + 1 < steps else env.advance  # nobody would play what begins after the last one
        observation, reward, over, _, info = step(actions[t].numpy())
        rewards[t], terminals[t] = torch.from_numpy(reward), torch.from_numpy(over)
        if over.any():
            final = info.get("final_info", info)
            ended, gathered = ended + int(over.sum()), gathered + float(final["fim"][over, 0].sum())
            violations, home = violations + int(final["violated"][over].sum()), home + int(final["home"][over].sum())
    states[steps] = torch.from_numpy(info["critic"])
    information = gathered / ended if ended else math.nan
    return Rollout(seen, states, actions, log_densities, rewards, terminals, ended, violations, home, information)


def exploration_noise(steps: int, envs: int, noise_memory: float, generator: torch.Generator) -> Tensor:
    """Gaussian noise with standard deviation 1 at every step and correlation ``noise_memory`` from step to step.

    White noise at 1 kHz averages out before the brake notices. Each step's own density is unchanged, and the policy's
    gradient estimated with it is the true one of the smoothed objective times the noise's covariance over time: an
    ascent direction that moves neighbouring steps together.

    Returns:
        Shape [steps, envs, 1].
    """
    noise = torch.randn(steps, envs, 1, generator=generator)
    noise[1:] *= math.sqrt(1.0 - noise_memory * noise_memory)
    for t in range(1, steps):
        noise[t] += noise_memory * noise[t - 1]
    return noise


def improve(
    actor: Actor,
    critic: Critic,
    optimiser: torch.optim.Optimizer,
    rollout: Rollout,
    ppo: Ppo,
    generator: torch.Generator,
) -> dict[str, float]:
    """Improve both networks on a rollout, K epochs of minibatches; returns the losses of :class:`Metrics`."""
    seen, actions = rollout.seen.flatten(0, 1), rollout.actions.flatten(0, 1)
    states = rollout.states[:-1].flatten(0, 1)
    with torch.no_grad():
        values = critic(rollout.states)
    advantages = generalised_advantages(rollout.rewards, values, rollout.terminals, ppo.gamma, ppo.gae_lambda)
    returns = (advantages + values[:-1]).flatten()
    advantages = advantages.flatten()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    columns = (seen, actions, states, torch.stack((rollout.log_densities.flatten(), advantages, returns), 1))
    samples, widths = torch.cat(columns, 1), [column.shape[1] for column in columns]  # one gather, not six
    records: list[list[float]] = []
    for epoch in range(ppo.epochs):
        for some in torch.split(samples[torch.randperm(len(samples), generator=generator)], ppo.minibatch):
            seen, actions, states, rest = torch.split(some, widths, 1)
            before, advantage, value = rest.unbind(1)
            log_ratio = actor.log_density(seen, actions) - before
            policy_loss = surrogate(log_ratio, advantage, ppo.clip)
            value_loss = 0.5 * (critic(states) - value).square().mean()  # eq. 4.46
            optimiser.zero_grad()
            torch.autograd.backward(policy_loss - ppo.entropy * actor.entropy() + value_loss)
            for network in (actor, critic):
                nn.utils.clip_grad_norm_(network.parameters(), ppo.max_gradient)
            optimiser.step()
            if epoch == ppo.epochs - 1:
                with torch.no_grad():
                    kl = (log_ratio.exp() - 1.0 - log_ratio).mean()
                records.append([float(policy_loss.detach()), float(value_loss.detach()), float(kl)])
    return dict(zip(("policy_loss", "value_loss", "kl"), np.mean(records, axis=0).tolist(), strict=True))


def generalised_advantages(
    rewards: Tensor, values: Tensor, terminals: Tensor, gamma: float, gae_lambda: float
) -> Tensor:
    """Â_t = Σ_l (γλ)^l δ_{t+l} with δ_t = r_t + γ V_{t+1} − V_t, and nothing from after the end of an experiment.

    Args:
        rewards: shape [T, N].
        values: V of the states before each step and after the last one, shape [T + 1, N].
        terminals: 1 where a step ended its experiment, shape [T, N].
        gamma: discount.
        gae_lambda: λ.

    Returns:
        Advantages, shape [T, N].
    """
    advantages, following = torch.empty_like(rewards), torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        goes_on = gamma * (1.0 - terminals[t])
        delta = rewards[t] + goes_on * values[t + 1] - values[t]
        advantages[t] = following = delta + gae_lambda * goes_on * following
    return advantages


def surrogate(log_ratio: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """−J^CLIP: minus the mean of min(ρ Â, clip(ρ, 1 − ε, 1 + ε) Â) (eq. 4.48).

    Args:
        log_ratio: log π_θ(a|s) − log π_θ_old(a|s), shape [M].
        advantages: shape [M].
        clip: ε.
    """
    ratio = log_ratio.exp()
    return -torch.min(ratio * advantages, ratio.clamp(1.0 - clip, 1.0 + clip) * advantages).mean()
