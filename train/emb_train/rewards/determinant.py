"""The rewards of section 6.2, from the determinant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emb_bench.information.symmetric import LOG_DET, each
from emb_train.rewards.increment import excess
from emb_train.rewards.transition import Floats, Transition


@dataclass(frozen=True)
class DeterminantGain:
    """r_k = α (log |M_k| − log |M_{k−1}|)^β: method 1 with β = 1 (eq. 6.4), method 2 with β = 2 (eq. 6.5).

    M begins at ε I (eq. 4.28). The thesis prints no penalties for these; they are those of eq. 5.14, which it says
    elsewhere that an experiment of 300 ms has.
    """

    scale: float
    """Of all of it."""
    power: int = 1
    """β."""
    alpha: float = 1e4
    """α."""
    epsilon: float = 1e-6
    """ε; the thesis calls it small."""
    unsafe: float = 4e4
    """Penalty of the step that leaves the limits."""
    threshold: float = 75.0
    """Angle beyond which the state is risky [rad]."""
    weight: float = 200.0
    """Of the squared angle beyond it [1/rad²]."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Any parameters will do."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        grown = each(LOG_DET, transition.after, self.epsilon) - each(LOG_DET, transition.before, self.epsilon)
        safe = self.alpha * grown**self.power - self.weight * excess(transition.x[:, 0], self.threshold)
        return self.scale * np.where(transition.violated, -self.unsafe, safe)
