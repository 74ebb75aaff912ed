"""The rewards that follow a quintic polynomial home: sections 5.3.2, 6.3.1 and 6.3.2.

Both take λ_min(M), which for one parameter is M itself. What the thesis leaves open is a field here: the weights of the
deviations (those of eq. 5.15), the penalty for leaving the limits (the same), and what counts as back at the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emb_bench.information.symmetric import LAMBDA_MIN, each
from emb_train.rewards.increment import excess
from emb_train.rewards.transition import Floats, Transition


def quintic(
    angle: Floats, velocity: Floats, acceleration: Floats, duration: float, time: Floats
) -> tuple[Floats, Floats]:
    """The polynomial of eq. 5.16 from a state to rest at zero: three conditions at the start, three at the end.

    Args:
        angle: at the start [rad], shape [N].
        velocity: at the start [rad/s], shape [N].
        acceleration: at the start [rad/s²], shape [N].
        duration: until angle, velocity and acceleration are zero [s].
        time: since the start [s], shape [N].

    Returns:
        Angle [rad] and velocity [rad/s] at that time, each of shape [N].
    """
    a, b, c = angle, velocity * duration, 0.5 * acceleration * (duration * duration)
    cubic = -10.0 * a - 6.0 * b - 3.0 * c
    quartic = 15.0 * a + 8.0 * b + 3.0 * c
    fifth = -6.0 * a - 3.0 * b - c
    s = time / duration
    position = a + s * (b + s * (c + s * (cubic + s * (quartic + s * fifth))))
    slope = b + s * (2.0 * c + s * (3.0 * cubic + s * (4.0 * quartic + s * 5.0 * fifth)))
    return position, slope / duration


@dataclass(frozen=True)
class TrajectoryReturn:
    """Explore for ``outward`` steps, then follow the quintic to rest at the origin (5.3.2; with λ_min, 6.3.1).

    While it follows, information earns nothing; what it gathered on the way is paid in the last step, if that ends at
    the origin.
    """

    scale: float
    """Of all of it."""
    outward: int = 300
    """Steps of the exploration."""
    unsafe: float = 1e7
    """Penalty of the step that leaves the limits."""
    threshold: float = 75.0
    """Angle beyond which the state is risky while exploring [rad]."""
    weight: float = 200.0
    """Of the squared angle beyond it [1/rad²]."""
    angle_weight: float = 10.0
    """Of the squared deviation from the planned angle [1/rad²]."""
    velocity_weight: float = 0.1
    """Of the squared deviation from the planned velocity [s²/rad²]."""
    home_angle: float = 2.0
    """|x₁| that counts as back [rad]."""
    home_velocity: float = 20.0
    """|x₂| that counts as back [rad/s]."""
    paid: float = 1.0
    """Share of the information of the way home that is paid at the end."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Any parameters will do."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        back = -self.deviation(transition, transition.horizon) + self.final(transition)
        return self.scale * self.composed(transition, back)

    def composed(self, transition: Transition, back: Floats) -> Floats:
        """The exploration's reward, ``back`` after it, and the penalty for leaving the limits; shape [N]."""
        gain = each(LAMBDA_MIN, transition.after, 0.0) - each(LAMBDA_MIN, transition.before, 0.0)
        out = gain - self.weight * excess(transition.x[:, 0], self.threshold)
        return np.where(transition.violated, -self.unsafe, np.where(transition.step > self.outward, back, out))

    def deviation(self, transition: Transition, end: int) -> Floats:
        """Weighted squared deviation from the quintic that is at rest at the origin in step ``end``, shape [N]."""
        mark = transition.mark
        time: Floats = transition.sample_time * (transition.step - self.outward).astype(np.float64)
        duration = (end - self.outward) * transition.sample_time
        angle, velocity = quintic(mark.x[:, 0], mark.x[:, 1], mark.acceleration, duration, time)
        return self.distance(transition.x[:, 0] - angle, transition.x[:, 1] - velocity)

    def distance(self, angle: Floats, velocity: Floats) -> Floats:
        """Weighted sum of squares, shape [N]."""
        return self.angle_weight * (angle * angle) + self.velocity_weight * (velocity * velocity)

    def final(self, transition: Transition) -> Floats:
        """What is paid in the last step for the information since the way home began, shape [N]."""
        last: NDArray[np.bool_] = transition.step == transition.horizon
        home = (np.abs(transition.x[:, 0]) <= self.home_angle) & (np.abs(transition.x[:, 1]) <= self.home_velocity)
        gathered = each(LAMBDA_MIN, transition.after, 0.0) - each(LAMBDA_MIN, transition.mark.m, 0.0)
        return np.where(last & home, self.paid * gathered, 0.0)


@dataclass(frozen=True)
class HybridReturn(TrajectoryReturn):
    """Explore, follow the quintic to step ``handover``, then eq. 6.6 until the end (6.3.2).

    With s = (k − 450) / 50: r_k = −a (1 − s²) x₁² − b s² x₂², a and b being the two weights of the deviations. The
    thesis says that what is paid at the end is scaled down; by how much it does not say.
    """

    paid: float = 0.1
    """Share of the information of the way home that is paid at the end."""
    handover: int = 450
    """Step in which the quintic is at the origin and eq. 6.6 takes over."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        angle, velocity = transition.x[:, 0], transition.x[:, 1]
        share = (transition.step - self.handover) / (transition.horizon - self.handover)
        s2 = share * share
        settle = self.angle_weight * (1.0 - s2) * (angle * angle) + self.velocity_weight * s2 * (velocity * velocity)
        following = self.deviation(transition, self.handover)
        back = self.final(transition) - np.where(transition.step > self.handover, settle, following)
        return self.scale * self.composed(transition, back)
