"""Test of whether the velocity is measured, or an observer derives it from the angle.

The mean velocity over a period is the difference of its two angles over the period. A lagging velocity differs from
this mean by the lag times the acceleration. An observer lags by 0.36 periods at least
(:mod:`emb_bench.sim.instruments`); jitter of the clock, a wrong scale and late frames cause no lag. The bandwidth is
fitted: that of the observer whose output for the measured angles is nearest to the velocity, at the sample rate or a
multiple of it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from scipy import optimize, special

from emb_bench.brake.motion import Floats
from emb_bench.estimate.records import Derived
from emb_bench.experiment.experiment import Experiment
from emb_runtime.estimator.observer import observer_gains

SURE = 10.0  # Significance of the lag [standard deviations]
LEAST = 0.1  # Lag [samples]: no observer has less
DAMPINGS = (0.7, 0.85, 1.0)
PARTS = (1, 2, 8)  # Observer steps in a period
SCALED = np.geomspace(0.03, 6.0, 60)  # Bandwidth times sample time
BOUNDS = [(0.02, 10.0), (0.7, 1.0)]  # Of bandwidth times sample time, and of the damping
STARTS = 3  # Local searches, from the best points of the grid
ALIKE = 1.25  # Ratio of mean squares below which two observers fit alike
TOLD = 1.3  # Largest ratio of the bandwidths that fit, for a determined one
SETTLED = 20  # Samples after the start or a gap until the initial state of an observer has decayed
FEWEST = 10  # Fewest periods of an experiment
LONGEST = 20_000  # Most samples of an experiment


def derived(experiments: Sequence[Experiment], t_s: float) -> Derived | None:
    """The observer in the first experiment that shows one; None if none does."""
    for experiment in experiments:
        angle, velocity = experiment.all_samples[:LONGEST].T
        lag, deviation = _lag(angle, velocity, t_s)
        if lag > max(SURE * deviation, LEAST * t_s):
            return Derived(*_bandwidth(angle, velocity, t_s), float(special.ndtr(-lag / max(deviation, 1e-300))))
    return None


def _lag(angle: Floats, velocity: Floats, t_s: float) -> tuple[float, float]:
    """Lag of the velocity behind the angle, with the scale as a nuisance, and its standard deviation [s]."""
    mean, acceleration = 0.5 * (velocity[1:] + velocity[:-1]), np.diff(velocity) / t_s
    short = np.diff(angle) / t_s - mean
    received = np.isfinite(short)
    if received.sum() < FEWEST:
        return 0.0, 0.0
    rows, short = np.stack([acceleration, mean], axis=1)[received], short[received]
    inverse = np.linalg.pinv(rows)
    fitted = inverse @ short
    spread = inverse[0] @ (inverse[0] * (short - rows @ fitted) ** 2)  # errors of fast samples are larger: White 1980
    return float(fitted[0]), float(spread**0.5)


def _bandwidth(angle: Floats, velocity: Floats, t_s: float) -> tuple[float, float, bool]:
    """Best bandwidth, the least that fits alike [rad/s], and True if all that fit alike are near."""
    from scipy.signal import lfilter  # slow to import, and for a velocity that lags only

    at, received = np.arange(len(angle)), np.isfinite(angle) & np.isfinite(velocity)
    every = np.interp(at, at[received], angle[received]) - angle[received][0]
    settled = received.copy()
    for unknown in (0, *np.flatnonzero(~received)):
        settled[unknown : unknown + SETTLED] = False
    counted = settled if 2 * settled.sum() > received.sum() else received
    found = []
    for parts in PARTS:
        finer = np.interp(np.arange((len(at) - 1) * parts + 1) / parts, at, every)

        def square(at: Sequence[float], parts: int = parts, finer: Floats = finer) -> float:
            """Mean square of the velocity less that of an observer of this bandwidth and damping."""
            scaled, damping = at
            alpha, beta = observer_gains(scaled / parts, 1.0, damping)
            ahead = np.array([1.0, alpha + beta - 2.0, 1.0 - alpha])
            shown = lfilter([beta, -beta], ahead, finer)[::parts] * parts / t_s
            return float(np.mean((velocity - shown)[counted] ** 2))

        row = sorted((square(at), at) for at in itertools.product(SCALED.tolist(), DAMPINGS))
        searched = [optimize.minimize(square, at, method="Nelder-Mead", bounds=BOUNDS) for _, at in row[:STARTS]]
        found += [(at[0], value) for value, at in row] + [(best.x[0], best.fun) for best in searched]
    scaled, squares = np.array(found).T
    alike = scaled[squares <= ALIKE * squares.min()]
    best, least = scaled[np.argmin(squares)] / t_s, alike.min() / t_s
    return float(best), float(least), bool(alike.max() < min(TOLD * alike.min(), SCALED[-1]))
