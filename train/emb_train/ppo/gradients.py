"""Gradient of a small perceptron without autograd, and Adam on one vector of parameters.

The networks have 64 units a layer and some thousand samples at a time: the bookkeeping of autograd and its fresh memory
then cost about as much as the products. Tests compare every gradient with autograd's.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.optim.adam import adam

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


class PerceptronTrainer:
    """Linear layers with tanh between them: forward, backward and Adam, in memory that is used again.

    Attributes:
        vector: all parameters of the network.
        adam: their optimiser.
    """

    def __init__(
        self, network: nn.Module, layers: nn.Sequential, minibatch: int, learning_rate: float, max_gradient: float
    ) -> None:
        """Prepare to train a network.

        Args:
            network: whose parameters are trained. The gradient of those outside ``layers`` is the caller's to write.
            layers: as :func:`emb_train.ppo.networks.perceptron` makes them.
            minibatch: the most samples that one pass may have.
            learning_rate: of Adam, at the start.
            max_gradient: largest norm of the gradient.

        Raises:
            UsageError: the layers are others.
        """
        linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
        kinds = [type(layer) for layer in layers]
        if kinds != [nn.Linear, nn.Tanh] * (len(linear) - 1) + [nn.Linear]:
            raise UsageError(f"expected linear layers with tanh between them, got {[k.__name__ for k in kinds]}")
        self.vector = as_one_vector(network)
        self.adam = torch.optim.Adam([self.vector], lr=learning_rate, eps=1e-5, fused=True)
        self._minibatch, self._max_gradient = minibatch, max_gradient
        self._layers = [_Layer(layer, minibatch) for layer in linear]
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

    @torch.no_grad()
    def outputs(self, inputs: Tensor) -> Tensor:
        """Outputs, shape [B, outputs], for any number of inputs, shape [B, inputs]."""
        return torch.cat([self.forward(part).clone() for part in torch.split(inputs, self._minibatch)])

    def backward(self, slope: Tensor) -> None:
        """Write the gradient of a loss whose derivative with respect to the last outputs is ``slope``, same shape."""
        first, count = self._layers[0], len(slope)
        for layer, seen in zip(reversed(self._layers), reversed(self._seen), strict=True):
            torch.mm(slope.t(), seen, out=layer.weight_slope)
            torch.sum(slope, 0, out=layer.bias_slope)
            if layer is not first:
                slope = torch.mm(slope, layer.weight, out=layer.slopes[:count])
                torch.ops.aten.tanh_backward.grad_input(slope, seen, grad_input=slope)

    def step(self, slope: Tensor) -> None:
        """One step of Adam along the clipped gradient; ``slope`` as for :meth:`backward`."""
        self.backward(slope)
        gradient = self.vector.grad
        assert gradient is not None
        gradient.mul_((self._max_gradient / (gradient.norm() + 1e-6)).clamp_(max=1.0))
        if not (state := self.adam.state[self.vector]):
            self.adam.step()  # which makes the state
            return
        group = self.adam.param_groups[0]
        adam(  # as self.adam.step() calls it, without the hooks, which cost more than the rest of a small step
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
