"""Actor and critic: small networks that share nothing (thesis 4.5.4, Fig. 4.6), the actor with a memory or without."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from emb_runtime.config.bench import Bench


class Exploring(nn.Module):
    """What both kinds of actor have: the normaliser, the standard deviation, and the way from an action to a current.

    The normaliser has fixed constants from the bench (middle and half of each signal's range), is part of the network,
    and therefore of every checkpoint and of the exported graph.

    An action u is Gaussian around what the network says. Either the environment clips it, or it is squashed: tanh u is
    the part of the limit that is asked for.
    """

    centre: Tensor
    span: Tensor

    def __init__(self, centre: Tensor, span: Tensor, initial_deviation: float, squashed: bool) -> None:
        """Keep the normaliser, shapes [I], and the untrained action's standard deviation."""
        super().__init__()
        self.register_buffer("centre", centre)
        self.register_buffer("span", span)
        self.log_deviation = nn.Parameter(torch.full((1,), math.log(initial_deviation)))
        self.squashed = squashed

    def normalised(self, observation: Tensor) -> Tensor:
        """What the layers see of raw observations: within −1..1 on the bench's ranges, same shape."""
        return (observation - self.centre) / self.span

    def part(self, action: Tensor) -> Tensor:
        """The part of the limit that an action asks for, within −1..1, same shape."""
        return torch.tanh(action) if self.squashed else torch.clamp(action, -1.0, 1.0)


def unsquashed(part: float, squashed: bool) -> float:
    """The action that asks for this part of the limit."""
    return math.atanh(part) if squashed else part


class Actor(Exploring):
    """From raw actor observations to the mean of the action."""

    def __init__(
        self,
        bench: Bench,
        hidden: Sequence[int],
        initial_mean: float,
        initial_deviation: float,
        inputs: int = 3,
        squashed: bool = False,
    ) -> None:
        """Build the network.

        Args:
            bench: gives the ranges of the signals.
            hidden: widths of the hidden layers.
            initial_mean: what the untrained actor asks for everywhere, part of the limit.
            initial_deviation: standard deviation of the untrained action.
            inputs: length of an observation; one of another length than the measured three has scales of order one.
            squashed: whether actions are squashed instead of clipped.
        """
        centre, span = (part[:3] for part in ranges_of(bench))
        if inputs != 3:
            centre, span = torch.zeros(inputs), torch.ones(inputs)
        super().__init__(centre, span, initial_deviation, squashed)
        self.layers = perceptron(inputs, hidden, 1, gain=0.01, bias=unsquashed(initial_mean, squashed))

    def forward(self, observation: Tensor) -> Tensor:
        """Means of the actions, shape [N, 1], for observations of shape [N, 3]."""
        mean: Tensor = self.layers(self.normalised(observation))
        return mean


class RecurrentActor(Exploring):
    """From raw observations and what it remembers of the earlier ones to the mean of the action.

    A gated recurrent unit (Cho et al., 2014, arXiv:1406.1078) sees the angle, the velocity, the step and the current
    that acted last; a perceptron sees these and what the unit remembers.
    """

    def __init__(
        self,
        bench: Bench,
        memory: int,
        hidden: Sequence[int],
        initial_mean: float,
        initial_deviation: float,
        squashed: bool = False,
    ) -> None:
        """Build the network; ``memory`` is what the unit remembers, H numbers, the rest as for :class:`Actor`."""
        centre, span = ranges_of(bench)
        super().__init__(centre, span, initial_deviation, squashed)
        self.memory = memory
        self.unit = nn.GRUCell(len(span), memory)
        bias = unsquashed(initial_mean, squashed)
        self.layers = perceptron(len(span) + memory, hidden, 1, gain=0.01, bias=bias)

    def forward(self, observation: Tensor, remembered: Tensor) -> tuple[Tensor, Tensor]:
        """Means of the actions, shape [N, 1], and what is remembered then, [N, H].

        Args:
            observation: raw, shape [N, 4].
            remembered: before it, shape [N, H]; zeros at the start of an experiment.
        """
        seen = self.normalised(observation)
        remembers = self.unit(seen, remembered)
        return self.layers(torch.cat((seen, remembers), dim=-1)), remembers


def ranges_of(bench: Bench) -> tuple[Tensor, Tensor]:
    """Middle and half of the ranges of angle [rad], velocity [rad/s], step and applied current [A], shape [4] each."""
    low, high = bench.limits.angle
    horizon = float(bench.timing.horizon)
    centre = torch.tensor([0.5 * (low + high), 0.0, 0.5 * horizon, 0.0])
    return centre, torch.tensor([0.5 * (high - low), bench.limits.velocity, 0.5 * horizon, bench.limits.current])


class Critic(nn.Module):
    """From the critic's observations, already of order one, to the value of the state."""

    def __init__(self, size: int, hidden: Sequence[int]) -> None:
        """Build the network for observations of length ``size``."""
        super().__init__()
        self.layers = perceptron(size, hidden, 1, gain=1.0, bias=0.0)

    def forward(self, observation: Tensor) -> Tensor:
        """Values, shape [N], for observations of shape [N, size]."""
        value: Tensor = self.layers(observation).squeeze(-1)
        return value


class DeployedActor(nn.Module):
    """What is exported: raw observation in, current [A] out; normaliser, scaling and clip inside."""

    def __init__(self, actor: Actor, limit: float) -> None:
        """Wrap a trained actor for a bench with this current limit [A]."""
        super().__init__()
        self.actor = actor
        self.limit = limit

    def forward(self, observation: Tensor) -> Tensor:
        """Currents [A] within ±limit, shape [N, 1], for raw observations, shape [N, 3]."""
        return self.limit * self.actor.part(self.actor(observation))


class DeployedRecurrentActor(nn.Module):
    """What is exported of an actor with a memory: its state is an input and an output, in float64 as every state."""

    estimates: tuple[str, ...] = ()
    """It estimates nothing."""

    def __init__(self, actor: RecurrentActor, limit: float) -> None:
        """Wrap a trained actor for a bench with this current limit [A]."""
        super().__init__()
        self.actor = actor
        self.limit = limit

    @property
    def initial_state(self) -> Tensor:
        """Nothing remembered, shape [H]."""
        return torch.zeros(self.actor.memory, dtype=torch.float64)

    @property
    def observation_size(self) -> int:
        """4: it sees the current that acted last as well."""
        return len(self.actor.span)

    def forward(self, obs: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Currents [A] within ±limit, shape [N, 1], next state, [N, H], and an estimate of nothing, [N, 0].

        Args:
            obs: raw observations, shape [N, 4].
            state: float64, shape [N, H].
        """
        action, remembers = self.actor(obs, state.float())
        return self.limit * self.actor.part(action), remembers.double(), action[:, :0]


def perceptron(inputs: int, hidden: Sequence[int], outputs: int, gain: float, bias: float) -> nn.Sequential:
    """Linear layers with tanh between them, orthogonal start, ``gain`` and ``bias`` for the last one."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [linear(inputs, width, math.sqrt(2.0), 0.0), nn.Tanh()]
        inputs = width
    return nn.Sequential(*layers, linear(inputs, outputs, gain, bias))


def linear(inputs: int, outputs: int, gain: float, bias: float) -> nn.Linear:
    """A linear layer with orthogonal weights."""
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.constant_(layer.bias, bias)
    return layer
