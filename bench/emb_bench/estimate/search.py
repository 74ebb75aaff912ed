"""Local searches for the least sum of squares, and the continuation that avoids local minima.

The method is a trust region within bounds (Branch, Coleman and Li 1999, as in ``scipy.optimize.least_squares``).

**Continuation.** A simulated brake that reverses a little too early diverges from the measured one, and later residuals
have little information on the parameters: a local minimum. A Kalman filter with process noise stays near the measured
brake and has few local minima. As the process noise goes to zero, the filter becomes the simulation;
:func:`continuation` lowers it step by step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import FEATURES, PARAMETERS
from emb_bench.estimate.innovations import Filter
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import End

EVALUATIONS = 100  # Limit of one local search; most need ten
ROUNDS = 8  # Limit of the updates of a filter's gains in one search; most need two
CONVERGED = 0.02  # Move of an estimate between rounds at the end of a search [standard deviations]
HUGE = 1e100  # Largest residual: a filter with fixed gains can diverge at a trial step
CONTINUATION = (1.0, 0.1, 0.01, 0.0)  # Process noise of the continuation, in units of :func:`strong`


def minimise(
    problem: Problem,
    start: Floats,
    residuals: Callable[[Floats], tuple[Floats, Floats]],
    evaluations: int = EVALUATIONS,
) -> End:
    """One local search for the least sum of squares within the bounds.

    ``residuals`` computes residuals and Jacobian at a z. Elements of ``start`` after the unknowns of the problem have
    no bounds. Features are searched linearly: zero is infinitely far in a logarithm.
    """
    added = np.zeros(len(start) - len(problem.unknowns))
    linear = np.append([u.name in FEATURES for u in problem.unknowns], added).astype(np.bool_)
    unit = np.append(problem.coordinates(np.array([PARAMETERS[u.name].start or 1.0 for u in problem.unknowns])), added)
    cache: dict[bytes, tuple[Floats, Floats]] = {}
    low, high = (np.append(z, added + side) for z, side in zip(problem.bounds, (-math.inf, math.inf), strict=True))

    def moved(z: Floats) -> Floats:
        return np.exp(z - unit, out=z.copy(), where=linear)

    def of(x: Floats) -> Floats:
        return np.add(np.log(x, out=x.copy(), where=linear), unit, out=x.copy(), where=linear)

    def both(x: Floats) -> tuple[Floats, Floats]:
        key = x.tobytes()
        if key not in cache:
            cache.clear()  # the derivatives are evaluated at the newest point only
            errors, derivatives = residuals(of(x))
            cache[key] = np.clip(errors, -HUGE, HUGE), derivatives / np.where(linear, x, 1.0)
        return cache[key]

    found = least_squares(
        lambda x: both(x)[0],
        np.clip(moved(start), moved(low), moved(high)),
        lambda x: both(x)[1],
        bounds=(moved(low), moved(high)),
        method="trf",
        x_scale="jac",
        ftol=1e-10,
        xtol=1e-12,
        gtol=1e-12,
        max_nfev=evaluations,
    )
    return End(of(found.x), 2.0 * float(found.cost), start, found.status > 0, int(found.nfev))


def strong(problem: Problem, kind: str = "walk") -> float:
    """Random walk that changes the velocity by its noise in one period, for a field of :class:`Filter`.

    Of the velocity, ``walk`` [rad/s per √s], or of the ``load`` [A per √s].
    """
    brake, noise, t_s = problem.bench.brake, problem.bench.noise.velocity, problem.bench.timing.sample_time
    if kind == "walk":
        return noise / math.sqrt(t_s)
    return noise * brake.J / (brake.k_m * t_s * math.sqrt(t_s))


def converge(found: Filter, start: Floats) -> End:
    """One local search under a disturbance."""
    problem, z, evaluations = found.problem, start, 0
    for _ in range(ROUNDS):
        weights = problem.weights(z)
        gains = found.gains(z, weights)
        end = minimise(problem, z, partial(found.jacobian, weights=weights, gains=gains))
        _, jacobian = found.jacobian(end.z, weights, gains)
        evaluations += end.evaluations
        moved = float(np.linalg.norm(jacobian @ (end.z - z)))
        z = end.z
        if moved < CONVERGED or (found.walk == found.load == 0.0 and problem.plant.instruments.clock_jitter == 0.0):
            break
    return replace(end, start=start, evaluations=evaluations)


def continuation(problem: Problem, start: Floats) -> End:
    """Minimum by continuation: process noise of a filter from strong to zero, where the filter is the simulation."""
    end = converge(Filter(problem, CONTINUATION[0] * strong(problem)), start)
    for share in CONTINUATION[1:]:
        end = end.then(converge(Filter(problem, share * strong(problem)), end.z))
    return end
