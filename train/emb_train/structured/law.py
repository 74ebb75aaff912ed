"""Law from an estimate to a current: a reference of a few levels, and the speed loop that follows it.

**Reference.** Levels l_0, l_1, … with switches between them at the times t_1, t_2, …, all affine in the estimated
parameters φ, which are scaled to −1..1 over their ranges: l_i = l_i0 + l_i1 φ_1 + … + l_i4 φ_4, clipped to ±1. With
zeros for all slopes the reference is blind: it depends on no measurement.

**Speed loop.** The current that brings the estimated velocity to its reference within one period, by the estimated
brake (deadbeat). It is clipped to the limit; what keeps the limits of the brake is the shield behind it.

Plain scalar functions; compiled by :func:`emb_bench.compiled.compiled` they are the same.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from emb_bench.brake.euler import sign
from emb_runtime.config.bench import Bench
from emb_train.structured.estimator import ANGLE, VELOCITY, VELOCITY_VARIANCE, Four, Model, believed, direction, follow

FEATURES = 4
"""Scaled estimates that a reference may depend on."""
TERMS = 1 + FEATURES
"""Of a level or a switch: a constant and the slopes."""


class Loop(NamedTuple):
    """Scaling of a reference, and gain of the loop that follows it; numbers only."""

    scale: float
    """Value of a level of 1 [rad/s], or [A] where the level is the current itself."""
    gain: float
    """Share of a velocity error that is removed within one period; 0 where the level is the current itself."""
    horizon: float
    """Steps in one experiment: what a switch of 1 stands for."""


def speed_loop(bench: Bench, gain: float = 1.0) -> Loop:
    """Levels are speeds; ``gain`` is less than 1 where commands act late."""
    return Loop(bench.limits.velocity, gain, float(bench.timing.horizon))


def no_loop(bench: Bench) -> Loop:
    """Levels are currents."""
    return Loop(bench.limits.current, 0.0, float(bench.timing.horizon))


def scaled(model: Model, state: Any, i: int) -> float:
    """Estimate of parameter ``i``, −1..1 over its range; 0 for one that is known."""
    width = model.high[i] - model.low[i]
    if width <= 0.0:
        return 0.0
    return float((2.0 * believed(model, state, i) - model.low[i] - model.high[i]) / width)


def affine(terms: Any, f1: float, f2: float, f3: float, f4: float) -> float:
    """A level or a switch for these features."""
    return float(terms[0] + terms[1] * f1 + terms[2] * f2 + terms[3] * f3 + terms[4] * f4)


def reference(model: Model, table: Any, state: Any, time: float) -> float:
    """The level that holds now, −1..1.

    Args:
        model: of the estimator.
        table: n levels, then n − 1 switches, shape [2 n − 1, TERMS].
        state: of the estimator.
        time: now, as a share of the experiment.
    """
    f1, f2, f3, f4 = scaled(model, state, 0), scaled(model, state, 1), scaled(model, state, 2), scaled(model, state, 3)
    levels = (table.shape[0] + 1) // 2
    held = min(max(affine(table[0], f1, f2, f3, f4), -1.0), 1.0)
    total = held
    for i in range(1, levels):
        level = min(max(affine(table[i], f1, f2, f3, f4), -1.0), 1.0)
        if time >= affine(table[levels + i - 1], f1, f2, f3, f4):
            total += level - held
        held = level
    return total


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
        table: of the reference.
        state: of the estimator, shape [STATE].
        angle: measured [rad].
        velocity: measured [rad/s].
        step: of the sample.
        applied: current that acted in the period that ends at the sample [A].
    """
    follow(model, state, angle, velocity, step, applied)
    level = reference(model, table, state, step / loop.horizon)
    if loop.gain == 0.0:
        return level * loop.scale
    parameters = (
        believed(model, state, 0),
        believed(model, state, 1),
        believed(model, state, 2),
        believed(model, state, 3),
    )
    x, v, variance = state[ANGLE], state[VELOCITY], state[VELOCITY_VARIANCE]
    return current_for(model, x, v, variance, parameters, level * loop.scale, loop.gain)
