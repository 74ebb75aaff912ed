"""Speed loop: the current that follows a target speed, by the estimated brake.

It brings the estimated velocity to the target, or a share of the way, within one period (deadbeat), clipped to the
limit. What keeps the limits of the brake is the shield behind it.

A scalar function, as in :mod:`emb_runtime.estimator.kalman`.
"""

from __future__ import annotations

from emb_runtime.estimator.kalman import Four, Model, State
from emb_runtime.estimator.stick_slip import sign


def current_for(model: Model, state: State, parameters: Four, speed: float, gain: float) -> float:
    """Current that takes the velocity to ``speed`` [rad/s], or ``gain`` of the way, within one period [A].

    The parameters are relative, within their ranges.
    """
    x, v = state.mean[0], state.mean[1]
    km, k1, tc, fv = parameters
    change = gain * (speed - v)
    drive = change / model.sample_time + model.spring * k1 * max(x, 0.0)
    # A brake that may stick has the friction of where it is to go, also at rest.
    drive += model.coulomb * tc * sign(v + change) + model.viscous * fv * v
    return min(max(drive / (model.motor * km), -model.current), model.current)
