"""Bootstrap intervals of statistics over many runs: brakes were drawn at random, so brakes are resampled.

The draws of the noise on one brake belong together, and all candidates are resampled by the same brakes: what
differs between two of them is then not hidden by what differs between brakes (paired; Efron and Tibshirani, An
introduction to the bootstrap, 1993, chapters 8 and 13).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import Floats
from emb_bench.numbers import LEVEL, Score

RESAMPLED = 2000

Indices = NDArray[np.int64]
Statistic = Callable[[Floats], Floats]  # Function from values of shape (..., n) to a statistic of shape (...)


def resampling(brakes: int, seed: int) -> Indices:
    """Numbers of the brakes in each resampled experiment, shape (RESAMPLED, brakes)."""
    return np.random.default_rng(seed).integers(0, brakes, (RESAMPLED, brakes))


def spread(values: Floats, statistic: Statistic, indices: Indices) -> Floats:
    """A statistic of each resampled experiment.

    Args:
        values: shape (brakes, draws).
        statistic: of all runs of an experiment.
        indices: from :func:`resampling`.

    Returns:
        Shape (RESAMPLED,).
    """
    return statistic(values[indices].reshape(len(indices), -1))


def score(values: Floats, statistic: Statistic, indices: Indices) -> Score:
    """A statistic with its bootstrap percentile interval; the arguments are those of :func:`spread`."""
    return _scored(float(statistic(values.reshape(1, -1))[0]), spread(values, statistic, indices))


def ratio(ours: Floats, theirs: Floats, statistic: Statistic, indices: Indices) -> Score:
    """A statistic of ours over that of theirs, paired by brake; NaN or inf where theirs is nothing."""
    with np.errstate(divide="ignore", invalid="ignore"):  # against nothing, and nothing against nothing
        value = float(statistic(ours.reshape(1, -1))[0] / statistic(theirs.reshape(1, -1))[0])
        return _scored(value, spread(ours, statistic, indices) / spread(theirs, statistic, indices))


def rate(happened: NDArray[np.bool_], indices: Indices) -> Score:
    """Frequency of an event in runs of shape (brakes, draws).

    Where it happened always or never, resampling knows of nothing else: then the interval is that of Clopper and
    Pearson (Biometrika 26, 1934) for as many independent runs as there are brakes.
    """
    n, value, tail = len(happened), float(happened.mean()), 0.5 * (1.0 - LEVEL)
    if value == 0.0:
        return Score(0.0, 0.0, 1.0 - tail ** (1.0 / n))
    if value == 1.0:
        return Score(1.0, tail ** (1.0 / n), 1.0)
    return score(happened.astype(np.float64), mean, indices)


def _scored(value: float, spread_out: Floats) -> Score:
    tail = 50.0 * (1.0 - LEVEL)
    # Values that occurred: between an infinite one and another there is nothing to interpolate.
    low, high = np.percentile(spread_out, [tail, 100.0 - tail], method="nearest").tolist()
    return Score(value, low, high)


def mean(values: Floats) -> Floats:
    """Of the last axis."""
    result: Floats = values.mean(axis=-1)
    return result


def median(values: Floats) -> Floats:
    """Of the last axis."""
    result: Floats = np.median(values, axis=-1)
    return result


def upper(values: Floats) -> Floats:
    """95th percentile of the last axis."""
    result: Floats = np.percentile(values, 95.0, axis=-1)
    return result


def root_mean_square(values: Floats) -> Floats:
    """Of the last axis."""
    result: Floats = np.sqrt((values**2).mean(axis=-1))
    return result
