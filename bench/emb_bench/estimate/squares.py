"""Sums of squares of the output error at many places at once, without derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emb_bench.brake.motion import SENSITIVE, STATES, Floats
from emb_bench.compiled import compiled
from emb_bench.estimate.prediction import Problem
from emb_bench.sim.open_loop import advance_periods
from emb_runtime.config.bench import BrakeParameters
from emb_runtime.config.plants import Mechanics


def sums_of_squares(problem: Problem, places: Floats, weights: Sequence[Floats]) -> Floats:
    """Sums of the squares of what :meth:`Problem.jacobian` calls residuals.

    Args:
        problem: records, model and unknowns.
        places: z of each place, shape (m, unknowns).
        weights: inverse standard deviations of the samples of each record, zero where one does not count.

    Returns:
        Shape (m,).
    """
    totals = np.array([float(np.sum(problem.known(z)[0] ** 2)) for z in places])
    for i, (record, root) in enumerate(zip(problem.records, weights, strict=True)):
        starts = [problem.opening(z, i, ()) for z in places]
        compiled(add_squares)(
            problem.plant.mechanics,
            np.array([start.p for start in starts]),
            np.array([start.x[:2] for start in starts]),
            np.array([start.contact + start.offset for start in starts]),
            np.array([start.late for start in starts]),
            record.currents,
            problem.bench.timing.sample_time,
            problem.plant.instruments.measurement_delay,
            np.nan_to_num(record.samples),
            np.zeros(len(root)) if record.late is None else record.late,
            root,
            totals,
        )
    return totals


def add_squares(
    mechanics: Mechanics,
    brakes: Floats,
    starts: Floats,
    biases: Floats,
    lates: Floats,
    currents: Floats,
    t_s: float,
    delay: int,
    samples: Floats,
    stamps: Floats,
    root: Floats,
    totals: Floats,
) -> None:
    """Adds the sums of squares of one record; runs as it is or compiled.

    Args:
        mechanics: how the brakes move.
        brakes: their parameters, shape (m, 6).
        starts: angle [rad], from the contact on, and velocity [rad/s], shape (m, 2).
        biases: what is shown of a brake at the angle zero [rad], shape (m,).
        lates: shares of the period in which the command before still acts, shape (m,).
        currents: shape (n,) [A].
        t_s: period [s].
        delay: periods that a sample waits before it is sent.
        samples: angle [rad] and velocity [rad/s], shape (n, 2).
        stamps: how much later than on the grid each was taken [s], shape (n,).
        root: inverse standard deviations, shape (n, 2).
        totals: grow by the sums of squares, shape (m,).
    """
    n, chosen = currents.shape[0], np.zeros(0, np.int64)
    x, s = np.zeros((n + 1, STATES)), np.zeros((n + 1, 0, SENSITIVE))
    for m in range(brakes.shape[0]):
        b, bias = brakes[m], biases[m]
        p = BrakeParameters(b[0], b[1], b[2], b[3], b[4], b[5])
        x[0] = 0.0
        x[0, 0], x[0, 1] = starts[m, 0], starts[m, 1]
        advance_periods(mechanics, p, currents, t_s, lates[m], chosen, x, s)
        for i in range(n):
            k = max(i - delay + 1, 0)  # until something comes through, the brake is shown at its start
            acceleration = (x[k, 1] - x[k - 1, 1]) / t_s if k > 0 else 0.0
            totals[m] += _squares(x[k, 0] + bias, x[k, 1], acceleration, stamps[i], samples[i], root[i])


def _squares(angle: float, velocity: float, acceleration: float, tau: float, sample: Floats, root: Floats) -> float:
    """Squared errors of one sample: the brake goes on to its stamp as it went through the period."""
    first = (sample[0] - angle - tau * (velocity + 0.5 * tau * acceleration)) * root[0]
    second = (sample[1] - velocity - tau * acceleration) * root[1]
    return float(first * first + second * second)
