"""Origin of the velocity on the bus: a sensor's, or derived from the angle by a tracking loop.

Candidates make a velocity of the measured angles: loops of second order, sampled once a period or continuous, and
slopes of the angles around a sample. A velocity that is measured is nearest to a slope, which does not lag. One that is
derived is nearest to a loop like its own, whose noise it has.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import minimize
from scipy.signal import cont2discrete, lfilter

from emb_bench.commission.records import Velocity
from emb_bench.experiment.experiment import Booleans, Experiment, Floats
from emb_bench.sim.instruments import observer_gains

DAMPINGS = (0.7, 0.85, 1.0)  # Of the loops at first
BANDWIDTHS = np.geomspace(0.2, 8.0, 24)  # Of the loops at first, times the sample time
BOUNDS = [(0.1, 10.0), (0.7, 1.0)]  # Of what is searched
STARTS = 3  # Of these loops from which better ones are searched
TELLING = 3.0  # The same from which on no loop lags less
HALVES = (1, 2, 3, 5)  # Samples on either side of which a slope is made
SETTLING = 20  # Samples after the first one, or a lost one, that tell nothing
CLEARLY = 0.8  # Mean square of a loop's errors, over that of a slope's, below which the velocity is derived
ALIKE = 4.0  # Mean square of a loop's errors, over the least one, up to which a loop cannot be excluded
MARGIN = 0.94  # Written bandwidth, over the least one that cannot be excluded

Maker = Callable[[Floats], Floats]
"""Makes velocities [rad/s] of angles [rad]."""


def velocity_origin(experiments: Sequence[Experiment], t_s: float) -> Velocity:
    """Origin of the velocity in experiments with this sample time [s]."""
    records = [_telling(own) for own in experiments]

    def error(make: Maker) -> float:
        """Mean square of what a candidate makes less what was shown [rad²/s²]."""
        return float(
            np.mean(np.concatenate([(make(angle) - velocity)[told] for angle, velocity, told in records]) ** 2)
        )

    found = []
    for is_sampled in (True, False):

        def of_loop(at: Sequence[float], is_sampled: bool = is_sampled) -> float:
            return error(_loop(at[0], at[1], is_sampled, t_s))

        row = sorted((of_loop(at), at) for at in itertools.product(BANDWIDTHS.tolist(), DAMPINGS))
        searched = [minimize(of_loop, at, method="Nelder-Mead", bounds=BOUNDS) for _, at in row[:STARTS]]
        found += row + [(float(best.fun), tuple(best.x)) for best in searched]
    least, (nearest, _) = min(found)
    if not least < CLEARLY * min(error(_slope(half, t_s)) for half in HALVES):
        return Velocity()
    alike = [scaled for square, (scaled, _) in found if square <= ALIKE * least]
    return Velocity(nearest / t_s, min(MARGIN * min(alike), TELLING) / t_s, max(alike) / t_s)


def _telling(own: Experiment) -> tuple[Floats, Floats, Booleans]:
    """Angles, without gaps, and velocities of an experiment, and where candidates have seen all that they need."""
    angle, velocity = own.all_samples.T
    seen = np.isfinite(angle)
    lost = np.convolve(~seen, np.ones(2 * SETTLING + 1), "same") > 0.5
    lost[:SETTLING] = lost[-SETTLING:] = True
    every = np.interp(np.arange(len(angle)), np.flatnonzero(seen), angle[seen])
    return every, velocity, ~lost & np.isfinite(velocity)


def _slope(half: int, t_s: float) -> Maker:
    """Slope of a line through the angles of so many samples on either side."""
    steps = np.arange(half, -half - 1, -1.0)
    return lambda angle: np.convolve(angle, steps / (t_s * (steps @ steps)), "same")


def _loop(scaled: float, damping: float, is_sampled: bool, t_s: float) -> Maker:
    """Loop of a bandwidth, times the sample time, and a damping; between samples a continuous one sees a line."""
    if is_sampled:
        alpha, beta = observer_gains(scaled / t_s, t_s, damping)
        above, below = [beta / t_s, -beta / t_s], [1.0, alpha + beta - 2.0, 1.0 - alpha]
    else:
        square = (scaled / t_s) ** 2
        above, below, _ = cont2discrete(([square, 0.0], [1.0, 2.0 * damping * scaled / t_s, square]), t_s, "foh")
    return lambda angle: lfilter(np.ravel(above), np.ravel(below), angle - angle[0])
