"""Motion of a brake that slides, stops, sticks and breaks away in one period, and its uncertainty.

The brake of eq. 3.12-3.14 solved within the period as :mod:`emb_bench.brake.exact` does, by series up to the fourth
power of time, with at most one stop. What the end of the period owes to its start is piecewise smooth: for an angle and
a velocity, a current and four parameters the velocity at the end is

- that of sliding against the pull, as long as it has not stopped (its end velocity W₁ points against the pull);
- r W₁ where it has stopped: r is the ratio of the accelerations after and before the stop, the saltation of
  :mod:`emb_bench.brake.exact`, 0 where the brake sticks;
- that of sliding with the pull (its end velocity W₂) where it moves that way, or breaks away.

**Uncertainty.** Where the kinks between these lie is known as well as the velocity is. For a Gaussian number the mean,
the regression and the variance about the regression of a function with a kink are known in closed form (statistical
linearisation; Gelb, Applied Optimal Estimation, 1974, chapter 6). So the derivatives below are those of the three cases
weighted by their probabilities, and what a straight line leaves out is noise of the prediction. A brake that surely
sticks has a velocity of exactly 0, which depends on no parameter: such a sample has no information on T_c. Nor has one
of which it is not sure whether the brake sticks: it is the same error in every such sample, and would be learned from
as if it were a new one each time.

Functions without a branch: they run on numbers, compiled for the batch, and on columns of torch numbers for the
exported graph, see :mod:`emb_train.structured.columns`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emb_bench.brake.euler import sign
from emb_train.structured.columns import ratio, where

STEEPNESS = math.sqrt(2.0 / math.pi)
CUBIC = 0.044715 * STEEPNESS
"""Φ(z) is within 4e-4 of (1 + tanh(STEEPNESS z + CUBIC z³))/2 (Page, Applied Statistics 26(1), 1977)."""
PEAK = 1.0 / math.sqrt(2.0 * math.pi)  # Density of a standard Gaussian number at 0
KINK = 0.0908
KINK_DECAY = 0.73
"""The variance of max(z, 0) about its regression is within 0.003 of KINK exp(−KINK_DECAY α²) for z ~ N(α, 1)."""
REST = 1e-5  # A velocity that is known better than this is one of a brake at rest, which moves against no pull [rad/s]
DOUBT = 2.0
"""Factor on the filter's deviation of the velocity that decides whether a brake sticks: there the errors are not
Gaussian, and a brake that is taken to stick and does not is not found again."""
SHORTEST = 1e-6  # Less than any period, where one is divided by [s]
FARTHEST = 12.0  # Standard deviations from a kink beyond which nothing is left of it


class Accelerations(NamedTuple):
    """Terms of the brake's acceleration."""

    pull: float  # Of motor and spring at the start of the period [rad/s²]
    coulomb: float  # T_c/J, of friction against the motion [rad/s²]
    damping: float  # f_v/J [1/s]
    spring: float  # γ k_1/J, also where there is no contact [1/s²]


class Motion(NamedTuple):
    """One period: where it leads, and the derivatives of angle and velocity at its end.

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
    kinked: float  # Variance of the velocity that no derivative stands for [rad²/s²]


def normal(z: float) -> float:
    """Φ(z), to 4e-4."""
    return 0.5 + 0.5 * math.tanh(z * (STEEPNESS + CUBIC * (z * z)))


def excess(z: float, probability: float) -> float:
    """Mean of max(y, 0) − max(z, 0) for y ~ N(z, 1), where Φ(z) is ``probability``."""
    return PEAK * math.exp(-0.5 * (z * z)) - abs(z) * min(probability, 1.0 - probability)


def slide(now: Accelerations, x: float, v: float, t: float, forward: float) -> tuple[float, float]:
    """Angle and velocity after the time ``t`` in the direction ``forward``, as if it could not stop."""
    touching = where(x > 0.0, now.spring, 0.0)
    a = now.pull - forward * now.coulomb - now.damping * v
    b = -now.damping * a - touching * v
    e = -now.damping * b - touching * a
    x1 = x + t * (v + t * (a / 2.0 + t * (b / 6.0 + t * e / 24.0)))
    v1 = v + t * (a + t * (b / 2.0 + t * e / 6.0))
    # Where contact is made or left on the way, the spring acts in a part of the period.
    return x1, v1 - where(x * x1 < 0.0, ratio(now.spring * t * x1 * x1, 2.0 * abs(x1 - x)), 0.0)


def move(
    now: Accelerations, x: float, v: float, t: float, spread: float, spread_against: float, spread_along: float
) -> Motion:
    """One period from a state whose velocity is uncertain.

    Args:
        now: what acts.
        x: angle [rad].
        v: velocity [rad/s].
        t: duration [s].
        spread: standard deviation of the velocity at the start [rad/s].
        spread_against: of that at the end of sliding against the pull, W₁ [rad/s].
        spread_along: of that at the end of sliding with the pull, W₂ [rad/s].
    """
    toward, strength = where(now.pull >= 0.0, 1.0, -1.0), abs(now.pull)
    braked, driven = strength + now.coulomb, strength - now.coulomb
    r = max(driven, 0.0) / braked
    forward = where(v == 0.0, toward, sign(v))
    x1, v1 = slide(now, x, v, t, forward)
    stops = forward * v1 < 0.0
    ahead, wide = toward * v, DOUBT * spread_along
    # One that moves with a pull that drives it has stopped at the start, if at all; any other stops at the end.
    before = where(stops, ratio(t * v, v - v1), where(min(ahead + REST, driven) > 0.0, 0.0, t))
    after = where(driven > 0.0, t - before, 0.0)
    v1 = where(stops, v1 * r, v1)  # 0 where it was the pull's direction, which is too weak then
    x1 = where(stops, x + 0.5 * (v * before + v1 * after), x1)
    started, kept = (ahead + REST) / spread, (ahead + t * driven) / wide
    sooner = started < kept
    width = where(sooner, spread, wide)
    first = min(max((ahead + t * braked) / spread_against, -FARTHEST), FARTHEST)
    second = min(max(min(started, kept), -FARTHEST), FARTHEST)
    not_against, along = normal(first), normal(second)
    against = 1.0 - not_against
    stopped = max(1.0 - against - along, 0.0)
    slower = 1.0 - r
    v1 = v1 + toward * slower * (width * excess(second, along) - spread_against * excess(first, not_against))
    bent = width * width * math.exp(-KINK_DECAY * (second * second))
    bent = KINK * (bent + spread_against * spread_against * math.exp(-KINK_DECAY * (first * first)))
    # Whether it breaks away: the less sure, the less is learned of why, and the more of it is noise.
    certain = where(sooner, 1.0, max(2.0 * along - 1.0, 0.0))
    uncertain = (1.0 - certain * certain) * along * along * max(width * width - spread * spread, 0.0)
    # The same where it stops on the way, and has the rest of the period to break away in.
    doubt = DOUBT * math.sqrt(max(spread_along * spread_along - spread * spread, REST * REST))
    leaving = min(max(t * driven / doubt, -FARTHEST), FARTHEST)
    released = normal(leaving)
    sure, share = max(2.0 * released - 1.0, 0.0), where(ahead < 0.0, (t - before) / max(t, SHORTEST), 0.0)
    wide = share * doubt
    v1 = v1 + toward * stopped * wide * excess(leaving, released)
    unsure = (1.0 - sure * sure) * released * released + KINK * math.exp(-KINK_DECAY * (leaving * leaving))
    uncertain = uncertain + stopped * wide * wide * unsure
    after = after * where(ahead < 0.0, sure, 1.0)
    damped = now.damping * t
    full, half = t * (1.0 - 0.5 * damped), t * t * (0.5 - damped / 6.0)
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
        the time that is left, on the angle [rad].
    """
    crossed, inside = x * x1 < 0.0, where(min(x, x1) < 0.0, 0.0, 1.0)
    share = where(crossed, ratio(max(x1, 0.0) - max(x, 0.0), x1 - x), inside)
    to_velocity = where(crossed, 0.5 * share * max(x, x1), inside * (x + t * (2.0 * v + v1) / 6.0))
    crossing = where(x1 > 0.0, share * share * x1 / 3.0, share * x * (1.0 - share / 3.0))
    return share, to_velocity, where(crossed, crossing, inside * (x + t * (3.0 * v + v1) / 12.0))
