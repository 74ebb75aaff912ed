"""The Gaussian currency: a Kalman recursion whose ellipsoid holds the true brake and state with probability 1 − δ.

The unknowns z are the angle, the velocity and the four relative parameters. c is what the recursion expects and P its
matrix; *no* distribution of z is assumed. G1 to G4 in ``docs/explanation/learning-shield.md``:

* **G1.** The identities of the recursion hold for the true z with the true errors in them. Where the model is not
  linear, the prediction is off by at most q_i in the unknown i: adding y_i to P costs q_i²/y_i.
* **G2.** q_i comes of exact products of half widths of the boxes that hold the truth now, of Taylor's remainder along
  the flow, and of everything that the assumptions leave open.
* **G3.** The errors' likelihood ratio against the recursion's own innovations is a supermartingale of mean 1 at most,
  so that by Ville's inequality the squares of all errors are bounded for all times at once.
* **G4.** By the energy of sub-Gaussian errors they are bounded a second time. Where less than nothing is left, the
  samples contradict the assumptions.

The ellipsoid is |z − c|² in P⁻¹ ≤ budget; the boxes around it are cut with those of before (the parameters) and with
what is measured (the state). Plain scalar functions without allocation; P is kept as its upper triangle, so that it
stays symmetric.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from emb_runtime.learning.assumptions import Assumptions
from emb_runtime.learning.known import (
    ANGLE_HIGH,
    ANGLE_LOW,
    BUDGET,
    FALSIFIED,
    HEAD,
    HEARD,
    HIGH,
    LOW,
    VELOCITY_HIGH,
    VELOCITY_LOW,
    State,
    falsify,
    start_head,
)

UNKNOWNS: Final = 6
CENTRE: Final = HEAD  # Index of c: angle [rad], velocity [rad/s], k_m, k_1, T_c, f_v
MATRIX: Final = 21  # Index of P, the rows of its upper triangle one after the other
PAID: Final = 42  # Index of what the start and all remainders have cost
LOGS: Final = 43  # Index of the sum of ln(S/σ²) over all measurements
SURPRISE: Final = 44  # Index of the sum of ν²/S
MEASURED: Final = 45  # Index of the number of measurements
STATE: Final = 46  # Length of a state
PAD: Final = 1e-9  # Relative, for rounding

Six = tuple[float, float, float, float, float, float]


class Step(NamedTuple):
    """Prediction of one period."""

    angle: float  # [rad]
    velocity: float  # [rad/s]
    by_angle: Six  # Derivatives of the angle to the six unknowns before
    by_velocity: Six  # Derivatives of the velocity
    angle_rest: float  # The angle is off by at most this [rad]
    velocity_rest: float  # [rad/s]


def start(assumptions: Assumptions) -> State:
    """The state before the first sample."""
    state = [0.0] * STATE
    start_head(assumptions, state)
    return state


def hear(assumptions: Assumptions, state: State, angle: float, velocity: float, applied: float) -> None:
    """Take in a sample, in place; one that is no number is lost.

    Args:
        assumptions: prior knowledge.
        state: from :func:`start`, or after what was heard before.
        angle: measured [rad].
        velocity: measured [rad/s].
        applied: the current of the period that ends here, as the node reports it [A].
    """
    if not math.isfinite(angle + velocity + applied):
        lose(assumptions, state)
        return
    if state[FALSIFIED] != 0.0:
        falsify(assumptions, state, angle, velocity)
        return
    if state[HEARD] == 0.0:
        _begin(assumptions, state, angle, velocity)
    else:
        _predict(assumptions, state, applied, assumptions.current_error)
        _correct_angle(state, angle, assumptions.angle_sigma * assumptions.angle_sigma)
        _correct_velocity(state, velocity, assumptions.velocity_sigma * assumptions.velocity_sigma)
    state[HEARD] += 1.0
    _enclose(assumptions, state)
    state[ANGLE_LOW] = _greater(state[ANGLE_LOW], angle - assumptions.angle_noise)
    state[ANGLE_HIGH] = -_greater(-state[ANGLE_HIGH], -angle - assumptions.angle_noise)
    state[VELOCITY_LOW] = _greater(state[VELOCITY_LOW], velocity - assumptions.velocity_noise)
    state[VELOCITY_HIGH] = -_greater(-state[VELOCITY_HIGH], -velocity - assumptions.velocity_noise)
    if not _possible(state):
        falsify(assumptions, state, angle, velocity)


def lose(assumptions: Assumptions, state: State) -> None:
    """Pass a period of which neither the sample at its end nor the current is known, in place."""
    if state[HEARD] > 0.0:  # else nothing was heard yet, or a contradiction
        _predict(assumptions, state, 0.0, assumptions.current + assumptions.current_error)
        _enclose(assumptions, state)


def _begin(a: Assumptions, state: State, angle: float, velocity: float) -> None:
    """The ellipsoid around the box of the first sample and of the set known beforehand."""
    state[CENTRE], state[CENTRE + 1] = angle, velocity
    state[MATRIX], state[MATRIX + 6] = a.angle_noise * a.angle_noise, a.velocity_noise * a.velocity_noise
    unknown = 2.0
    diagonal = MATRIX + 11
    for i in range(4):
        half = 0.5 * (state[HIGH + i] - state[LOW + i])
        state[CENTRE + 2 + i] = 0.5 * (state[HIGH + i] + state[LOW + i])
        state[diagonal] = half * half
        diagonal += 4 - i
        if half > 0.0:
            unknown += 1.0
    state[PAID] = unknown


def _predict(a: Assumptions, state: State, applied: float, current_error: float) -> None:
    """Go on by one period, in place (G1, G2)."""
    step = _flow(a, state, applied, current_error) if a.flow else _euler(a, state, applied, current_error)
    state[CENTRE], state[CENTRE + 1] = step.angle, step.velocity
    _spread(state, step.by_angle, step.by_velocity)
    state[PAID] += _allow(state, MATRIX, step.angle_rest) + _allow(state, MATRIX + 6, step.velocity_rest)


def _allow(state: State, diagonal: int, rest: float) -> float:
    """Widen P for an unknown that is off by at most ``rest``; returns what that costs.

    Any positive addition is right. This one weighs the cost against what the addition makes of P: of the order of the
    product of the two deviations where the rest is small, and one for one where it is large.
    """
    if rest <= 0.0:
        return 0.0
    added = max(0.5 * rest * math.sqrt(UNKNOWNS * max(state[diagonal], 0.0) / state[BUDGET]), rest * rest)
    state[diagonal] += added
    return rest * rest / added


def _euler(a: Assumptions, state: State, u: float, current_error: float) -> Step:
    """Prediction of a brake under forward Euler."""
    t = a.sample_time
    x, v = state[CENTRE], state[CENTRE + 1]
    km, k1, tc, fv = state[CENTRE + 2], state[CENTRE + 3], state[CENTRE + 4], state[CENTRE + 5]
    xl, xh, vl, vh = state[ANGLE_LOW], state[ANGLE_HIGH], state[VELOCITY_LOW], state[VELOCITY_HIGH]
    direction = 1.0 if vl > 0.0 else -1.0 if vh < 0.0 else 0.0
    spring = a.spring if xl >= 0.0 else 0.0
    off = a.model_error + a.motor * state[HIGH] * current_error
    if direction == 0.0:
        off += a.coulomb * state[HIGH + 2]
    doubtful = 0.5 * a.spring * state[HIGH + 1] * max(xh, 0.0) if xl < 0.0 else 0.0
    off += doubtful
    off += spring * _half(state, 1) * max(xh - x, x - xl) + a.viscous * _half(state, 3) * max(vh - v, v - vl)
    acceleration = a.motor * u * km - spring * k1 * x - doubtful - a.coulomb * direction * tc - a.viscous * fv * v
    return Step(
        x + t * v,
        v + t * acceleration,
        (1.0, t, 0.0, 0.0, 0.0, 0.0),
        (
            -t * spring * k1,
            1.0 - t * a.viscous * fv,
            t * a.motor * u,
            -t * spring * x,
            -t * a.coulomb * direction,
            -t * a.viscous * v,
        ),
        0.0,
        t * off,
    )


def _flow(a: Assumptions, state: State, u: float, current_error: float) -> Step:
    """Prediction of a brake along its flow, by Taylor's series to t²/2 for the velocity and t³/6 for the angle."""
    t = a.sample_time
    x, v = state[CENTRE], state[CENTRE + 1]
    km, k1, tc, fv = state[CENTRE + 2], state[CENTRE + 3], state[CENTRE + 4], state[CENTRE + 5]
    xl, xh, vl, vh = state[ANGLE_LOW], state[ANGLE_HIGH], state[VELOCITY_LOW], state[VELOCITY_HIGH]
    strongest, stiffest = a.motor * state[HIGH], a.spring * state[HIGH + 1]
    roughest, thickest = a.coulomb * state[HIGH + 2], a.viscous * state[HIGH + 3]
    off = a.model_error + strongest * current_error
    # No acceleration within the period is greater, and no speed.
    speed = max(vh, -vl)
    greatest = strongest * abs(u) + off + stiffest * (max(xh, 0.0) + t * speed) + roughest + thickest * speed
    greatest /= 1.0 - t * thickest - t * t * stiffest
    fastest = speed + t * greatest
    lowest, highest = xl + t * min(vl - t * greatest, 0.0), xh + t * max(vh + t * greatest, 0.0)
    direction = _direction(a, state, u, off, lowest, highest, fastest)
    if direction == 0.0:
        off += roughest
    spring = a.spring if lowest >= 0.0 else 0.0
    doubtful = 0.5 * stiffest * max(highest, 0.0) if lowest < 0.0 else 0.0
    off += doubtful
    by_motor, by_friction, by_damping = a.motor * u, -a.coulomb * direction, -a.viscous * v
    stiff, damping = spring * k1, a.viscous * fv
    acceleration = by_motor * km - stiff * x - doubtful + by_friction * tc - damping * v
    jerk = -stiff * v - damping * acceleration
    # Derivatives of the acceleration and of the jerk, and what these leave: products of two half widths.
    hx, hv, h2, h4 = max(xh - x, x - xl), max(vh - v, v - vl), _half(state, 1), _half(state, 3)
    bend = spring * h2 * hx + a.viscous * h4 * hv
    change = abs(stiff) * hx + abs(damping) * hv + abs(by_motor) * _half(state, 0) + spring * abs(x) * h2
    change += abs(by_friction) * _half(state, 2) + abs(by_damping) * h4 + bend
    twist = spring * h2 * hv + a.viscous * h4 * change + abs(damping) * bend
    snap = stiffest * greatest + thickest * (stiffest * fastest + thickest * greatest)
    half, sixth = 0.5 * t * t, t * t * t / 6.0
    in_velocity, in_angle = t - half * damping, half - sixth * damping
    by_k1, by_fv = -spring * x, by_damping
    return Step(
        x + t * v + half * acceleration + sixth * jerk,
        v + t * acceleration + half * jerk,
        (
            1.0 - in_angle * stiff,
            t - in_angle * damping - sixth * stiff,
            in_angle * by_motor,
            in_angle * by_k1 - sixth * spring * v,
            in_angle * by_friction,
            in_angle * by_fv - sixth * a.viscous * acceleration,
        ),
        (
            -in_velocity * stiff,
            1.0 - in_velocity * damping - half * stiff,
            in_velocity * by_motor,
            in_velocity * by_k1 - half * spring * v,
            in_velocity * by_friction,
            in_velocity * by_fv - half * a.viscous * acceleration,
        ),
        half * (off + bend) + sixth * twist + t * t * t * t / 24.0 * snap,
        t * (off + bend) + half * twist + sixth * snap,
    )


def _direction(
    a: Assumptions, state: State, u: float, off: float, lowest: float, highest: float, fastest: float
) -> float:
    """1.0 or −1.0 where the brake surely moves in one direction throughout the period, else 0.0."""
    t, vl, vh = a.sample_time, state[VELOCITY_LOW], state[VELOCITY_HIGH]
    against = a.coulomb * state[HIGH + 2] + a.viscous * state[HIGH + 3] * fastest + off
    if vl > 0.0:
        drive = a.motor * min(state[LOW] * u, state[HIGH] * u)
        slowing = drive - a.spring * state[HIGH + 1] * max(highest, 0.0) - against
        return 1.0 if vl + t * slowing > 0.0 else 0.0
    if vh < 0.0:
        drive = a.motor * max(state[LOW] * u, state[HIGH] * u)
        slowing = drive - a.spring * state[LOW + 1] * max(lowest, 0.0) + against
        return -1.0 if vh + t * slowing < 0.0 else 0.0
    return 0.0


def _half(state: State, i: int) -> float:
    """Farthest that parameter ``i`` may be from where the recursion expects it."""
    expected = state[CENTRE + 2 + i]
    return max(state[HIGH + i] - expected, expected - state[LOW + i])


def _spread(state: State, by_angle: Six, by_velocity: Six) -> None:
    """P' = F P Fᵀ, where only the rows of angle and velocity are not those of the unit matrix."""
    a0, a1, a2, a3, a4, a5 = by_angle
    b0, b1, b2, b3, b4, b5 = by_velocity
    p00, p01, p02 = state[MATRIX], state[MATRIX + 1], state[MATRIX + 2]
    p03, p04, p05 = state[MATRIX + 3], state[MATRIX + 4], state[MATRIX + 5]
    p11, p12, p13 = state[MATRIX + 6], state[MATRIX + 7], state[MATRIX + 8]
    p14, p15 = state[MATRIX + 9], state[MATRIX + 10]
    p22, p23, p24, p25 = state[MATRIX + 11], state[MATRIX + 12], state[MATRIX + 13], state[MATRIX + 14]
    p33, p34, p35 = state[MATRIX + 15], state[MATRIX + 16], state[MATRIX + 17]
    p44, p45, p55 = state[MATRIX + 18], state[MATRIX + 19], state[MATRIX + 20]
    x0 = a0 * p00 + a1 * p01 + a2 * p02 + a3 * p03 + a4 * p04 + a5 * p05
    x1 = a0 * p01 + a1 * p11 + a2 * p12 + a3 * p13 + a4 * p14 + a5 * p15
    x2 = a0 * p02 + a1 * p12 + a2 * p22 + a3 * p23 + a4 * p24 + a5 * p25
    x3 = a0 * p03 + a1 * p13 + a2 * p23 + a3 * p33 + a4 * p34 + a5 * p35
    x4 = a0 * p04 + a1 * p14 + a2 * p24 + a3 * p34 + a4 * p44 + a5 * p45
    x5 = a0 * p05 + a1 * p15 + a2 * p25 + a3 * p35 + a4 * p45 + a5 * p55
    v0 = b0 * p00 + b1 * p01 + b2 * p02 + b3 * p03 + b4 * p04 + b5 * p05
    v1 = b0 * p01 + b1 * p11 + b2 * p12 + b3 * p13 + b4 * p14 + b5 * p15
    v2 = b0 * p02 + b1 * p12 + b2 * p22 + b3 * p23 + b4 * p24 + b5 * p25
    v3 = b0 * p03 + b1 * p13 + b2 * p23 + b3 * p33 + b4 * p34 + b5 * p35
    v4 = b0 * p04 + b1 * p14 + b2 * p24 + b3 * p34 + b4 * p44 + b5 * p45
    v5 = b0 * p05 + b1 * p15 + b2 * p25 + b3 * p35 + b4 * p45 + b5 * p55
    state[MATRIX] = a0 * x0 + a1 * x1 + a2 * x2 + a3 * x3 + a4 * x4 + a5 * x5
    state[MATRIX + 1] = b0 * x0 + b1 * x1 + b2 * x2 + b3 * x3 + b4 * x4 + b5 * x5
    state[MATRIX + 6] = b0 * v0 + b1 * v1 + b2 * v2 + b3 * v3 + b4 * v4 + b5 * v5
    state[MATRIX + 2], state[MATRIX + 3], state[MATRIX + 4], state[MATRIX + 5] = x2, x3, x4, x5
    state[MATRIX + 7], state[MATRIX + 8], state[MATRIX + 9], state[MATRIX + 10] = v2, v3, v4, v5


def _correct_angle(state: State, angle: float, variance: float) -> None:
    """Take in a measured angle, in place."""
    row = (
        state[MATRIX],
        state[MATRIX + 1],
        state[MATRIX + 2],
        state[MATRIX + 3],
        state[MATRIX + 4],
        state[MATRIX + 5],
    )
    total = max(state[MATRIX], 0.0) + variance
    _correct(state, row, angle - state[CENTRE], total, variance)
    # The row itself by a product: after many lost samples a difference would leave rounding only.
    kept = variance / total
    state[MATRIX], state[MATRIX + 1], state[MATRIX + 2] = kept * row[0], kept * row[1], kept * row[2]
    state[MATRIX + 3], state[MATRIX + 4], state[MATRIX + 5] = kept * row[3], kept * row[4], kept * row[5]


def _correct_velocity(state: State, velocity: float, variance: float) -> None:
    """Take in a measured velocity, in place."""
    row = (
        state[MATRIX + 1],
        state[MATRIX + 6],
        state[MATRIX + 7],
        state[MATRIX + 8],
        state[MATRIX + 9],
        state[MATRIX + 10],
    )
    total = max(state[MATRIX + 6], 0.0) + variance
    _correct(state, row, velocity - state[CENTRE + 1], total, variance)
    kept = variance / total
    state[MATRIX + 1], state[MATRIX + 6], state[MATRIX + 7] = kept * row[0], kept * row[1], kept * row[2]
    state[MATRIX + 8], state[MATRIX + 9], state[MATRIX + 10] = kept * row[3], kept * row[4], kept * row[5]


def _correct(state: State, row: Six, innovation: float, total: float, variance: float) -> None:
    """Take in a measurement of an unknown with this row of P, and account for it (G1, G3)."""
    r0, r1, r2, r3, r4, r5 = row
    surprise = innovation / total
    state[CENTRE] += r0 * surprise
    state[CENTRE + 1] += r1 * surprise
    state[CENTRE + 2] += r2 * surprise
    state[CENTRE + 3] += r3 * surprise
    state[CENTRE + 4] += r4 * surprise
    state[CENTRE + 5] += r5 * surprise
    g = r0 / total
    state[MATRIX] -= g * r0
    state[MATRIX + 2] -= g * r2
    state[MATRIX + 3] -= g * r3
    state[MATRIX + 4] -= g * r4
    state[MATRIX + 5] -= g * r5
    g = r1 / total
    state[MATRIX + 6] -= g * r1
    state[MATRIX + 7] -= g * r2
    state[MATRIX + 8] -= g * r3
    state[MATRIX + 9] -= g * r4
    state[MATRIX + 10] -= g * r5
    g = r2 / total
    state[MATRIX + 11] -= g * r2
    state[MATRIX + 12] -= g * r3
    state[MATRIX + 13] -= g * r4
    state[MATRIX + 14] -= g * r5
    g = r3 / total
    state[MATRIX + 15] -= g * r3
    state[MATRIX + 16] -= g * r4
    state[MATRIX + 17] -= g * r5
    g = r4 / total
    state[MATRIX + 18] -= g * r4
    state[MATRIX + 19] -= g * r5
    state[MATRIX + 20] -= r5 / total * r5
    state[LOGS] += math.log(total / variance)
    state[SURPRISE] += innovation * surprise
    state[MEASURED] += 1.0


def budget(a: Assumptions, state: State) -> float:
    """Square of the ellipsoid's radius; negative where the samples contradict the assumptions.

    Half of δ is for G3, half for G4 at each of the measurements that one experiment has.
    """
    paid, measured = state[PAID], state[MEASURED]
    by_ratio = paid + 2.0 * math.log(2.0 / a.delta) + state[LOGS]
    if measured > 2.0 * a.samples:
        return by_ratio
    rare = math.log(4.0 * a.samples / a.delta)
    by_energy = paid + measured + 2.0 * math.sqrt(measured * rare) + 2.0 * rare - state[SURPRISE]
    return min(by_ratio, by_energy)


def _enclose(a: Assumptions, state: State) -> None:
    """Put the boxes around the ellipsoid into the head; those of the parameters never grow."""
    state[BUDGET] = budget(a, state)
    radius = (1.0 + PAD) * state[BUDGET]
    reach = _reach(radius, state[MATRIX], state[CENTRE])
    state[ANGLE_LOW], state[ANGLE_HIGH] = state[CENTRE] - reach, state[CENTRE] + reach
    reach = _reach(radius, state[MATRIX + 6], state[CENTRE + 1])
    state[VELOCITY_LOW], state[VELOCITY_HIGH] = state[CENTRE + 1] - reach, state[CENTRE + 1] + reach
    diagonal = MATRIX + 11
    for i in range(4):
        centre = state[CENTRE + 2 + i]
        reach = _reach(radius, state[diagonal], centre)
        state[LOW + i] = _greater(centre - reach, state[LOW + i])
        state[HIGH + i] = -_greater(-centre - reach, -state[HIGH + i])
        diagonal += 4 - i


def _greater(drawn: float, bound: float) -> float:
    """The greater of two bounds; NaN where the first is, which ``max`` would hide in one order."""
    return bound if drawn < bound else drawn


def _reach(radius: float, variance: float, centre: float) -> float:
    """Half the ellipsoid's width; NaN where rounding has left no ellipsoid."""
    square = radius * variance
    return math.sqrt(square) + PAD * abs(centre) if square >= 0.0 else math.nan


def _possible(state: State) -> bool:
    """Returns True if the budget is not used up and no box is empty; a NaN is neither."""
    possible = state[BUDGET] > 0.0
    possible = possible and state[ANGLE_LOW] <= state[ANGLE_HIGH] and state[VELOCITY_LOW] <= state[VELOCITY_HIGH]
    for i in range(4):
        possible = possible and state[LOW + i] <= state[HIGH + i]
    return possible
