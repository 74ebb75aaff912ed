"""A brake with any of the features beyond the thesis's equations, exact between events, and its sensitivities.

Between events the brake slides smoothly (:mod:`emb_bench.brake.runge_kutta`) or sticks. Steps end at events, found as
roots in the step's length to the last digits; a step also ends where the acceleration changes its sign, so that the
velocity is monotone within each and no stop is overlooked. Jumps of the sensitivities at events (Leine and Nijmeijer,
Dynamics and Bifurcations of Non-Smooth Mechanical Systems, 2004, chapter 7), with t* the time of the event:

- the brake *stops* and sticks: that of the velocity is zero from then on;
- it *reverses*: that of the velocity jumps by the factor a⁺/a⁻;
- it *breaks away* within a period, for the current comes with a lag. At g = |k_m i − γ F_cl| − T_s = 0, so
  ∂t*/∂θ = −(∂g/∂θ)/(dg/dt), and the velocity's sensitivity is −a⁺ ∂t*/∂θ. With a Stribeck velocity a⁺ = 0: it parts
  gently. Without a lag it breaks away at the beginning of a period, which depends on no parameter;
- *contact* begins or ends: the force is zero, so the motion's sensitivities are continuous. w begins at 0 with the
  contact, so that its sensitivity becomes that of (x1 − contact)/hysteresis_travel; and it ends with the contact;
- w *saturates*: the force is continuous, and so are the motion's sensitivities; those of w become zero, except that to
  the play: w is then ±play/2. With play the contact depends on angle and w alone, and w's sensitivity is continuous.

A brake that starts at rest exactly where contact begins counts as one that makes contact: w's derivative to ``contact``
and ``x1_0`` is that of a brake that starts just outside.

Accuracy: the velocity's local error is below ``tolerance``, 1e-8 rad/s, by the lower order of the pair. Over 500 ms of
random currents the states were within 5e-9 rad and 1e-7 rad/s of those with a tolerance of 1e-12, far below the
sensors' 1e-3 rad and 1 rad/s; sensitivities within 3e-7 of their largest value, and within 1e-4 for a Stribeck
exponent that is not an integer, for then the curve is not smooth at rest. Without features all values agree with the
exact brake to 1e-9.
"""

from __future__ import annotations

import math
from typing import Any

from emb_bench.brake.exact import late_start
from emb_bench.brake.forces import (
    acceleration_from_rest,
    clamping_force,
    decay,
    edge_ahead,
    parting_acceleration,
    sliding_torque,
    static_torque,
    stop_limit,
    stop_rate,
    travel,
)
from emb_bench.brake.parameters import CONTACT, DELAY, PLAY
from emb_bench.brake.runge_kutta import (
    Slide,
    Step,
    acceleration,
    current,
    current_share,
    forcing,
    stage,
    stages,
    step,
    vary,
)
from emb_bench.config.plants import Mechanics
from emb_runtime.config.bench import BrakeParameters

ROUNDING = 1e-13
"""Local error per step as a share of the velocity: keeps the steps of an extremely fast brake above rounding."""
SHORTEST = 1e-9  # Step that is taken whatever its error [s]
FIRST = 1e-5
"""First step of a brake that leaves rest on a Stribeck curve, whose slope need not be smooth there; they grow [s]."""
_ITERATIONS = 100  # of a root search; 4 to 8 are needed
_ANGLE = 0
_VELOCITY = 1
_ACCELERATION = 2


def advance_extended(m: Mechanics, p: BrakeParameters, x: Any, u: float, t_s: float, unknowns: Any, s: Any) -> None:
    """One sample period, in place; arguments are those of :func:`emb_bench.brake.motion.advance`."""
    i = _switch(m, p, x, u, t_s, unknowns, s)
    remaining, longest = t_s, t_s
    while remaining > 0.0:
        if x[1] == 0.0:
            sticking = min(_sticking_time(m, p, float(x[0]), float(x[2]), i, u), remaining)
            if sticking > 0.0:
                i = _stick(m, p, x, i, u, sticking, sticking < remaining, t_s, unknowns, s)
                remaining -= sticking
                if remaining <= 0.0:
                    break
        a, before, edge = _begin(m, p, x, i, u, unknowns, s)
        if a.x2 == 0.0 and m.stribeck_velocity > 0.0:
            longest = FIRST
        found, h, longest = _try(m, p, a, before, min(remaining, longest))
        found, h, reaches = _cut(m, p, a, before, edge, found, h)
        _vary_all(m, p, a, found, h, t_s, unknowns, s)
        i = current(m, i, u, h)
        _arrive(m, x, a, found, edge, reaches, unknowns, s)
        if found.x2 * a.direction <= 0.0:
            _stop(m, p, x, i, found.acceleration, a.direction, unknowns, s)
        remaining -= h
    x[3] = i


def _switch(m: Mechanics, p: BrakeParameters, x: Any, u: float, t_s: float, unknowns: Any, s: Any) -> float:
    """Switches to the new command; current at the beginning of the period [A]."""
    if m.current_lag > 0.0:
        for j in range(unknowns.shape[0]):
            s[j, 3] = current_share(m, float(x[3]), u, 0.0, s[j, 3], t_s, int(unknowns[j]))
        return float(x[3])
    for j in range(unknowns.shape[0]):
        if unknowns[j] == DELAY:
            force = _force(m, p, float(x[0]), float(x[2]))
            before, now = p.k_m * x[3] - p.gamma * force, p.k_m * u - p.gamma * force
            if x[1] == 0.0:
                sliding = math.copysign(sliding_torque(m, p, 0.0, force, decay(m, 0.0)), before)
                s[j, 1] += t_s * late_start(
                    acceleration_from_rest(m, p, before, force),
                    (now - sliding) / p.J,
                    acceleration_from_rest(m, p, now, force),
                )
            else:
                s[j, 1] += t_s * (before - now) / p.J
    return u


def _force(m: Mechanics, p: BrakeParameters, x1: float, w: float) -> float:
    """Clamping force on either side of contact [N]."""
    return clamping_force(m, p, x1, w) if travel(m, x1, w) > 0.0 else 0.0


def _sticking_time(m: Mechanics, p: BrakeParameters, x1: float, w: float, i: float, u: float) -> float:
    """Time for which a brake at rest sticks while the current goes from ``i`` to ``u``: from 0.0 to infinity [s]."""
    force = _force(m, p, x1, w)
    static, load = static_torque(m, p, force), p.gamma * force
    if abs(p.k_m * i - load) > static:
        return 0.0
    final = p.k_m * u - load
    if abs(final) <= static:
        return math.inf
    gap = (load + math.copysign(static, final)) / p.k_m - u
    if gap * (i - u) <= 0.0:  # the command lies at the limit, to the last digit
        return math.inf
    return max(0.0, m.current_lag * math.log((i - u) / gap))


def _stick(
    m: Mechanics,
    p: BrakeParameters,
    x: Any,
    i: float,
    u: float,
    t: float,
    breaks: bool,
    t_s: float,
    unknowns: Any,
    s: Any,
) -> float:
    """Keeps the brake at rest for the time ``t``, after which it may break away; current at the end [A]."""
    x1, w = float(x[0]), float(x[2])
    after = current(m, i, u, t)
    force = _force(m, p, x1, w)
    parting = parting_acceleration(m, p, force)
    direction = math.copysign(1.0, u - i)
    loaded = 1.0 if travel(m, x1, w) > 0.0 else 0.0
    at = stage(m, p, Slide(direction, x1, 0.0, w, 0.0, loaded, after, after), 0.0, x1, 0.0, 1.0)
    for j in range(unknowns.shape[0]):
        s[j, 1] = 0.0
        s[j, 3] = current_share(m, i, u, t, s[j, 3], t_s, int(unknowns[j]))
        if breaks:
            margin = at.per_angle * s[j, 0] + at.per_w * s[j, 2]
            margin += forcing(m, p, direction, at, int(unknowns[j]), s[j, 3])
            growth = p.k_m * (u - after) / m.current_lag / p.J
            s[j, 1] = direction * parting * margin / growth
    return after


def _begin(
    m: Mechanics, p: BrakeParameters, x: Any, i: float, u: float, unknowns: Any, s: Any
) -> tuple[Slide, float, float]:
    """The step that begins here, its acceleration [rad/s²], and the angle at which its laws end [rad]."""
    x1, x2, w = float(x[0]), float(x[1]), float(x[2])
    ahead = x2 if x2 != 0.0 else p.k_m * i - p.gamma * _force(m, p, x1, w)
    direction = 1.0 if ahead > 0.0 else -1.0
    rate, clamp = stop_rate(m, w, direction), travel(m, x1, w)
    if m.play > 0.0:
        loaded = clamp > 0.0 or (clamp == 0.0 and direction > 0.0 and rate == 0.0)
    else:
        loaded = clamp > 0.0 or (clamp == 0.0 and direction > 0.0)
        rate = rate if loaded else 0.0
    if x1 == 0.0 and loaded and m.play == 0.0:
        for j in range(unknowns.shape[0]):
            s[j, 2] = rate * (s[j, 0] - (1.0 if unknowns[j] == CONTACT else 0.0))
    a = Slide(direction, x1, x2, w, rate, 1.0 if loaded else 0.0, i, u)
    before = acceleration(m, p, a, 0.0, x1, x2)
    if x2 == 0.0 and before * direction < 0.0:  # by rounding, at the limit of sticking
        before = 0.0
    return a, before, edge_ahead(m, x1, w, direction)


def _try(m: Mechanics, p: BrakeParameters, a: Slide, before: float, h: float) -> tuple[Step, float, float]:
    """A step of at most ``h`` that is accurate enough, its length, and one for the next step [s]."""
    found = step(m, p, a, before, h)
    allowed = m.tolerance + ROUNDING * abs(found.x2)
    while found.error > allowed and h > SHORTEST:
        h *= max(0.1, 0.9 * (allowed / found.error) ** 0.2)
        found = step(m, p, a, before, h)
        allowed = m.tolerance + ROUNDING * abs(found.x2)
    return found, h, h * min(5.0, 0.9 * (allowed / max(found.error, 1e-30)) ** 0.2)


def _cut(
    m: Mechanics, p: BrakeParameters, a: Slide, before: float, edge: float, found: Step, h: float
) -> tuple[Step, float, bool]:
    """The step of length ``h`` cut at its first event, its length [s], and whether it ends at the ``edge`` [rad]."""
    if found.acceleration * before < 0.0:
        h = _root(m, p, a, before, h, _ACCELERATION, 0.0)
        found = step(m, p, a, before, h)
    if found.x2 * a.direction <= 0.0 and a.x2 != 0.0:
        h = _root(m, p, a, before, h, _VELOCITY, 0.0)
        found = step(m, p, a, before, h)
    reaches = (found.x1 - edge) * a.direction >= 0.0
    if reaches and found.x1 != edge:
        h = _root(m, p, a, before, h, _ANGLE, edge)
        found = step(m, p, a, before, h)
    return found, h, reaches


def _root(m: Mechanics, p: BrakeParameters, a: Slide, before: float, h: float, which: int, goal: float) -> float:
    """The shortest step, up to ``h``, with which angle, velocity or acceleration has come to ``goal`` [s].

    The Illinois variant of regula falsi (Dowell and Jarratt, BIT 11, 1971), which keeps a bracket: the result lies on
    the far side of the event.
    """
    low, high, moved = 0.0, h, 0
    f_low = (a.x1 if which == _ANGLE else a.x2 if which == _VELOCITY else before) - goal
    f_high = _value(step(m, p, a, before, h), which) - goal
    for _ in range(_ITERATIONS):
        if f_high == 0.0 or high - low <= 1e-15 * h:
            break
        guess = high - f_high * (high - low) / (f_high - f_low)
        if not low < guess < high:
            guess = 0.5 * (low + high)
            if not low < guess < high:
                break
        value = _value(step(m, p, a, before, guess), which) - goal
        if value * f_low > 0.0:
            low, f_low = guess, value
            f_high *= 0.5 if moved < 0 else 1.0
            moved = -1
        else:
            high, f_high = guess, value
            f_low *= 0.5 if moved > 0 else 1.0
            moved = 1
    return high


def _value(at: Step, which: int) -> float:
    return at.x1 if which == _ANGLE else at.x2 if which == _VELOCITY else at.acceleration


def _vary_all(
    m: Mechanics, p: BrakeParameters, a: Slide, found: Step, h: float, t_s: float, unknowns: Any, s: Any
) -> None:
    """Take the sensitivities along a step."""
    if unknowns.shape[0] == 0:
        return
    at = stages(m, p, a, found.angles, found.velocities, h)
    for j in range(unknowns.shape[0]):
        unknown, start = int(unknowns[j]), float(s[j, 0])
        before = (start, float(s[j, 1]), float(s[j, 2]), float(s[j, 3]))
        s[j, 0], s[j, 1] = vary(m, p, a, at, h, unknown, before, t_s)
        s[j, 2] += a.rate * (s[j, 0] - start)
        s[j, 3] = current_share(m, a.i, a.u, h, before[3], t_s, unknown)


def _arrive(m: Mechanics, x: Any, a: Slide, found: Step, edge: float, reaches: bool, unknowns: Any, s: Any) -> None:
    """Write the end of a step to the state; at the ``edge`` the contact changes or w saturates."""
    limit = stop_limit(m)
    x[0], x[1] = found.x1, found.x2
    x[2] = min(limit, max(-limit, a.w + a.rate * (found.x1 - a.x1)))
    if not reaches:
        return
    x[0] = edge
    if m.play == 0.0:
        x[2] = 0.0 if edge == 0.0 else a.direction
        s[:, 2] = 0.0
    elif a.rate > 0.0:
        x[2] = a.direction * limit
        for j in range(unknowns.shape[0]):
            s[j, 2] = a.direction * limit if unknowns[j] == PLAY else 0.0


def _stop(
    m: Mechanics, p: BrakeParameters, x: Any, i: float, before: float, direction: float, unknowns: Any, s: Any
) -> None:
    """Stops or reverses a brake whose velocity came to zero from ``direction``, decelerated by ``before`` [rad/s²]."""
    force = _force(m, p, float(x[0]), float(x[2]))
    after = acceleration_from_rest(m, p, p.k_m * i - p.gamma * force, force)
    factor = after / before if before * direction < 0.0 else 0.0
    for j in range(unknowns.shape[0]):
        s[j, 1] *= factor
    x[1] = 0.0
