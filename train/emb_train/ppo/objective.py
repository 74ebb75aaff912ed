"""What proximal policy optimisation improves: advantages, and the clipped surrogate with its derivative."""

from __future__ import annotations

import math

import torch
from torch import Tensor


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


def log_density(z: Tensor, log_deviation: Tensor) -> Tensor:
    """Log density of a Gaussian with this log standard deviation, ``z`` of them away from its mean; shape of ``z``."""
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


def normalised(advantages: Tensor) -> Tensor:
    """Mean 0 and standard deviation 1 over the whole batch."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)
