"""Recursive least squares: the simple baseline.

Over a period the thesis's equation of motion (eq. 3.12-3.14) is linear in the four parameters:

    J Δω = k_m u T − γ k_1 ∫ max(x, 0) dt − T_c sign(ω) T − f_v ∫ ω dt.

The samples at both ends replace the motion: Δω is the difference of the velocities, the integrals are means of both
ends. Each period in which the brake surely keeps its direction updates the estimate and its covariance (Ljung, System
Identification, 2nd ed., section 11.2). The initial values are the prior, or the nominal brake with a wide covariance.

The method needs no start, no search and no simulation. It is biased, because the regressors carry the sensors' noise;
its deviations do not include this bias, and the report states it.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import lsq_linear

from emb_bench.brake.motion import Floats, is_plain
from emb_bench.config.plants import EXACT
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.method import Method
from emb_bench.estimate.output_error import finished, sandwich
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import End
from emb_bench.experiment.experiment import Experiment
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.errors import UsageError

SURE = 4.0  # Standard deviations of a velocity beyond which its sign is certain
WIDE = 1e3  # Initial standard deviation of a parameter without a prior, over its nominal value


class RecursiveLeastSquares(Method):
    """Some of k_m, k_1, T_c and f_v from the equation of motion; the others of them are nominal."""

    def solve(self, problem: Problem) -> Estimate:
        """As :class:`Method`."""
        others = [name for name in problem.question.names if name not in PARAMETER_NAMES]
        if others:
            raise UsageError(
                f"recursive least squares estimates {', '.join(PARAMETER_NAMES)}, not {', '.join(others)}: it follows "
                "no motion from its start; another method does"
            )
        plant = problem.plant
        if plant.mechanics.solver == EXACT and not is_plain(plant.mechanics):
            raise UsageError(
                f"plant '{plant.name}': recursive least squares has the thesis's torques only, which are linear in "
                "the parameters; another method takes this model"
            )
        parts = [regression(problem, experiment) for experiment in problem.experiments]
        rows, errors = (np.concatenate(part) for part in zip(*parts, strict=True))
        counts = np.any(rows != 0.0, axis=1)
        used = int(counts.sum())
        if used < len(problem.unknowns):
            raise UsageError(
                f"recursive least squares: the brake surely moves in {used} periods, too few for "
                f"{len(problem.unknowns)} unknowns: excite it more"
            )
        values = recursion(rows[counts], errors[counts], *beginning(problem))
        low, high = map(problem.values, problem.bounds)
        prior_mean, inverse = problem.prior
        if (values < low).any() or (values > high).any():
            unit = problem.values(problem.nominal())
            stacked = np.concatenate([rows, np.diag(inverse)]) * unit, np.concatenate([errors, inverse * prior_mean])
            values = np.clip(lsq_linear(*stacked, bounds=(low / unit, high / unit)).x * unit, low, high)
        z = problem.coordinates(values)
        residuals = errors - rows @ values
        relative = rows * values
        prior = np.diag((inverse * values) ** 2)
        information = relative.T @ relative + prior
        paired = np.stack([relative, np.zeros_like(relative)], axis=1).reshape(-1, len(z))
        of_prior = (prior_mean - values) * inverse
        spread = sandwich(
            information,
            np.concatenate([paired, np.diag(inverse * values)]),
            np.concatenate([np.stack([residuals, np.zeros_like(residuals)], axis=1).ravel(), of_prior]),
            [len(part) for part, _ in parts],
        )
        cost = float(residuals @ residuals + of_prior @ of_prior)
        return finished(
            problem,
            z,
            problem.weights(z),
            (End(z, cost, problem.nominal(), True, used),),
            information=information,
            samples=relative.T @ relative,
            sandwich=spread,
            method="rls",
        )


def regression(problem: Problem, experiment: Experiment) -> tuple[Floats, Floats]:
    """An experiment's equations of motion, each divided by its standard deviation from the velocities' noise.

    Returns:
        Regressors, shape (periods, unknowns), and the impulse that they explain, shape (periods,). Zero for a period
        that does not count. Without the first period, whose start was not sampled.
    """
    p, t_s = problem.bench.brake, problem.bench.timing.sample_time
    delay, offset = problem.plant.instruments.measurement_delay, problem.plant.instruments.encoder_offset
    seen = experiment.samples[delay:]
    begun, ended = seen[:-1], seen[1:]
    mean = 0.5 * (begun + ended)
    noise = problem.bench.noise.velocity
    sign = np.sign(mean[:, 1])
    impulses = {
        "k_m": experiment.currents[1 : len(seen)] * t_s,
        "k_1": -p.gamma * np.maximum(mean[:, 0] - offset, 0.0) * t_s,
        "T_c": -sign * t_s,
        "f_v": -mean[:, 1] * t_s,
    }
    fixed = sum(getattr(p, n) * v for n, v in impulses.items() if n not in problem.question.names)
    impulse = p.J * (ended[:, 1] - begun[:, 1]) - fixed
    rows = np.stack([impulses[name] for name in problem.question.names], axis=1)
    reported = True if experiment.assumed is None else np.isnan(experiment.assumed[1 : len(seen)])
    with np.errstate(invalid="ignore"):  # a lost sample compares as not sure
        moves = np.minimum(begun[:, 1] * sign, ended[:, 1] * sign) > SURE * noise
    counts = moves & np.isfinite(mean[:, 0]) & reported
    deviation = np.sqrt(2.0) * p.J * noise
    return np.where(counts[:, None], rows / deviation, 0.0), np.where(counts, impulse / deviation, 0.0)


def beginning(problem: Problem) -> tuple[Floats, Floats]:
    """Mean and covariance of the parameters before the first period."""
    mean, inverse = problem.prior
    nominal, with_prior = problem.values(problem.nominal()), inverse > 0.0
    deviation = np.where(with_prior, 1.0 / np.where(with_prior, inverse, 1.0), WIDE * nominal)
    return np.where(with_prior, mean, nominal), np.diag(deviation**2)


def recursion(rows: Floats, errors: Floats, z: Floats, covariance: Floats) -> Floats:
    """Mean after equations ``rows z = errors``, shape (m, p), one after the other, each with a noise of variance one.

    Begins at the mean ``z`` and its ``covariance``.
    """
    for row, value in zip(rows, errors.tolist(), strict=True):
        cross = covariance @ row
        gain = cross / (1.0 + float(row @ cross))
        z = z + gain * (value - float(row @ z))
        reduced = np.eye(len(z)) - np.outer(gain, row)
        covariance = reduced @ covariance @ reduced.T + np.outer(gain, gain)  # Joseph's form stays positive
    return z
