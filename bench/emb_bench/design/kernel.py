"""Inner loops of a design search, for any plant of :func:`emb_bench.brake.motion.advance`.

Plain Python on arrays; :func:`emb_bench.compiled.compiled` makes it fast. Conventions: n periods, m unknowns, and the
extended state z = (x, s) of Z = STATES + SENSITIVE m numbers, the brake's state first, then the rows of its
sensitivities.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emb_bench.brake.euler import sensitivity_step, sign, step
from emb_bench.brake.motion import SENSITIVE, STATES, Integers, advance
from emb_bench.brake.parameters import DELAY, PAST_COMMAND
from emb_bench.information.symmetric import Floats, add_increment, information, packed_index, packed_size
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import EULER, Mechanics

STATE_STEP = 1e-5
"""Half width of the differences in state and current [rad, rad/s, 1, A]: the maps are smooth, of order 1."""
ASIDE = 2e-5
"""Least distance from contact and from rest at which the maps are differentiated [rad, rad/s]: across them they jump,
and a jump over a difference of STATE_STEP, multiplied over some dozen samples, is beyond all numbers."""
SPEED_PRICE = 0.02
"""Price of 1 rad/s beyond the speed limit for one sample, where 1 rad beyond an angle, and 1 rad or 1 rad/s at the
end, cost 1. More than it brings: the speed limit brings some 1e-4 per sample and rad/s, in the logarithm of a
criterion, and home 0.1 per rad."""
FEW = 4  # Unknowns at most, for which the Euler brake's sensitivities are computed in loops of fixed length
ARRIVED = 0.02  # Distance from the end of a journey that counts as having arrived [rad]
ARRIVAL = 4.0  # Periods that a coarse return home keeps in hand; the polish takes them back


class Box(NamedTuple):
    """Limits that a design keeps: floats, so that numba takes it."""

    current: float  # Largest current, both signs [A]
    low: float  # Lowest angle [rad]
    high: float  # Highest angle [rad]
    speed: float  # Largest speed, both signs [rad/s]
    home_angle: float  # Largest |angle| at the end [rad]; inf without a return
    home_velocity: float  # Largest |velocity| at the end [rad/s]; inf without a return


def excess(x: Floats, box: Box) -> tuple[float, float]:
    """Excess of a trajectory, shape (n + 1, STATES), over the box: a price, and its maximum [rad, rad/s].

    The price is the sum over samples, of speeds at a rate of SPEED_PRICE but for the last one.
    """
    total, worst = 0.0, 0.0
    n = x.shape[0] - 1
    for k in range(1, n + 1):
        if not (box.low <= x[k, 0] <= box.high and abs(x[k, 1]) <= box.speed):
            angle = max(0.0, box.low - x[k, 0], x[k, 0] - box.high)
            speed = max(0.0, abs(x[k, 1]) - box.speed)
            total += angle + SPEED_PRICE * speed
            worst = max(worst, angle, speed)
    angle, speed = max(0.0, abs(x[n, 0]) - box.home_angle), max(0.0, abs(x[n, 1]) - box.home_velocity)
    return total + angle + speed, max(worst, angle, speed)


def is_stepped(mechanics: Mechanics, chosen: Integers) -> bool:
    """Returns True if a period is one step of the Euler brake and of the sensitivities of few unknowns, and no more."""
    return mechanics.solver == EULER and chosen.shape[0] <= FEW and not (chosen == DELAY).any()


def rows(mechanics: Mechanics, chosen: Integers) -> int:
    """Number of sensitivities that :func:`inform` computes; those beyond the unknowns are zero."""
    return FEW if is_stepped(mechanics, chosen) else chosen.shape[0]


def inform(
    mechanics: Mechanics,
    p: BrakeParameters,
    t_s: float,
    chosen: Integers,
    bias: Floats,
    w1: float,
    w2: float,
    first: int,
    u: Floats,
    x: Floats,
    s: Floats,
    m: Floats,
) -> None:
    """Sensitivities and information of a motion from a period on.

    Args:
        mechanics: how the brake moves.
        p: the brake.
        t_s: period [s].
        chosen: indices in ``PARAMETERS``.
        bias: what the encoder adds to each sensitivity of the angle, of the length of ``chosen``.
        w1: weight of the angle.
        w2: weight of the velocity.
        first: the period.
        u: currents, shape (n,).
        x: states, shape (n + 1, STATES).
        s: sensitivities, a result but for those up to the start of the period, shape (n + 1, q, SENSITIVE), where q is
            :func:`rows`.
        m: packed FIM of the samples up to each, likewise, shape (n + 1, q (q + 1) / 2).
    """
    if is_stepped(mechanics, chosen):
        inform_stepped(p, t_s, chosen, bias, w1, w2, first, u, x, s, m)
        return
    y, trial = np.zeros((chosen.shape[0], 2)), np.zeros(STATES)
    for k in range(first, u.shape[0]):
        trial[:] = x[k]
        s[k + 1], m[k + 1] = s[k], m[k]
        advance(mechanics, p, trial, u[k], t_s, chosen, s[k + 1])
        for i in range(chosen.shape[0]):
            y[i, 0], y[i, 1] = s[k + 1, i, 0] + bias[i], s[k + 1, i, 1]
        add_increment(m[k + 1], y, w1, w2)


def inform_stepped(
    p: BrakeParameters,
    t_s: float,
    chosen: Integers,
    bias: Floats,
    w1: float,
    w2: float,
    first: int,
    u: Floats,
    x: Floats,
    s: Floats,
    m: Floats,
) -> None:
    """As :func:`inform`, of the Euler brake: without loops over the unknowns, whose numbers then stay in registers.

    The velocity's sensitivity after a step is linear in both before it, in the current, the angle and the number 1 in
    contact, and in the velocity and its sign. The coefficients are what ``sensitivity_step`` makes of ones and zeros.
    """
    of, offset = np.zeros((FEW, 5)), np.zeros(FEW)
    for i in range(chosen.shape[0]):
        c = chosen[i]
        of[i, 0] = sensitivity_step(p, -1.0, 0.0, 1.0, t_s, 0.0, 0.0, c)[1]
        of[i, 1] = sensitivity_step(p, 0.0, 0.0, 0.0, t_s, 0.0, 0.0, c)[1]
        of[i, 2] = sensitivity_step(p, 1.0, 0.0, 0.0, t_s, 0.0, 0.0, c)[1] - of[i, 1]
        of[i, 3] = sensitivity_step(p, -1.0, 2.0, 0.0, t_s, 0.0, 0.0, c)[1]
        of[i, 4] = sensitivity_step(p, -1.0, 1.0, 0.0, t_s, 0.0, 0.0, c)[1]
        of[i, 3] -= of[i, 4]
        of[i, 4] -= of[i, 3]
        offset[i] = bias[i]
    kept = sensitivity_step(p, -1.0, 0.0, 0.0, t_s, 0.0, 1.0, PAST_COMMAND)[1]
    pulled = sensitivity_step(p, 0.0, 0.0, 0.0, t_s, 1.0, 0.0, PAST_COMMAND)[1]
    f0, f1, f2, f3 = five(of[0]), five(of[1]), five(of[2]), five(of[3])
    o0, o1, o2, o3 = offset[0], offset[1], offset[2], offset[3]
    a0, a1, a2, a3 = s[first, 0, 0], s[first, 1, 0], s[first, 2, 0], s[first, 3, 0]
    b0, b1, b2, b3 = s[first, 0, 1], s[first, 1, 1], s[first, 2, 1], s[first, 3, 1]
    m00, m01, m02, m03, m11 = five(m[first])
    m12, m13, m22, m23, m33 = five(m[first, 5:])
    for k in range(first, u.shape[0]):
        x1, x2 = x[k, 0], x[k, 1]
        touching = 1.0 if x1 >= 0.0 else 0.0
        by, back = (u[k], touching, touching * x1, x2, sign(x2)), touching * pulled
        a0, b0 = a0 + t_s * b0, kept * b0 + back * a0 + dot5(f0, by)
        a1, b1 = a1 + t_s * b1, kept * b1 + back * a1 + dot5(f1, by)
        a2, b2 = a2 + t_s * b2, kept * b2 + back * a2 + dot5(f2, by)
        a3, b3 = a3 + t_s * b3, kept * b3 + back * a3 + dot5(f3, by)
        s[k + 1, 0, 0], s[k + 1, 1, 0], s[k + 1, 2, 0], s[k + 1, 3, 0] = a0, a1, a2, a3
        s[k + 1, 0, 1], s[k + 1, 1, 1], s[k + 1, 2, 1], s[k + 1, 3, 1] = b0, b1, b2, b3
        y0, y1, y2, y3 = a0 + o0, a1 + o1, a2 + o2, a3 + o3
        m00 += information(y0, b0, y0, b0, w1, w2)
        m01 += information(y0, b0, y1, b1, w1, w2)
        m02 += information(y0, b0, y2, b2, w1, w2)
        m03 += information(y0, b0, y3, b3, w1, w2)
        m11 += information(y1, b1, y1, b1, w1, w2)
        m12 += information(y1, b1, y2, b2, w1, w2)
        m13 += information(y1, b1, y3, b3, w1, w2)
        m22 += information(y2, b2, y2, b2, w1, w2)
        m23 += information(y2, b2, y3, b3, w1, w2)
        m33 += information(y3, b3, y3, b3, w1, w2)
        m[k + 1, 0], m[k + 1, 1], m[k + 1, 2], m[k + 1, 3], m[k + 1, 4] = m00, m01, m02, m03, m11
        m[k + 1, 5], m[k + 1, 6], m[k + 1, 7], m[k + 1, 8], m[k + 1, 9] = m12, m13, m22, m23, m33


Five = tuple[float, float, float, float, float]


def five(v: Floats) -> Five:
    """The first five numbers."""
    return v[0], v[1], v[2], v[3], v[4]


def dot5(a: Five, b: Five) -> float:
    """Their dot product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4]


def linearise(
    mechanics: Mechanics,
    p: BrakeParameters,
    u: Floats,
    t_s: float,
    chosen: Integers,
    x: Floats,
    s: Floats,
    work_x: Floats,
    work_s: Floats,
    jacobian: Floats,
) -> None:
    """Derivatives of every period's map (z, u) → z by central differences.

    The map is linear in the sensitivities, and each row of them moves as the brake's state does: their derivatives are
    differences over a unit step, of one row for all.

    Args:
        mechanics: how the brake moves.
        p: the brake.
        u: currents, shape (n,).
        t_s: period [s].
        chosen: indices in ``PARAMETERS``, shape (m,).
        x: states, shape (n + 1, STATES).
        s: sensitivities, shape (n + 1, m, SENSITIVE).
        work_x: scratch, shape (2, STATES).
        work_s: scratch, shape (2, m, SENSITIVE).
        jacobian: the result, shape (n, Z, Z + 1); its last column is the current's.
    """
    m = chosen.shape[0]
    size = STATES + SENSITIVE * m
    jacobian[:] = 0.0
    for k in range(u.shape[0]):
        for column in range(STATES + SENSITIVE + 1):
            of_state, of_current = column < STATES, column == STATES + SENSITIVE
            h = STATE_STEP if of_state or of_current else 1.0
            for side in range(2):
                shift = h if side == 0 else -h
                work_x[side] = x[k]
                work_s[side] = s[k]
                if of_state:
                    work_x[side, 0], work_x[side, 1] = aside(x[k, 0]), aside(x[k, 1])
                    work_x[side, column] += shift
                elif not of_current:
                    work_s[side, 0, column - STATES] += shift
                current = u[k] + shift if of_current else u[k]
                advance(mechanics, p, work_x[side], current, t_s, chosen, work_s[side])
            if of_state or of_current:
                to = column if of_state else size
                for row in range(STATES):
                    jacobian[k, row, to] = (work_x[0, row] - work_x[1, row]) / (2.0 * h)
                for row in range(STATES, size):
                    i, j = (row - STATES) // SENSITIVE, (row - STATES) % SENSITIVE
                    jacobian[k, row, to] = (work_s[0, i, j] - work_s[1, i, j]) / (2.0 * h)
            else:
                for j in range(SENSITIVE):
                    share = (work_s[0, 0, j] - work_s[1, 0, j]) / (2.0 * h)
                    for i in range(m):
                        jacobian[k, STATES + SENSITIVE * i + j, column + SENSITIVE * i] = share


def aside(value: float) -> float:
    """An angle [rad] or a velocity [rad/s], moved to ASIDE if nearer to zero."""
    if abs(value) >= ASIDE:
        return value
    return ASIDE if value >= 0.0 else -ASIDE


def gradients(jacobian: Floats, s: Floats, bias: Floats, w1: float, w2: float, adjoint: Floats, result: Floats) -> None:
    """Derivatives of every element of the FIM with respect to every current, by one adjoint sweep.

    Args:
        jacobian: of :func:`linearise`, shape (n, Z, Z + 1).
        s: sensitivities, shape (n + 1, m, SENSITIVE).
        bias: what the encoder adds to each sensitivity of the angle, shape (m,).
        w1: weight of the angle.
        w2: weight of the velocity.
        adjoint: scratch, shape (2, Z), zero where it is not known.
        result: shape (m (m + 1) / 2, n), packed elements by currents.
    """
    n, size = jacobian.shape[0], jacobian.shape[1]
    m = s.shape[1]
    element = 0
    for i in range(m):
        for j in range(i, m):
            adjoint[0] = 0.0
            for k in range(n - 1, -1, -1):
                adjoint[0, STATES + SENSITIVE * i] += w1 * (s[k + 1, j, 0] + bias[j])
                adjoint[0, STATES + SENSITIVE * i + 1] += w2 * s[k + 1, j, 1]
                adjoint[0, STATES + SENSITIVE * j] += w1 * (s[k + 1, i, 0] + bias[i])
                adjoint[0, STATES + SENSITIVE * j + 1] += w2 * s[k + 1, i, 1]
                adjoint[1] = 0.0
                slope = 0.0
                for row in range(size):
                    weight = adjoint[0, row]
                    if weight != 0.0:
                        for column in range(size):
                            adjoint[1, column] += weight * jacobian[k, row, column]
                        slope += weight * jacobian[k, row, size]
                result[element, k] = slope
                adjoint[0] = adjoint[1]
            element += 1


def explore(
    mechanics: Mechanics,
    p: BrakeParameters,
    box: Box,
    t_s: float,
    genes: Floats,
    chosen: Integers,
    start_s: Floats,
    bias: Floats,
    w1: float,
    w2: float,
    u: Floats,
    m: Floats,
    price: Floats,
) -> None:
    """Simulate a population of coarse designs: journeys, driven by a deadbeat loop within the box.

    A journey is the fastest way to an angle, and a speed from there on. Where a brake waits, and on which side of
    contact and in which direction it creeps while it does, is worth more than how it gets there; a reference that
    gives only speeds has it as the small difference of long ways.

    Args:
        mechanics: how the brake moves.
        p: the brake.
        box: what is kept, but for what the loop's simple laws miss.
        t_s: period [s].
        genes: shape (count, 3 g): the angles −1..1 of g journeys, of which the cube is the share of the angle's limit
            on that side; the speeds −1..1 thereafter, of which it is the share of the largest; their lengths in any
            unit.
        chosen: indices in ``PARAMETERS``, shape (q,).
        start_s: sensitivities at the start, shape (q, SENSITIVE).
        bias: what the encoder adds to each sensitivity of the angle, shape (q,).
        w1: weight of the angle.
        w2: weight of the velocity.
        u: currents, a result, shape (count, n).
        m: packed FIM, a result, shape (count, q (q + 1) / 2).
        price: a result, that of :func:`excess`, shape (count,).
    """
    n, q = u.shape[1], chosen.shape[0]
    journeys, stepped, size = genes.shape[1] // 3, is_stepped(mechanics, chosen), rows(mechanics, chosen)
    nothing, none = chosen[:0], start_s[:0]
    x, s = np.zeros((n + 1, STATES)), np.zeros((n + 1, size, SENSITIVE))
    total = np.zeros((n + 1, packed_size(size)))
    s[0, :q] = start_s
    for e in range(genes.shape[0]):
        whole = 0.0
        for g in range(journeys):
            whole += genes[e, 2 * journeys + g]
        journey, end, toward = -1, 0.0, 0.0
        target, speed = 0.0, 0.0
        for k in range(n):
            while k >= end and journey < journeys - 1:
                journey += 1
                end += genes[e, 2 * journeys + journey] / whole * n
                angle, creep = genes[e, journey], genes[e, journeys + journey]
                target = angle * angle * angle * (box.high if angle > 0.0 else -box.low)
                speed = creep * creep * creep * box.speed
                toward = 1.0 if target > x[k, 0] else -1.0
            left = target - x[k, 0] - t_s * x[k, 1]  # after this period, which its current does not change much
            if toward * (target - x[k, 0]) <= 0.0 or abs(left) < ARRIVED:
                toward = 0.0
            wanted = speed
            if toward != 0.0:
                wanted = sign(left) * min(allowed(abs(left), deceleration(p, box), t_s), abs(left) / t_s, box.speed)
            u[e, k] = follow(p, box, t_s, x[k, 0], x[k, 1], wanted, n - k)
            if stepped:
                x[k + 1, 0], x[k + 1, 1] = step(p, x[k, 0], x[k, 1], u[e, k], t_s)
            else:
                x[k + 1] = x[k]
                advance(mechanics, p, x[k + 1], u[e, k], t_s, nothing, none)
        inform(mechanics, p, t_s, chosen, bias, w1, w2, 0, u[e], x, s, total)
        price[e] = excess(x, box)[0]
        for i in range(q):
            for j in range(i, q):
                m[e, packed_index(q, i, j)] = total[n, packed_index(size, i, j)]


def deceleration(p: BrakeParameters, box: Box) -> float:
    """Deceleration that a coarse design counts on, whatever the angle [rad/s²]."""
    motor = p.k_m * box.current
    return 0.9 * max(motor + p.T_c - p.gamma * p.k_1 * box.high * 0.5, 0.1 * motor) / p.J


def follow(p: BrakeParameters, box: Box, t_s: float, x1: float, x2: float, wanted: float, left: int) -> float:
    """Current that brings the speed to ``wanted`` in one period, unless a limit or the way home forbids [A].

    Args:
        p: the brake.
        box: what is kept.
        t_s: period [s].
        x1: angle [rad].
        x2: velocity [rad/s].
        wanted: velocity [rad/s].
        left: periods to the end of the experiment.
    """
    spring = p.gamma * p.k_1 * max(x1, 0.0)
    braking = deceleration(p, box)
    if math.isfinite(box.home_angle) and left * t_s <= way_home(x1, x2, braking, box.speed) + ARRIVAL * t_s:
        wanted = -sign(x1) * allowed(abs(x1), braking, t_s)
    ahead = x1 + t_s * x2
    fastest = min(allowed(box.high - ahead, braking, t_s), box.speed)
    slowest = -min(allowed(ahead - box.low, braking, t_s), box.speed)
    target = min(max(wanted, slowest), fastest)
    rubbing = x2 if abs(x2) > p.T_c * t_s / p.J else target
    torque = p.J * (target - x2) / t_s + spring + p.T_c * sign(rubbing) + p.f_v * x2
    return min(max(torque / p.k_m, -box.current), box.current)


def allowed(distance: float, braking: float, t_s: float) -> float:
    """Speed from which a brake that is slowed once per period stops within a distance [rad/s]."""
    step = braking * t_s
    return max(0.0, math.sqrt(step * step + 2.0 * braking * max(distance, 0.0)) - step)


def way_home(x1: float, x2: float, braking: float, speed: float) -> float:
    """Time to come to rest at the origin with one acceleration both ways and a largest speed [s]."""
    distance, ahead = abs(x1), -x2 * sign(x1)
    time = 0.0
    if ahead < 0.0:
        time = -ahead / braking
        distance += 0.5 * ahead * ahead / braking
        ahead = 0.0
    peak = max(min(speed, math.sqrt(braking * distance + 0.5 * ahead * ahead)), ahead, 1e-9)
    cruise = max(0.0, distance - (peak * peak - 0.5 * ahead * ahead) / braking)
    return time + (2.0 * peak - ahead) / braking + cruise / peak
