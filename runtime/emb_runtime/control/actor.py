"""Interface of the core to the source of currents, and the actor of the way home."""

from __future__ import annotations

from typing import Protocol

from emb_runtime.config.bench import Bench
from emb_runtime.estimator.estimator import Estimator

LONGEST_WAY = 3.0  # Time for a way home; from anywhere inside the limits it takes well below one [s]


class Actor(Protocol):
    """Source of the requested currents: a policy, or the way home."""

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """Current requested for the period that begins at this sample, which the estimator has taken in [A]."""
        ...


class Still:
    """Actor of the way home: it requests 0 A, so that the shield alone moves the brake."""

    def act(self, angle: float, velocity: float, step: float, estimator: Estimator) -> float:
        """Return 0 A."""
        return 0.0


def homing_steps(bench: Bench) -> int:
    """Number of samples after which a way home is given up."""
    return round(LONGEST_WAY / bench.timing.sample_time)
