"""Inner loops of a design search, for any plant of :func:`emb_bench.brake.motion.advance`.

Plain Python on arrays; :func:`emb_bench.compiled.compiled` makes it fast. Conventions: n periods, m unknowns, and the
extended state z = (x, s) of Z = STATES + SENSITIVE m numbers, the brake's state first, then the rows of its
sensitivities.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emb_bench.brake.euler import sign
from emb_bench.brake.motion import SENSITIVE, STATES, Integers, advance
from emb_bench.config.plants import Mechanics
from emb_bench.information.symmetric import Floats, add_increment
from emb_runtime.config.bench import BrakeParameters

COARSE_SEARCHES = 18  # Default number of coarse searches; the best designs are polished
STATE_STEP = 1e-5
"""Half width of the differences in state and current [rad, rad/s, 1, A]: the maps are smooth, of order 1."""
ASIDE = 2e-5
"""Least distance from contact and from rest at which the maps are differentiated [rad, rad/s]: across them they jump,
and a jump divided by STATE_STEP, multiplied over some dozen samples, overflows."""
SPEED_PRICE = 0.02
"""Price of 1 rad/s beyond the speed limit for one sample, where 1 rad beyond an angle, and 1 rad or 1 rad/s at the end,
cost 1. It exceeds the gain: some 1e-4 in the logarithm of a criterion per sample and rad/s beyond the speed limit, and
0.1 per rad beyond home."""
ARRIVED = 0.02  # Distance from the end of a journey that counts as having arrived [rad]
ARRIVAL = 4.0  # Reserve of a coarse return home [periods], which the polish uses


class Box(NamedTuple):
    """Limits of a design, as floats for numba."""

    current: float  # Largest current, both signs [A]
    low: float  # Lowest angle [rad]
    high: float  # Highest angle [rad]
    speed: float  # Largest speed, both signs [rad/s]
    home_angle: float  # Largest |angle| at the end [rad]; inf without a return
    home_velocity: float  # Largest |velocity| at the end [rad/s]; inf without a return


class Task(NamedTuple):
    """A design problem for compiled loops: a brake, the m unknowns, and limits."""

    mechanics: Mechanics
    brake: BrakeParameters
    box: Box
    t_s: float  # Period [s]
    unknowns: Integers  # Indices of the unknowns in ``PARAMETERS``, shape (m,)
    start: Floats  # Their sensitivities at the start, shape (m, SENSITIVE)
    bias: Floats  # Derivative of the encoder's reading to each unknown, shape (m,)
    w1: float  # Weight of the angle
    w2: float  # Weight of the velocity


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


def inform(task: Task, first: int, u: Floats, x: Floats, s: Floats, m: Floats) -> None:
    """Sensitivities and information of a motion from a period on; earlier rows stay unchanged."""
    size = task.unknowns.shape[0]
    y, trial = np.zeros((size, 2)), np.zeros(STATES)
    for k in range(first, u.shape[0]):
        for i in range(STATES):
            trial[i] = x[k, i]
        for i in range(size):
            for j in range(SENSITIVE):
                s[k + 1, i, j] = s[k, i, j]
        for i in range(m.shape[1]):
            m[k + 1, i] = m[k, i]
        advance(task.mechanics, task.brake, trial, u[k], task.t_s, task.unknowns, s[k + 1])
        for i in range(size):
            y[i, 0], y[i, 1] = s[k + 1, i, 0] + task.bias[i], s[k + 1, i, 1]
        add_increment(m[k + 1], y, task.w1, task.w2)


def linearise(task: Task, u: Floats, x: Floats, s: Floats, jacobian: Floats) -> None:
    """Derivatives of every period's map (z, u) → z by central differences, shape (n, Z, Z + 1), the current's last.

    The map is linear in the sensitivities, with the same derivatives for each row: one difference over a unit step
    serves for all rows.
    """
    m = task.unknowns.shape[0]
    size = STATES + SENSITIVE * m
    work_x, work_s = np.empty((2, STATES)), np.empty((2, m, SENSITIVE))
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
                advance(task.mechanics, task.brake, work_x[side], current, task.t_s, task.unknowns, work_s[side])
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


def gradients(task: Task, jacobian: Floats, s: Floats, result: Floats) -> None:
    """Derivatives of every packed element of the FIM with respect to every current, by one adjoint sweep.

    The result has the shape (m (m + 1) / 2, n); the Jacobian is that of :func:`linearise`.
    """
    w1, w2, bias = task.w1, task.w2, task.bias
    n, size = jacobian.shape[0], jacobian.shape[1]
    m, element, adjoint = s.shape[1], 0, np.zeros((2, size))
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


def explore(task: Task, genes: Floats, u: Floats, m: Floats, price: Floats) -> None:
    """Simulate a population of coarse designs: journeys, driven by a deadbeat loop within the box.

    A journey is the fastest way to an angle, followed by a constant speed. The place of slow creep, its side of contact
    and its direction determine the criterion more than the way to it; a reference of speeds alone would have the place
    as a small difference of long ways. The simple control laws may leave the box.

    Genes, shape (count, 3 g): the angles −1..1 of g journeys, of which the cube is the share of the angle's limit on
    that side; the speeds −1..1 thereafter, of which it is the share of the largest; their lengths in any unit.

    Results: currents ``u``, shape (count, n), packed FIM ``m`` and the price of :func:`excess`, one for each design.
    """
    p, box, t_s, n = task.brake, task.box, task.t_s, u.shape[1]
    journeys, nothing, none = genes.shape[1] // 3, task.unknowns[:0], task.start[:0]
    x, s = np.zeros((n + 1, STATES)), np.zeros((n + 1, task.unknowns.shape[0], SENSITIVE))
    total = np.zeros((n + 1, m.shape[1]))
    s[0] = task.start
    for e in range(genes.shape[0]):
        duration = 0.0
        for g in range(journeys):
            duration += genes[e, 2 * journeys + g]
        journey, end, toward = -1, 0.0, 0.0
        target, speed = 0.0, 0.0
        for k in range(n):
            while k >= end and journey < journeys - 1:
                journey += 1
                end += genes[e, 2 * journeys + journey] / duration * n
                angle, creep = genes[e, journey], genes[e, journeys + journey]
                target = angle * angle * angle * (box.high if angle > 0.0 else -box.low)
                speed = creep * creep * creep * box.speed
                toward = 1.0 if target > x[k, 0] else -1.0
            distance = target - x[k, 0] - t_s * x[k, 1]  # at the end of the period; its current has little effect
            if toward * (target - x[k, 0]) <= 0.0 or abs(distance) < ARRIVED:
                toward = 0.0
            goal = speed
            if toward != 0.0:
                fastest = allowed(abs(distance), deceleration(p, box), t_s)
                goal = sign(distance) * min(fastest, abs(distance) / t_s, box.speed)
            u[e, k] = follow(p, box, t_s, x[k, 0], x[k, 1], goal, n - k)
            for i in range(STATES):
                x[k + 1, i] = x[k, i]
            advance(task.mechanics, p, x[k + 1], u[e, k], t_s, nothing, none)
        inform(task, 0, u[e], x, s, total)
        price[e], m[e] = excess(x, box)[0], total[n]


def deceleration(p: BrakeParameters, box: Box) -> float:
    """Deceleration of a coarse design at any angle [rad/s²]."""
    motor = p.k_m * box.current
    return 0.9 * max(motor + p.T_c - p.gamma * p.k_1 * box.high * 0.5, 0.1 * motor) / p.J


def follow(p: BrakeParameters, box: Box, t_s: float, x1: float, x2: float, goal: float, periods: int) -> float:
    """Current that brings the speed to ``goal`` in one period, unless a limit or the way home forbids [A].

    ``periods`` remain to the end of the experiment.
    """
    spring = p.gamma * p.k_1 * max(x1, 0.0)
    braking = deceleration(p, box)
    if math.isfinite(box.home_angle) and periods * t_s <= way_home(x1, x2, braking, box.speed) + ARRIVAL * t_s:
        goal = -sign(x1) * allowed(abs(x1), braking, t_s)
    ahead = x1 + t_s * x2
    fastest = min(allowed(box.high - ahead, braking, t_s), box.speed)
    slowest = -min(allowed(ahead - box.low, braking, t_s), box.speed)
    target = min(max(goal, slowest), fastest)
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
