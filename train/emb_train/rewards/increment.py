"""What the Fisher information grew by in a step, alone and with the penalties of section 5.2."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emb_bench.information.symmetric import LAMBDA_MIN, each
from emb_runtime.errors import UsageError
from emb_train.rewards.transition import Floats, Transition


def check_one(parameters: tuple[str, ...], equation: str) -> None:
    """Raise UsageError unless there is exactly one parameter."""
    if len(parameters) != 1:
        raise UsageError(f"the reward of eq. {equation} is defined for one parameter, got {', '.join(parameters)}")


def excess(angle: Floats, threshold: float) -> Floats:
    """(x₁ − x₁,d)² in the risky state x₁ > x₁,d, else 0 [rad²]; the thesis prints the threshold's name in two ways."""
    beyond = np.maximum(angle - threshold, 0.0)
    return beyond * beyond


@dataclass(frozen=True)
class InformationIncrement:
    """r_k = M_k − M_{k−1} for one parameter (eq. 5.13), where D-, A- and E-optimality are the same.

    Enough under the shield, which keeps the limits and returns to the origin.
    """

    scale: float
    """Brings an episode's return from some 1e7 to a number that a network fits."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError unless there is exactly one parameter."""
        check_one(parameters, "5.13")

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        return self.scale * (transition.after[:, 0] - transition.before[:, 0])


@dataclass(frozen=True)
class EigenvalueIncrement:
    """r_k = λ_min(M_k) − λ_min(M_{k−1}): the same for several parameters, E-optimal (eq. 4.14)."""

    scale: float
    """As above."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Any parameters will do."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        return self.scale * (each(LAMBDA_MIN, transition.after, 0.0) - each(LAMBDA_MIN, transition.before, 0.0))


@dataclass(frozen=True)
class PenalisedIncrement:
    """The increment, with a penalty for leaving the limits and one for being close to the upper angle (eq. 5.14)."""

    scale: float
    """Of all of it: the thesis normalises, which a fixed factor does without hidden state."""
    unsafe: float = 4e4
    """Penalty of the step that leaves the limits."""
    threshold: float = 75.0
    """Angle beyond which the state is risky [rad]."""
    weight: float = 200.0
    """Of the squared angle beyond it [1/rad²]."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError unless there is exactly one parameter."""
        check_one(parameters, "5.14")

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        gain = transition.after[:, 0] - transition.before[:, 0]
        safe = gain - self.weight * excess(transition.x[:, 0], self.threshold)
        return self.scale * np.where(transition.violated, -self.unsafe, safe)
