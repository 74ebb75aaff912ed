"""The adaptive reward of section 5.3.1: information first, then more and more the way home."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emb_train.rewards.increment import check_one, excess
from emb_train.rewards.transition import Floats, Transition


@dataclass(frozen=True)
class AdaptiveReturn:
    """Eq. 5.15, all five branches in one line, with q = (k/T)² after ``outward`` steps and 0 before.

    r_k = (1 − q) ΔM_k − 200 (x₁ − 75)² [x₁ > 75] − 0.1 q ((10 x₁)² + x₂²), and −10⁷ where the limits are left.
    """

    scale: float
    """Of all of it."""
    outward: int = 300
    """Steps before the way home counts."""
    unsafe: float = 1e7
    """Penalty of the step that leaves the limits."""
    threshold: float = 75.0
    """Angle beyond which the state is risky [rad]."""
    weight: float = 200.0
    """Of the squared angle beyond it [1/rad²]."""
    home: float = 0.1
    """Weight of the distance from rest at the origin."""
    lever: float = 10.0
    """What a radian is worth in it, in rad/s."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError unless there is exactly one parameter."""
        check_one(parameters, "5.15")

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        angle, velocity = transition.x[:, 0], transition.x[:, 1]
        share = transition.step / transition.horizon
        q = np.where(transition.step > self.outward, share * share, 0.0)
        lever = self.lever * angle
        gain = (1.0 - q) * (transition.after[:, 0] - transition.before[:, 0])
        away = self.home * q * (lever * lever + velocity * velocity)
        safe = gain - self.weight * excess(angle, self.threshold) - away
        return self.scale * np.where(transition.violated, -self.unsafe, safe)
