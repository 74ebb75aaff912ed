"""A gated recurrent unit over whole experiments, forward and backward through all of their steps, without a graph.

Here what is recurrent is one compiled loop, and all that is not is one matrix product for all steps together: for 8
experiments of 500 steps and 32 numbers a tenth of the time of torch's GRU and its autograd. Equations as torch's
GRUCell has them: r = σ(W_ir x + b_ir + W_hr h + b_hr), z likewise, n = tanh(W_in x + b_in + r (W_hn h + b_hn)), and
h' = (1 − z) n + z h.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from emb_bench.compiled import compiled
from emb_train.ppo.rollout_kernel import Singles, multiply, tanh


def remember(given: Singles, weights: Singles, bias: Singles, h: Singles, kept: Singles) -> None:
    """Take each of M experiments through L steps.

    Args:
        given: W_i x + b_i of r, z and n, shape [L, M, 3 H]; becomes r, z and n themselves.
        weights: W_h transposed, shape [H, 3 H], with rows of zeros up to the next multiple of four.
        bias: b_h, shape [3 H].
        h: becomes what is remembered before each step and after the last, shape [L + 1, M, rows of ``weights``]; zeros.
        kept: becomes W_hn h + b_hn, shape [L, M, H].
    """
    size, one, half = kept.shape[2], np.float32(1.0), np.float32(0.5)
    from_memory = np.empty(3 * size, np.float32)
    for i in range(given.shape[1]):
        for t in range(given.shape[0]):
            gates, before, after, candidate = given[t, i], h[t, i], h[t + 1, i], kept[t, i]
            multiply(weights, bias, before, from_memory)
            for j in range(2 * size):
                gates[j] = half + half * tanh(half * (gates[j] + from_memory[j]))
            for j in range(size):
                candidate[j] = from_memory[2 * size + j]
            for j in range(size):
                gates[2 * size + j] = tanh(gates[2 * size + j] + gates[j] * candidate[j])
            for j in range(size):
                z = gates[size + j]
                after[j] = (one - z) * gates[2 * size + j] + z * before[j]


def recall(gates: Singles, weights: Singles, h: Singles, kept: Singles, slope: Singles, back: Singles) -> None:
    """Go back through the steps of :func:`remember`.

    Args:
        gates: r, z and n, shape [L, M, 3 H]; becomes the derivative with respect to W_i x + b_i.
        weights: W_h, shape [3 H, H], with rows of zeros up to the next multiple of four.
        h: see :func:`remember`.
        kept: see :func:`remember`.
        slope: derivative of a loss with respect to what is remembered after each step, as far as it is used there,
            shape [L, M, H].
        back: becomes the derivative with respect to W_h h + b_h, shape [L, M, rows of ``weights``]; zeros.
    """
    size, one = kept.shape[2], np.float32(1.0)
    later, through, nothing = np.empty(size, np.float32), np.empty(size, np.float32), np.zeros(size, np.float32)
    for i in range(gates.shape[1]):
        for j in range(size):
            later[j] = np.float32(0.0)
        for t in range(gates.shape[0] - 1, -1, -1):
            own, before, candidate, out, pulled = gates[t, i], h[t, i], kept[t, i], back[t, i], slope[t, i]
            for j in range(size):
                r, z, n = own[j], own[size + j], own[2 * size + j]
                d = pulled[j] + later[j]
                dn = d * (one - z) * (one - n * n)
                dr, dz = dn * candidate[j] * r * (one - r), d * (before[j] - n) * z * (one - z)
                own[j], own[size + j], own[2 * size + j] = dr, dz, dn
                out[j], out[size + j], out[2 * size + j] = dr, dz, dn * r
                through[j] = d * z
            multiply(weights, nothing, out, later)
            for j in range(size):
                later[j] += through[j]


class Recurrence:
    """A GRU cell over whole experiments, each from an empty memory."""

    def __init__(self, unit: nn.GRUCell) -> None:
        """Prepare for a unit whose parameters have gradients to write to; it stays on the CPU."""
        self._unit = unit
        self._forward: Any = compiled(remember)
        self._backward: Any = compiled(recall)
        self._seen, self._gates, self._h, self._kept = (torch.empty(0) for _ in range(4))

    @torch.no_grad()
    def forward(self, seen: Tensor) -> Tensor:
        """What is remembered after each step, shape [L, M, H], for inputs, shape [L, M, I]."""
        unit, (steps, count, _) = self._unit, seen.shape
        size = unit.hidden_size
        weights = _padded(unit.weight_hh.t())
        self._seen = seen
        self._gates = torch.addmm(unit.bias_ih, seen.flatten(0, 1), unit.weight_ih.t()).view(steps, count, 3 * size)
        self._h, self._kept = seen.new_zeros(steps + 1, count, len(weights)), seen.new_empty(steps, count, size)
        self._forward(
            self._gates.numpy(), weights.numpy(), unit.bias_hh.numpy(force=True), self._h.numpy(), self._kept.numpy()
        )
        return self._h[1:, :, :size]

    @torch.no_grad()
    def backward(self, slope: Tensor) -> None:
        """Write the gradient of a loss, after one :meth:`forward`.

        Args:
            slope: its derivative with respect to what is remembered after each step, shape [L, M, H].
        """
        unit, size = self._unit, self._unit.hidden_size
        weights = _padded(unit.weight_hh.detach())
        back = slope.new_zeros(*slope.shape[:2], len(weights))
        self._backward(
            self._gates.numpy(),
            weights.numpy(),
            self._h.numpy(),
            self._kept.numpy(),
            slope.contiguous().numpy(),
            back.numpy(),
        )
        given, from_memory = self._gates.flatten(0, 1), back[:, :, : 3 * size].flatten(0, 1)
        before = self._h[:-1, :, :size].flatten(0, 1)
        for parameter, gradient in (
            (unit.weight_ih, given.t() @ self._seen.flatten(0, 1)),
            (unit.weight_hh, from_memory.t() @ before),
            (unit.bias_ih, given.sum(0)),
            (unit.bias_hh, from_memory.sum(0)),
        ):
            assert parameter.grad is not None
            parameter.grad.copy_(gradient)


def _padded(weights: Tensor) -> Tensor:
    """With rows of zeros up to the next multiple of four."""
    return nn.functional.pad(weights.detach(), (0, 0, 0, -len(weights) % 4)).contiguous()
