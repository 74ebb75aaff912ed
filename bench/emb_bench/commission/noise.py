"""Noise of samples, some of which a mapped drive tells in steps that are larger."""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize, stats

from emb_bench.experiment.drive_steps import step_of
from emb_bench.experiment.experiment import Floats
from emb_runtime.config.bench import Noise
from emb_runtime.drives.mapping import Mapping

UNIFORM = math.sqrt(1.0 / 12.0)  # Standard deviation of an error that may be anything within a step, in steps


def noise_at_rest(angle: Floats, velocity: Floats, mapping: Mapping | None) -> Noise:
    """Noise of a resting brake's samples, below the steps of a mapped drive."""
    steps = (0.0, 0.0) if mapping is None else (step_of(mapping.angle), step_of(mapping.velocity))
    return Noise(scatter(angle, steps[0]), scatter(velocity, steps[1]))


def noise_in_motion(at_rest: Noise, mapping: Mapping | None) -> Noise:
    """Noise of a moving brake's samples: a mapped drive's steps add to it."""
    if mapping is None:
        return at_rest
    added = UNIFORM * step_of(mapping.angle), UNIFORM * step_of(mapping.velocity)
    return Noise(math.hypot(at_rest.angle, added[0]), math.hypot(at_rest.velocity, added[1]))


def scatter(values: Floats, step: float) -> float:
    """Standard deviation of a normal noise before it was rounded to steps, about a constant: most likely one.

    Args:
        values: as they came.
        step: of their signal.
    """
    found = float(np.std(values, ddof=1))
    if found >= step:
        return math.sqrt(found**2 - (UNIFORM * step) ** 2)
    places, counts = np.unique(np.round((values - values[0]) / step), return_counts=True)

    def unlikelihood(at: Floats) -> float:
        below, above = (places - at[0] - 0.5) / math.exp(at[1]), (places - at[0] + 0.5) / math.exp(at[1])
        share = np.maximum(stats.norm.cdf(above) - stats.norm.cdf(below), 1e-300)
        return -float(counts @ np.log(share))

    begin = [float(np.mean(values - values[0])) / step, math.log(0.25)]
    return step * math.exp(float(optimize.minimize(unlikelihood, begin, method="Nelder-Mead").x[1]))
