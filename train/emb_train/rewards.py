"""Rewards of a step, or of an experiment at its end.

The rewards of a step are small named functions of what it did to the brake and to its Fisher information: each takes a
:class:`Transition` of N brakes and returns N numbers. Those of the thesis read the weighted FIM (outputs divided by
100 rad and 500 rad/s, eq. 4.21). The constants below are those of eq. 5.14 and 5.15; where the thesis prints none for
another reward, the same ones hold. Those at the end look at the experiments of a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from emb_bench.estimate.expected import IntervalCriterion
from emb_bench.information.symmetric import LAMBDA_MIN, LOG_DET, LOG_LAMBDA_MIN, MINUS_LOG_TRACE, Floats, each
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.errors import UsageError
from emb_train.closed_loop import Batch, Bools, Positive, Price, Share
from emb_train.intervals import finite, intervals
from emb_train.lies import clearness

OUTWARD = 300  # Steps before the way home begins (5.3)
HANDOVER = 450  # Step in which the hybrid's quintic is at the origin and eq. 6.6 takes over
UNSAFE, UNSAFE_RETURN = 4e4, 1e7  # Penalty of the step that leaves the limits (eq. 5.14; 5.15)
RISKY_ANGLE = 75.0  # x₁,d [rad]: beyond it the state is risky
RISKY_WEIGHT = 200.0  # Weight of the squared angle beyond it [1/rad²]
ANGLE_WEIGHT, VELOCITY_WEIGHT = 10.0, 0.1  # Weights of squared deviations [1/rad², s²/rad²] (eq. 5.15)
HOME_ANGLE, HOME_VELOCITY = 2.0, 20.0  # |x₁| [rad] and |x₂| [rad/s] that count as back at the origin
HYBRID_PAID = 0.1  # Share of the return's information that the hybrid pays; "scaled down", by an amount not printed
EPSILON = 1e-6  # ε of M₀ = ε I (eq. 4.28); the thesis calls it small
ALPHA = 1e4  # α of eq. 6.4 and 6.5
PRIOR = 12.0  # Information of a prior of ±50 %: one over the variance of a uniform distribution from 0.5 to 1.5
UNKNOWN = 1e9  # Times a deviation is too large before the first sample
SHORTEST = 20  # Samples of a record below which nothing counts as estimated


class Turn(NamedTuple):
    """State of N brakes in step ``OUTWARD``, where their way home begins; the newest of those not there yet."""

    x: Floats  # True angle [rad] and velocity [rad/s], shape [N, 2]
    acceleration: Floats  # Over the period before [rad/s²], shape [N]
    m: Floats  # Packed FIM, shape [N, n (n + 1) / 2]


class Transition(NamedTuple):
    """One step of N brakes."""

    before: Floats  # Packed FIM before the step, shape [N, n (n + 1) / 2]
    after: Floats  # Packed FIM after the step, same shape
    x: Floats  # True angle [rad] and velocity [rad/s] after the step, shape [N, 2]
    step: NDArray[np.int64]  # Steps made, this one included, shape [N]: k of r_k
    violated: NDArray[np.bool_]  # True where the limits are violated, shape [N]
    turn: Turn
    horizon: int  # Steps in one experiment, T
    sample_time: float  # [s]
    tracking: float = 1.0  # Factor of the weights of the deviation from the quintic, which the thesis does not print


def transition(batch: Batch) -> Transition:
    """The newest step of a batch of experiments."""
    e, timing = batch.experiments, batch.bench.timing
    rows, turn = np.arange(len(e.k)), np.minimum(e.k, OUTWARD)
    x, slower = e.x[rows, turn, :2], e.x[rows, turn - 1, 1]
    return Transition(
        before=batch.information(e.k - 1),
        after=batch.information(e.k),
        x=batch.x,
        step=e.k,
        violated=batch.experiments.violated,
        turn=Turn(x, (x[:, 1] - slower) / timing.sample_time, batch.information(turn)),
        horizon=timing.horizon,
        sample_time=timing.sample_time,
        tracking=batch.conditions.tracking,
    )


Reward = Callable[[Transition], Floats]


def information_increment(t: Transition) -> Floats:
    """r_k = M_k − M_{k−1} for one parameter (eq. 5.13), where D-, A- and E-optimality are the same."""
    return t.after[:, 0] - t.before[:, 0]


def penalised_increment(t: Transition) -> Floats:
    """The increment less 200 (x₁ − 75)² [x₁ > 75], and −4·10⁴ where the limits are violated (eq. 5.14)."""
    return np.where(t.violated, -UNSAFE, information_increment(t) - risk(t))


def adaptive_return(t: Transition) -> Floats:
    """Information first, then more and more the way home (eq. 5.15, all five branches in one line).

    r_k = (1 − q) ΔM_k − 200 (x₁ − 75)² [x₁ > 75] − 0.1 q ((10 x₁)² + x₂²), with q = (k/T)² after 300 steps and 0
    before; and −10⁷ where the limits are violated.
    """
    x1, x2 = t.x[:, 0], t.x[:, 1]
    q = np.where(t.step > OUTWARD, (t.step / t.horizon) ** 2, 0.0)
    safe = (1.0 - q) * information_increment(t) - risk(t) - q * (ANGLE_WEIGHT * x1**2 + VELOCITY_WEIGHT * x2**2)
    return np.where(t.violated, -UNSAFE_RETURN, safe)


def trajectory_return(t: Transition) -> Floats:
    """Explore for 300 steps, then follow the quintic of eq. 5.16 to rest at the origin (5.3.2; with λ_min, 6.3.1).

    The exploration earns λ_min(M), which for one parameter is M itself. The way home earns no information; what it
    gathered is paid in the last step, if that ends at the origin.
    """
    return _explored(t, -deviation(t, t.horizon) + gathered_at_home(t))


def hybrid_return(t: Transition) -> Floats:
    """Explore, follow the quintic to step 450, then eq. 6.6 (6.3.2).

    With s = (k − 450)/50: r_k = −a (1 − s²) x₁² − b s² x₂².
    """
    x1, x2 = t.x[:, 0], t.x[:, 1]
    s2 = ((t.step - HANDOVER) / (t.horizon - HANDOVER)) ** 2
    settling = ANGLE_WEIGHT * (1.0 - s2) * x1**2 + VELOCITY_WEIGHT * s2 * x2**2
    costs = np.where(t.step > HANDOVER, settling, deviation(t, HANDOVER))
    return _explored(t, -costs + HYBRID_PAID * gathered_at_home(t))


def determinant_step(t: Transition) -> Floats:
    """r_k = log |M_k| − log |M_{k−1}|, as it is (eq. 4.13, 6.2.1), with the penalties of eq. 5.14."""
    return np.where(t.violated, -UNSAFE, gain(LOG_DET, t, EPSILON) - risk(t))


def determinant_gain(t: Transition) -> Floats:
    """r_k = α (log |M_k| − log |M_{k−1}|), method 1 (eq. 6.4), with the penalties of eq. 5.14 (not printed for it)."""
    return np.where(t.violated, -UNSAFE, ALPHA * gain(LOG_DET, t, EPSILON) - risk(t))


def squared_determinant_gain(t: Transition) -> Floats:
    """r_k = α (log |M_k| − log |M_{k−1}|)², method 2 (eq. 6.5), with the penalties of eq. 5.14."""
    return np.where(t.violated, -UNSAFE, ALPHA * gain(LOG_DET, t, EPSILON) ** 2 - risk(t))


def log_determinant(t: Transition) -> Floats:
    """Increment of ln |M + 12 I| (D, eq. 4.12-4.13): the information of the prior of ±50 % earns nothing."""
    return gain(LOG_DET, t, PRIOR)


def log_smallest_eigenvalue(t: Transition) -> Floats:
    """Increment of ln λ_min(M + 12 I) (E, eq. 4.14)."""
    return gain(LOG_LAMBDA_MIN, t, PRIOR)


def log_trace(t: Transition) -> Floats:
    """Increment of −ln tr (M + 12 I)⁻¹ (A, eq. 4.16)."""
    return gain(MINUS_LOG_TRACE, t, PRIOR)


def gain(criterion: int, t: Transition, prior: float) -> Floats:
    """Growth of a criterion of M + prior I in a step, shape [N]."""
    return each(criterion, t.after, prior) - each(criterion, t.before, prior)


def risk(t: Transition) -> Floats:
    """Cost of the risky state, 200 (x₁ − x₁,d)² [x₁ > x₁,d], shape [N]."""
    return RISKY_WEIGHT * np.maximum(t.x[:, 0] - RISKY_ANGLE, 0.0) ** 2


def deviation(t: Transition, end: int) -> Floats:
    """Weighted squared deviation from the quintic that is at rest at the origin in step ``end``, shape [N]."""
    time: Floats = t.sample_time * (t.step - OUTWARD).astype(np.float64)
    x1, x2 = t.turn.x[:, 0], t.turn.x[:, 1]
    angle, velocity = quintic(x1, x2, t.turn.acceleration, t.sample_time * (end - OUTWARD), time)
    apart = ANGLE_WEIGHT * (t.x[:, 0] - angle) ** 2 + VELOCITY_WEIGHT * (t.x[:, 1] - velocity) ** 2
    return t.tracking * apart


def gathered_at_home(t: Transition) -> Floats:
    """Growth of λ_min(M) since the way home began, in the last step and if that ends at the origin, else 0; [N]."""
    home = (np.abs(t.x[:, 0]) <= HOME_ANGLE) & (np.abs(t.x[:, 1]) <= HOME_VELOCITY)
    gathered = each(LAMBDA_MIN, t.after, 0.0) - each(LAMBDA_MIN, t.turn.m, 0.0)
    return np.where(home & (t.step == t.horizon), gathered, 0.0)


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
    a, b, c = angle, velocity * duration, 0.5 * acceleration * duration**2
    d, e, f = -10.0 * a - 6.0 * b - 3.0 * c, 15.0 * a + 8.0 * b + 3.0 * c, -6.0 * a - 3.0 * b - c
    s = time / duration
    position = a + s * (b + s * (c + s * (d + s * (e + s * f))))
    slope = b + s * (2.0 * c + s * (3.0 * d + s * (4.0 * e + s * 5.0 * f)))
    return position, slope / duration


def _explored(t: Transition, back: Floats) -> Floats:
    """The exploration's reward until step 300, ``back`` after it, and −10⁷ where the limits are violated; shape [N]."""
    out = gain(LAMBDA_MIN, t, 0.0) - risk(t)
    return np.where(t.violated, -UNSAFE_RETURN, np.where(t.step > OUTWARD, back, out))


class Demands(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Demands on an experiment besides its information, with the penalties for each demand that is not met.

    A faulty sensor moves a brake by some radians before it is detected, so the experiment keeps a distance on the side
    of the release. And the motion has to reveal a faulty node (:mod:`emb_train.lies`).
    """

    astray: Price = 20.0  # Penalty for violated limits, or for an end away from home [nat]
    release: Share = 0.3  # Share of the distance to the lowest angle without a penalty
    beyond: Price = 1.0  # Penalty for each radian beyond it [nat]
    shown: Price = 1.15  # Required detectability of each fault; above 1 the fault ends a run
    hidden: Price = 10.0  # Penalty for each unit below it [nat]


DEMANDS = Demands()


@dataclass(frozen=True)
class ExpectedInterval:
    """Reward of an experiment, in its last step [nat]: the criterion of the interval that an estimate will have.

    Without a discount it is the sum of the criterion's increments. The penalties of the experiment are subtracted.
    """

    criterion: IntervalCriterion
    demands: Demands = DEMANDS
    pool: Executor | None = None  # Of processes that share the work

    def __call__(self, batch: Batch) -> Floats:
        """Rewards of the newest step of N experiments, shape [N]: 0 for those that go on."""
        over, demands, e = batch.terminated, self.demands, batch.experiments
        rewards = np.zeros(len(over))
        if not over.any():
            return rewards
        brakes, acted, motion = brakes_of(batch, over), e.applied[over, 1:], e.x[over, :, :2]
        found = intervals(batch.bench, batch.plant.name, batch.parameters, brakes, acted, self.pool)
        clear = clearness(batch.bench, brakes, motion, acted)
        clear[batch.experiments.violated[over]] = 0.0  # it was stopped in the middle
        hidden = np.maximum(demands.shown - clear, 0.0)
        beyond = np.maximum(demands.release * batch.bench.limits.angle[0] - motion[:, :, 0].min(axis=1), 0.0)
        prices = demands.astray * ~batch.home[over] + demands.beyond * beyond + demands.hidden * hidden.sum(axis=1)
        rewards[over] = finite([self.criterion.of(one) for one in found]) - prices
        return rewards


class Precision(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Precision to be reached, as relative standard deviations; 95 % of the estimates are within twice that."""

    repeatability: Positive = 0.0065  # Of the running estimates, which ends an experiment
    interval: Positive = 0.0025  # Between runs, of the complete record
    price: Price = 10.0  # Of an interval that is e times as wide [periods]


PRECISION = Precision()


class TimeToPrecision:
    """Reward of a step: minus the share of the period in which a running estimate was not precise enough.

    So the return is minus the number of periods until all four are precise. The experiment has ended then, and its way
    home begins, as in the runtime. An interval of the record that is wider than required has a price: it is paid at
    this end, for the record so far, and what the way home improves is paid back at the first sample at home.
    """

    def __init__(self, precision: Precision = PRECISION, pool: Executor | None = None) -> None:
        """Reward the experiments of one batch; the ``pool`` has processes that share the work."""
        self._precision, self._pool = precision, pool
        self._missing, self._price = np.zeros(1), np.zeros(1)

    def __call__(self, batch: Batch) -> Floats:
        """Rewards of the newest step of N experiments, shape [N]; the way home begins for those that are precise."""
        returning, begun = batch.experiments.returning, batch.experiments.k == 1
        before, price = np.where(begun, UNKNOWN, self._missing), np.where(begun, 0.0, self._price)
        self._missing, self._price = np.minimum(before, self._ratio(batch)), price
        first, second = np.log(np.maximum(before, 1e-9)), np.log(np.maximum(self._missing, 1e-9))
        share = np.where(second <= 0.0, first / np.maximum(first - second, 1e-9), 1.0)  # continuous in the time
        rewards: Floats = np.where(first <= 0.0, 0.0, -np.clip(share, 0.0, 1.0))
        ended, arrived = ~returning & (self._missing <= 1.0), (price > 0.0) & returning & batch.home
        returning |= ended
        for rows, more in ((ended, 1.0), (arrived, 0.0)):
            if rows.any():
                now = self._price_of(batch, rows)
                rewards[rows] += price[rows] - now
                price[rows] = more * now
        return rewards

    def _ratio(self, batch: Batch) -> Floats:
        """Greatest ratio of a relative deviation to the required one, shape [N]."""
        estimates, required = batch.estimate(), self._precision.repeatability
        ratio: Floats = np.minimum((estimates[:, 4:] / (required * estimates[:, :4])).max(axis=1), UNKNOWN)
        return ratio

    def _price_of(self, batch: Batch, rows: Bools) -> Floats:
        """Price of the interval of the records so far of R rows, shape [R]."""
        e, at = batch.experiments, np.flatnonzero(rows)
        long = e.k[at] >= SHORTEST
        records = [e.applied[row, 1 : e.k[row] + 1] for row in at[long]]
        brakes = brakes_of(batch, at[long])
        found = intervals(batch.bench, batch.plant.name, batch.parameters, brakes, records, self._pool)
        wide = np.full((len(at), len(batch.parameters)), UNKNOWN)
        for i, one in zip(np.flatnonzero(long), found, strict=True):
            wide[i] = np.nan_to_num(one.between_runs[: one.count], nan=UNKNOWN) / self._precision.interval
        prices: Floats = self._precision.price * np.log(np.clip(wide, 1.0, UNKNOWN)).sum(axis=1)
        return prices


def brakes_of(batch: Batch, rows: NDArray[np.generic]) -> list[BrakeParameters]:
    """The brakes of some rows of a batch."""
    return [BrakeParameters(*brake) for brake in batch.experiments.brakes[rows].tolist()]


AnyReward = Reward | ExpectedInterval | TimeToPrecision


def worth(reward: AnyReward, batch: Batch) -> Floats:
    """Rewards of the newest step of a batch of experiments, shape [N]."""
    return reward(batch) if isinstance(reward, ExpectedInterval | TimeToPrecision) else reward(transition(batch))


ONE_PARAMETER = (information_increment, penalised_increment, adaptive_return)  # The thesis defines them for one only
REWARDS: Mapping[str, Reward] = {
    reward.__name__: reward
    for reward in (
        *ONE_PARAMETER,
        trajectory_return,
        hybrid_return,
        determinant_step,
        determinant_gain,
        squared_determinant_gain,
        log_determinant,
        log_smallest_eigenvalue,
        log_trace,
    )
}
"""Rewards by the name that a preset gives them."""


def require_defined(reward: AnyReward, parameters: Sequence[str]) -> None:
    """Check that a reward is defined for these parameters.

    Raises:
        UsageError: it is defined for one parameter only.
    """
    if reward in ONE_PARAMETER and len(parameters) != 1:
        name = getattr(reward, "__name__", "the reward")
        raise UsageError(f"{name}: defined for one parameter, got {', '.join(parameters)}: choose another reward")
