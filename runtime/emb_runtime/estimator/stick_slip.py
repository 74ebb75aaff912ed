"""Motion of a brake that slides, stops, sticks and breaks away in one period, and its uncertainty.

The brake of eq. 3.12-3.14 solved within the period, by series up to the fourth power of time, with at most one stop.
As a function of angle, velocity, current and four parameters the velocity at the end is piecewise smooth:

- that of sliding against the pull, as long as it has not stopped (its end velocity W₁ points against the pull);
- r W₁ where it has stopped: r is the ratio of the accelerations after and before the stop (the saltation), 0 where the
  brake sticks;
- that of sliding with the pull (its end velocity W₂) where it moves that way, or breaks away.

**Uncertainty.** The velocity is uncertain, and so is the piece that applies. For a Gaussian number the mean, the
regression and the variance about the regression of a function with a kink are known in closed form (statistical
linearisation; Gelb, Applied Optimal Estimation, 1974, chapter 6). So the derivatives are those of the three pieces
weighted by their probabilities, and the variance about the regression is noise of the prediction. A brake that surely
sticks has a velocity of exactly 0, which depends on no parameter: such a sample has no information on T_c. Neither has
a sample of which it is uncertain whether the brake sticks: its error is the same in every such sample, and is not
averaged out.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

STEEPNESS: Final = math.sqrt(2.0 / math.pi)
CUBIC: Final = 0.044715 * STEEPNESS
"""Φ(z) is within 4e-4 of (1 + tanh(STEEPNESS z + CUBIC z³))/2 (Page, Applied Statistics 26(1), 1977)."""
PEAK: Final = 1.0 / math.sqrt(2.0 * math.pi)  # Density of a standard Gaussian number at 0
KINK: Final = 0.0908
KINK_DECAY: Final = 0.73
"""The variance of max(z, 0) about its regression is within 0.003 of KINK exp(−KINK_DECAY α²) for z ~ N(α, 1)."""
REST: Final = 1e-5  # Standard deviation of the velocity below which a brake is at rest [rad/s]
DOUBT: Final = 2.0
"""Factor on the standard deviation of the velocity that decides whether a brake sticks: there the errors are not
Gaussian, and the filter does not recover from taking a moving brake for one that sticks."""
FARTHEST: Final = 12.0  # Standard deviations from a kink beyond which it has no effect


class Accelerations(NamedTuple):
    """Terms of the brake's acceleration."""

    pull: float  # Of motor and spring at the start of the period [rad/s²]
    coulomb: float  # T_c/J, of friction against the motion [rad/s²]
    damping: float  # f_v/J [1/s]
    spring: float  # γ k_1/J, also where there is no contact [1/s²]


class Motion(NamedTuple):
    """End of one period, and the derivatives of angle and velocity there.

    They are to the velocity at its start (``by_velocity``), to an acceleration that is added to the pull (``by_pull``),
    and to one of friction (``by_friction``).
    """

    angle: float
    velocity: float
    angle_by_velocity: float
    angle_by_pull: float
    angle_by_friction: float
    velocity_by_velocity: float
    velocity_by_pull: float
    velocity_by_friction: float
    stopped: float  # Probability that it stops on the way, or sticks
    kinked: float  # Variance of the velocity about the regression [rad²/s²]


def sign(value: float) -> float:
    """Sign, 0 at 0."""
    return 1.0 if value > 0.0 else -1.0 if value < 0.0 else 0.0


def normal(z: float) -> float:
    """Φ(z), to 4e-4."""
    return 0.5 + 0.5 * math.tanh(z * (STEEPNESS + CUBIC * (z * z)))


def excess(z: float, probability: float) -> float:
    """Mean of max(y, 0) − max(z, 0) for y ~ N(z, 1), where Φ(z) is ``probability``."""
    return PEAK * math.exp(-0.5 * (z * z)) - abs(z) * min(probability, 1.0 - probability)


def slide(now: Accelerations, x: float, v: float, t: float, forward: float) -> tuple[float, float]:
    """Angle and velocity after the time ``t`` in the direction ``forward``, as if it could not stop."""
    touching = now.spring if x > 0.0 else 0.0
    a = now.pull - forward * now.coulomb - now.damping * v
    b = -now.damping * a - touching * v
    e = -now.damping * b - touching * a
    x1 = x + t * (v + t * (a / 2.0 + t * (b / 6.0 + t * e / 24.0)))
    v1 = v + t * (a + t * (b / 2.0 + t * e / 6.0))
    if x * x1 < 0.0:  # contact begins or ends on the way: the spring acts in a part of the period
        v1 -= now.spring * t * x1 * x1 / (2.0 * abs(x1 - x))
    return x1, v1


def move(
    now: Accelerations, x: float, v: float, t: float, spread: float, spread_against: float, spread_along: float
) -> Motion:
    """One period from a state whose velocity is uncertain.

    Args:
        now: accelerations.
        x: angle [rad].
        v: velocity [rad/s].
        t: duration [s]; not 0.
        spread: standard deviation of the velocity at the start [rad/s].
        spread_against: of that at the end of sliding against the pull, W₁ [rad/s].
        spread_along: of that at the end of sliding with the pull, W₂ [rad/s].
    """
    toward, strength = 1.0 if now.pull >= 0.0 else -1.0, abs(now.pull)
    braked, driven = strength + now.coulomb, strength - now.coulomb
    forward = toward if v == 0.0 else sign(v)
    x1, v1 = slide(now, x, v, t, forward)
    ahead, wide, stops = toward * v, DOUBT * spread_along, forward * v1 < 0.0
    damped = now.damping * t
    full, half = t * (1.0 - 0.5 * damped), t * t * (0.5 - damped / 6.0)
    at_start, at_end = (ahead + REST) / spread, (ahead + t * driven) / wide
    first, second = (ahead + t * braked) / spread_against, min(at_start, at_end)
    if not stops and (max(first, second) <= -FARTHEST or min(first, second) >= FARTHEST):  # it slides for certain
        return Motion(x1, v1, t, half, -forward * half, 1.0, full, -forward * full, 0.0, 0.0)
    r = max(driven, 0.0) / braked
    # One that moves with a pull that drives it has stopped at the start, if at all; any other stops at the end.
    otherwise = 0.0 if min(ahead + REST, driven) > 0.0 else t
    before = t * v / (v - v1) if stops else otherwise
    after = t - before if driven > 0.0 else 0.0
    if stops:
        v1 *= r  # 0 if it moved in the direction of the pull, which is then too weak
        x1 = x + 0.5 * (v * before + v1 * after)
    sooner = at_start < at_end
    width = spread if sooner else wide
    not_against, along = normal(first), normal(second)
    against = 1.0 - not_against
    stopped = max(1.0 - against - along, 0.0)
    slower = 1.0 - r
    v1 += toward * slower * (width * excess(second, along) - spread_against * excess(first, not_against))
    bent = width * width * math.exp(-KINK_DECAY * (second * second))
    bent = KINK * (bent + spread_against * spread_against * math.exp(-KINK_DECAY * (first * first)))
    # The less certain it is that the brake breaks away, the smaller the derivatives, and the greater the noise.
    certain = 1.0 if sooner else max(2.0 * along - 1.0, 0.0)
    uncertain = (1.0 - certain * certain) * along * along * max(width * width - spread * spread, 0.0)
    # The same where it stops on the way, and has the rest of the period to break away in.
    doubt = DOUBT * math.sqrt(max(spread_along * spread_along - spread * spread, REST * REST))
    leaving = t * driven / doubt
    released = normal(leaving)
    sure, share = max(2.0 * released - 1.0, 0.0), (t - before) / t if ahead < 0.0 else 0.0
    wide = share * doubt
    v1 += toward * stopped * wide * excess(leaving, released)
    unsure = (1.0 - sure * sure) * released * released + KINK * math.exp(-KINK_DECAY * (leaving * leaving))
    uncertain += stopped * wide * wide * unsure
    if ahead < 0.0:
        after *= sure
    sliding, leaning = against + certain * along, toward * (against - certain * along)
    reversing, turned, rest = r * before, r * after, 0.5 * after * after
    way = before * (0.5 * before + turned)
    return Motion(
        x1,
        v1,
        (against + along) * t + stopped * (before + turned),
        sliding * half + stopped * (way + rest),
        leaning * half - stopped * (forward * way + toward * rest),
        against + along + stopped * r,
        sliding * full + stopped * (reversing + after),
        leaning * full - stopped * (forward * reversing + toward * after),
        stopped,
        slower * slower * bent + uncertain,
    )


def contact(x: float, x1: float, t: float, v: float, v1: float) -> tuple[float, float, float]:
    """Contact in a period from ``x``, ``v`` to ``x1``, ``v1`` of length ``t``.

    Returns:
        Share of the period in contact, and the mean of the squeezed angle as it acts on the velocity and, weighted with
        the rest of the period, on the angle [rad].
    """
    if x * x1 < 0.0:
        share = (max(x1, 0.0) - max(x, 0.0)) / (x1 - x)
        to_velocity = 0.5 * share * max(x, x1)
        return share, to_velocity, share * share * x1 / 3.0 if x1 > 0.0 else share * x * (1.0 - share / 3.0)
    if min(x, x1) < 0.0:
        return 0.0, 0.0, 0.0
    return 1.0, x + t * (2.0 * v + v1) / 6.0, x + t * (3.0 * v + v1) / 12.0
