"""Prediction-error method: the parameters with the smallest innovations, each sample given those before it.

Output error takes the brake to move as the model says and nothing else; what disturbs it then is in all later samples,
and biases the parameters. Here the brake is followed by a Kalman filter (:mod:`emb_bench.estimate.innovations`), and
what is to be small are its innovations (Ljung, System Identification, 2nd ed., chapter 7). How much the brake is
disturbed is chosen by maximum restricted likelihood; where nothing disturbs it, this is output error.

For a given disturbance the innovations are minimised with the gains held (:func:`emb_bench.estimate.search.converge`);
their information is that of the innovations with the gains held, too. That the disturbance is itself an estimate is
left out of it; intervals still cover (``benchmarks/interval_coverage.py --case disturbance``). Every search begins
under a strong disturbance, where there are few local minima, and takes what it found there to the likely one.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from emb_bench.brake.motion import Floats
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.innovations import Filter, Followed
from emb_bench.estimate.method import Method
from emb_bench.estimate.model_validation import examine
from emb_bench.estimate.output_error import finished, start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Disturbance
from emb_bench.estimate.search import converge, strong
from emb_bench.information.fisher import information_of_range

POWERS = {"walk": range(2, -7, -1), "load": range(0, -5, -1)}
"""Powers of ten of the walks that are tried, in their units: weaker ones are lost in the noise."""
BOTH = 6.6  # Deviance that a second kind of disturbance has to take away: by chance less in 199 of 200 cases
_NOTHING = 1e-3  # of a deviance: what is left of searches that end


class PredictionError(Method):
    """The smallest innovations, and how much the brake was disturbed."""

    systematic = True

    def solve(self, problem: Problem) -> Estimate:
        """As :class:`Method`."""
        points = start_points(problem, self.starts, self.seed)
        followed = [converge(Filter(problem, strong(problem)), point) for point in points]
        first = int(np.argmin([end.cost for end in followed]))
        found, near, ratio = likely(problem, followed[first].z)
        ends = []
        for i, before in enumerate(followed):
            end = converge(found, near if i == first else before.z)
            deviance = found.deviance(end.z, problem.weights(end.z))
            ends.append(replace(before.then(end), cost=deviance))
        ends.sort(key=lambda end: end.cost)
        best = ends[0].z
        weights = problem.weights(best)
        gains = found.gains(best, weights)
        innovations = found.jacobian(best, weights, gains)
        disturbance, shown = Disturbance(found.walk, found.load, ratio), Followed(found, best, weights, gains)
        validation = examine(problem, best, weights, innovations, disturbance, shown)
        return finished(
            problem,
            best,
            weights,
            tuple(ends),
            partial(found.jacobian, weights=weights, gains=gains),
            validation,
            method="pem",
            process_noise=found.walk,
            load_noise=found.load,
        )


def likely(problem: Problem, near: Floats) -> tuple[Filter, Floats, float]:
    """The disturbance of the greatest restricted likelihood, z under it, and the deviance that it takes away.

    A walk of the velocity, or one of the load; both where that takes away more of the deviance than chance would.
    """
    none, kinds = Filter(problem, 0.0), tuple(POWERS)
    places = [_refined(none, kind, _roughly(none, kind, near)) for kind in kinds]
    first = int(np.argmin([place.deviance for place in places]))
    best = places[first]
    still, undisturbed = _least(none, best.z)
    if undisturbed - best.deviance > BOTH:
        other = kinds[1 - first]
        second = _roughly(best.filter, other, best.z)
        if best.deviance - second.deviance > BOTH:
            second = _refined(best.filter, other, second)
            best = _refined(second.filter, kinds[first], second)
    gained = undisturbed - best.deviance
    return (best.filter, best.z, gained) if gained > _NOTHING else (none, still, 0.0)


class _Place(NamedTuple):
    """One disturbance, the other unknowns under it, and the restricted deviance."""

    filter: Filter
    z: Floats
    deviance: float


def _place(base: Filter, kind: str, power: float, near: Floats) -> _Place:
    """A disturbance with one of its walks replaced by a power of ten of its unit."""
    found = replace(base, **{kind: strong(base.problem, kind) * 10.0**power})
    return _Place(found, *_least(found, near))


def _roughly(base: Filter, kind: str, near: Floats) -> _Place:
    """The likeliest power of ten of one kind of walk, the other kind as it is; from the strongest down."""
    places = []
    for power in POWERS[kind]:
        places.append(_place(base, kind, power, near))
        near = places[-1].z
    return min(places, key=lambda one: one.deviance)


def _refined(base: Filter, kind: str, rough: _Place) -> _Place:
    """The likeliest size of one kind of walk near a rough one, the other kind as it is."""
    power = math.log10(getattr(rough.filter, kind) / strong(base.problem, kind))
    sought = minimize_scalar(
        lambda x: _place(base, kind, x, rough.z).deviance,
        bounds=(power - 1.0, power + 1.0),
        method="bounded",
        options={"xatol": 0.02},
    )
    return _place(base, kind, float(sought.x), rough.z)


def _least(found: Filter, start: Floats) -> tuple[Floats, float]:
    """The best of the other unknowns under a disturbance, and the restricted deviance there.

    What a disturbance does most looks much like other parameters, and the fit has taken it up. So the likelihood is
    that with the unknowns integrated out, flat within their bounds, as if it were Gaussian in them (Patterson and
    Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 58, 1971).
    """
    problem = found.problem
    z = converge(found, start).z
    weights = problem.weights(z)
    _, jacobian = found.jacobian(z, weights, found.gains(z, weights))
    low, high = problem.bounds
    curvature = jacobian.T @ jacobian + np.diag(information_of_range(low, high))
    return z, found.deviance(z, weights) + float(np.linalg.slogdet(curvature)[1])
