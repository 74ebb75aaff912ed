"""Set membership: the brakes and states that remain possible where every sensor error is bounded.

Four relative parameters θ = (k_m, k_1, T_c, f_v) over nominal. While a brake moves in one certain direction, its
acceleration M θ₁ u − W θ₂ x⁺ ∓ D θ₃ − C θ₄ v is linear in θ. So sums and differences of what was measured bound
φ·θ from both sides: a *strip*. Each strip cuts a box and an ellipsoid that hold the true θ for sure; an empty cut says
that an assumption is false. The argument, pad by pad, is in ``docs/explanation/learning-shield.md`` (B1-B5).

Periods of one certain direction, all heard, make a *segment* (B1). Three strips come from it, for windows of n periods
t and R = (M ∫u, −W ∫x⁺, ∓D time, −C x) (B2):

* *rise*: the difference of two velocities is (R_k − R_b)·θ;
* *bend*: the second difference of angles y_k − 2 y_b + y_a is n t (mean of R over [b, k) less that over [a, b))·θ;
* *velocity*: the newest velocity is (y_k − y_b)/(n t) + (R_k − mean of R over [b, k))·θ, which bounds the state.

Under forward Euler the integrals are left sums, along the flow trapezoids whose errors are in the pads (B3).

Plain scalar functions on one row of numbers; see :mod:`emb_runtime.learning.known`.
"""

from __future__ import annotations

import math
from typing import Final

from emb_runtime.learning.assumptions import Assumptions, Four
from emb_runtime.learning.known import (
    ANGLE_LOW,
    FALSIFIED,
    HEAD,
    HEARD,
    HIGH,
    LOW,
    VELOCITY_LOW,
    State,
    falsify,
    start_head,
)

FOLLOWS: Final = HEAD
LENGTH: Final = HEAD + 1
DIRECTION: Final = HEAD + 2
PLACE: Final = HEAD + 3
PEAK: Final = HEAD + 4
UNKNOWNS: Final = HEAD + 5
"""Indices, after the head, of 1 where the newest sample was heard; the periods of the present segment, its direction of
motion, where its newest sample is stored, the greatest acceleration in it [rad/s²]; and the number of parameters whose
bounds differ."""
CENTRE: Final = UNKNOWNS + 1
SHAPE: Final = CENTRE + 4
"""Of the ellipsoid (θ − c)ᵀ P⁻¹ (θ − c) ≤ 1, P packed by rows of its upper triangle: symmetric by construction."""
RECORD: Final = SHAPE + 10  # Samples of the segment in a ring: angle, velocity, ∫u, ∫x⁺, ∫∫u, ∫∫x⁺, ∫x
COLUMNS: Final = 7
LONGEST: Final = 127  # Periods of a segment that are looked at
PLACES: Final = LONGEST  # Samples in the ring: the longest bend is of an even number of periods, and of a sample more
SIZE: Final = RECORD + PLACES * COLUMNS  # Length of the row
SHORT: Final = 8
LONG: Final = 20  # Periods that the velocity is taken from in turns, at most
ROUNDING: Final = 1e-9  # Beyond every bound, and share beyond every ellipsoid
LEAST_SHARE: Final = 1e-4  # Of an ellipsoid's axis squared that one strip leaves, before it is scaled


def start(assumptions: Assumptions) -> State:
    """The state before the first sample."""
    state = [0.0] * SIZE
    start_head(assumptions, state)
    for i in range(4):
        half = 0.5 * (assumptions.high[i] - assumptions.low[i])
        state[CENTRE + i] = assumptions.low[i] + half
        state[UNKNOWNS] += 1.0 if half > 0.0 else 0.0
    for i, diagonal in enumerate((0, 4, 7, 9)):
        half = 0.5 * (assumptions.high[i] - assumptions.low[i])
        state[SHAPE + diagonal] = state[UNKNOWNS] * half * half * (1.0 + ROUNDING)
    return state


def hear(assumptions: Assumptions, state: State, angle: float, velocity: float, applied: float) -> None:
    """Take in a sample [rad, rad/s], one period after the one before, in place; one that is no number is lost.

    The current ``applied`` acted in the period that ends at the sample [A].
    """
    if not math.isfinite(angle + velocity + applied):
        lose(assumptions, state)
        return
    toward = 0.0
    if state[FALSIFIED] == 0.0:
        if state[HEARD] == 0.0:
            state[ANGLE_LOW], state[ANGLE_LOW + 1] = -math.inf, math.inf
            state[VELOCITY_LOW], state[VELOCITY_LOW + 1] = -math.inf, math.inf
        else:
            toward = _advance(assumptions, state, applied, assumptions.current_error)
        state[HEARD] += 1.0
        _intersect(state, ANGLE_LOW, angle - assumptions.angle_noise, angle + assumptions.angle_noise)
        _intersect(state, VELOCITY_LOW, velocity - assumptions.velocity_noise, velocity + assumptions.velocity_noise)
        _record(assumptions, state, angle, velocity, applied)
        _learn(assumptions, state, toward)
    if state[FALSIFIED] != 0.0:
        falsify(assumptions, state, angle, velocity)


def lose(assumptions: Assumptions, state: State) -> None:
    """Go on by a period of which nothing is known, in place: any current may have acted, with the error of any."""
    state[FOLLOWS] = state[LENGTH] = 0.0
    if state[HEARD] > 0.0:  # else nothing was heard yet, or a contradiction
        _advance(assumptions, state, 0.0, assumptions.current + assumptions.current_error)


def _learn(assumptions: Assumptions, state: State, toward: float) -> None:
    """Extend the segment by the period that ends now, if it has a certain direction, and take what it says."""
    followed, state[FOLLOWS] = state[FOLLOWS], 1.0
    if toward == 0.0 or followed == 0.0:
        state[LENGTH] = state[PEAK] = 0.0
        return
    if toward != state[DIRECTION]:
        state[DIRECTION], state[LENGTH] = toward, 0.0
    length = min(int(state[LENGTH]) + 1, LONGEST)
    state[LENGTH] = float(length)
    _narrow(assumptions, state, length)
    _bound_velocity(assumptions, state, min(length, SHORT if length % 2 else LONG))


def _advance(assumptions: Assumptions, state: State, current: float, error: float) -> float:
    """The state one period on (B5); the certain direction of motion in it, 0 if there is none (B1)."""
    t, flow = assumptions.sample_time, assumptions.flow
    xl, xh, vl, vh = state[ANGLE_LOW], state[ANGLE_LOW + 1], state[VELOCITY_LOW], state[VELOCITY_LOW + 1]
    stiffest, slowest = state[HIGH + 1], assumptions.coulomb * state[LOW + 2]
    friction = assumptions.coulomb * state[HIGH + 2]
    lightest, thickest = assumptions.viscous * state[LOW + 3], assumptions.viscous * state[HIGH + 3]
    more, less = assumptions.motor * (current + error), assumptions.motor * (current - error)
    above = (
        max(more * state[LOW], more * state[HIGH])
        - assumptions.spring * state[LOW + 1] * max(xl, 0.0)
        + assumptions.model_error
    )
    below = (
        min(less * state[LOW], less * state[HIGH])
        - assumptions.spring * stiffest * max(xh, 0.0)
        - assumptions.model_error
    )
    jerk = pad = 0.0
    if flow:
        pulled = assumptions.spring * stiffest * assumptions.speed
        peak = max(above, -below) + friction + thickest * assumptions.speed + t * pulled
        state[PEAK] = max(state[PEAK], peak)
        jerk = pulled + thickest * peak
        pad = 0.5 * t * t * jerk
    fastest = _fastest(t, vl, vh, above, slowest, friction, lightest, thickest) + pad
    least = -_fastest(t, -vh, -vl, -below, slowest, friction, lightest, thickest) - pad
    toward = 0.0
    if vl > 0.0 and (not flow or vl + t * (below - friction - thickest * vl) > pad):
        toward = 1.0
    elif vh < 0.0 and (not flow or vh + t * (above + friction - thickest * vh) < -pad):
        toward = -1.0
    if not flow:
        state[ANGLE_LOW], state[ANGLE_LOW + 1] = xl + t * vl, xh + t * vh
    elif toward != 0.0:
        rest = t * pad / 6.0
        state[ANGLE_LOW], state[ANGLE_LOW + 1] = (
            xl + 0.5 * t * (vl + least) - rest,
            xh + 0.5 * t * (vh + fastest) + rest,
        )
    else:
        state[ANGLE_LOW], state[ANGLE_LOW + 1] = xl + t * min(vl, least), xh + t * max(vh, fastest)
    state[VELOCITY_LOW], state[VELOCITY_LOW + 1] = least, fastest
    return toward


def _fastest(
    t: float, vl: float, vh: float, drive: float, slowest: float, friction: float, lightest: float, thickest: float
) -> float:
    """Greatest velocity one period after [vl, vh]; a brake that would come to rest may stick.

    Motor and spring have ``drive`` at most; friction lies within ``slowest`` and ``friction`` [rad/s²], viscous
    friction within ``lightest`` and ``thickest`` [1/s].
    """
    if vh <= 0.0:
        return vh + t * (drive + friction - thickest * vh)
    fastest = max(vh + t * (drive - slowest - lightest * vh), 0.0)
    if vl <= 0.0:
        fastest = max(fastest, t * (drive + friction))
    return fastest


def _intersect(state: State, i: int, low: float, high: float) -> None:
    """Cuts an interval of the state, two numbers from index ``i`` on; falsified where nothing is left."""
    low, high = max(state[i], low - ROUNDING), min(state[i + 1], high + ROUNDING)
    if low > high:
        state[FALSIFIED] = 1.0
    state[i], state[i + 1] = low, high


def _record(assumptions: Assumptions, state: State, angle: float, velocity: float, current: float) -> None:
    """Stores a sample and the sums up to it; only differences within a segment count, wherever the sums began."""
    t = assumptions.sample_time
    old = RECORD + int(state[PLACE]) * COLUMNS
    state[PLACE] = place = (state[PLACE] + 1.0) % PLACES
    new = RECORD + int(place) * COLUMNS
    state[new], state[new + 1] = angle, velocity
    before = state[old]
    driven, squeezed = state[old + 2], state[old + 3]
    state[new + 2] = driven + t * current
    if assumptions.flow:
        state[new + 3] = now = squeezed + 0.5 * t * (max(before, 0.0) + max(angle, 0.0))
        state[new + 4] = state[old + 4] + t * (driven + 0.5 * t * current)
        state[new + 5] = state[old + 5] + 0.5 * t * (squeezed + now)
        state[new + 6] = state[old + 6] + 0.5 * t * (before + angle)
    else:
        state[new + 3] = squeezed + t * max(before, 0.0)
        state[new + 4] = state[old + 4] + t * driven
        state[new + 5] = state[old + 5] + t * squeezed
        state[new + 6] = state[old + 6] + t * before


def _at(state: State, ago: int) -> int:
    """Index of the sample so many periods ago."""
    return RECORD + (int(state[PLACE]) - ago) % PLACES * COLUMNS


def _unmodelled(assumptions: Assumptions, state: State) -> float:
    """Acceleration that the strips do not see: the spring's by the angle's error, the model's, the current's (B3)."""
    spring = assumptions.angle_noise * assumptions.spring * state[HIGH + 1]
    return spring + assumptions.model_error + assumptions.motor * state[HIGH] * assumptions.current_error


def _narrow(assumptions: Assumptions, state: State, length: int) -> None:
    """The strips of one sample: a bend of the longest window, and of shorter ones in turns; a rise at first."""
    if length < 4:
        _rise(assumptions, state, length)
    if length >= 2:
        _bend(assumptions, state, length // 2)
    if length > 8:
        turn = length % 3
        _bend(assumptions, state, length // 3 if turn == 0 else length // 4 if turn == 1 else length // 6)


def _rise(assumptions: Assumptions, state: State, n: int) -> None:
    """Strip from the velocities of now and n periods ago."""
    t = assumptions.sample_time
    k, b = _at(state, 0), _at(state, n)
    nt = n * t
    pad = 2.0 * assumptions.velocity_noise + 2.0 * assumptions.angle_noise * assumptions.viscous * state[HIGH + 3]
    pad += nt * _unmodelled(assumptions, state)
    if assumptions.flow:
        stiff = assumptions.spring * state[HIGH + 1]
        pad += stiff * t * t * (n * t / 12.0 * state[PEAK] + assumptions.speed / 8.0)
    _take(
        state,
        assumptions.motor * (state[k + 2] - state[b + 2]),
        -assumptions.spring * (state[k + 3] - state[b + 3]),
        -assumptions.coulomb * state[DIRECTION] * nt,
        -assumptions.viscous * (state[k] - state[b]),
        state[k + 1] - state[b + 1],
        pad,
    )


def _bend(assumptions: Assumptions, state: State, n: int) -> None:
    """Strip from the angles of now, n and 2 n periods ago."""
    t = assumptions.sample_time
    k, b, a = _at(state, 0), _at(state, n), _at(state, 2 * n)
    nt = n * t
    pad = 4.0 * assumptions.angle_noise / nt + 2.0 * assumptions.angle_noise * assumptions.viscous * state[HIGH + 3]
    pad += nt * _unmodelled(assumptions, state)
    if assumptions.flow:
        stiff, peak = assumptions.spring * state[HIGH + 1], state[PEAK]
        pad += stiff * t * t * (nt / 12.0 * peak + assumptions.speed / 8.0 + assumptions.speed / 6.0)
        pad += assumptions.viscous * state[HIGH + 3] * t * t / 6.0 * peak
    _take(
        state,
        assumptions.motor * (state[k + 4] - 2.0 * state[b + 4] + state[a + 4]) / nt,
        -assumptions.spring * (state[k + 5] - 2.0 * state[b + 5] + state[a + 5]) / nt,
        -assumptions.coulomb * state[DIRECTION] * nt,
        -assumptions.viscous * (state[k + 6] - 2.0 * state[b + 6] + state[a + 6]) / nt,
        (state[k] - 2.0 * state[b] + state[a]) / nt,
        pad,
    )


def _bound_velocity(assumptions: Assumptions, state: State, n: int) -> None:
    """Bounds the newest velocity by the angles of now and n periods ago, and the parameters' ellipsoid (B5)."""
    t = assumptions.sample_time
    k, b = _at(state, 0), _at(state, n)
    nt = n * t
    before = 0.5 * nt if assumptions.flow else 0.5 * (nt + t)
    pad = 2.0 * assumptions.angle_noise / nt + 2.0 * assumptions.angle_noise * assumptions.viscous * state[HIGH + 3]
    pad += before * _unmodelled(assumptions, state)
    if assumptions.flow:
        stiff, peak = assumptions.spring * state[HIGH + 1], state[PEAK]
        pad += stiff * t * t * (nt / 12.0 * peak + assumptions.speed / 8.0 + assumptions.speed / 12.0)
        pad += assumptions.viscous * state[HIGH + 3] * t * t / 12.0 * peak
    f1 = assumptions.motor * (state[k + 2] - (state[k + 4] - state[b + 4]) / nt)
    f2 = -assumptions.spring * (state[k + 3] - (state[k + 5] - state[b + 5]) / nt)
    f3 = -assumptions.coulomb * state[DIRECTION] * before
    f4 = -assumptions.viscous * (state[k] - (state[k + 6] - state[b + 6]) / nt)
    g1, g2, g3, g4 = _turned(state, f1, f2, f3, f4)
    mean = (state[k] - state[b]) / nt
    mean += f1 * state[CENTRE] + f2 * state[CENTRE + 1] + f3 * state[CENTRE + 2] + f4 * state[CENTRE + 3]
    pad += math.sqrt(max(f1 * g1 + f2 * g2 + f3 * g3 + f4 * g4, 0.0))
    _intersect(state, VELOCITY_LOW, mean - pad, mean + pad)


def _turned(state: State, f1: float, f2: float, f3: float, f4: float) -> Four:
    """P φ."""
    p11, p12, p13, p14 = state[SHAPE], state[SHAPE + 1], state[SHAPE + 2], state[SHAPE + 3]
    p22, p23, p24, p33, p34, p44 = (
        state[SHAPE + 4],
        state[SHAPE + 5],
        state[SHAPE + 6],
        state[SHAPE + 7],
        state[SHAPE + 8],
        state[SHAPE + 9],
    )
    return (
        p11 * f1 + p12 * f2 + p13 * f3 + p14 * f4,
        p12 * f1 + p22 * f2 + p23 * f3 + p24 * f4,
        p13 * f1 + p23 * f2 + p33 * f3 + p34 * f4,
        p14 * f1 + p24 * f2 + p34 * f3 + p44 * f4,
    )


def _take(state: State, f1: float, f2: float, f3: float, f4: float, value: float, pad: float) -> None:
    """Cuts box and ellipsoid to |φ·θ − value| ≤ pad (B4)."""
    _cut_box(state, f1, f2, f3, f4, value - pad, value + pad)
    _cut_ellipsoid(state, f1, f2, f3, f4, value - pad, value + pad)


def _cut_box(state: State, f1: float, f2: float, f3: float, f4: float, low: float, high: float) -> None:
    """Cuts the box to low ≤ φ·θ ≤ high, by interval arithmetic."""
    a1, a2, a3, a4 = f1 * state[LOW], f2 * state[LOW + 1], f3 * state[LOW + 2], f4 * state[LOW + 3]
    b1, b2, b3, b4 = f1 * state[HIGH], f2 * state[HIGH + 1], f3 * state[HIGH + 2], f4 * state[HIGH + 3]
    w1, w2, w3, w4 = abs(b1 - a1), abs(b2 - a2), abs(b3 - a3), abs(b4 - a4)
    half, middle = 0.5 * (w1 + w2 + w3 + w4), 0.5 * (a1 + a2 + a3 + a4 + b1 + b2 + b3 + b4)
    upward, downward = middle + half - low, high - middle + half
    if upward < 0.0 or downward < 0.0:
        state[FALSIFIED] = 1.0
        return
    if max(w1, w2, w3, w4) <= min(upward, downward):
        return
    _cut_side(state, 0, f1, upward, downward)
    _cut_side(state, 1, f2, upward, downward)
    _cut_side(state, 2, f3, upward, downward)
    _cut_side(state, 3, f4, upward, downward)


def _cut_side(state: State, i: int, f: float, upward: float, downward: float) -> None:
    """Cuts parameter ``i`` where f θ may be at most ``upward`` below its greatest and ``downward`` above its least."""
    low, high = state[LOW + i], state[HIGH + i]
    if f > 0.0:
        state[LOW + i] = max(low, high - upward / f - ROUNDING)
        state[HIGH + i] = min(high, low + downward / f + ROUNDING)
    elif f < 0.0:
        state[LOW + i] = max(low, high + downward / f - ROUNDING)
        state[HIGH + i] = min(high, low - upward / f + ROUNDING)


def _cut_ellipsoid(state: State, f1: float, f2: float, f3: float, f4: float, low: float, high: float) -> None:
    """Cuts the ellipsoid to low ≤ φ·θ ≤ high, with the ρ of least volume (B4), and the box to the ellipsoid's."""
    g1, g2, g3, g4 = _turned(state, f1, f2, f3, f4)
    square = f1 * g1 + f2 * g2 + f3 * g3 + f4 * g4
    if square <= 0.0:
        return
    reach = math.sqrt(square)
    centre = f1 * state[CENTRE] + f2 * state[CENTRE + 1] + f3 * state[CENTRE + 2] + f4 * state[CENTRE + 3]
    lowest, highest = max((low - centre) / reach, -1.0), min((high - centre) / reach, 1.0)
    if lowest > highest + ROUNDING:
        state[FALSIFIED] = 1.0
        return
    # In units of the reach: the strip's middle and half width, ρ = m / (1 − m), and what is left of the axis, m.
    nu, half = 0.5 * (lowest + highest), 0.5 * (highest - lowest)
    n, nn, hh = state[UNKNOWNS], nu * nu, half * half
    b = 1.0 - hh - nn
    root = math.sqrt(b * b + 4.0 * (n * n - 1.0) * nn * hh)
    m = max(2.0 * (n - 1.0) * hh / max(b + root, ROUNDING), LEAST_SHARE)
    if m >= 1.0:
        return
    taken = 1.0 - m
    scale = (1.0 + hh * taken / m - nn * taken) * (1.0 + ROUNDING)
    step, share = taken * nu / reach, taken / square
    c1, c2, c3, c4 = (
        state[CENTRE] + step * g1,
        state[CENTRE + 1] + step * g2,
        state[CENTRE + 2] + step * g3,
        state[CENTRE + 3] + step * g4,
    )
    state[CENTRE], state[CENTRE + 1], state[CENTRE + 2], state[CENTRE + 3] = c1, c2, c3, c4
    h1, h2, h3 = share * g1, share * g2, share * g3
    state[SHAPE] = p11 = scale * (state[SHAPE] - h1 * g1)
    state[SHAPE + 1] = scale * (state[SHAPE + 1] - h1 * g2)
    state[SHAPE + 2] = scale * (state[SHAPE + 2] - h1 * g3)
    state[SHAPE + 3] = scale * (state[SHAPE + 3] - h1 * g4)
    state[SHAPE + 4] = p22 = scale * (state[SHAPE + 4] - h2 * g2)
    state[SHAPE + 5] = scale * (state[SHAPE + 5] - h2 * g3)
    state[SHAPE + 6] = scale * (state[SHAPE + 6] - h2 * g4)
    state[SHAPE + 7] = p33 = scale * (state[SHAPE + 7] - h3 * g3)
    state[SHAPE + 8] = scale * (state[SHAPE + 8] - h3 * g4)
    state[SHAPE + 9] = p44 = scale * (state[SHAPE + 9] - share * g4 * g4)
    _keep(state, 0, c1, p11)
    _keep(state, 1, c2, p22)
    _keep(state, 2, c3, p33)
    _keep(state, 3, c4, p44)


def _keep(state: State, i: int, centre: float, square: float) -> None:
    """Cuts parameter ``i`` to what the ellipsoid leaves of it."""
    half = math.sqrt(max(square, 0.0)) + ROUNDING
    low, high = max(state[LOW + i], centre - half), min(state[HIGH + i], centre + half)
    if low > high:
        state[FALSIFIED] = 1.0
        return
    state[LOW + i], state[HIGH + i] = low, high
