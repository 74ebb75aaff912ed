"""Step rewards: small named functions of what a step did to the brake and to its Fisher information.

The thesis's read the weighted FIM (outputs divided by 100 rad and 500 rad/s, eq. 4.21), always packed as an upper
triangle, for N brakes with n parameters. What the thesis leaves open is a field: the factor ``scale``, which brings a
return to a number that a network fits (the thesis normalises; a fixed factor needs no hidden state), the weights of the
trajectory rewards (those of eq. 5.15), the penalty for leaving the limits, and what counts as back at the origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from emb_bench.information.symmetric import LAMBDA_MIN, LOG_DET, LOG_LAMBDA_MIN, MINUS_LOG_TRACE, each
from emb_runtime.errors import UsageError

Floats = NDArray[np.float64]


class Mark(NamedTuple):
    """State of N brakes when their way home began; zeros for those that are not there yet."""

    x: Floats  # True angle [rad] and velocity [rad/s], shape [N, 2]
    acceleration: Floats  # Over the period before [rad/s²], shape [N]
    m: Floats  # Packed FIM, shape [N, n (n + 1) / 2]


class Transition(NamedTuple):
    """One step of N brakes."""

    before: Floats  # Packed FIM before the step, shape [N, n (n + 1) / 2]
    after: Floats  # Packed FIM after the step, same shape
    x: Floats  # True angle [rad] and velocity [rad/s] after the step, shape [N, 2]
    step: NDArray[np.int64]  # Steps made, this one included, shape [N]: k of r_k
    violated: NDArray[np.bool_]  # True where the limits have been left, shape [N]
    mark: Mark  # State at the step that a :class:`Returning` reward names
    horizon: int  # Steps in one experiment, T
    sample_time: float  # [s]


class Reward(Protocol):
    """A rule that turns a step into a number for each brake."""

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError if this reward is not defined for these parameters."""

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""


@runtime_checkable
class Returning(Protocol):
    """A reward that needs the state of the brakes when their way home began."""

    @property
    def outward(self) -> int:
        """Steps before that, at least 1: 300 in the thesis (5.3)."""


def excess(angle: Floats, threshold: float) -> Floats:
    """(x₁ − x₁,d)² in the risky state x₁ > x₁,d, else 0 [rad²]; the thesis prints the threshold's name in two ways."""
    beyond = np.maximum(angle - threshold, 0.0)
    return beyond * beyond


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
class _Scaled:
    """A reward with its factor, for any parameters, or for one if the thesis defines it by an ``EQUATION`` for one."""

    EQUATION: ClassVar[str] = ""

    scale: float  # Factor of the whole reward

    def check(self, parameters: tuple[str, ...]) -> None:
        """Raise UsageError if this reward is not defined for these parameters."""
        if self.EQUATION and len(parameters) != 1:
            given = ", ".join(parameters)
            raise UsageError(f"the reward of eq. {self.EQUATION} is defined for one parameter, got {given}")


@dataclass(frozen=True)
class InformationIncrement(_Scaled):
    """r_k = M_k − M_{k−1} for one parameter (eq. 5.13), where D-, A- and E-optimality are the same.

    Enough under the shield, which keeps the limits and returns to the origin.
    """

    EQUATION = "5.13"

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        return self.scale * (transition.after[:, 0] - transition.before[:, 0])


@dataclass(frozen=True)
class PenalisedIncrement(_Scaled):
    """The increment, with a penalty for leaving the limits and one for being close to the upper angle (eq. 5.14)."""

    EQUATION = "5.14"

    unsafe: float = 4e4  # Penalty of the step that leaves the limits
    threshold: float = 75.0  # Angle beyond which the state is risky [rad]
    weight: float = 200.0  # Weight of the squared angle beyond the threshold [1/rad²]

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        gain = transition.after[:, 0] - transition.before[:, 0]
        safe = gain - self.weight * excess(transition.x[:, 0], self.threshold)
        return self.scale * np.where(transition.violated, -self.unsafe, safe)


@dataclass(frozen=True)
class DeterminantGain(_Scaled):
    """r_k = α (log |M_k| − log |M_{k−1}|)^β: method 1 with β = 1 (eq. 6.4), method 2 with β = 2 (eq. 6.5).

    M begins at ε I (eq. 4.28). The running normalisation (eq. 4.35-4.39) leaves step rewards as they are and guards a
    determinant that is multiplied out; these come from a Cholesky factor and need no guard. The thesis prints no
    penalties for these; they are those of eq. 5.14, which it says elsewhere that an experiment of 300 ms has.
    """

    power: int = 1  # β
    alpha: float = 1e4  # α
    epsilon: float = 1e-6  # ε; the thesis calls it small
    unsafe: float = 4e4  # Penalty of the step that leaves the limits
    threshold: float = 75.0  # Angle beyond which the state is risky [rad]
    weight: float = 200.0  # Weight of the squared angle beyond the threshold [1/rad²]

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        grown = _gained(LOG_DET, transition, self.epsilon)
        safe = self.alpha * grown**self.power - self.weight * excess(transition.x[:, 0], self.threshold)
        return self.scale * np.where(transition.violated, -self.unsafe, safe)


@dataclass(frozen=True)
class AdaptiveReturn(_Scaled):
    """Information first, then more and more the way home (5.3.1): eq. 5.15, all five branches in one line.

    r_k = (1 − q) ΔM_k − 200 (x₁ − 75)² [x₁ > 75] − 0.1 q ((10 x₁)² + x₂²), with q = (k/T)² after ``outward`` steps and
    0 before; and −10⁷ where the limits are left.
    """

    EQUATION = "5.15"

    outward: int = 300  # Steps before the way home counts
    unsafe: float = 1e7  # Penalty of the step that leaves the limits
    threshold: float = 75.0  # Angle beyond which the state is risky [rad]
    weight: float = 200.0  # Weight of the squared angle beyond the threshold [1/rad²]
    home: float = 0.1  # Weight of the distance from rest at the origin
    lever: float = 10.0  # Velocity that an angle of 1 rad is worth in that distance [rad/s]

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


@dataclass(frozen=True)
class TrajectoryReturn(_Scaled):
    """Explore for ``outward`` steps, then follow the quintic to rest at the origin (5.3.2; with λ_min, 6.3.1).

    It takes λ_min(M), which for one parameter is M itself. While it follows, information earns nothing; what it
    gathered on the way is paid in the last step, if that ends at the origin.
    """

    outward: int = 300  # Steps of the exploration
    unsafe: float = 1e7  # Penalty of the step that leaves the limits
    threshold: float = 75.0  # Angle beyond which the state is risky while exploring [rad]
    weight: float = 200.0  # Weight of the squared angle beyond the threshold [1/rad²]
    angle_weight: float = 10.0  # Weight of the squared deviation from the planned angle [1/rad²]
    velocity_weight: float = 0.1  # Weight of the squared deviation from the planned velocity [s²/rad²]
    home_angle: float = 2.0  # |x₁| that counts as back [rad]
    home_velocity: float = 20.0  # |x₂| that counts as back [rad/s]
    paid: float = 1.0  # Share of the information of the way home that is paid at the end

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        back = -self.deviation(transition, transition.horizon) + self.final(transition)
        return self.scale * self.composed(transition, back)

    def composed(self, transition: Transition, back: Floats) -> Floats:
        """The exploration's reward, ``back`` after it, and the penalty for leaving the limits; shape [N]."""
        out = _gained(LAMBDA_MIN, transition, 0.0) - self.weight * excess(transition.x[:, 0], self.threshold)
        return np.where(transition.violated, -self.unsafe, np.where(transition.step > self.outward, back, out))

    def deviation(self, transition: Transition, end: int) -> Floats:
        """Weighted squared deviation from the quintic that is at rest at the origin in step ``end``, shape [N]."""
        mark = transition.mark
        time: Floats = transition.sample_time * (transition.step - self.outward).astype(np.float64)
        duration = (end - self.outward) * transition.sample_time
        angle, velocity = quintic(mark.x[:, 0], mark.x[:, 1], mark.acceleration, duration, time)
        angle, velocity = transition.x[:, 0] - angle, transition.x[:, 1] - velocity
        return self.angle_weight * (angle * angle) + self.velocity_weight * (velocity * velocity)

    def final(self, transition: Transition) -> Floats:
        """Payment in the last step for the information since the way home began, shape [N]."""
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

    paid: float = 0.1  # Share of the information of the way home that is paid at the end
    handover: int = 450  # Step in which the quintic is at the origin and eq. 6.6 takes over.

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        angle, velocity = transition.x[:, 0], transition.x[:, 1]
        share = (transition.step - self.handover) / (transition.horizon - self.handover)
        s2 = share * share
        settle = self.angle_weight * (1.0 - s2) * (angle * angle) + self.velocity_weight * s2 * (velocity * velocity)
        following = self.deviation(transition, self.handover)
        back = self.final(transition) - np.where(transition.step > self.handover, settle, following)
        return self.scale * self.composed(transition, back)


@dataclass(frozen=True)
class _Gain(_Scaled):
    """Growth of a criterion of M + prior I: the project's own rewards, for the *physical* information.

    The prior takes the place of the thesis's ε: 12 is one over the variance of a parameter that is uniform within
    ±50 %, so that what is known beforehand earns nothing. An experiment's rewards add up to its criterion minus the
    prior's.
    """

    CRITERION: ClassVar[int]

    prior: float = 12.0  # Information on each parameter before the experiment

    def __post_init__(self) -> None:
        """Refuse a prior without which a logarithm does not exist.

        Raises:
            UsageError: it is not positive.
        """
        if not self.prior > 0.0:
            raise UsageError(f"prior: expected a positive number, got {self.prior}")

    def __call__(self, transition: Transition) -> Floats:
        """Rewards of one step, shape [N]."""
        return self.scale * _gained(self.CRITERION, transition, self.prior)


@dataclass(frozen=True)
class LogDeterminant(_Gain):
    """Increments of ln |M + prior I| (D, eq. 4.12-4.13)."""

    CRITERION = LOG_DET


@dataclass(frozen=True)
class LogSmallest(_Gain):
    """Increments of ln λ_min(M + prior I) (E, eq. 4.14)."""

    CRITERION = LOG_LAMBDA_MIN


@dataclass(frozen=True)
class LogTrace(_Gain):
    """Increments of −ln tr (M + prior I)⁻¹ (A, eq. 4.16)."""

    CRITERION = MINUS_LOG_TRACE


def _gained(criterion: int, transition: Transition, added: float) -> Floats:
    """Growth of a criterion of M + added · I in a step, shape [N]."""
    return each(criterion, transition.after, added) - each(criterion, transition.before, added)


REWARDS: Mapping[str, type] = {
    kind.__name__: kind
    for kind in (
        InformationIncrement,
        PenalisedIncrement,
        AdaptiveReturn,
        TrajectoryReturn,
        HybridReturn,
        DeterminantGain,
        LogDeterminant,
        LogSmallest,
        LogTrace,
    )
}
"""Rewards by the name that a configuration gives them."""
