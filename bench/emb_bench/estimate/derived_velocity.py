"""Test of whether a velocity is a measurement of its own, or an observer derives it from the angle.

The mean velocity over a period is the difference of its two angles, whatever moves the brake. Measured velocities have
that mean; those that lag fall short of it by the lag times the acceleration. An observer lags by 0.36 periods at least
(:mod:`emb_bench.sim.instruments`); a jittering clock, a wrong scale and late frames make no lag. The bandwidth is that
of the observer that makes the velocity of the measured angles best, sampled with them or more often.
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

SURE = 10.0  # Standard deviations by which the lag differs from zero
LEAST = 0.1  # Lag [samples]: no observer has less
DAMPINGS = (0.7, 0.85, 1.0)
PARTS = (1, 2, 8)  # Of a period, after each of which the observer takes an angle
SCALED = np.geomspace(0.03, 6.0, 60)  # Bandwidth times sample time
BOUNDS = [(0.02, 10.0), (0.7, 1.0)]  # Of what is searched
STARTS = 3  # Of the nearest, from which a nearer one is searched
ALIKE = 1.25  # Ratio of mean squares of two observers that are not told apart
TOLD = 1.3  # Ratio of the ends of a bandwidth that is known
SETTLED = 20  # Samples after the begin or a gap, during which an observer forgets what is not known
FEWEST = 10  # Periods of an experiment that tell a lag
LONGEST = 20_000  # Samples of an experiment that are looked at


def derived(experiments: Sequence[Experiment], t_s: float) -> Derived | None:
    """The observer in the first experiment that shows one; None if none does."""
    for experiment in experiments:
        angle, velocity = experiment.all_samples[:LONGEST].T
        lag, deviation = _lag(angle, velocity, t_s)
        if lag > max(SURE * deviation, LEAST * t_s):
            return Derived(*_bandwidth(angle, velocity, t_s), float(special.ndtr(-lag / max(deviation, 1e-300))))
    return None


def _lag(angle: Floats, velocity: Floats, t_s: float) -> tuple[float, float]:
    """Lag of the velocity behind the angle, beside an error of its scale, and its standard deviation [s]."""
    mean, acceleration = 0.5 * (velocity[1:] + velocity[:-1]), np.diff(velocity) / t_s
    short = np.diff(angle) / t_s - mean
    known = np.isfinite(short)
    if known.sum() < FEWEST:
        return 0.0, 0.0
    rows, short = np.stack([acceleration, mean], axis=1)[known], short[known]
    inverse = np.linalg.pinv(rows)
    fitted = inverse @ short
    spread = inverse[0] @ (inverse[0] * (short - rows @ fitted) ** 2)  # errors of fast samples are larger: White 1980
    return float(fitted[0]), float(spread**0.5)


def _bandwidth(angle: Floats, velocity: Floats, t_s: float) -> tuple[float, float, bool]:
    """Best bandwidth, the least that is not told apart from it [rad/s], and whether the others are near."""
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
