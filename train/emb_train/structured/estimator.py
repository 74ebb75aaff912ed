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

Plain scalar functions on one row of numbers, without allocation; compiled by :func:`emb_bench.compiled.compiled` they
are the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from emb_bench.packed import Floats, packed_index, packed_size
from emb_runtime.bench import PARAMETER_NAMES, Bench, Ranges
from emb_runtime.errors import UsageError
from emb_runtime.plants import EULER

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
their packed covariance (see :mod:`emb_bench.packed`), the last two in the order of the unknowns."""
STATE = COVARIANCE + packed_size(UNKNOWNS)
"""Length of the row."""
SLOPE = 0.8
"""tanh(SLOPE z) is within 0.03 of the mean sign of a Gaussian number with mean z and standard deviation 1."""
LEAST_VARIANCE = 1e-12
"""Of a velocity, where it is divided by its standard deviation [rad²/s²]."""

Four = tuple[float, float, float, float]


class Model(NamedTuple):
    """What the filter knows beforehand; floats only. Four numbers are of k_m, k_1, T_c and f_v, in this order."""

    sample_time: float
    """t_s [s]."""
    within: float
    """Share of t_s² by which an acceleration moves the angle within its own period: 0 under Euler, else 1/2."""
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
        within=0.0 if bench.plant(plant).mechanics.solver == EULER else 0.5,
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
    correct(state, 0, angle, model.angle_variance)
    correct(state, 1, velocity, model.velocity_variance)


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
    h = model.within * t * t
    state[ANGLE] = x + t * v + h * a
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
        along_angle += slopes[j] * (to_angle + t * to_velocity + h * pushed[j])
        along_velocity += slopes[j] * (to_velocity + t * pushed[j])
    p00, p01, p11 = _element(state, 0, 0), _element(state, 0, 1), _element(state, 1, 1)
    angle_0, angle_1 = p00 + t * p01 + h * pushed[0], p01 + t * p11 + h * pushed[1]
    for j in range(MOTION, UNKNOWNS):
        to_angle, to_velocity = _element(state, 0, j), _element(state, 1, j)
        state[COVARIANCE + packed_index(UNKNOWNS, 0, j)] = to_angle + t * to_velocity + h * pushed[j]
        state[COVARIANCE + packed_index(UNKNOWNS, 1, j)] = to_velocity + t * pushed[j]
    lost = max(periods - 1.0, 0.0) * model.lost
    turning = (t * model.coulomb * tc) ** 2 * (1.0 - s * s)
    unsure = turning + lost * lost
    state[COVARIANCE] = angle_0 + t * angle_1 + h * along_angle + (t * lost) ** 2 + (model.within * t) ** 2 * turning
    state[COVARIANCE + 1] = angle_1 + t * along_angle
    state[COVARIANCE + packed_index(UNKNOWNS, 1, 1)] = p11 + t * pushed[1] + t * along_velocity + unsure


def correct(state: Any, i: int, value: float, variance: float) -> None:
    """Take in a measurement of the unknown ``i``, 0 for the angle and 1 for the velocity, in place.

    Args:
        state: shape [STATE].
        i: which.
        value: measured.
        variance: of its noise.
    """
    row = (
        _element(state, i, 0),
        _element(state, i, 1),
        _element(state, i, 2),
        _element(state, i, 3),
        _element(state, i, 4),
        _element(state, i, 5),
    )
    surprise = (value - state[ANGLE + i]) / (row[i] + variance)
    position = COVARIANCE
    for j in range(UNKNOWNS):
        state[ANGLE + j] += row[j] * surprise
        gain = row[j] / (row[i] + variance)
        for k in range(j, UNKNOWNS):
            state[position] -= gain * row[k]
            position += 1


def _element(state: Any, i: int, j: int) -> float:
    """Of the covariance."""
    return float(state[COVARIANCE + packed_index(UNKNOWNS, min(i, j), max(i, j))])


def _pushed(state: Any, slopes: tuple[float, float, float, float, float, float], j: int) -> float:
    """Covariance of the acceleration with the unknown ``j``."""
    total = 0.0
    for k in range(UNKNOWNS):
        total += slopes[k] * _element(state, k, j)
    return total
