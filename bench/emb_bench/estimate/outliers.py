"""Outliers: samples that lie apart from their neighbours, as a wrong model does not put them.

The error of a sample is compared with the median of those around it, in standard deviations. What a model lacks bends
the errors of many samples alike and shows in the median as well; a single wrong sample does not. One that lies further
off than ``APART`` is left out, angle and velocity together: a loss that is quadratic up to there and constant beyond,
so that no sample, however wrong, moves an estimate by more than its absence does. Where more samples do than ``MOST``
of all, none is left out: then it is the noise, or the model, that is not as the bench file says, and the tests tell.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import Floats

APART = 8.0  # Distance from the neighbours from which on a sample is an outlier, in standard deviations
AROUND = 5  # Neighbours on each side
MOST = 0.01  # Largest share of the samples that is left out


def outliers(residuals: Floats, counts: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask of the samples of a record that lie apart from their neighbours, shape (n,).

    Args:
        residuals: in standard deviations, shape (n, 2).
        counts: True where an output of a sample counts, shape (n, 2).
    """
    found = np.zeros(len(residuals), np.bool_)
    for errors, counted in zip(residuals.T, counts.T, strict=True):
        at = np.flatnonzero(counted)
        if len(at) <= 2 * AROUND:
            continue
        padded = np.pad(errors[at], AROUND, mode="reflect")
        windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * AROUND + 1)
        apart = np.abs(errors[at] - np.median(windows, axis=1))
        usual = 1.4826 * float(np.median(apart))  # of Gaussian noise, its standard deviation
        found[at[apart > APART * max(usual, 1.0)]] = True
    return found


def few(found: Sequence[NDArray[np.bool_]]) -> bool:
    """Returns True if there are outliers, and so few that they can be left out."""
    count = sum(int(mask.sum()) for mask in found)
    return 0 < count <= max(1.0, MOST * sum(len(mask) for mask in found))
