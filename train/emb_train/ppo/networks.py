"""Actor and critic: small networks that share nothing (thesis 4.5.4, Fig. 4.6)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from emb_runtime.config.bench import Bench


class Actor(nn.Module):
    """Network from raw actor observations to the mean of the action, a part of the current limit.

    The normaliser has fixed constants from the bench (middle and half of each signal's range), is part of the network,
    and therefore of every checkpoint and of the exported graph. An action is Gaussian around the mean; the environment
    clips it to the limit.
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
        low, high = bench.limits.angle
        half = 0.5 * float(bench.timing.horizon)
        centre, span = (
            torch.tensor([0.5 * (low + high), 0.0, half]),
            torch.tensor([0.5 * (high - low), bench.limits.velocity, half]),
        )
        measured = inputs == 3
        self.register_buffer("centre", centre if measured else torch.zeros(inputs))
        self.register_buffer("span", span if measured else torch.ones(inputs))
        self.log_deviation = nn.Parameter(torch.full((1,), math.log(initial_deviation)))
        self.layers = perceptron(inputs, hidden, 1, gain=0.01, bias=initial_mean)

    def normalised(self, observation: Tensor) -> Tensor:
        """Returns raw observations scaled to −1..1 on the bench's ranges, same shape."""
        return (observation - self.centre) / self.span

    def forward(self, observation: Tensor) -> Tensor:
        """Means of the actions, shape [N, 1], for observations of shape [N, I]."""
        mean: Tensor = self.layers(self.normalised(observation))
        return mean


class Critic(nn.Module):
    """Network from the critic's observations, already of order one, to the value of the state."""

    def __init__(self, size: int, hidden: Sequence[int]) -> None:
        """Build the network for observations of length ``size``."""
        super().__init__()
        self.layers = perceptron(size, hidden, 1, gain=1.0, bias=0.0)

    def forward(self, observation: Tensor) -> Tensor:
        """Values, shape [N], for observations of shape [N, size]."""
        value: Tensor = self.layers(observation).squeeze(-1)
        return value


class DeployedActor(nn.Module):
    """The network that is exported: raw observation in, current [A] out; normaliser, scaling and clip inside."""

    def __init__(self, actor: Actor, limit: float) -> None:
        """Wrap a trained actor for a bench with this current limit [A]."""
        super().__init__()
        self.actor = actor
        self.limit = limit

    def forward(self, observation: Tensor) -> Tensor:
        """Currents [A] within ±limit, shape [N, 1], for raw observations, shape [N, 3]."""
        return self.limit * torch.clamp(self.actor(observation), -1.0, 1.0)


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
