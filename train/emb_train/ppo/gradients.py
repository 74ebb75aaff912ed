"""Gradients of a small network without a graph.

At 64 units and some thousand samples, autograd's bookkeeping and its fresh memory cost more than half as much again as
the matrix products. A chain of linear layers with tanh between them needs neither: this module computes the same
numbers, and keeps parameters and gradients of a network as one vector each, so that the norm of the gradient and
Adam's step are one operation.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from emb_runtime.errors import UsageError


def as_one_vector(module: nn.Module) -> nn.Parameter:
    """All parameters of a module as one vector; they and their gradients become views of it and of its gradient."""
    parameters = list(module.parameters())
    vector = nn.Parameter(torch.cat([p.detach().flatten() for p in parameters]))
    vector.grad = torch.zeros_like(vector)
    at = 0
    for p in parameters:
        part = slice(at, at := at + p.numel())
        p.data = vector.data[part].view_as(p)
        p.grad = vector.grad[part].view_as(p)
    return vector


class Chain:
    """Linear layers with tanh between them, forward and backward, in memory that is used again."""

    def __init__(self, layers: nn.Sequential, samples: int) -> None:
        """Prepare for up to ``samples`` samples at a time.

        Args:
            layers: as :func:`emb_train.ppo.networks.perceptron` makes them; their parameters have gradients to write
            to.
            samples: the most that one pass may have.

        Raises:
            UsageError: the layers are others.
        """
        linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
        kinds = [type(layer) for layer in layers]
        if kinds != [nn.Linear, nn.Tanh] * (len(linear) - 1) + [nn.Linear]:
            raise UsageError(f"expected linear layers with tanh between them, got {[k.__name__ for k in kinds]}")
        self._layers = [_Layer(layer, samples) for layer in linear]
        self._seen: list[Tensor] = []

    def forward(self, inputs: Tensor) -> Tensor:
        """Outputs, shape [M, outputs], for inputs, shape [M, inputs]. The next pass overwrites them."""
        self._seen, last, count = [], self._layers[-1], len(inputs)
        for layer in self._layers:
            self._seen.append(inputs)
            inputs = torch.addmm(layer.bias, inputs, layer.transposed, out=layer.outputs[:count])
            if layer is not last:
                inputs.tanh_()
        return inputs

    def backward(self, slope: Tensor, through: bool = False) -> Tensor:
        """Write the gradient of a loss whose derivative with respect to the last outputs is ``slope``, same shape.

        Returns:
            If it is to go ``through``, the derivative with respect to the inputs, until the next pass.
        """
        first, count = self._layers[0], len(slope)
        for layer, seen in zip(reversed(self._layers), reversed(self._seen), strict=True):
            torch.mm(slope.t(), seen, out=layer.weight_slope)
            torch.sum(slope, 0, out=layer.bias_slope)
            if layer is not first or through:
                slope = torch.mm(slope, layer.weight, out=layer.slopes[:count])
            if layer is not first:
                torch.ops.aten.tanh_backward.grad_input(slope, seen, grad_input=slope)
        return slope


class _Layer:
    """Views of a linear layer's parameters and gradients, and memory for what passes it."""

    def __init__(self, linear: nn.Linear, samples: int) -> None:
        self.weight, self.bias = linear.weight.detach(), linear.bias.detach()
        self.transposed = self.weight.t()
        self.outputs = self.weight.new_empty(samples, linear.out_features)
        self.slopes = self.weight.new_empty(samples, linear.in_features)
        assert linear.weight.grad is not None
        assert linear.bias.grad is not None
        self.weight_slope, self.bias_slope = linear.weight.grad, linear.bias.grad
