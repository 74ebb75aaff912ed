"""Simulated annealing of a design's speeds: it leaves the local optima of a polish.

A polish keeps the direction of motion of every sample, and ends on a corner of the set with this pattern. The optima of
E have many short hops during a slow creep, and each set of hops is a local optimum. The annealing varies the pattern:
it shifts, replaces and moves blocks of speeds, and adds hops; the currents follow by dead-beat control. A worse
variation is accepted with a falling probability (Kirkpatrick, Gelatt and Vecchi, Science 220, 1983), one variation at a
time: the best of several would mostly be one without effect. Only the periods after the first change are simulated
again.

Without it, E of the three held-out Euler brakes of docs/figures.md ends at 0.939 to 0.948 of the best found instead of
0.994 and more, and D at 0.987 to 0.999; polishing more designs to convergence does not help.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from emb_bench.brake.euler import sign
from emb_bench.brake.motion import STATES, advance
from emb_bench.compiled import compiled
from emb_bench.design.kernel import Task, excess, inform
from emb_bench.design.problem import Problem
from emb_bench.information.symmetric import Floats, packed_size, phi

VARIATIONS = 28  # Variations that one annealing simulates for each sample of a design
TEMPERATURE = 2e-4  # Mean loss of φ that is accepted at the start; it falls to zero as a parabola
SOFTNESS = 0.03
"""Initial softness of the criterion, which rounds E's kinks; it falls to zero in the warmer half. In good designs for E
the two smallest eigenvalues are equal, and hardly a variation increases both."""
PRICE = 0.3  # Share of the price of leaving the box that a variation pays; the polish moves it back inside
HOPELESS = 0.05  # Loss by that price beyond which a variation is dropped before its information is computed
TWICE = 0.4  # Share of the variations that are two changes
AT_TURNS = 0.4  # Share of the changes that begin near a turn
STRAY = 0.05  # Way beyond home to which the speeds of a variation may lead [rad]; one that leads further is drawn anew
DRAWS = 4  # Most times that a variation is drawn
CORRECTIONS = 8  # Simulations of a period at most that find the current for a speed; the Euler brake needs none
HIT = 1e-3  # Distance from a speed that counts as having reached it [rad/s]


class Tracks(NamedTuple):
    """Designs given by their speeds, with their trajectories."""

    speeds: Floats  # Reached at the ends of the periods, shape (count, n) [rad/s]
    u: Floats  # Currents, shape (count, n) [A]
    x: Floats  # States, shape (count, n + 1, STATES)
    s: Floats  # Sensitivities, shape (count, n + 1, m, SENSITIVE)
    m: Floats  # Packed FIM of the samples up to each, shape (count, n + 1, m (m + 1) / 2)
    price: Floats  # That of :func:`emb_bench.design.kernel.excess`, shape (count,)


def annealed(problem: Problem, speeds: Floats, rng: np.random.Generator) -> Floats:
    """Currents of the best design that an annealing passed in its colder half, shape (n,), n ≥ 3.

    It begins with speeds at the ends of the samples [rad/s].
    """
    tracks = tracked(problem, np.tile(speeds, (2, 1)))  # the present one and its variation
    best: Floats = tracks.u[0].copy()
    compiled(anneal)(problem.task, problem.criterion.compiled, VARIATIONS * len(speeds), rng, tracks, best)
    return best


def tracked(problem: Problem, speeds: Floats) -> Tracks:
    """Designs that follow speeds, shape (count, n) [rad/s], within the currents' limit."""
    start = problem.task.start
    count, n = speeds.shape
    s = np.zeros((count, n + 1, *start.shape))
    s[:, 0] = start
    m = np.zeros((count, n + 1, packed_size(len(start))))
    u, x = np.zeros((count, n)), np.zeros((count, n + 1, STATES))
    tracks = Tracks(speeds.copy(), u, x, s, m, np.zeros(count))
    for number in range(count):
        compiled(track)(problem.task, number, tracks)
    return tracks


def track(task: Task, number: int, tracks: Tracks) -> None:
    """Simulate the design of a number, with target speeds."""
    u, x, s, m = tracks.u[number], tracks.x[number], tracks.s[number], tracks.m[number]
    reach(task, 0, tracks.speeds[number], u, x)
    tracks.price[number] = excess(x, task.box)[0]
    inform(task, 0, u, x, s, m)


def reach(task: Task, first: int, speeds: Floats, u: Floats, x: Floats) -> None:
    """Find the currents for a design's speeds from a period on, and the states and speeds that they reach, in place.

    Of the box, only the currents' limit is certain to hold.
    """
    p, most = task.brake, task.box.current
    nothing, none = task.unknowns[:0], task.start[:0]
    rate = p.J / (task.t_s * p.k_m)
    for k in range(first, u.shape[0]):
        x1, x2 = x[k, 0], x[k, 1]
        rubbing = x2 if x2 != 0.0 else speeds[k]
        torque = p.gamma * p.k_1 * max(x1, 0.0) + p.T_c * sign(rubbing) + p.f_v * x2
        current = min(max(torque / p.k_m + rate * (speeds[k] - x2), -most), most)
        for _ in range(CORRECTIONS):
            u[k] = current
            for i in range(STATES):
                x[k + 1, i] = x[k, i]
            advance(task.mechanics, p, x[k + 1], current, task.t_s, nothing, none)
            missed = speeds[k] - x[k + 1, 1]
            corrected = min(max(current + rate * missed, -most), most)
            if abs(missed) < HIT or corrected == current:
                break
            current = corrected
        speeds[k] = x[k + 1, 1]


def anneal(task: Task, goal: int, count: int, rng: np.random.Generator, tracks: Tracks, best: Floats) -> None:
    """Vary a design ``count`` times, and continue with each accepted variation.

    Of the two designs the first one is varied first; both change. ``best`` becomes the currents of the best design of
    the colder half.
    """
    box, n, rows = task.box, tracks.u.shape[1], tracks.s.shape[2]
    work = np.empty((rows, rows))
    at, most = 0, -math.inf
    for number in range(count):
        to = 1 - at
        speeds, u, x, s, m = tracks.speeds[to], tracks.u[to], tracks.x[to], tracks.s[to], tracks.m[to]
        first = 0
        for _ in range(DRAWS):
            speeds[:] = tracks.speeds[at]
            first = vary(speeds, box.speed, rng)
            if task.t_s * abs(speeds.sum()) <= box.home_angle + STRAY:
                break
        u[:first], x[: first + 1] = tracks.u[at, :first], tracks.x[at, : first + 1]
        reach(task, first, speeds, u, x)
        tracks.price[to] = excess(x, box)[0]
        if PRICE * (tracks.price[to] - tracks.price[at]) > HOPELESS:
            continue
        s[first], m[first] = tracks.s[at, first], tracks.m[at, first]
        inform(task, first, u, x, s, m)
        remaining = 1.0 - number / count
        softness = max(0.0, 2.0 * remaining - 1.0) * SOFTNESS
        now = phi(goal, tracks.m[at, n], softness, work) - PRICE * tracks.price[at]
        worth = phi(goal, m[n], softness, work) - PRICE * tracks.price[to]
        if worth >= now - TEMPERATURE * remaining * remaining * rng.exponential():
            s[:first], m[:first] = tracks.s[at, :first], tracks.m[at, :first]
            at = to
            if remaining <= 0.5 and worth > most:
                most = worth
                best[:] = u


def vary(v: Floats, largest: float, rng: np.random.Generator) -> int:
    """Change speeds up to ``largest`` [rad/s] once or twice, in place; index before which nothing is changed."""
    first = change(v, largest, rng)
    if rng.random() < TWICE:
        first = min(first, change(v, largest, rng))
    return first


def change(v: Floats, largest: float, rng: np.random.Generator) -> int:
    """Change a sequence of speeds once; as :func:`vary`."""
    n = v.shape[0]
    begin = int(rng.random() * (n - 2))
    if rng.random() < AT_TURNS:
        begin = near_turn(v, begin, rng)
    length = min(int(10.0 ** (2.2 * rng.random())), n - begin - 1)
    end = begin + length
    way = 1.0 if rng.random() < 0.5 else -1.0
    kind = rng.random()
    if kind < 0.3:
        shift(v[begin:end], way, rng)
    elif kind < 0.45:
        which = rng.random()
        creep = way * largest * 10.0 ** (-3.7 * rng.random())
        v[begin:end] = creep if which < 0.5 else (-v[begin] if which < 0.75 else v[begin])
    elif kind < 0.6:
        v[begin:end] += way * largest * 10.0 ** (-4.2 + 3.5 * rng.random())
    elif kind < 0.7:
        v[begin:end] *= 1.0 + 0.2 * rng.standard_normal()
    elif kind < 0.9:
        hop(v[begin:], way * largest * 10.0 ** (-2.4 + 2.2 * rng.random()), rng)
    else:
        block, rest = v[begin:end].copy(), np.concatenate((v[:begin], v[end:]))
        to = int(rng.random() * (n - length + 1))
        v[:to], v[to : to + length], v[to + length :] = rest[:to], block, rest[to:]
        begin = min(begin, to)
    return begin


def near_turn(v: Floats, otherwise: int, rng: np.random.Generator) -> int:
    """Index near a random change of direction; ``otherwise`` if there is none."""
    turns = 0
    for k in range(v.shape[0] - 1):
        turns += v[k] * v[k + 1] < 0.0
    which = int(rng.random() * turns)
    for k in range(v.shape[0] - 1):
        if v[k] * v[k + 1] < 0.0:
            if which == 0:
                return min(max(k - 1 + int(5.0 * rng.random()), 0), len(v) - 3)
            which -= 1
    return otherwise


def shift(block: Floats, way: float, rng: np.random.Generator) -> None:
    """Shift a block by some samples, in place; an end of it is cut off, the other one holds."""
    size = block.shape[0]
    by = min(1 + int((4.0 if rng.random() < 0.8 else 20.0) * rng.random()), size)
    old = block.copy()
    if way > 0.0:
        block[by:] = old[: size - by]
        block[:by] = old[0]
    else:
        block[: size - by] = old[by:]
        block[size - by :] = old[size - 1]


def hop(after: Floats, height: float, rng: np.random.Generator) -> None:
    """Add a triangle of speed at the start, in place, and mostly one that takes it back, at once or later."""
    length = 2 + int(14.0 * rng.random())
    back = after.shape[0]
    if rng.random() < 0.7:
        back = length + (int(60.0 * rng.random()) if rng.random() < 0.5 else 0)
    for j in range(length):
        part = height * (1 + min(j, length - 1 - j)) / ((length + 1) // 2)
        if j < after.shape[0]:
            after[j] += part
        if back + j < after.shape[0]:
            after[back + j] -= part
