"""What one step did, and what a reward is."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Mark(NamedTuple):
    """How N brakes were when their way home began; zeros for those that are not there yet."""

    x: Floats
    """True angle [rad] and velocity [rad/s], shape [N, 2]."""
    acceleration: Floats
    """Over the period before [rad/s²], shape [N]."""
    m: Floats
    """Packed FIM, shape [N, n (n + 1) / 2]."""


class Transition(NamedTuple):
    """What one step did, for N brakes."""

    before: Floats
    """Packed FIM before the step, shape [N, n (n + 1) / 2]."""
    after: Floats
    """The same after it."""
    x: Floats
    """True angle [rad] and velocity [rad/s] after it, shape [N, 2]."""
    step: NDArray[np.int64]
    """Steps made, this one included, shape [N]: k of r_k."""
    violated: NDArray[np.bool_]
    """Whether the limits have been left, shape [N]."""
    mark: Mark
    """Of the step that a :class:`Returning` reward names."""
    horizon: int
    """Steps in one experiment, T."""
    sample_time: float
    """[s]."""


class Reward(Protocol):
    """A rule that turns a step into a number for each brake."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError if this reward is not defined for these parameters."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""


@runtime_checkable
class Returning(Protocol):
    """A reward that wants to know later how the brakes were when their way home began."""

    @property
    def outward(self) -> int:
        """Steps before that, at least 1: 300 in the thesis (5.3)."""
