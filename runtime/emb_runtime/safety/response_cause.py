"""Cause of a response that is not as declared: an observer, late frames or a lag of the current, and the key to change.

Called once a run has ended. The angle tells whether the velocity is an observer's: that of a sensor leads the mean
velocity of the last period, an observer's lags it. Late frames and lags of the current are tried one after the other
with the filter of the proof; the likeliest counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Final

from emb_runtime.config.bench import OLDEST_FRAME
from emb_runtime.safety.response import (
    LIKELIHOOD,
    MATRIX,
    MEMORY,
    MOTOR,
    OVERSHOOT,
    SIZE,
    STATE,
    ResponseModel,
    Row,
    begin,
    fits,
    take,
)

LEADS: Final = 0.3  # Samples by which a sensor's velocity leads the mean of the last period, at least: in truth 0.5
MOVES: Final = 20.0  # Change of the velocity that shows that, in its standard deviations
BANDWIDTHS: Final = tuple(round(200.0 * 1.04**i, -1) for i in range(77))  # Of an observer, to 4,000 [rad/s]
BELOW: Final = 0.96  # Share of it that is named, as the true one must not be less
DAMPING: Final = 0.7  # Of an observer: with a greater one the same lag is that of a faster observer
LAGS: Final = (0.5, 0.75, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0)  # Of the current [samples]
LIKER: Final = 0.25  # Share of the squares that an observer must leave, of those that a sensor leaves
ALIKE: Final = 6.0  # The same by which frames must be likelier than a lag
LIKELIER: Final = 9.0  # Twice the logarithm of the ratio of likelihoods that names a cause


def cause(model: ResponseModel, rows: Sequence[Row], bandwidth: float | None) -> str:
    """Quantity, measured value, and key of the bench file to change; "" if nothing explains the first samples.

    ``bandwidth`` is the declared one of an observer, None where none is declared [rad/s].
    """
    found = observer_bandwidth(model, rows)
    if found and (bandwidth is None or found < 0.9 * bandwidth):
        alpha, beta = _gains(model, found)
        behind = f"{(alpha / beta - 0.5) * model.sample_time * 1e3:.1f} ms"
        least = round(BELOW * found, -1)
        key = f'[sensors] velocity = "observer", observer_bandwidth = {least:g} at most'
        return f"the velocity lags the angle by {behind}, as that of an observer does: {key}"
    declared = likelihood(model, rows, model.age, 0.0)
    ages = {age: likelihood(model, rows, age, 0.0) for age in range(OLDEST_FRAME + 1) if age != model.age}
    flows = {lag: likelihood(model, rows, model.age, lag * model.sample_time) for lag in LAGS}
    age, lag = min(ages, key=ages.__getitem__), min(flows, key=flows.__getitem__)
    if not min(ages[age], flows[lag]) < declared - LIKELIER:  # this way round, nothing fits where both are infinite
        return ""
    if ages[age] < flows[lag] - ALIKE:
        when = f"commands act {age} periods after the sample that they answer"
        return f"{when}: [shield] frame_age = [{min(age, model.age)}, {max(age, model.age)}]"
    seconds = lag * model.sample_time
    return f"the current lags by {seconds * 1e3:g} ms: [shield] current_lag = {seconds:g}"


def likelihood(model: ResponseModel, rows: Sequence[Row], age: int, lag: float) -> float:
    """Minus twice the log-likelihood of frames of one age and a current with one lag [s]; infinite if they do not fit.

    The overshoot is then that of the lag, and no unknown.
    """
    doubts = age + 1.0 + math.ceil(3.0 * lag / model.sample_time)
    tried = model._replace(age=age, oldest=age, lag=lag, extra=0.0, transient=0.0, doubts=doubts)
    memory = [0.0] * MEMORY
    begin(tried, memory, rows[0].angle, rows[0].velocity)
    share = model.current * lag
    variance = memory[MATRIX + (SIZE + 1) * MOTOR]
    memory[STATE + OVERSHOOT] = share * memory[STATE + MOTOR]
    memory[MATRIX + SIZE * MOTOR + OVERSHOOT] = memory[MATRIX + SIZE * OVERSHOOT + MOTOR] = share * variance
    memory[MATRIX + (SIZE + 1) * OVERSHOOT] = share * share * variance
    for row in rows[1:]:
        take(tried, memory, *row)
    return memory[LIKELIHOOD] if fits(tried, memory) else math.inf


def observer_bandwidth(model: ResponseModel, rows: Sequence[Row]) -> float:
    """Bandwidth of the observer that derives the velocity from the angle [rad/s]; 0 if none does, or it is not seen."""
    leads = changes = squares = 0.0
    for before, row in pairwise(rows):
        if row.follows:
            change = row.velocity - before.velocity
            ahead = row.velocity - (row.angle - before.angle) / model.sample_time
            leads += change * ahead
            squares += (ahead - 0.5 * change) ** 2
            changes += change * change
    if changes < (MOVES * model.deviation) ** 2 or leads > LEADS * changes:
        return 0.0
    unlike = {bandwidth: _unlike(model, rows, bandwidth) for bandwidth in BANDWIDTHS}
    likest = min(unlike, key=unlike.__getitem__)
    return likest if unlike[likest] < LIKER * squares else 0.0


def _unlike(model: ResponseModel, rows: Sequence[Row], bandwidth: float) -> float:
    """Sum of the squared differences of the velocities from those of an observer of the angles [rad²/s²]."""
    ts = model.sample_time
    alpha, beta = _gains(model, bandwidth)
    angle, velocity, squares = rows[0].angle, rows[0].velocity, 0.0
    for row in rows[1:]:
        if not row.follows:
            angle, velocity = row.angle, row.velocity
            continue
        ahead = angle + ts * velocity
        angle = ahead + alpha * (row.angle - ahead)
        velocity += beta / ts * (row.angle - ahead)
        squares += (row.velocity - velocity) ** 2
    return squares


def _gains(model: ResponseModel, bandwidth: float) -> tuple[float, float]:
    """α and β of a sampled observer of second order with its poles at this bandwidth [rad/s]."""
    radius = math.exp(-DAMPING * bandwidth * model.sample_time)
    real = radius * math.cos(math.sqrt(1.0 - DAMPING * DAMPING) * bandwidth * model.sample_time)
    return 1.0 - radius * radius, 1.0 + radius * radius - 2.0 * real
