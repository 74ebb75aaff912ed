"""Prediction-error method: the parameters with the smallest innovations, each sample given those before it.

Output error assumes that no disturbance acts on the brake; a disturbance changes all later samples and biases the
parameters. This method minimises the innovations of a Kalman filter (:mod:`emb_bench.estimate.innovations`; Ljung,
System Identification, 2nd ed., chapter 7). The process noise is estimated by maximum restricted likelihood; without
process noise the method is output error.

For a given process noise the innovations are minimised with fixed gains (:func:`emb_bench.estimate.search.converge`),
and the information is theirs with fixed gains. It neglects that the process noise is an estimate; intervals still cover
(``benchmarks/interval_coverage.py --case disturbance``). Every search begins with strong process noise, where there are
few local minima, and continues from there with the likeliest.
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
from emb_bench.estimate.innovations import Filter, FilterPrediction
from emb_bench.estimate.method import Method
from emb_bench.estimate.model_validation import validate
from emb_bench.estimate.output_error import finished, start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Disturbance
from emb_bench.estimate.search import converge, strong
from emb_bench.information.fisher import information_of_range

POWERS = {"walk": range(2, -7, -1), "load": range(0, -5, -1)}
"""Powers of ten of the walks on the grid, in their units; weaker ones are below the noise."""
BOTH = 6.6  # Fall of the deviance that justifies a second kind of disturbance: by chance less in 199 of 200 cases
_NOTHING = 1e-3  # of a deviance: the error of a converged search


class PredictionError(Method):
    """The smallest innovations, and the likeliest process noise."""

    systematic = True

    def solve(self, problem: Problem) -> Estimate:
        """As :class:`Method`."""
        points = start_points(problem, self.starts, self.seed)
        begun = [converge(Filter(problem, strong(problem)), point) for point in points]
        first = int(np.argmin([end.cost for end in begun]))
        found, near, ratio = likely(problem, begun[first].z)
        ends = []
        for i, before in enumerate(begun):
            end = converge(found, near if i == first else before.z)
            deviance = found.deviance(end.z, problem.weights(end.z))
            ends.append(replace(before.then(end), cost=deviance))
        ends.sort(key=lambda end: end.cost)
        best = ends[0].z
        weights = problem.weights(best)
        gains = found.gains(best, weights)
        innovations = found.jacobian(best, weights, gains)
        disturbance = Disturbance(found.walk, found.load, ratio)
        prediction = FilterPrediction(found, best, weights, gains)
        validation = validate(problem, best, weights, innovations, disturbance, prediction)
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
    """The filter of the greatest restricted likelihood, its z, and its fall of the deviance against no disturbance.

    A walk of the velocity, or of the load; both only if the deviance falls by more than by chance.
    """
    none, kinds = Filter(problem, 0.0), tuple(POWERS)
    places = [_refined(none, kind, _roughly(none, kind, near)) for kind in kinds]
    first = int(np.argmin([place.deviance for place in places]))
    best = places[first]
    z, undisturbed = _least(none, best.z)
    if undisturbed - best.deviance > BOTH:
        other = kinds[1 - first]
        second = _roughly(best.filter, other, best.z)
        if best.deviance - second.deviance > BOTH:
            second = _refined(best.filter, other, second)
            best = _refined(second.filter, kinds[first], second)
    gained = undisturbed - best.deviance
    return (best.filter, best.z, gained) if gained > _NOTHING else (none, z, 0.0)


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
    """The likeliest power of ten of one kind of walk, with the other kind fixed; from the strongest down."""
    places = []
    for power in POWERS[kind]:
        places.append(_place(base, kind, power, near))
        near = places[-1].z
    return min(places, key=lambda one: one.deviance)


def _refined(base: Filter, kind: str, rough: _Place) -> _Place:
    """The likeliest size of one kind of walk near a rough one, with the other kind fixed."""
    power = math.log10(getattr(rough.filter, kind) / strong(base.problem, kind))
    sought = minimize_scalar(
        lambda x: _place(base, kind, x, rough.z).deviance,
        bounds=(power - 1.0, power + 1.0),
        method="bounded",
        options={"xatol": 0.02},
    )
    return _place(base, kind, float(sought.x), rough.z)


def _least(found: Filter, start: Floats) -> tuple[Floats, float]:
    """The best z under a disturbance, and the restricted deviance there.

    Other parameters absorb most of a disturbance's effect. So the likelihood is that with the unknowns integrated out,
    with a flat prior within their bounds and in Gaussian approximation (Patterson and Thompson, Recovery of inter-block
    information when block sizes are unequal, Biometrika 58, 1971).
    """
    problem = found.problem
    z = converge(found, start).z
    weights = problem.weights(z)
    _, jacobian = found.jacobian(z, weights, found.gains(z, weights))
    low, high = problem.bounds
    curvature = jacobian.T @ jacobian + np.diag(information_of_range(low, high))
    return z, found.deviance(z, weights) + float(np.linalg.slogdet(curvature)[1])
