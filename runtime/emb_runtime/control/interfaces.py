"""Interface of the core to what decides."""

from __future__ import annotations

from typing import Protocol


class Actor(Protocol):
    """Source of the wanted currents: a policy, or the way home."""

    def begin(self) -> None:
        """Reset the actor's memory: a run begins."""
        ...

    def act(self, angle: float, velocity: float, step: float, applied_current: float) -> float:
        """Current wanted for the period that begins at this sample [A]; the last argument acted in the one before."""
        ...
