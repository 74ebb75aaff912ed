"""Local searches for the least sum of squares, and how they keep out of local minima.

The method is a trust region within bounds (Branch, Coleman and Li 1999, as in ``scipy.optimize.least_squares``).

**Following.** A simulated brake that turns a little too early drifts away from the measured one, and from there on the
residuals hold little information on the parameters: a local minimum. A filter that trusts the samples never lets the
brake get far from the measured one, and has few. It is the simulation again when its trust is taken away;
:func:`released` does that step by step.
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

EVALUATIONS = 100  # Most simulations of one local search; most end after ten
ROUNDS = 8  # Most times that the gains of a filter are recomputed in one search; two are the rule
STAYS = 0.02  # Standard deviations by which an estimate moves between rounds, at most, when it is at its end
HUGE = 1e100  # Residual that is as bad as any: a filter whose gains are held can diverge at a trial step
RELEASE = (1.0, 0.1, 0.01, 0.0)  # Disturbances, in :func:`strong`, by which a filter becomes the simulation


def minimise(
    problem: Problem,
    start: Floats,
    residuals: Callable[[Floats], tuple[Floats, Floats]],
    evaluations: int = EVALUATIONS,
) -> End:
    """One local search for the least sum of squares within the bounds.

    What follows the unknowns of the problem in ``start`` is searched along without bounds, and is in the end too.
    ``residuals`` gives those of a z with their derivatives. Features are moved by their values, for none at all is
    infinitely far in a logarithm.
    """
    added = np.zeros(len(start) - len(problem.unknowns))
    linear = np.append([u.name in FEATURES for u in problem.unknowns], added).astype(np.bool_)
    unit = np.append(problem.coordinates(np.array([PARAMETERS[u.name].start or 1.0 for u in problem.unknowns])), added)
    known: dict[bytes, tuple[Floats, Floats]] = {}
    low, high = (np.append(z, added + side) for z, side in zip(problem.bounds, (-math.inf, math.inf), strict=True))

    def moved(z: Floats) -> Floats:
        return np.exp(z - unit, out=z.copy(), where=linear)

    def of(x: Floats) -> Floats:
        return np.add(np.log(x, out=x.copy(), where=linear), unit, out=x.copy(), where=linear)

    def both(x: Floats) -> tuple[Floats, Floats]:
        key = x.tobytes()
        if key not in known:
            known.clear()  # the derivatives are evaluated at the newest point only
            errors, derivatives = residuals(of(x))
            known[key] = np.clip(errors, -HUGE, HUGE), derivatives / np.where(linear, x, 1.0)
        return known[key]

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
    """The random walk that moves the velocity by the bench's noise in a period, by the field of a :class:`Filter`.

    That of the velocity itself [rad/s per √s], or of a ``load`` [A per √s].
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
        if moved < STAYS or (found.walk == found.load == 0.0 and problem.plant.instruments.clock_jitter == 0.0):
            break
    return replace(end, start=start, evaluations=evaluations)


def released(problem: Problem, start: Floats) -> End:
    """Minimum that a filter leads to which follows the measured brake at first, and is the simulation in the end."""
    end = converge(Filter(problem, RELEASE[0] * strong(problem)), start)
    for share in RELEASE[1:]:
        end = end.then(converge(Filter(problem, share * strong(problem)), end.z))
    return end
