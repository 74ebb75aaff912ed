"""Asymmetric proximal policy optimisation (thesis Algorithm 1; Schulman et al., 2017, arXiv:1707.06347).

The actor sees what the bench measures, the critic sees the true state. Each iteration begins N new experiments,
collects T steps of each, and then improves both networks, which share nothing, on those N T steps. All randomness of
iteration i comes from (seed, i); the networks begin with torch's global random numbers.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, TypeVar

import msgspec
import numpy as np
import torch
from torch import Tensor, nn

from emb_bench.config.bench import Bench
from emb_bench.parallel import processors
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import EmbError
from emb_runtime.policy.contract import SAMPLE
from emb_train.closed_loop import Batch, Count, Positive, Share
from emb_train.env import EmbExcitationVectorEnv

Result = TypeVar("Result")

STEPS = 128  # Soft steps in time that a network of time and estimate has
SEEN = slice(len(SAMPLE) - 1, len(SAMPLE) + len(PARAMETER_NAMES))  # Time and estimates in an observation
SLOPE = 2.0  # Of the soft step in an estimate, at the nominal value and relative to it
FARTHEST = 1.0  # Most that a reward may be from its pair's mean
FINENESS = 9.0  # A speed is sinh(9 a)/sinh 9 of the limit for the action a


class TrainingDivergedError(EmbError):
    """A loss, reward or weight is not finite any more: further training would be worthless."""

    exit_code = 1


class Algorithm(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The hyper-parameters of the algorithm as it is published."""

    total_steps: Count  # Environment steps of the training; rounded up to a multiple of an iteration's
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


class Ppo(Algorithm, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The hyper-parameters: those of the algorithm, of the networks and of the exploration."""

    hidden: tuple[Count, ...] = (64, 64)  # Widths of the hidden layers of both networks
    initial_mean: float = 0.0  # Mean action of the untrained actor, part of the limit
    initial_deviation: Positive = 0.5  # The untrained action's standard deviation, part of the limit
    noise_memory: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.0
    """Correlation of the exploration noise from one step to the next, see :func:`exploration_noise`."""
    noise_hold: Count = 1  # Steps for which the exploration noise keeps a value; one step of these is learned from
    final_deviation: Positive | None = None
    """The action's standard deviation falls linearly to this one over the training; None learns it."""
    clone_steps: Count = 6000  # Gradient steps of the cloning of a plan
    clone_rate: Positive = 3e-3  # Learning rate of the cloning at the start
    pairs: bool = False
    """Experiments come in pairs with the same brake and the opposite exploration, and a return counts by its difference
    from the pair's mean (antithetic variates): the luck of the brake drops out."""

    @property
    def batch(self) -> int:
        """N T."""
        return self.envs * self.rollout

    @property
    def iterations(self) -> int:
        """Least number of iterations that make the steps of the training."""
        return -(-self.total_steps // self.batch)


class Scaled(nn.Module):
    """Raw observations in scales of order one, with fixed constants from the bench."""

    centre: Tensor
    span: Tensor

    def __init__(self, bench: Bench, size: int) -> None:
        """Middle and half of each measured signal's range; an observation of another length has such scales already."""
        super().__init__()
        (low, high), half = bench.limits.angle, 0.5 * bench.timing.horizon
        centre, span = torch.zeros(size), torch.ones(size)
        if size == len(SAMPLE):
            centre = torch.tensor([0.5 * (low + high), 0.0, half])
            span = torch.tensor([0.5 * (high - low), bench.limits.velocity, half])
        self.register_buffer("centre", centre)
        self.register_buffer("span", span)

    def forward(self, observation: Tensor) -> Tensor:
        """Shape [N, size] to the same."""
        return (observation - self.centre) / self.span

    def layers(self, sample_time: float) -> list[nn.Module]:
        """Layers with the same outputs, for observations with the time [s] in place of the step."""
        return [linear(torch.diag(1.0 / self.span), -self.centre / self.span, sample_time)]


class TimeAndEstimate(nn.Module):
    """Features of an observation with the estimate: soft steps in time, and in each of the four estimates.

    A plan changes its speed from one sample to the next. Steps spread over the experiment let a network do so from the
    start. The measured sample and the estimate's deviations are no features: under clock jitter the deviations jump.
    """

    scale: Tensor
    shift: Tensor

    def __init__(self, bench: Bench, inputs: int) -> None:
        super().__init__()
        self._inputs = inputs
        width, nominal = bench.timing.horizon / STEPS, torch.tensor(nominal_of(bench))
        scale, shift = torch.zeros(STEPS + len(nominal), 1 + len(nominal)), torch.zeros(STEPS + len(nominal))
        scale[:STEPS, 0], shift[:STEPS] = 1.0 / width, -torch.arange(STEPS)
        scale[STEPS:, 1:], shift[STEPS:] = torch.diag(SLOPE / nominal), -SLOPE
        self.register_buffer("scale", scale)
        self.register_buffer("shift", shift)

    def forward(self, observation: Tensor) -> Tensor:
        """Shape [N, 11] to [N, features]."""
        return torch.tanh(nn.functional.linear(observation[:, SEEN], self.scale, self.shift))

    def layers(self, sample_time: float) -> list[nn.Module]:
        """Layers with the same outputs, for all of an observation, with the time [s] in place of the step."""
        weight = torch.zeros(len(self.shift), self._inputs)
        weight[:, SEEN] = self.scale
        return [linear(weight, self.shift, sample_time), nn.Tanh()]


def linear(weight: Tensor, bias: Tensor, sample_time: float) -> nn.Linear:
    """A layer with these weights of (angle, velocity, step, ...), for (angle, velocity, time [s], ...)."""
    initial: Any = nn.utils.skip_init  # without types; drawn weights would change what is drawn next
    layer: nn.Linear = initial(nn.Linear, *reversed(weight.shape))
    with torch.no_grad():
        layer.weight.copy_(weight)
        layer.weight[:, len(SAMPLE) - 1] /= sample_time
        layer.bias.copy_(bias)
    return layer


class Actor(nn.Module):
    """Network from raw actor observations to the mean of the action.

    The features have fixed constants from the bench, are part of the network, and therefore of every file and of the
    exported graph. An action is Gaussian around the mean; :meth:`part` makes it a part of the limit.
    """

    def __init__(self, bench: Bench, ppo: Ppo, inputs: int = len(SAMPLE), speed: bool = False) -> None:
        """Build the network.

        Args:
            bench: gives the ranges of the signals.
            ppo: widths of the layers, mean and standard deviation of the untrained action.
            inputs: length of an observation; one of another length than the measured three has scales of order one.
            speed: the action is a target speed, of time and estimate.
        """
        super().__init__()
        self.speed = speed
        features = TimeAndEstimate(bench, inputs) if speed else Scaled(bench, inputs)
        self.features: TimeAndEstimate | Scaled = features
        self.log_deviation = nn.Parameter(torch.full((1,), math.log(ppo.initial_deviation)))
        self.log_deviation.requires_grad_(ppo.final_deviation is None)
        size = len(features.shift) if isinstance(features, TimeAndEstimate) else inputs
        self.layers = perceptron(size, ppo.hidden, gain=0.01, bias=ppo.initial_mean)

    def forward(self, observation: Tensor) -> Tensor:
        """Means of the actions, shape [N, 1], for observations of shape [N, I]."""
        mean: Tensor = self.layers(self.features(observation))
        return mean

    def part(self, action: Tensor) -> Tensor:
        """The part of the limit that an action is; one beyond ±1 is clipped behind it.

        Near zero a speed is exponentially finer, so that noise lets neither a creep nor a standstill stick.
        """
        return torch.sinh(FINENESS * action.clamp(-1.0, 1.0)) / math.sinh(FINENESS) if self.speed else action

    def action(self, part: Tensor) -> Tensor:
        """The action whose :meth:`part` this is, of a speed."""
        return torch.asinh(part * math.sinh(FINENESS)) / FINENESS

    def log_density(self, observation: Tensor, action: Tensor) -> Tensor:
        """Log π(a | o) of actions, shape [N, 1], around their means: shape [N]."""
        return self.log_density_of((action - self(observation)) / self.log_deviation.exp())

    def log_density_of(self, noise: Tensor) -> Tensor:
        """Log π(a | o) of actions this many standard deviations from their means, shape [..., 1] to [...]."""
        return log_density(noise, self.log_deviation)

    def entropy(self) -> Tensor:
        """Of the policy, the same for every observation."""
        return self.log_deviation.sum() + 0.5 * math.log(2.0 * math.pi * math.e)


def log_density(noise: Tensor, log_deviation: Tensor) -> Tensor:
    """Log density of Gaussian actions this many standard deviations from their means, shape [..., 1] to [...]."""
    density: Tensor = -0.5 * noise.square() - log_deviation - 0.5 * math.log(2.0 * math.pi)
    return density.squeeze(-1)


class Critic(nn.Module):
    """Network from the critic's observations, already of order one, to the value of the state."""

    def __init__(self, size: int, hidden: Sequence[int], gain: float = 1.0) -> None:
        """Build the network for observations of length ``size``; ``gain`` is of the untrained values."""
        super().__init__()
        self.layers = perceptron(size, hidden, gain=gain, bias=0.0)

    def forward(self, observation: Tensor) -> Tensor:
        """Values, shape [N], for observations of shape [N, size]."""
        value: Tensor = self.layers(observation).squeeze(-1)
        return value


class DeployedActor(nn.Module):
    """The network that is exported: raw observation in, current [A] or speed [rad/s] out; scaling and clip inside.

    It has as few operators as there can be, for each takes its time in a cycle, however small it is.
    """

    def __init__(self, actor: Actor, limit: float, sample_time: float = 1.0) -> None:
        """Take the layers of a trained actor.

        Args:
            actor: of this bench.
            limit: of the bench, [A] or [rad/s].
            sample_time: of a bench whose policies get the time [s] in place of the step.
        """
        super().__init__()
        self.limit, self.speed = limit, actor.speed
        alike = [nn.Tanh() if isinstance(layer, Tanh) else copy.deepcopy(layer) for layer in actor.layers]
        self.layers = nn.Sequential(*actor.features.layers(sample_time), *alike)
        if actor.speed:
            for values in alike[-1].parameters():
                values.data *= FINENESS

    def forward(self, observation: Tensor) -> Tensor:
        """Currents [A] or speeds [rad/s] within ±limit, shape [N, 1], for raw observations, shape [N, I]."""
        action = self.layers(observation)
        requested = self.limit / math.sinh(FINENESS) * torch.sinh(action) if self.speed else self.limit * action
        return torch.clamp(requested, -self.limit, self.limit)


def clone(actor: Actor, speeds: Sequence[float], bench: Bench, ppo: Ppo, generator: torch.Generator) -> None:
    """Let an untrained actor of speeds follow a plan, whatever the estimate is: supervised learning, in place.

    Args:
        actor: becomes the plan.
        speeds: parts of the limit, one for each step.
        bench: of the actor; gives the estimates that are drawn around the nominal ones.
        ppo: number of steps, and learning rate, of the cloning.
        generator: of the estimates.
    """
    actions = actor.action(torch.tensor(speeds, dtype=torch.float32))
    time, nominal = torch.arange(len(actions), dtype=torch.float32)[:, None], torch.tensor(nominal_of(bench))
    optimiser = torch.optim.Adam(actor.layers.parameters(), ppo.clone_rate, fused=True)
    for step in range(ppo.clone_steps):
        optimiser.param_groups[0]["lr"] = ppo.clone_rate * (1.0 - step / ppo.clone_steps)
        estimate = nominal * (0.5 + torch.rand(len(actions), len(nominal), generator=generator))
        seen = torch.cat([torch.zeros(len(actions), 2), time, estimate, torch.zeros_like(estimate)], 1)
        loss = (actor(seen)[:, 0] - actions).square().mean()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()


def nominal_of(bench: Bench) -> list[float]:
    """Nominal values of the four parameters, SI units."""
    return [getattr(bench.brake, name) for name in PARAMETER_NAMES]


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
    """tanh by the logistic function: that of torch takes several times as long, a quarter of a training."""

    def forward(self, x: Tensor) -> Tensor:
        """Of each element."""
        apply: Any = _Tanh.apply  # without types
        y: Tensor = apply(x)
        return y


def perceptron(inputs: int, hidden: Sequence[int], gain: float, bias: float) -> nn.Sequential:
    """Linear layers with tanh between them and one output; orthogonal start, ``gain`` and ``bias`` for the last one."""
    layers: list[nn.Module] = []
    for width, scale, level in (*((width, math.sqrt(2.0), 0.0) for width in hidden), (1, gain, bias)):
        layer = nn.Linear(inputs, width)
        nn.init.orthogonal_(layer.weight, scale)
        nn.init.constant_(layer.bias, level)
        layers += [layer, Tanh()]
        inputs = width
    return nn.Sequential(*layers[:-1])


@dataclass(frozen=True)
class Rollout:
    """N T steps. Time is the first axis, experiments the second."""

    seen: Tensor  # Observations of the actor, shape [T, N, I]
    states: Tensor  # Observations of the critic, shape [T + 1, N, C]; the last follow the last step
    actions: Tensor  # As sampled, before they are clipped, shape [T, N, 1]
    log_densities: Tensor  # Log π(a | o) of these actions, shape [T, N]
    rewards: Tensor  # Shape [T, N]
    terminals: Tensor  # 1 where the step ended its experiment, shape [T, N]
    strayed: Tensor  # 1 where the step violated the limits, shape [T, N]
    homes: Tensor  # 1 where the step ended its experiment at home, shape [T, N]
    mean_return: float
    """Sum of the rewards per experiment that ended; that began, where the rollout is shorter than an experiment."""

    @property
    def counts(self) -> dict[str, int]:
        """Experiments that ended, that violated the limits, and that ended at home."""
        of = {"ended": self.terminals, "violations": self.strayed, "home": self.homes}
        return {name: int(where.sum()) for name, where in of.items()}


@dataclass(frozen=True)
class Metrics:
    """Results of one iteration."""

    iteration: int
    steps: int  # Environment steps so far
    mean_return: float  # Sum of rewards per experiment that ended
    violations: int
    home: int
    ended: int
    policy_loss: float
    value_loss: float
    kl: float  # Approximate divergence between the policies before and after, mean over the last epoch
    deviation: float  # Standard deviation of the action, part of the limit


def train(envs: Sequence[EmbExcitationVectorEnv], actor: Actor, ppo: Ppo, seed: int) -> Iterator[Metrics]:
    """Train an actor, in place (Algorithm 1), on the experiments of several environments alike.

    Yields:
        After each iteration, its results.

    Raises:
        TrainingDivergedError: something is not finite any more, or for long every experiment has violated the limits.
    """
    torch.set_num_threads(1)  # networks this small lose more by sharing out a product than they win
    critic = Critic(envs[0].batch.critic_observation().shape[1], ppo.hidden, 0.01 if ppo.pairs else 1.0)
    learned = [weight for weight in (*actor.parameters(), *critic.parameters()) if weight.requires_grad]
    optimiser = torch.optim.Adam(learned, eps=1e-5, fused=True)
    early = 0
    for iteration in range(ppo.iterations):
        seeds, generator = random_numbers(seed, iteration, ppo.envs)
        remaining = 1.0 - iteration / ppo.iterations
        optimiser.param_groups[0]["lr"] = ppo.learning_rate * remaining
        if ppo.final_deviation is not None:
            deviation = ppo.final_deviation + remaining * (ppo.initial_deviation - ppo.final_deviation)
            actor.log_deviation.fill_(math.log(deviation))
        rollout = collect_all(envs, actor, ppo, seeds, generator)
        losses = improve(actor, critic, optimiser, rollout, ppo, generator)
        if not all(torch.isfinite(w).all() for network in (actor, critic) for w in network.parameters()):
            raise TrainingDivergedError(
                f"training diverged in iteration {iteration + 1}: a weight is not finite: lower learning_rate or "
                "scale with --set"
            )
        counts = rollout.counts
        early = early + 1 if counts["ended"] == counts["violations"] > 0 else 0
        if early > max(10, ppo.iterations // 4):
            raise TrainingDivergedError(
                f"training diverged in iteration {iteration + 1}: for {early} iterations every experiment has left "
                "the limits: lower learning_rate with --set, or take a preset with the shield"
            )
        yield Metrics(
            iteration=iteration + 1,
            steps=(iteration + 1) * ppo.batch,
            mean_return=rollout.mean_return,
            violations=counts["violations"],
            home=counts["home"],
            ended=counts["ended"],
            **losses,
            deviation=float(actor.log_deviation.detach().exp()),
        )


def random_numbers(seed: int, iteration: int, envs: int) -> tuple[list[int], torch.Generator]:
    """All randomness of an iteration of a training: seeds of its experiments, generator of its noise and orders."""
    *seeds, own = np.random.SeedSequence([seed, iteration]).generate_state(envs + 1, np.uint64).tolist()
    return seeds, torch.Generator().manual_seed(own >> 1)


def collect_all(
    envs: Sequence[EmbExcitationVectorEnv], actor: Actor, ppo: Ppo, seeds: Sequence[int], generator: torch.Generator
) -> Rollout:
    """The rollouts of all environments side by side, each with its share of the seeds; see :func:`collect`."""
    noise = [exploration_noise(ppo.rollout, e.num_envs, ppo.noise_memory, generator, ppo.noise_hold) for e in envs]
    each = len(seeds) // len(envs)
    seeds_of = [list(seeds[i : i + each]) for i in range(0, len(seeds), each)]
    if not ppo.pairs:
        return joined(at_once(collect, envs, [actor] * len(envs), noise, seeds_of))
    for of_env, values in zip(seeds_of, noise, strict=True):
        half = len(of_env) // 2
        of_env[half:], values[:, half:] = of_env[:half], -values[:, :half]
    return joined([against_mean(found) for found in at_once(collect, envs, [actor] * len(envs), noise, seeds_of)])


def at_once(work: Callable[..., Result], *arguments: Sequence[Any]) -> list[Result]:
    """The results of work with several environments: while one steps, another may wait for processes."""
    # A thread of its own has torch's number of threads again: one here, too.
    with ThreadPoolExecutor(processors(), initializer=torch.set_num_threads, initargs=(1,)) as threads:
        return list(threads.map(work, *arguments))


def against_mean(rollout: Rollout) -> Rollout:
    """A rollout of pairs, experiment i and i + N/2, with rewards less their pair's mean.

    A pair of which one leaves the limits does not end together. There, the first experiments are compared by their
    returns, each in its last step. One that violated them gets the least, and the steps after it count for nothing.
    """
    apart = _less_mean(rollout.rewards)
    first = rollout.terminals.cumsum(0) - rollout.terminals == 0.0
    violated = (rollout.strayed.bool() & first).any(0)
    returns = torch.where(first, rollout.rewards, 0.0).sum(0).masked_fill(violated, -math.inf)
    paid = torch.where(violated, -FARTHEST, _less_mean(returns[None])[0])
    ends = torch.zeros_like(apart)
    ends[first.sum(0) - 1, torch.arange(len(violated))] = paid
    one, other = rollout.strayed.any(0).chunk(2)
    return replace(rollout, rewards=torch.where(torch.cat(2 * [one | other]), ends, apart))


def _less_mean(values: Tensor) -> Tensor:
    """Values of pairs less their pair's mean, bounded: one that goes astray would drown all others. Shape [.., N]."""
    first, second = torch.chunk(values, 2, 1)
    apart = (0.5 * (first - second)).clamp(-FARTHEST, FARTHEST)
    return torch.cat([apart, -apart], 1)


def joined(rollouts: Sequence[Rollout]) -> Rollout:
    """Several rollouts of the same steps as one, side by side."""
    names = [field.name for field in fields(Rollout) if field.name != "mean_return"]
    beside = {name: torch.cat([getattr(one, name) for one in rollouts], 1) for name in names}
    return Rollout(**beside, mean_return=float(np.mean([one.mean_return for one in rollouts])))


@torch.no_grad()
def collect(env: EmbExcitationVectorEnv, actor: Actor, noise: Tensor, seeds: Sequence[int]) -> Rollout:
    """Begin new experiments with these seeds and follow the actor for T steps.

    An experiment that ends begins again with another brake.

    Args:
        env: with N experiments.
        actor: on the CPU.
        noise: in standard deviations of the policy, shape [T, N, 1]; zeros follow the mean action.
        seeds: of the N experiments.
    """
    steps = len(noise)
    observation, info = env.reset(seed=seeds)
    seen = torch.empty(steps, *observation.shape)
    states = torch.empty(steps + 1, *info["critic"].shape)
    rewards, terminals, strayed, homes = (torch.zeros(steps, env.num_envs) for _ in range(4))
    log_densities = actor.log_density_of(noise)
    actions = noise * actor.log_deviation.exp()
    for t in range(steps):
        seen[t], states[t] = torch.from_numpy(observation), torch.from_numpy(info["critic"])
        actions[t] += actor(seen[t])
        step = env.step if t + 1 < steps else env.advance  # nobody would play what begins after the last one
        observation, reward, over, _, info = step(actor.part(actions[t]).numpy())
        rewards[t], terminals[t] = torch.from_numpy(reward), torch.from_numpy(over)
        if over.any():
            final = info.get("final_info", info)
            strayed[t], homes[t] = (torch.from_numpy(over & final[name]) for name in ("violated", "home"))
    states[steps] = torch.from_numpy(info["critic"])
    mean = mean_return(rewards, terminals, env.batch)
    return Rollout(seen, states, actions, log_densities, rewards, terminals, strayed, homes, mean)


def mean_return(rewards: Tensor, terminals: Tensor, batch: Batch) -> float:
    """:attr:`Rollout.mean_return` of rewards and ends, shape [T, N]."""
    steps, count = rewards.shape
    ended = int(terminals.sum())
    complete = ended and steps >= batch.bench.timing.horizon
    return float(rewards.sum()) / (ended if complete else count + int(terminals[:-1].sum()))


def exploration_noise(steps: int, envs: int, noise_memory: float, generator: torch.Generator, hold: int = 1) -> Tensor:
    """Gaussian noise with standard deviation 1 at every step and correlation ``noise_memory`` from step to step.

    White noise at 1 kHz averages out before the brake notices. The density of each step is unchanged, and the policy's
    gradient estimated with it is the true one of the smoothed objective times the noise's covariance over time: an
    ascent direction that moves neighbouring steps together. Each value stays for ``hold`` steps.

    Returns:
        Shape [steps, envs, 1].
    """
    noise = torch.randn(-(-steps // hold), envs, 1, generator=generator)
    noise[1:] *= math.sqrt(1.0 - noise_memory * noise_memory)
    for t in range(1, len(noise)):
        noise[t] += noise_memory * noise[t - 1]
    return noise.repeat_interleave(hold, 0)[:steps]


def improve(
    actor: Actor,
    critic: Critic,
    optimiser: torch.optim.Optimizer,
    rollout: Rollout,
    ppo: Ppo,
    generator: torch.Generator,
) -> dict[str, float]:
    """Improve both networks on a rollout, K epochs of minibatches; returns the losses of :class:`Metrics`."""
    phase = int(torch.randint(ppo.noise_hold, (), generator=generator)) if ppo.noise_hold > 1 else 0

    def thinned(of_steps: Tensor) -> Tensor:
        """One step of each value of the noise, those of all experiments one after the other."""
        return of_steps[phase :: ppo.noise_hold].flatten(0, 1)

    seen, actions, states = thinned(rollout.seen), thinned(rollout.actions), thinned(rollout.states[:-1])
    with torch.no_grad():
        values = critic(rollout.states)
    advantages = generalised_advantages(rollout.rewards, values, rollout.terminals, ppo.gamma, ppo.gae_lambda)
    returns = thinned(advantages + values[:-1])
    advantages = thinned(advantages)
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    columns = (seen, actions, states, torch.stack((thinned(rollout.log_densities), advantages, returns), 1))
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
