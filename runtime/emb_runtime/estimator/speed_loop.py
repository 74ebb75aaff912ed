"""Speed loop: the current that follows a reference of a few levels of speed, by the estimated brake.

**Reference.** Speeds l_0, l_1, … as shares of the speed limit, with switches between them at the times t_1, t_2, … as
shares of the experiment. A switch is never before the one that comes first.

**Switches between samples.** In the period in which a switch lies, the current is the mean of those for both levels,
weighted with their shares of the period. So what an experiment is worth is continuous in the switching time.

**Loop.** The current that brings the estimated velocity to its reference within one period (deadbeat), clipped to the
limit. What keeps the limits of the brake is the shield behind it.

Scalar functions, as in :mod:`emb_runtime.estimator.kalman`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from emb_runtime.config.bench import Bench
from emb_runtime.estimator.kalman import Four, Model, State, direction
from emb_runtime.estimator.stick_slip import sign


class Scale(NamedTuple):
    """Scale of a reference, and gain of the loop."""

    speed: float  # Of a level of 1 [rad/s]
    horizon: float  # Of a switch of 1 [samples]
    gain: float  # Share of a velocity error that is removed within one period


def scale_of(bench: Bench, gain: float = 1.0) -> Scale:
    """A bench's scale; ``gain`` is less than 1 where commands act late."""
    return Scale(bench.limits.velocity, float(bench.timing.horizon), gain)


def current_for(model: Model, state: State, parameters: Four, speed: float, gain: float) -> float:
    """Current that takes the velocity to ``speed`` [rad/s], or ``gain`` of the way, within one period [A].

    The parameters are relative, within their ranges.
    """
    x, v, variance = state.mean[0], state.mean[1], state.covariance[6]
    km, k1, tc, fv = parameters
    change = gain * (speed - v)
    drive = change / model.sample_time + model.spring * k1 * max(x, 0.0)
    # A brake that may stick has the friction of where it is to go, also at rest.
    toward = sign(v + change) if model.sticks else direction(v, variance)
    drive += model.coulomb * tc * toward + model.viscous * fv * v
    return min(max(drive / (model.motor * km), -model.current), model.current)


def share_after(switch: float, step: float, horizon: float) -> float:
    """Share of the period that begins at ``step`` that lies after a switch, 0..1."""
    return min(max(step + 1.0 - horizon * switch, 0.0), 1.0)


def follow_reference(
    model: Model, state: State, parameters: Four, scale: Scale, levels: Any, switches: Any, step: float
) -> float:
    """Current for the period that begins now, at the sample ``step`` [A].

    Args:
        model: of the estimator.
        state: estimate of the newest sample.
        parameters: relative, within their ranges.
        scale: of levels and switches.
        levels: n speeds, −1..1.
        switches: n − 1 times, 0..1.
        step: of the newest sample.
    """
    total, before, last = 0.0, 1.0, len(levels) - 1
    for i in range(last + 1):
        after = min(before, share_after(switches[i], step, scale.horizon)) if i < last else 0.0
        if before > after:
            speed = levels[i] * scale.speed
            total += (before - after) * current_for(model, state, parameters, speed, scale.gain)
        before = after
    return total
