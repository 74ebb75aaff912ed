"""Extended Kalman filter of a brake: angle, velocity, and k_m, k_1, T_c and f_v relative to their nominal values.

It predicts with the brake of eq. 3.12-3.14 and the current that acted, and corrects with the measured angle and then
with the velocity, which for independent noise is the joint correction (Simon, Optimal State Estimation, 2006, chapters
6 and 13). The velocity of an observer is a function of the angles and no measurement: there the angle alone corrects.
The parameters are constant. docs/explanation/runtime.md has the reason for each of the following.

- **Ranges.** The filter's parameters are not bounded: values are cut off at their ranges where they are used.
- **Gaps.** The current in lost periods is the newest reported one, with an uncertainty of the current limit for each.
- **Stiction.** The brake stops and sticks within a period, see :mod:`emb_runtime.estimator.stick_slip`.
- **Second order.** f_v v and k_1 x have another mean where both factors are uncertain and correlated (Gelb, Applied
  Optimal Estimation, 1974, chapter 6.1).
- **Misfit.** If the model is right, the normalised squares of the innovations have the mean 1. Once their running mean
  exceeds :data:`MISFIT`, the deviations are those of the prior, to the end of the run.

Scalar functions of floats and tuples: the loop runs them as they are, the compiled core by mypyc, the batch by numba,
with the same bits.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from emb_runtime.config.bench import PARAMETER_NAMES, Bench, BrakeParameters, Ranges
from emb_runtime.estimator.stick_slip import Accelerations, contact, move

MEMORY: Final = 128.0  # Memory of the running mean of the squared innovations, of which a sample has one or two
MISFIT: Final = 1.6  # The right model reached a running mean of 1.48 in one of 10,000 experiments
LEAST_VARIANCE: Final = 1e-12  # Of a velocity, where it is divided by its standard deviation [rad²/s²]
COHERENCE: Final = 10.0
"""Factor on the variance that the terms of second order add in one sample: their error lasts for many samples."""
STOP_VARIANCE: Final = 1e-9  # Error of the series where the brake stops [rad²]
CONTACT_VARIANCE: Final = 1e-8  # Error of the series where contact changes [rad²/s²]

Four = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]
Packed = tuple[
    float, float, float, float, float, float,
    float, float, float, float, float,
    float, float, float, float,
    float, float, float,
    float, float,
    float,
]  # fmt: skip
"""Symmetric matrix of 6 × 6: the rows of its upper triangle one after the other."""


class Model(NamedTuple):
    """Prior knowledge of the filter. Four numbers are of k_m, k_1, T_c and f_v, in this order."""

    sample_time: float  # t_s [s]
    nominal: Four  # Nominal parameters, SI units
    motor: float  # k_m/J of the nominal brake [rad/(s²·A)]
    spring: float  # γ k_1/J [1/s²]
    coulomb: float  # T_c/J [rad/s²]
    viscous: float  # f_v/J [1/s]
    low: Four  # Least relative parameters
    high: Four  # Greatest
    angle_variance: float  # Of a measured angle [rad²]
    velocity_variance: float  # Of a measured velocity [rad²/s²]
    derived: bool  # True if the velocity is an observer's, which derives it from the angle
    start_angle_variance: float  # Of the angle before the first sample: anywhere at home [rad²]
    start_velocity_variance: float  # Of the velocity [rad²/s²]
    lost: float  # Uncertainty of the velocity after a period with an unknown current [rad/s]
    current: float  # Limit, both signs [A]


class State(NamedTuple):
    """Estimate after a sample. The six unknowns are angle [rad], velocity [rad/s], and the relative parameters."""

    step: float  # Of the sample
    mean: Six
    covariance: Packed
    innovation: float  # Running mean of the squared normalised innovations
    worst: float  # Its greatest value so far


def make_model(bench: Bench, ranges: Ranges) -> Model:
    """Prior knowledge of the filter on a bench. J and γ have their nominal values.

    The other parameters are taken to be uniform in their ranges: ±50 % have the variance 1/12.
    """
    brake, t_s = bench.brake, bench.timing.sample_time
    return Model(
        sample_time=t_s,
        nominal=(brake.k_m, brake.k_1, brake.T_c, brake.f_v),
        motor=brake.k_m / brake.J,
        spring=brake.gamma * brake.k_1 / brake.J,
        coulomb=brake.T_c / brake.J,
        viscous=brake.f_v / brake.J,
        low=relative(bench, ranges.low),
        high=relative(bench, ranges.high),
        angle_variance=bench.noise.angle**2,
        velocity_variance=bench.noise.velocity**2,
        derived=bench.sensors.velocity == "observer",
        start_angle_variance=bench.shield.home_angle**2,
        start_velocity_variance=bench.shield.home_velocity**2,
        lost=t_s * ranges.high.k_m / brake.J * bench.limits.current,
        current=bench.limits.current,
    )


def relative(bench: Bench, brake: BrakeParameters) -> Four:
    """k_m, k_1, T_c and f_v of a brake relative to the nominal one."""
    k_m, k_1, t_c, f_v = (getattr(brake, name) / getattr(bench.brake, name) for name in PARAMETER_NAMES)
    return k_m, k_1, t_c, f_v


def initial_state(model: Model) -> State:
    """Estimate before the first sample: at home, parameters in the middle of their ranges."""
    (l2, l3, l4, l5), (h2, h3, h4, h5) = model.low, model.high
    return State(
        0.0,
        (0.0, 0.0, 0.5 * (l2 + h2), 0.5 * (l3 + h3), 0.5 * (l4 + h4), 0.5 * (l5 + h5)),
        (
            model.start_angle_variance, 0.0, 0.0, 0.0, 0.0, 0.0,
            model.start_velocity_variance, 0.0, 0.0, 0.0, 0.0,
            (h2 - l2) ** 2 / 12.0, 0.0, 0.0, 0.0,
            (h3 - l3) ** 2 / 12.0, 0.0, 0.0,
            (h4 - l4) ** 2 / 12.0, 0.0,
            (h5 - l5) ** 2 / 12.0,
        ),
        1.0,
        1.0,
    )  # fmt: skip


def follow(model: Model, state: State, angle: float, velocity: float, step: float, applied: float) -> State:
    """Estimate with one more sample, measured [rad, rad/s]; an observer's velocity is not used.

    Samples were lost where its ``step`` does not follow the last one. The current ``applied`` acted in the period that
    ends at the sample [A].
    """
    mean, p = predict(model, state, step - state.step, applied)
    row = p[0], p[1], p[2], p[3], p[4], p[5]
    mean, p, square = _correct(mean, p, row, angle - mean[0], row[0] + model.angle_variance)
    samples = MEMORY
    if not model.derived:
        row = p[1], p[6], p[7], p[8], p[9], p[10]
        mean, p, other = _correct(mean, p, row, velocity - mean[1], row[1] + model.velocity_variance)
        square, samples = 0.5 * (square + other), 0.5 * MEMORY
    innovation = state.innovation + (square - state.innovation) / samples
    worst = state.worst
    return State(step, mean, p, innovation, innovation if innovation > worst else worst)


def predict(model: Model, state: State, periods: float, applied: float) -> tuple[Six, Packed]:
    """Mean and covariance after a number of periods, the last of them with the current ``applied`` [A].

    They are unchanged if there are none.
    """
    mean, p = state.mean, state.covariance
    if periods <= 0.0:
        return mean, p
    by_k1, by_tc, by_fv = model.spring, model.coulomb, model.viscous
    t, lost = periods * model.sample_time, max(periods - 1.0, 0.0) * model.lost
    x, v, km, k1, tc, fv = mean
    p00, p01, _, p03, p04, _, p11, p12, p13, p14, p15, _, _, p24, _, p33, p34, _, p44, p45, p55 = p
    driving, by_friction, pressed = model.motor * applied, t * by_tc, 0.0 if x < 0.0 else x
    spring, damping = by_k1 * k1, by_fv * fv
    pull = driving * km - spring * pressed
    # Variance of the velocity after sliding, by the motion and by friction, and the covariance of these two parts.
    b0, b1, b2 = -spring if x >= 0.0 else 0.0, -damping, driving
    b3, b5 = -by_k1 * pressed, -by_fv * v
    c0, c1, c2, c3, _, c5 = _product(p, (b0, b1, b2, b3, 0.0, b5))
    sliding = p11 + by_friction * by_friction * p44
    sliding += t * b0 * (2.0 * p01 + t * c0)
    sliding += t * b1 * (2.0 * p11 + t * c1)
    sliding += t * b2 * (2.0 * p12 + t * c2)
    sliding += t * b3 * (2.0 * p13 + t * c3)
    sliding += t * b5 * (2.0 * p15 + t * c5)
    common = p14 + t * b0 * p04 + t * b1 * p14 + t * b2 * p24 + t * b3 * p34 + t * b5 * p45
    common *= by_friction
    shared = 2.0 * common if pull >= 0.0 else -2.0 * common
    against, along = sliding + shared, sliding - shared
    x1, v1, x_by_v, x_by_pull, x_by_tc, v_by_v, v_by_pull, v_by_tc, stopped, kinked = move(
        Accelerations(pull, by_tc * tc, damping, spring),
        x,
        v,
        t,
        math.sqrt(LEAST_VARIANCE if p11 < LEAST_VARIANCE else p11),
        math.sqrt(LEAST_VARIANCE if against < LEAST_VARIANCE else against),
        math.sqrt(LEAST_VARIANCE if along < LEAST_VARIANCE else along),
    )
    share, to_velocity, to_angle = contact(x, x1, t, v, v1)
    stiff = by_k1 * share
    # Second order: the mean and the variance of the products f_v v and k_1 x.
    drifting, softening = by_fv * p15, stiff * p03
    doubtful = drifting * drifting + by_fv * by_fv * p11 * p55
    doubtful += softening * softening + stiff * stiff * p00 * p33
    half_square, bias = 0.5 * t * t, drifting + softening
    unsure = 2.0 * COHERENCE * (half_square * doubtful) + kinked
    crossed = CONTACT_VARIANCE if 0.0 < share < 1.0 else 0.0
    missed, touched, sums = t * lost, spring * share, v + v1
    x_slopes = (
        1.0 - x_by_pull * touched,
        x_by_v - x_by_pull * damping,
        x_by_pull * driving,
        x_by_pull * (-by_k1 * to_angle),
        x_by_tc * by_tc,
        x_by_pull * (-by_fv / 3.0 * (v + sums)),
    )
    v_slopes = (
        -v_by_pull * touched,
        v_by_v * (1.0 - half_square * touched) - v_by_pull * damping,
        v_by_pull * driving,
        v_by_pull * (-by_k1 * to_velocity),
        v_by_tc * by_tc,
        v_by_pull * (-0.5 * by_fv * sums),
    )
    noise = (
        0.5 * (half_square * unsure) + missed * missed + stopped * STOP_VARIANCE,
        0.5 * t * unsure,
        unsure + lost * lost + crossed,
    )
    end = x1 - half_square * bias, v1 - t * bias, km, k1, tc, fv
    return end, _spread(p, x_slopes, v_slopes, noise)


def believed(model: Model, state: State) -> Four:
    """Relative parameters, cut off at their ranges."""
    (_, _, km, k1, tc, fv), (l2, l3, l4, l5), (h2, h3, h4, h5) = state.mean, model.low, model.high
    km, k1 = l2 if km < l2 else km, l3 if k1 < l3 else k1
    tc, fv = l4 if tc < l4 else tc, l5 if fv < l5 else fv
    return h2 if km > h2 else km, h3 if k1 > h3 else k1, h4 if tc > h4 else tc, h5 if fv > h5 else fv


def fits(state: State) -> bool:
    """Returns True if the innovations were as the model has them, up to now."""
    return state.worst <= MISFIT


def deviations(model: Model, state: State, used: Four) -> Four:
    """Standard deviations of the relative parameters; at least the distance of the filter's values from those used.

    ``used`` are the values of :func:`believed`. Once the model did not fit, the deviations are at least those of the
    prior. Infinite where rounding has made a variance negative.
    """
    mean, p, doubted = state.mean, state.covariance, not fits(state)
    low, high = model.low, model.high
    return (
        _deviation(p[11], mean[2] - used[0], high[0] - low[0], doubted),
        _deviation(p[15], mean[3] - used[1], high[1] - low[1], doubted),
        _deviation(p[18], mean[4] - used[2], high[2] - low[2], doubted),
        _deviation(p[20], mean[5] - used[3], high[3] - low[3], doubted),
    )


def _deviation(variance: float, beyond: float, width: float, doubted: bool) -> float:
    if variance < 0.0:
        return math.inf
    deviation, beyond = math.sqrt(variance), abs(beyond)
    deviation = beyond if beyond > deviation else deviation
    return max(deviation, width / math.sqrt(12.0)) if doubted else deviation


def _product(p: Packed, a: Six) -> Six:
    """P a."""
    p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34, p35, p44, p45, p55 = p
    a0, a1, a2, a3, a4, a5 = a
    return (
        a0 * p00 + a1 * p01 + a2 * p02 + a3 * p03 + a4 * p04 + a5 * p05,
        a0 * p01 + a1 * p11 + a2 * p12 + a3 * p13 + a4 * p14 + a5 * p15,
        a0 * p02 + a1 * p12 + a2 * p22 + a3 * p23 + a4 * p24 + a5 * p25,
        a0 * p03 + a1 * p13 + a2 * p23 + a3 * p33 + a4 * p34 + a5 * p35,
        a0 * p04 + a1 * p14 + a2 * p24 + a3 * p34 + a4 * p44 + a5 * p45,
        a0 * p05 + a1 * p15 + a2 * p25 + a3 * p35 + a4 * p45 + a5 * p55,
    )


def _spread(p: Packed, angle_slopes: Six, velocity_slopes: Six, noise: tuple[float, float, float]) -> Packed:
    """P' = F P Fᵀ + Q, where the rows of F but those of angle and velocity are those of the unit matrix.

    Noise is that of the angle, common to both, and that of the velocity.
    """
    _, _, _, _, _, _, _, _, _, _, _, p22, p23, p24, p25, p33, p34, p35, p44, p45, p55 = p
    a0, a1, a2, a3, a4, a5 = angle_slopes
    v0, v1, v2, v3, v4, v5 = velocity_slopes
    x0, x1, x2, x3, x4, x5 = _product(p, angle_slopes)
    y0, y1, y2, y3, y4, y5 = _product(p, velocity_slopes)
    return (
        a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3 + a4 * x4 + a5 * x5 + noise[0],
        a0 * y0 + a1 * y1 + a2 * y2 + a3 * y3 + a4 * y4 + a5 * y5 + noise[1],
        x2, x3, x4, x5,
        v0 * y0 + v1 * y1 + v2 * y2 + v3 * y3 + v4 * y4 + v5 * y5 + noise[2],
        y2, y3, y4, y5,
        p22, p23, p24, p25,
        p33, p34, p35,
        p44, p45,
        p55,
    )  # fmt: skip


def _correct(mean: Six, p: Packed, row: Six, innovation: float, variance: float) -> tuple[Six, Packed, float]:
    """Mean and covariance after one measurement, and the square of its innovation over its variance.

    ``row``: that of the covariance for the unknown that is measured.
    """
    m0, m1, m2, m3, m4, m5 = mean
    p00, p01, p02, p03, p04, p05, p11, p12, p13, p14, p15, p22, p23, p24, p25, p33, p34, p35, p44, p45, p55 = p
    r0, r1, r2, r3, r4, r5 = row
    surprise = innovation / variance
    g0, g1, g2 = r0 / variance, r1 / variance, r2 / variance
    g3, g4, g5 = r3 / variance, r4 / variance, r5 / variance
    return (
        (
            m0 + r0 * surprise,
            m1 + r1 * surprise,
            m2 + r2 * surprise,
            m3 + r3 * surprise,
            m4 + r4 * surprise,
            m5 + r5 * surprise,
        ),
        (
            p00 - g0 * r0, p01 - g0 * r1, p02 - g0 * r2, p03 - g0 * r3, p04 - g0 * r4, p05 - g0 * r5,
            p11 - g1 * r1, p12 - g1 * r2, p13 - g1 * r3, p14 - g1 * r4, p15 - g1 * r5,
            p22 - g2 * r2, p23 - g2 * r3, p24 - g2 * r4, p25 - g2 * r5,
            p33 - g3 * r3, p34 - g3 * r4, p35 - g3 * r5,
            p44 - g4 * r4, p45 - g4 * r5,
            p55 - g5 * r5,
        ),
        innovation * surprise,
    )  # fmt: skip
