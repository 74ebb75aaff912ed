"""Observation of the critic: the true state of an experiment, in fixed scales of order one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.config.bench import Bench
from emb_bench.information.symmetric import Floats, packed_size
from emb_runtime.config.bench import BrakeParameters, Ranges
from emb_runtime.safety.shield import PAST
from emb_train.envs.closed_loop import Experiments, Integers

Singles = NDArray[np.float32]

EXTRA = 3 + PAST  # Numbers that are added to the critic's observation where experiments vary beside the brake


class Scale(NamedTuple):
    """Offsets and divisors that bring the critic's numbers to order one."""

    horizon: int  # Steps in one experiment
    angle: float  # [rad]
    velocity: float  # [rad/s]
    current: float  # [A]
    columns: Integers  # Of the n parameters in ``Experiments.brakes``, shape [n]
    middle: Floats  # Of the range of each parameter, shape [n]
    half: Floats  # Its half width, shape [n]; 1 for a parameter that does not vary
    delay: float  # Greatest delay that is drawn, at least 1 [samples]


def make_scale(bench: Bench, ranges: Ranges, parameters: Sequence[str], delay: int) -> Scale:
    """The scale for these parameters, drawn from these ranges, and delays of at most so many samples."""
    columns = np.array([BrakeParameters._fields.index(name) for name in parameters], np.int64)
    low, high = np.array(ranges.low)[columns], np.array(ranges.high)[columns]
    return Scale(
        bench.timing.horizon,
        bench.limits.angle[1],
        bench.limits.velocity,
        bench.limits.current,
        columns,
        0.5 * (low + high),
        np.where(high > low, 0.5 * (high - low), 1.0),
        float(max(delay, 1)),
    )


def critic_size(n: int) -> int:
    """Length of the critic's observation for n parameters where nothing varies beside the brake."""
    return 3 + n + packed_size(n) + 2 * n


def describe(scale: Scale, experiments: Experiments, out: Singles) -> None:
    """Writes the critic's observation (thesis Table 4.2, and the sensitivities), in place.

    Without the sensitivities the next increment of the FIM is not a function of the state: it would not be Markov.
    Where experiments vary beside the brake, the delay of the commands follows, whether the sample was received, the
    current in the motor, and the last sent currents, which may still be on their way.

    Args:
        scale: of the numbers.
        experiments: N of them.
        out: becomes x_1, x_2, k, θ, FIM, sensitivities, and the rest where there is room for it: shape
            [N, 3 + n + n (n + 1) / 2 + 2 n] or that and ``EXTRA``.
    """
    for i in range(experiments.k.shape[0]):
        describe_one(scale, experiments, i, out[i])


def describe_one(scale: Scale, experiments: Experiments, i: int, out: Singles) -> None:
    """Writes the critic's observation of experiment ``i`` to ``out``; see :func:`describe`."""
    x, s, m, k = experiments.x, experiments.s, experiments.m, experiments.k
    n = scale.columns.shape[0]
    out[0] = x[i, 0] / scale.angle
    out[1] = x[i, 1] / scale.velocity
    out[2] = k[i] / scale.horizon
    at = 3
    for j in range(n):
        out[at + j] = (experiments.brakes[i, scale.columns[j]] - scale.middle[j]) / scale.half[j]
    at += n
    for j in range(m.shape[1]):
        out[at + j] = 0.1 * signed_log(m[i, j])
    at += m.shape[1]
    for j in range(n):
        out[at + 2 * j] = 4.0 * s[i, j, 0] / scale.angle
        out[at + 2 * j + 1] = 4.0 * s[i, j, 1] / scale.velocity
    at += 2 * n
    if at == out.shape[0]:
        return
    out[at] = experiments.delay[i] / scale.delay
    out[at + 1] = 0.0 if experiments.lost[i, k[i]] else 1.0
    out[at + 2] = x[i, 3] / scale.current
    for j in range(PAST):
        out[at + 3 + j] = experiments.past[i, j] / scale.current


def signed_log(value: float) -> float:
    """sign(v) log(1 + |v|): of order one for what spans many decades."""
    return math.copysign(math.log1p(abs(value)), value)
