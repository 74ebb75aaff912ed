"""Cause of a response that is not as declared: an observer, late frames or a lag of the current, and the key to change.

Called once a run has ended. The angle tells whether the velocity is an observer's: that of a sensor leads the mean
velocity of the last period, an observer's lags it. Late frames and lags of the current are tried one after the other
with the filter of the proof; the likeliest counts. An observer's velocity lags as well: the angles give mean
velocities in its place.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from typing import Final

from emb_runtime.config.bench import OLDEST_FRAME, Bench
from emb_runtime.estimator.observer import observer_gains
from emb_runtime.safety.response import BEYOND, ResponseModel, Row, begin_response, explains, take
from emb_runtime.safety.shield_design import LONGEST_LAG

LEADS: Final = 0.3  # Samples by which a sensor's velocity leads the mean of the last period, at least: in truth 0.5
MOVES: Final = 14.0  # Change of the velocity that shows that, in its standard deviations
BANDWIDTHS: Final = tuple(round(200.0 * 1.04**i, -1) for i in range(77))  # Of an observer, to 4,000 [rad/s]
BELOW: Final = 0.96  # Share of it that is named, as the true one must not be less
LAGS: Final = tuple(2.5e-4 * 1.08**i for i in range(40))  # Of the current, to 5 ms [s]
OBSERVER_SHARE: Final = 0.25  # Share of the squares that an observer must leave, of those that a sensor leaves
BRAKES: Final = 16  # Samples of the stop that tell a lag; later the brake rests
MEAN_NOISE: Final = 1.73  # Deviation of the change of a mean velocity over √2, in that of the angle
LIKELY: Final = 9.0  # Twice the logarithm of the ratio of likelihoods that names a cause
ERRORS: Final = 16.0  # The same within which a lag may be the true one: four standard deviations


def cause(bench: Bench, model: ResponseModel, rows: Sequence[Row], stop: Sequence[Row], proven: bool = False) -> str:
    """Quantity, measured value, and key of the bench file to change; "" if nothing explains the samples.

    ``stop`` are the samples after ``rows`` in which the node brakes by itself. Where the response is ``proven``, the
    commands act as declared, and an observer alone is looked for.
    """
    bandwidth = bench.sensors.bandwidth
    found = observer_bandwidth(model, [*rows, *stop])
    if found and (bandwidth is None or found < 0.9 * bandwidth):
        alpha, beta = observer_gains(found, model.sample_time)
        behind = f"{(alpha / beta - 0.5) * model.sample_time * 1e3:.1f} ms"
        least = math.floor(BELOW * found / 10.0) * 10.0
        key = f'[sensors] velocity = "observer", observer_bandwidth = {least:g} at most'
        return f"the velocity lags the angle by {behind}, as that of an observer does: {key}"
    if proven:
        return ""
    if found:
        model = model._replace(deviation=max(MEAN_NOISE * bench.noise.angle / model.sample_time, model.deviation))
        means = mean_velocities(model.sample_time, [*rows, *stop])
        rows, stop = means[: len(rows)], means[len(rows) :]
    return _of_commands(model, rows, stop, found > 0.0)


def _of_commands(model: ResponseModel, rows: Sequence[Row], stop: Sequence[Row], means: bool) -> str:
    """The likeliest age of the frames, or lag of the current."""
    braked, later = stop[:BRAKES], [age for age in range(OLDEST_FRAME + 1) if age != model.age]
    deviance_of = partial(deviance, model, rows, braked, means=means)
    declared = deviance_of(model.age, 0.0)
    ages = {age: min(deviance_of(age, 0.0, seen) for seen in range(age + 1)) for age in later}
    flows = {lag: deviance_of(model.age, lag) for lag in LAGS}
    aged, lagged = min(ages.values()), min(flows.values())
    if not min(aged, lagged) < declared - LIKELY:  # this way round, nothing fits where both are infinite
        return "" if not stop else _of_commands(model, rows, (), means)
    likely = sorted([(aged, _of_ages(model, ages)), (lagged, _of_lag(model, flows))])
    return ", or ".join(named for value, named in likely if value < likely[0][0] + LIKELY)


def _of_ages(model: ResponseModel, ages: dict[int, float]) -> str:
    """The likeliest age, and the key with all that are likely."""
    likely = [age for age in ages if ages[age] <= min(ages.values()) + LIKELY]
    when = f"commands act {min(ages, key=ages.__getitem__)} periods after the sample that they answer"
    return f"{when}: [shield] frame_age = [{min(*likely, model.age)}, {max(*likely, model.oldest)}]"


def _of_lag(model: ResponseModel, flows: dict[float, float]) -> str:
    """The likeliest lag, and the key with the longest that may be there, or the longest covered if it may be that."""
    likely = [lag for lag in flows if flows[lag] <= min(flows.values()) + ERRORS]
    lag, longest = min(flows, key=flows.__getitem__), LONGEST_LAG * model.sample_time
    most = math.ceil(max(likely) * 1e4) * 1e-4
    if lag <= BEYOND * longest:
        most = min(most, longest)
    return f"the current lags by {lag * 1e3:.1f} ms: [shield] current_lag = {most:g}"


def deviance(
    model: ResponseModel,
    rows: Sequence[Row],
    stop: Sequence[Row],
    age: int,
    lag: float,
    seen: int = 0,
    means: bool = False,
) -> float:
    """Minus twice the log-likelihood of frames of one age and a current with one lag [s]; infinite if they do not fit.

    The overshoot is then that of the lag, and no unknown. The measurements are late by ``seen`` periods of the age, the
    commands by the others: they wait, and the current of the node's stop does not. With ``means`` the velocities are
    means of the periods before: these change by the mean of two currents.
    """
    doubts = age + 1.0 + math.ceil(3.0 * lag / model.sample_time)
    slides = 6.0 * model.deviation
    tried = model._replace(age=0, oldest=0, lag=lag, extra=0.0, transient=0.0, doubts=doubts, slides=slides)
    state, share = begin_response(tried, rows[0].angle, rows[0].velocity), model.current * lag
    mean, p = state.mean, state.covariance
    covariance = (*p[:10], share * p[6], *p[11:20], share * share * p[6])
    state = state._replace(mean=(*mean[:5], share * mean[1]), covariance=covariance)
    flowing = rows[0].command  # the run's first sample has none
    if rows[0].follows:  # the commands before it are unknown
        state = state._replace(doubts=doubts, lagging=flowing)
    commands = [flowing] * (age - seen) + [row.command for row in rows[1:]]
    acting = [flowing] * seen + commands[: len(rows) - 1] + [row.command for row in stop]
    if means:
        acting = [0.5 * (u + before) for before, u in pairwise([flowing, *acting])]
    for row, current in zip([*rows[1:], *stop], acting, strict=False):
        state, _ = take(tried, state, row.follows, row.angle, row.velocity, current)
    return state.likelihood if explains(tried, state) else math.inf


def mean_velocities(sample_time: float, rows: Sequence[Row]) -> list[Row]:
    """The rows with the mean velocity of the period before, which the angles give, in place of an observer's."""
    return [
        row._replace(velocity=(row.angle - before.angle) / sample_time) if row.follows else row
        for before, row in pairwise([rows[0], *rows])
    ]


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
    misfits = {bandwidth: _observer_misfit(model, rows, bandwidth) for bandwidth in BANDWIDTHS}
    best = min(misfits, key=misfits.__getitem__)
    return best if misfits[best] < OBSERVER_SHARE * squares else 0.0


def _observer_misfit(model: ResponseModel, rows: Sequence[Row], bandwidth: float) -> float:
    """Sum of the squared differences of the velocities from those of an observer of the angles [rad²/s²].

    The observer's angle follows from two velocities: at the start and where a sample is missing it is unknown.
    """
    ts, follows = model.sample_time, False
    alpha, beta = observer_gains(bandwidth, model.sample_time)
    angle = velocity = squares = 0.0
    for before, row in pairwise(rows):
        if not row.follows:
            follows = False
            continue
        ahead = angle + ts * velocity
        surprise = row.angle - ahead if follows else ts / beta * (row.velocity - before.velocity)
        angle = row.angle - (1.0 - alpha) * surprise
        velocity = velocity + beta / ts * surprise if follows else row.velocity
        squares += (row.velocity - velocity) ** 2
        follows = True
    return squares
