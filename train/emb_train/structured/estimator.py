"""A running estimate of a brake: an extended Kalman filter of its motion and its four uncertain parameters.

The filter's state is the angle, the velocity, and k_m, k_1, T_c and f_v relative to their nominal values, which do not
change with time. It predicts with the brake of eq. 3.12-3.14 and the current that acted, and corrects with the angle
and the velocity measured, one after the other, which for independent noise is the same as both at once (Simon, Optimal
State Estimation, 2006, chapters 6 and 13).

**Friction where the direction of motion is uncertain.** For a velocity that is v ± σ, sign(v) has the mean
s ≈ tanh(0.8 v/σ) and the variance 1 − s². The mean goes into the prediction, the variance into that of the velocity:
a filter that trusted the sign of its own estimate would be wrong by 2 t_s T_c/J at each reversal, and sure of it.

**Ranges.** The filter's own parameters are free: to cut one off that noise has taken beyond its range, and leave those
that are correlated with it, would be a step that the covariance does not know of. What is *used* is cut off.

**Gaps.** Where samples were lost, what acted in between is not known: it is taken to be what the newest sample reports,
with an uncertainty of the current limit for each lost period.

**Stiction.** The above is how the forward-Euler brake goes, whose sign() never rests. A brake that is solved exactly
stops within a period and sticks: see :mod:`emb_train.structured.stiction`. There the filter is one of second order, for
where feedback has the estimate, a term of second order is one of the largest: f_v v with both uncertain, and as they
are correlated, the product has another mean (Gelb, Applied Optimal Estimation, 1974, chapter 6.1).

**Misfit.** If the model is right, the squares of the innovations, each over its variance, have the mean 1. A running
mean of them that noise does not reach says that it is not; then nothing that the filter has learned is to be believed,
for a model that does not fit is wrong by more than its deviations, by an unknown amount. That stays so.

Plain scalar functions on one row of numbers, without allocation; compiled by :func:`emb_bench.compiled.compiled` they
are the same. Those of the prediction, :func:`slid`, :func:`begin_slopes` and :func:`stuck`, have no branch: the
exported graph is made of them, see :mod:`emb_train.structured.columns`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from emb_bench.information.symmetric import Floats, packed_index, packed_size
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Ranges
from emb_runtime.config.plants import EULER
from emb_runtime.errors import UsageError
from emb_train.structured.columns import where
from emb_train.structured.stiction import Accelerations, contact, move

UNKNOWNS = 6  # Angle, velocity and the four parameters
MOTION = 2  # Of them are not parameters
STEP = 0
ANGLE = 1
VELOCITY = 2
PARAMETERS = 3
COVARIANCE = 7
"""Indices in a row of state of the last step seen, the angle [rad], the velocity [rad/s], the relative parameters, and
their packed covariance (see :mod:`emb_bench.information.symmetric`), the last two in the order of the unknowns."""
VELOCITY_VARIANCE = COVARIANCE + packed_index(UNKNOWNS, 1, 1)  # Index in it of the variance of the velocity [rad²/s²]
INNOVATION = COVARIANCE + packed_size(UNKNOWNS)
WORST = INNOVATION + 1
"""Indices in it of the running mean of the squared normalised innovations, and of its greatest value so far."""
STATE = WORST + 1  # Length of the row
MEMORY = 64.0  # Samples that the running mean forgets in
MISFIT = 1.6
"""A running mean that noise does not reach: with the right model it came to 1.48 in one of 10,000 experiments."""
SLOPE = 0.8  # tanh(SLOPE z) is within 0.03 of the mean sign of a Gaussian number with mean z and standard deviation 1
LEAST_VARIANCE = 1e-12  # Of a velocity, where it is divided by its standard deviation [rad²/s²]
COHERENCE = 10.0
"""Factor on the variance that the terms of second order add in one sample: their error is not a new one
in each sample, it lasts until what is uncertain is found."""
STOP_VARIANCE = 1e-9
CONTACT_VARIANCE = 1e-8
"""Variance that the series leaves out: of the angle where the brake stops, of the velocity where contact changes
[rad², rad²/s²]."""

Four = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]


class Model(NamedTuple):
    """Prior knowledge of the filter; floats only. Four numbers are of k_m, k_1, T_c and f_v, in this order."""

    sample_time: float  # t_s [s]
    sticks: bool  # True if the brake is solved within a period, and sticks; else it is stepped by forward Euler
    motor: float  # k_m/J of the nominal brake [rad/(s²·A)]
    spring: float  # γ k_1/J [1/s²]
    coulomb: float  # T_c/J [rad/s²]
    viscous: float  # f_v/J [1/s]
    low: Four  # Least relative parameters
    high: Four  # Greatest
    angle_variance: float  # Of a measured angle [rad²]
    velocity_variance: float  # Of a measured velocity [rad²/s²]
    start_angle_variance: float  # Of the angle before the first sample: anywhere at home [rad²]
    start_velocity_variance: float  # Of the velocity [rad²/s²]
    lost: float  # Uncertainty of the velocity after a period with an unknown current [rad/s]
    current: float  # Limit, both signs [A]


def make_model(bench: Bench, ranges: Ranges, plant: str) -> Model:
    """Prior knowledge of the filter on this bench.

    Args:
        bench: nominal brake, noise, timing, limits, what counts as home.
        ranges: where the parameters lie; each is taken to be uniform there, ±50 % have the variance 1/12.
        plant: what the brake is; the bench's plants.

    Raises:
        BenchFileError: the bench has no such plant.
        UsageError: J or γ vary in these ranges.
    """
    brake, t_s = bench.brake, bench.timing.sample_time
    for name in ("J", "gamma"):
        if not getattr(ranges.low, name) == getattr(ranges.high, name) == getattr(brake, name):
            raise UsageError(f"the estimator takes {name} as known, the set of ranges '{ranges.name}' varies it")
    low, high = (
        tuple(getattr(end, n) / getattr(brake, n) for n in PARAMETER_NAMES) for end in (ranges.low, ranges.high)
    )
    return Model(
        sample_time=t_s,
        sticks=bench.plant(plant).mechanics.solver != EULER,
        motor=brake.k_m / brake.J,
        spring=brake.gamma * brake.k_1 / brake.J,
        coulomb=brake.T_c / brake.J,
        viscous=brake.f_v / brake.J,
        low=(low[0], low[1], low[2], low[3]),
        high=(high[0], high[1], high[2], high[3]),
        angle_variance=bench.noise.angle**2,
        velocity_variance=bench.noise.velocity**2,
        start_angle_variance=bench.shield.home_angle**2,
        start_velocity_variance=bench.shield.home_velocity**2,
        lost=t_s * ranges.high.k_m / brake.J * bench.limits.current,
        current=bench.limits.current,
    )


def start(model: Model) -> Floats:
    """The state before the first sample: at home, parameters in the middle of their ranges, shape [STATE]."""
    state = np.zeros(STATE)
    state[INNOVATION], state[WORST] = 1.0, 1.0
    state[COVARIANCE + packed_index(UNKNOWNS, 0, 0)] = model.start_angle_variance
    state[VELOCITY_VARIANCE] = model.start_velocity_variance
    for i, (low, high) in enumerate(zip(model.low, model.high, strict=True)):
        state[PARAMETERS + i] = 0.5 * (low + high)
        state[COVARIANCE + packed_index(UNKNOWNS, MOTION + i, MOTION + i)] = (high - low) ** 2 / 12.0
    return state


def direction(v: float, variance: float) -> float:
    """Mean of the sign of a velocity ``v`` [rad/s] that is known to this variance, −1..1."""
    return math.tanh(SLOPE * v / math.sqrt(max(variance, LEAST_VARIANCE)))


def follow(model: Model, state: Any, angle: float, velocity: float, step: float, applied: float) -> None:
    """Take in one sample, in place.

    Args:
        model: from :func:`make_model`.
        state: shape [STATE], from :func:`start` or after the samples before.
        angle: measured [rad].
        velocity: measured [rad/s].
        step: of the sample; where it does not follow the last one, samples were lost.
        applied: the current that acted in the period that ends at the sample [A].
    """
    predict(model, state, step - state[STEP], applied)
    state[STEP] = step
    squares = correct(state, 0, angle, model.angle_variance) + correct(state, 1, velocity, model.velocity_variance)
    state[INNOVATION] += (0.5 * squares - state[INNOVATION]) / MEMORY
    state[WORST] = max(state[WORST], state[INNOVATION])


def believed(model: Model, state: Any, i: int) -> float:
    """Relative parameter ``i`` as far as it is in its range."""
    return float(min(max(state[PARAMETERS + i], model.low[i]), model.high[i]))


def deviation(model: Model, state: Any, i: int) -> float:
    """Standard deviation of relative parameter ``i``, at least by how far the filter would have it beyond its range."""
    where = COVARIANCE + packed_index(UNKNOWNS, MOTION + i, MOTION + i)
    return float(max(math.sqrt(max(state[where], 0.0)), abs(state[PARAMETERS + i] - believed(model, state, i))))


class Prediction(NamedTuple):
    """Prediction of one sample from the one before."""

    angle: float
    velocity: float
    angle_slopes: Six  # Derivatives of the angle to the six unknowns at the sample before
    velocity_slopes: Six  # Derivatives of the velocity to them
    angle_noise: float  # Noise of the prediction, which is added to the variance of the angle,
    common_noise: float  # to its covariance with the velocity,
    velocity_noise: float  # and to the variance of the velocity


def predict(model: Model, state: Any, periods: float, applied: float) -> None:
    """Go on by a number of periods, in place; by none if that is negative.

    Args:
        model: from :func:`make_model`.
        state: shape [STATE].
        periods: since the last sample.
        applied: the current in the last of them [A].
    """
    if periods <= 0.0:
        return
    t, lost = periods * model.sample_time, max(periods - 1.0, 0.0) * model.lost
    x, v = state[ANGLE], state[VELOCITY]
    parameters = (state[PARAMETERS], state[PARAMETERS + 1], state[PARAMETERS + 2], state[PARAMETERS + 3])
    if not model.sticks:
        toward = direction(v, state[VELOCITY_VARIANCE])
        _go_on(state, slid(model, x, v, parameters, applied, toward, t, lost))
        return
    begun = begin_slopes(model, x, v, parameters, applied)
    by_friction = t * model.coulomb
    p00, p11, p03 = _element(state, 0, 0), _element(state, 1, 1), _element(state, 0, 3)
    p33, p15, p55 = _element(state, 3, 3), _element(state, 1, 5), _element(state, 5, 5)
    sliding, common = p11 + by_friction * by_friction * _element(state, 4, 4), _element(state, 1, 4)
    for j in range(UNKNOWNS):
        sliding += t * begun[j] * (2.0 * _element(state, 1, j) + t * _pushed(state, begun, j))
        common += t * begun[j] * _element(state, 4, j)
    common *= by_friction
    elements = (p00, p11, p03, p33, p15, p55)
    _go_on(state, stuck(model, x, v, parameters, applied, t, lost, elements, sliding, common))


def slid(
    model: Model, x: float, v: float, parameters: Four, applied: float, toward: float, t: float, lost: float
) -> Prediction:
    """A step of forward Euler, as the brake with sign() moves.

    Args:
        model: from :func:`make_model`.
        x: angle [rad].
        v: velocity [rad/s].
        parameters: relative.
        applied: current [A].
        toward: mean of the sign of the velocity.
        t: duration [s].
        lost: by how much the velocity is uncertain because samples were lost [rad/s].
    """
    km, k1, tc, fv = parameters
    squeezed, by_motor = max(x, 0.0), model.motor * applied
    by_spring, by_friction, by_damping = -model.spring * squeezed, -model.coulomb * toward, -model.viscous * v
    a = by_motor * km + by_spring * k1 + by_friction * tc + by_damping * fv
    touching = where(x >= 0.0, -model.spring * k1, 0.0)
    turning, missed = t * model.coulomb * tc, t * lost
    return Prediction(
        x + t * v,
        v + t * a,
        (1.0, t, 0.0, 0.0, 0.0, 0.0),
        (
            t * touching,
            1.0 - t * model.viscous * fv,
            t * by_motor,
            t * by_spring,
            t * by_friction,
            t * by_damping,
        ),
        missed * missed,
        0.0,
        turning * turning * (1.0 - toward * toward) + lost * lost,
    )


def begin_slopes(model: Model, x: float, v: float, parameters: Four, applied: float) -> Six:
    """Derivatives of the acceleration without friction to the six unknowns, at the start of a period."""
    _, k1, _, fv = parameters
    return (
        where(x >= 0.0, -model.spring * k1, 0.0),
        -model.viscous * fv,
        model.motor * applied,
        -model.spring * max(x, 0.0),
        0.0,
        -model.viscous * v,
    )


def stuck(
    model: Model,
    x: float,
    v: float,
    parameters: Four,
    applied: float,
    t: float,
    lost: float,
    elements: Six,
    sliding: float,
    common: float,
) -> Prediction:
    """A period of a brake that stops and sticks.

    Args:
        model: this and what follows, up to ``lost``, as for :func:`slid`.
        x: angle [rad].
        v: velocity [rad/s].
        parameters: relative.
        applied: current [A].
        t: duration [s].
        lost: uncertainty of the velocity after lost samples [rad/s].
        elements: of the covariance: of the unknowns 0 and 0, 1 and 1, 0 and 3, 3 and 3, 1 and 5, 5 and 5.
        sliding: variance of the velocity after sliding, by the motion and by friction.
        common: covariance of the two.
    """
    km, k1, tc, fv = parameters
    p00, p11, p03, p33, p15, p55 = elements
    driving = model.motor * applied
    spring, damping = model.spring * k1, model.viscous * fv
    now = Accelerations(driving * km - spring * max(x, 0.0), model.coulomb * tc, damping, spring)
    shared = where(now.pull >= 0.0, 2.0 * common, -2.0 * common)
    ahead = move(
        now,
        x,
        v,
        t,
        math.sqrt(max(p11, LEAST_VARIANCE)),
        math.sqrt(max(sliding + shared, LEAST_VARIANCE)),
        math.sqrt(max(sliding - shared, LEAST_VARIANCE)),
    )
    share, to_velocity, to_angle = contact(x, ahead.angle, t, v, ahead.velocity)
    stiff = model.spring * share
    drifting, softening = model.viscous * p15, stiff * p03
    doubtful = drifting * drifting + model.viscous * model.viscous * p11 * p55
    doubtful = doubtful + softening * softening + stiff * stiff * p00 * p33
    half_square, bias = 0.5 * t * t, drifting + softening
    unsure = 2.0 * COHERENCE * (half_square * doubtful) + ahead.kinked
    crossed = where((share > 0.0) & (share < 1.0), CONTACT_VARIANCE, 0.0)
    missed, touched, sums = t * lost, spring * share, v + ahead.velocity
    by_angle, by_velocity = ahead.angle_by_pull, ahead.velocity_by_pull
    return Prediction(
        ahead.angle - half_square * bias,
        ahead.velocity - t * bias,
        (
            1.0 - by_angle * touched,
            ahead.angle_by_velocity - by_angle * damping,
            by_angle * driving,
            by_angle * (-model.spring * to_angle),
            ahead.angle_by_friction * model.coulomb,
            by_angle * (-model.viscous / 3.0 * (v + sums)),
        ),
        (
            -by_velocity * touched,
            ahead.velocity_by_velocity * (1.0 - half_square * touched) - by_velocity * damping,
            by_velocity * driving,
            by_velocity * (-model.spring * to_velocity),
            ahead.velocity_by_friction * model.coulomb,
            by_velocity * (-0.5 * model.viscous * sums),
        ),
        0.5 * (half_square * unsure) + missed * missed + ahead.stopped * STOP_VARIANCE,
        0.5 * t * unsure,
        unsure + lost * lost + crossed,
    )


def _go_on(state: Any, to: Prediction) -> None:
    """Put a prediction into the state: its mean, and P' = F P Fᵀ with its noise."""
    state[ANGLE], state[VELOCITY] = to.angle, to.velocity
    _spread(state, to.angle_slopes, to.velocity_slopes)
    state[COVARIANCE] += to.angle_noise
    state[COVARIANCE + 1] += to.common_noise
    state[VELOCITY_VARIANCE] += to.velocity_noise


def _spread(state: Any, angle: Six, velocity: Six) -> None:
    """P' = F P Fᵀ where only the rows of angle and velocity are not those of the unit matrix."""
    angles = (
        _pushed(state, angle, 0),
        _pushed(state, angle, 1),
        _pushed(state, angle, 2),
        _pushed(state, angle, 3),
        _pushed(state, angle, 4),
        _pushed(state, angle, 5),
    )
    velocities = (
        _pushed(state, velocity, 0),
        _pushed(state, velocity, 1),
        _pushed(state, velocity, 2),
        _pushed(state, velocity, 3),
        _pushed(state, velocity, 4),
        _pushed(state, velocity, 5),
    )
    p00, p01, p11 = 0.0, 0.0, 0.0
    for j in range(UNKNOWNS):
        p00 += angle[j] * angles[j]
        p01 += angle[j] * velocities[j]
        p11 += velocity[j] * velocities[j]
    state[COVARIANCE], state[COVARIANCE + 1] = p00, p01
    state[VELOCITY_VARIANCE] = p11
    for j in range(MOTION, UNKNOWNS):
        state[COVARIANCE + packed_index(UNKNOWNS, 0, j)] = angles[j]
        state[COVARIANCE + packed_index(UNKNOWNS, 1, j)] = velocities[j]


def correct(state: Any, i: int, value: float, variance: float) -> float:
    """Take in a measurement of the unknown ``i``, 0 for the angle and 1 for the velocity, in place.

    Args:
        state: shape [STATE].
        i: which.
        value: measured.
        variance: of its noise.

    Returns:
        The square of the innovation over its variance; 1 is its mean if the model is right.
    """
    row = (
        _element(state, i, 0),
        _element(state, i, 1),
        _element(state, i, 2),
        _element(state, i, 3),
        _element(state, i, 4),
        _element(state, i, 5),
    )
    innovation = value - state[ANGLE + i]
    surprise = innovation / (row[i] + variance)
    position = COVARIANCE
    for j in range(UNKNOWNS):
        state[ANGLE + j] += row[j] * surprise
        gain = row[j] / (row[i] + variance)
        for k in range(j, UNKNOWNS):
            state[position] -= gain * row[k]
            position += 1
    return float(innovation * surprise)


def _element(state: Any, i: int, j: int) -> float:
    """Of the covariance."""
    return float(state[COVARIANCE + packed_index(UNKNOWNS, min(i, j), max(i, j))])


def _pushed(state: Any, slopes: Six, j: int) -> float:
    """Covariance of what these are the derivatives of with the unknown ``j``."""
    total = 0.0
    for k in range(UNKNOWNS):
        total += slopes[k] * _element(state, k, j)
    return total
