"""Prediction-error method: the parameters with the smallest innovations, each sample given those before it.

Output error takes the brake to move as the model says and nothing else; what disturbs it then is in all later samples,
and biases the parameters. Here the brake is followed by a Kalman filter (:mod:`emb_bench.estimate.innovations`), and
what is to be small are its innovations (Ljung, System Identification, 2nd ed., chapter 7). How much the brake is
disturbed is chosen by maximum restricted likelihood; where nothing disturbs it, this is output error.

For a given disturbance the innovations are minimised with the gains held (:func:`emb_bench.estimate.search.converge`);
their information is that of the innovations with the gains held, too. That the disturbance is itself an estimate is
left out of it; intervals still cover as they should (``benchmarks/estimators.py``). Every search begins under a strong
disturbance, where there are few local minima, and takes what it found there to the likely one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize_scalar

from emb_bench.brake.motion import Floats
from emb_bench.estimate.innovations import Filter, Followed
from emb_bench.estimate.model_validation import Disturbance, examine
from emb_bench.estimate.output_error import by_record, finished, start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Estimate
from emb_bench.estimate.search import converge, strong

WEAKEST, STRONGEST = -6, 2
"""Powers of ten of the disturbances that are tried, in :func:`strong`. Weaker ones are lost in the noise."""
_NOTHING = 1e-3  # of a deviance: what is left of searches that end
HYSTERESIS = "where the brake is in its hysteresis is taken from the model: disturbances of it are not followed there"


def estimate(problem: Problem, *, starts: int, seed: int) -> Estimate:
    """Estimate parameters, and how much the brake was disturbed.

    Args:
        problem: records, model and unknowns.
        starts: local searches; the first begins at the nominal brake, the others at random ones.
        seed: of the random numbers.

    Raises:
        UsageError: ``starts`` is below 1.
    """
    points = start_points(problem, starts, seed)
    followed = [converge(Filter(problem, strong(problem)), point) for point in points]
    first = int(np.argmin([end.cost for _, end in followed]))
    walk, near, ratio = likely(problem, followed[first][0])
    found = Filter(problem, walk)
    searches = []
    for i, (z, before) in enumerate(followed):
        z, end = converge(found, near if i == first else z)
        searches.append((z, replace(end, start=before.start, evaluations=before.evaluations + end.evaluations)))
    searches = [(z, replace(end, cost=found.deviance(z, problem.weights(z)))) for z, end in searches]
    searches.sort(key=lambda pair: pair[1].cost)
    best = searches[0][0]
    weights = problem.weights(best)
    gains = found.gains(best, weights)
    errors, jacobian = found.jacobian(best, weights, gains)

    shown = Followed(found, best, weights, gains)
    disturbance, residuals = Disturbance(walk, ratio), by_record(errors, weights)
    validation = examine(problem, best, weights, residuals, jacobian, disturbance, shown, errors)
    return finished(
        problem,
        best,
        weights,
        tuple(end for _, end in searches),
        (errors, jacobian),
        validation,
        method="pem",
        process_noise=walk,
        caveats=(HYSTERESIS,) if problem.plant.mechanics.hysteresis > 0.0 and walk > 0.0 else (),
    )


def likely(problem: Problem, near: Floats) -> tuple[float, Floats, float]:
    """The disturbance of the greatest restricted likelihood, the other unknowns at theirs.

    Args:
        problem: records, model and unknowns.
        near: z to begin with.

    Returns:
        The disturbance [rad/s per √s], z under it, and the deviance that it takes away.
    """
    unit, powers = strong(problem), np.arange(STRONGEST, WEAKEST - 1, -1)
    deviances, places, z = [], [], near
    for power in powers:
        z, deviance = _least(problem, unit * 10.0**power, z)
        places.append(z)
        deviances.append(deviance)
    still, undisturbed = _least(problem, 0.0, z)
    best = int(np.argmin(deviances))
    found = minimize_scalar(
        lambda power: _least(problem, unit * 10.0**power, places[best])[1],
        bounds=(float(powers[best]) - 1.0, float(powers[best]) + 1.0),
        method="bounded",
        options={"xatol": 0.01},
    )
    walk = float(unit * 10.0**found.x)
    z, deviance = _least(problem, walk, places[best])
    gained = undisturbed - deviance
    return (walk, z, gained) if gained > _NOTHING else (0.0, still, 0.0)


def _least(problem: Problem, walk: float, start: Floats) -> tuple[Floats, float]:
    """The best of the other unknowns under a disturbance, and the restricted deviance there.

    What a disturbance does most looks much like other parameters, and the fit has taken it up. So the likelihood is
    that with the unknowns integrated out, flat within their bounds, as if it were Gaussian in them (Patterson and
    Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 1971).
    """
    found = Filter(problem, walk)
    z, _ = converge(found, start)
    weights = problem.weights(z)
    _, jacobian = found.jacobian(z, weights, found.gains(z, weights))
    low, high = problem.bounds
    curvature = jacobian.T @ jacobian + np.diag(12.0 / (high - low) ** 2)
    return z, found.deviance(z, weights) + float(np.linalg.slogdet(curvature)[1])
