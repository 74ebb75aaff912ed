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
for a model that does not fit is wrong by more than its deviations, by nobody knows how much. That stays so.

Plain scalar functions on one row of numbers, without allocation; compiled by :func:`emb_bench.compiled.compiled` they
are the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from emb_bench.information.symmetric import Floats, packed_index, packed_size
from emb_runtime.config.bench import PARAMETER_NAMES, Bench, Ranges
from emb_runtime.config.plants import EULER
from emb_runtime.errors import UsageError
from emb_train.structured.stiction import Accelerations, Passage, contact, passage

UNKNOWNS = 6
"""Angle, velocity and the four parameters."""
MOTION = 2
"""Of them are not parameters."""
STEP = 0
ANGLE = 1
VELOCITY = 2
PARAMETERS = 3
COVARIANCE = 7
"""Where a row of state has the last step seen, the angle [rad], the velocity [rad/s], the relative parameters, and
their packed covariance (see :mod:`emb_bench.information.symmetric`), the last two in the order of the unknowns."""
INNOVATION = COVARIANCE + packed_size(UNKNOWNS)
WORST = INNOVATION + 1
"""Where it has the running mean of the squared normalised innovations, and its greatest value so far."""
STATE = WORST + 1
"""Length of the row."""
MEMORY = 64.0
"""Samples that the running mean forgets in."""
MISFIT = 1.6
"""A running mean that noise does not reach: with the right model it came to 1.48 in one of 10,000 experiments."""
SLOPE = 0.8
"""tanh(SLOPE z) is within 0.03 of the mean sign of a Gaussian number with mean z and standard deviation 1."""
LEAST_VARIANCE = 1e-12
"""Of a velocity, where it is divided by its standard deviation [rad²/s²]."""
COHERENCE = 10.0
"""What the terms of second order add to the variance in one sample is added so many times: their error is not a new one
in each sample, it lasts until what is uncertain is found."""
STOP_VARIANCE = 1e-9
CONTACT_VARIANCE = 1e-8
"""What the series leaves out where the brake stops, of its angle, and where contact is made or left, of its velocity
[rad², rad²/s²]."""

Four = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]


class Model(NamedTuple):
    """What the filter knows beforehand; floats only. Four numbers are of k_m, k_1, T_c and f_v, in this order."""

    sample_time: float
    """t_s [s]."""
    sticks: bool
    """Whether the brake is solved within a period, and sticks; else it is stepped by forward Euler."""
    motor: float
    """k_m/J of the nominal brake [rad/(s²·A)]."""
    spring: float
    """γ k_1/J [1/s²]."""
    coulomb: float
    """T_c/J [rad/s²]."""
    viscous: float
    """f_v/J [1/s]."""
    low: Four
    """Least relative parameters."""
    high: Four
    """Greatest."""
    angle_variance: float
    """Of a measured angle [rad²]."""
    velocity_variance: float
    """Of a measured velocity [rad²/s²]."""
    start_angle_variance: float
    """Of the angle before the first sample: anywhere at home [rad²]."""
    start_velocity_variance: float
    """Of the velocity [rad²/s²]."""
    lost: float
    """By how much the velocity is uncertain after a period with an unknown current [rad/s]."""
    current: float
    """Limit, both signs [A]."""


def make_model(bench: Bench, ranges: Ranges, plant: str) -> Model:
    """What the filter knows on this bench.

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
    state[COVARIANCE + packed_index(UNKNOWNS, 1, 1)] = model.start_velocity_variance
    for i, (low, high) in enumerate(zip(model.low, model.high, strict=True)):
        state[PARAMETERS + i] = 0.5 * (low + high)
        state[COVARIANCE + packed_index(UNKNOWNS, MOTION + i, MOTION + i)] = (high - low) ** 2 / 12.0
    return state


def direction(state: Any) -> float:
    """Mean of the sign of the velocity, −1..1."""
    variance = max(state[COVARIANCE + packed_index(UNKNOWNS, 1, 1)], LEAST_VARIANCE)
    return math.tanh(SLOPE * state[VELOCITY] / math.sqrt(variance))


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


def predict(model: Model, state: Any, periods: float, applied: float) -> None:
    """Go on by a number of periods, in place; by none if that is negative.

    Args:
        model: from :func:`make_model`.
        state: shape [STATE].
        periods: since the last sample.
        applied: the current in the last of them [A].
    """
    if model.sticks:
        predict_sticking(model, state, periods, applied)
        return
    t = max(periods, 0.0) * model.sample_time
    x, v = state[ANGLE], state[VELOCITY]
    km, k1, tc, fv = state[PARAMETERS], state[PARAMETERS + 1], state[PARAMETERS + 2], state[PARAMETERS + 3]
    s = direction(state)
    squeezed = max(x, 0.0)
    # Derivatives of the acceleration to the six unknowns.
    slopes = (
        -model.spring * k1 if x >= 0.0 else 0.0,
        -model.viscous * fv,
        model.motor * applied,
        -model.spring * squeezed,
        -model.coulomb * s,
        -model.viscous * v,
    )
    a = slopes[2] * km + slopes[3] * k1 + slopes[4] * tc + slopes[5] * fv
    state[ANGLE] = x + t * v
    state[VELOCITY] = v + t * a
    # P' = F P Fᵀ: F moves angle and velocity and leaves the parameters as they are.
    pushed = (
        _pushed(state, slopes, 0),
        _pushed(state, slopes, 1),
        _pushed(state, slopes, 2),
        _pushed(state, slopes, 3),
        _pushed(state, slopes, 4),
        _pushed(state, slopes, 5),
    )
    along_angle, along_velocity = 0.0, 0.0
    for j in range(UNKNOWNS):
        to_angle, to_velocity = _element(state, 0, j), _element(state, 1, j)
        along_angle += slopes[j] * (to_angle + t * to_velocity)
        along_velocity += slopes[j] * (to_velocity + t * pushed[j])
    p00, p01, p11 = _element(state, 0, 0), _element(state, 0, 1), _element(state, 1, 1)
    angle_0, angle_1 = p00 + t * p01, p01 + t * p11
    for j in range(MOTION, UNKNOWNS):
        to_angle, to_velocity = _element(state, 0, j), _element(state, 1, j)
        state[COVARIANCE + packed_index(UNKNOWNS, 0, j)] = to_angle + t * to_velocity
        state[COVARIANCE + packed_index(UNKNOWNS, 1, j)] = to_velocity + t * pushed[j]
    lost = max(periods - 1.0, 0.0) * model.lost
    turning = (t * model.coulomb * tc) ** 2 * (1.0 - s * s)
    unsure = turning + lost * lost
    state[COVARIANCE] = angle_0 + t * angle_1 + (t * lost) ** 2
    state[COVARIANCE + 1] = angle_1 + t * along_angle
    state[COVARIANCE + packed_index(UNKNOWNS, 1, 1)] = p11 + t * pushed[1] + t * along_velocity + unsure


def predict_sticking(model: Model, state: Any, periods: float, applied: float) -> None:
    """The same for a brake that stops and sticks."""
    if periods <= 0.0:
        return
    t = periods * model.sample_time
    x, v = state[ANGLE], state[VELOCITY]
    km, k1, tc, fv = state[PARAMETERS], state[PARAMETERS + 1], state[PARAMETERS + 2], state[PARAMETERS + 3]
    squeezed, driving = max(x, 0.0), model.motor * applied
    now = Accelerations(
        driving * km - model.spring * k1 * squeezed, model.coulomb * tc, model.viscous * fv, model.spring * k1
    )
    begun = (-now.spring if x >= 0.0 else 0.0, -now.damping, driving, -model.spring * squeezed, 0.0, -model.viscous * v)
    p11, by_friction = _element(state, 1, 1), t * model.coulomb
    # Variances of the velocity after sliding, by the motion and by friction, and twice their covariance.
    sliding, common = p11 + by_friction * by_friction * _element(state, 4, 4), _element(state, 1, 4)
    for j in range(UNKNOWNS):
        sliding += t * begun[j] * (2.0 * _element(state, 1, j) + t * _pushed(state, begun, j))
        common += t * begun[j] * _element(state, 4, j)
    common *= 2.0 * by_friction if now.pull >= 0.0 else -2.0 * by_friction
    ahead = passage(
        now,
        x,
        v,
        t,
        math.sqrt(max(p11, LEAST_VARIANCE)),
        math.sqrt(max(sliding + common, LEAST_VARIANCE)),
        math.sqrt(max(sliding - common, LEAST_VARIANCE)),
    )
    share, to_velocity, to_angle = contact(x, ahead.angle, t, v, ahead.velocity)
    drifting, softening = model.viscous * _element(state, 1, 5), model.spring * share * _element(state, 0, 3)
    doubtful = drifting * drifting + model.viscous * model.viscous * p11 * _element(state, 5, 5)
    doubtful += softening * softening
    doubtful += (model.spring * share) ** 2 * _element(state, 0, 0) * _element(state, 3, 3)
    lost = max(periods - 1.0, 0.0) * model.lost
    unsure = COHERENCE * t * t * doubtful + ahead.kinked
    crossed = CONTACT_VARIANCE if 0.0 < share < 1.0 else 0.0
    _spread(
        state,
        angle_slopes(model, now, ahead, share, driving, to_angle, v),
        velocity_slopes(model, now, ahead, share, driving, to_velocity, v, t),
    )
    state[COVARIANCE] += 0.25 * t * t * unsure + (t * lost) ** 2 + ahead.stopped * STOP_VARIANCE
    state[COVARIANCE + 1] += 0.5 * t * unsure
    state[COVARIANCE + packed_index(UNKNOWNS, 1, 1)] += unsure + lost * lost + crossed
    state[ANGLE] = ahead.angle - 0.5 * t * t * (drifting + softening)
    state[VELOCITY] = ahead.velocity - t * (drifting + softening)


def angle_slopes(
    model: Model, now: Accelerations, ahead: Passage, share: float, driving: float, squeezed: float, v: float
) -> Six:
    """Derivatives of the angle at the end of a period to the six unknowns at its start."""
    by_pull = ahead.angle_by_pull
    return (
        1.0 - by_pull * now.spring * share,
        ahead.angle_by_velocity - by_pull * now.damping,
        by_pull * driving,
        -by_pull * model.spring * squeezed,
        ahead.angle_by_friction * model.coulomb,
        -by_pull * model.viscous * (2.0 * v + ahead.velocity) / 3.0,
    )


def velocity_slopes(
    model: Model, now: Accelerations, ahead: Passage, share: float, driving: float, squeezed: float, v: float, t: float
) -> Six:
    """The same of the velocity."""
    by_pull = ahead.velocity_by_pull
    return (
        -by_pull * now.spring * share,
        ahead.velocity_by_velocity * (1.0 - 0.5 * t * t * now.spring * share) - by_pull * now.damping,
        by_pull * driving,
        -by_pull * model.spring * squeezed,
        ahead.velocity_by_friction * model.coulomb,
        -by_pull * model.viscous * (v + ahead.velocity) / 2.0,
    )


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
    state[COVARIANCE + packed_index(UNKNOWNS, 1, 1)] = p11
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
