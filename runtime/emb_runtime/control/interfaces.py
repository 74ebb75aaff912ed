"""Interface of the core to what decides."""

from __future__ import annotations

from typing import Protocol

from emb_runtime.estimator.estimator import Estimator


class Actor(Protocol):
    """Source of the wanted currents: a policy, or the way home."""

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """Current wanted for the period that begins at this sample, which the estimator has taken in [A]."""
        ...
