"""Step rewards: small named functions of what a step did to the Fisher information.

All of them read the weighted FIM (outputs divided by 100 rad and 500 rad/s, thesis eq. 4.21), packed as an upper
triangle, for a batch of N brakes with n parameters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from emb_runtime.errors import UsageError

Floats = NDArray[np.float64]


class Transition(NamedTuple):
    """What one step did, for N brakes."""

    before: Floats
    """Packed weighted FIM before the step, shape [N, n (n + 1) / 2]."""
    after: Floats
    """The same after it."""


class Reward(Protocol):
    """A rule that turns a step into a number for each brake."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError if this reward is not defined for these parameters."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""


@dataclass(frozen=True)
class InformationIncrement:
    """r_k = M_k − M_{k−1} for one parameter (eq. 5.13), where D-, A- and E-optimality are the same.

    The limits need no penalty and the origin no bonus here: the shield keeps the first and returns to the second.
    """

    scale: float
    """Brings an episode's return from some 1e7 to a number that a network fits."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError unless there is exactly one parameter."""
        if len(parameters) != 1:
            raise UsageError(f"the reward of eq. 5.13 is defined for one parameter, got {', '.join(parameters)}")

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        return self.scale * (transition.after[:, 0] - transition.before[:, 0])
