"""Law from an estimate to a current: a reference of a few levels, and the speed loop that follows it.

**Reference.** Speeds l_0, l_1, … with switches between them at the times t_1, t_2, …, all of them polynomials of the
estimated parameters, l_i = l_i0 + Σ l_ij φ_j + Σ l_ijk φ_j φ_k, clipped to ±1, with φ the logarithms of the estimates,
scaled to −1..1 over their ranges. With zeros for all slopes the reference is blind: it depends on no measurement. A
first level of small speed is a probe: its few milliseconds tell the estimator enough to decide on the rest.

**Switches between samples.** In the period in which a switch lies, the current is the mean of those for both levels,
weighted with their shares of the period. So what an experiment is worth is continuous in the switching time.

**Speed loop.** The current that brings the estimated velocity to its reference within one period, by the estimated
brake (deadbeat). It is clipped to the limit; what keeps the limits of the brake is the shield behind it.

Plain scalar functions; compiled by :func:`emb_bench.compiled.compiled` they are the same.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from emb_bench.brake.euler import sign
from emb_runtime.config.bench import Bench
from emb_train.structured.estimator import ANGLE, VELOCITY, VELOCITY_VARIANCE, Four, Model, believed, direction, follow

FEATURES = 4  # Scaled estimates that a reference may depend on
PRODUCTS = tuple((i, j) for i in range(FEATURES) for j in range(i, FEATURES))
TERMS = 1 + FEATURES + len(PRODUCTS)  # Of a level or switch: constant, slopes, products in the order of ``PRODUCTS``


class Loop(NamedTuple):
    """Scaling of a reference, and gain of the loop that follows it; numbers only."""

    scale: float  # Value of a level of 1 [rad/s]
    gain: float  # Share of a velocity error that is removed within one period
    horizon: float  # Steps in one experiment: what a switch of 1 stands for


def speed_loop(bench: Bench, gain: float = 1.0) -> Loop:
    """The bench's scaling; ``gain`` is less than 1 where commands act late."""
    return Loop(bench.limits.velocity, gain, float(bench.timing.horizon))


def scaled(model: Model, state: Any, i: int) -> float:
    """Logarithm of the estimate of parameter ``i``, −1..1 over its range; 0 for one that is known."""
    low, high, value = model.low[i], model.high[i], believed(model, state, i)
    if high <= low:
        return 0.0
    return math.log(value * value / (low * high)) / math.log(high / low)


def features(model: Model, state: Any) -> Four:
    """Features φ that levels and switches depend on."""
    return scaled(model, state, 0), scaled(model, state, 1), scaled(model, state, 2), scaled(model, state, 3)


def of_features(terms: Any, f: Four) -> float:
    """A level or a switch; ``terms`` has the shape [TERMS]."""
    f1, f2, f3, f4 = f
    total = terms[0] + terms[1] * f1 + terms[2] * f2 + terms[3] * f3 + terms[4] * f4
    total += f1 * (terms[5] * f1 + terms[6] * f2 + terms[7] * f3 + terms[8] * f4)
    total += f2 * (terms[9] * f2 + terms[10] * f3 + terms[11] * f4)
    total += f3 * (terms[12] * f3 + terms[13] * f4) + f4 * (terms[14] * f4)
    return float(total)


def level_of(table: Any, i: int, f: Four) -> float:
    """Level ``i`` of a table, −1..1."""
    return min(max(of_features(table[i], f), -1.0), 1.0)


def share_after(table: Any, i: int, f: Four, step: float, horizon: float) -> float:
    """Share of the period that begins now in which level ``i`` or a later one holds, 0..1.

    Args:
        table: n levels, then n − 1 switches, shape [2 n − 1, TERMS].
        i: 0 to n; nothing is after the last level.
        f: from :func:`features`.
        step: now.
        horizon: see :class:`Loop`.
    """
    levels = (table.shape[0] + 1) // 2
    if i == 0:
        return 1.0
    if i == levels:
        return 0.0
    return min(max(step + 1.0 - horizon * of_features(table[levels + i - 1], f), 0.0), 1.0)


def current_for(
    model: Model, x: float, v: float, variance: float, parameters: Four, speed: float, gain: float
) -> float:
    """The current that takes the velocity to ``speed`` [rad/s], or ``gain`` of the way, within one period [A].

    Without a branch: the exported graph is made of it, see :mod:`emb_train.structured.columns`.

    Args:
        model: of the estimator.
        x: estimated angle [rad].
        v: estimated velocity [rad/s].
        variance: of that velocity [rad²/s²].
        parameters: believed, relative.
        speed: to be reached [rad/s].
        gain: share of the error that is removed.
    """
    km, k1, tc, fv = parameters
    change = gain * (speed - v)
    drive = change / model.sample_time + model.spring * k1 * max(x, 0.0)
    # A brake that may stick has the friction of where it is to go, also at rest.
    toward = sign(v + change) if model.sticks else direction(v, variance)
    drive = drive + (model.coulomb * tc * toward + model.viscous * fv * v)
    return min(max(drive / (model.motor * km), -model.current), model.current)


def act(
    model: Model, loop: Loop, table: Any, state: Any, angle: float, velocity: float, step: float, applied: float
) -> float:
    """Requested current after one more sample [A]; the state changes in place.

    Args:
        model: of the estimator.
        loop: how the reference is followed.
        table: of the reference, see :func:`share_after`.
        state: of the estimator, shape [STATE].
        angle: measured [rad].
        velocity: measured [rad/s].
        step: of the sample.
        applied: current that acted in the period that ends at the sample [A].
    """
    follow(model, state, angle, velocity, step, applied)
    f = features(model, state)
    parameters = (
        believed(model, state, 0),
        believed(model, state, 1),
        believed(model, state, 2),
        believed(model, state, 3),
    )
    x, v, variance = state[ANGLE], state[VELOCITY], state[VELOCITY_VARIANCE]
    total, before = 0.0, 1.0
    for i in range((table.shape[0] + 1) // 2):
        # A switch is never before the one that comes first.
        after = min(before, share_after(table, i + 1, f, step, loop.horizon))
        if before > after:
            speed = level_of(table, i, f) * loop.scale
            total += (before - after) * current_for(model, x, v, variance, parameters, speed, loop.gain)
        before = after
    return total
