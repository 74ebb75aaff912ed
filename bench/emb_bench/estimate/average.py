"""Bayesian average over the presence of each systematic error (docs/explanation/estimation.md).

An error is absent with the probability ``ABSENT``; otherwise it is Gaussian, with one of ``SHARES`` of its prior's
standard deviation: a spike and a slab (Mitchell and Beauchamp, Journal of the American Statistical Association 83,
1988). For given deviations the estimate of the linearised problem is Gaussian; the combinations are averaged with their
probabilities given the experiment (Bayesian model averaging: Hoeting, Madigan, Raftery and Volinsky, Statistical
Science 14, 1999).

Let M be the information with all priors in full, C its inverse, and S the prior deviations of the errors η. The samples
have the information A = C_ηη⁻¹ − S⁻² on η, and the score b = C_ηη⁻¹ η̂. With the deviations D, the errors have the
covariance V = D (1 + D A D)⁻¹ D and the mean V b, and the posterior weight of D is its prior probability times |1 + D A
D|^−½ exp(½ bᵀ V b). The other unknowns follow from the errors by regression.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.estimate.prediction import Problem
from emb_bench.information.identifiability import Spectrum, schur_complement

ABSENT = 5.0 / 6.0  # Prior probability that a bench does not have a given systematic error
SHARES = (1e-3, 1e-2, 0.1, 1.0)  # Deviations of a present error, over that of its prior


class Average(NamedTuple):
    """A linearised problem averaged over combinations of errors and of their deviations."""

    step: Floats  # From the point of linearisation to the mean of the unknowns, shape (p,)
    errors: list[int]  # Places of the systematic errors among the unknowns
    gain: Floats  # Change of all unknowns with the errors, shape (p, errors)
    full: Floats  # Information on the errors with all priors in full
    covariance: Floats  # Of the errors, over all combinations
    chances: Floats  # Logarithms of the probabilities of the combinations given the experiment, shape (c,)
    shifts: Floats  # Means of the errors from the fit with all priors in full, by combination
    covariances: Floats  # Of the errors, by combination

    def added(self) -> Floats:
        """Information beyond that with all priors in full, shape (p, p)."""
        found = np.zeros((len(self.step), len(self.step)))
        found[np.ix_(self.errors, self.errors)] = np.linalg.inv(self.covariance) - self.full
        return found

    def biases(self, effects: Sequence[Influence]) -> tuple[Floats, Floats]:
        """Root mean squares of the biases by effects, signed as for positive ones, and of the effects' sizes.

        Shapes (effects, p) and (effects,).
        """
        moved, information, score, deviations, present, besides = map(np.array, zip(*effects, strict=True))
        there, sizes = moved[:, self.errors], deviations[:, None, :]
        score_gain = there @ self.full
        spread = np.einsum("cij,ej->eci", self.covariances, score_gain)
        seen = np.einsum("ei,ei->e", score_gain, there)[:, None] - np.einsum("ei,eci->ec", score_gain, spread)
        informations = (information[:, None] + np.maximum(seen, 0.0))[:, :, None]
        scores = (score[:, None] + score_gain @ self.shifts.T)[:, :, None]
        changed = moved[:, None] - (there[:, None] - spread) @ self.gain.T
        changed += np.copysign(besides[:, None], changed)
        variances = 1.0 / (sizes**-2.0 + informations)
        logs = 0.5 * (variances * scores**2 - np.log1p(sizes**2 * informations)) + self.chances[:, None]
        logs += np.log(present / deviations.shape[1])[:, None, None]
        most = np.maximum(logs.max(axis=(1, 2)), self.chances.max())[:, None]
        weights, absent = np.exp(logs - most[:, :, None]), (1.0 - present) * np.exp(self.chances - most).sum(axis=1)
        squares = (weights * (variances + (variances * scores) ** 2)).sum(axis=2)
        squares /= (weights.sum(axis=(1, 2)) + absent)[:, None]
        roots = np.sqrt(np.einsum("ec,eci->ei", squares, changed**2))
        signs = np.einsum("c,eci->ei", np.exp(self.chances), changed)
        return np.copysign(roots, signs), np.sqrt(squares.sum(axis=1))


class Influence(NamedTuple):
    """An unmodelled effect, relative to the fit with all priors in full."""

    moved: Floats  # Change of the unknowns by an effect of size 1, shape (p,)
    information: float  # On its size
    score: float  # Of the residuals
    deviations: Floats  # Possible deviations of its prior, equally many for each effect
    present: float  # Prior probability that it is present
    besides: Floats  # Further bias of each unknown, added in absolute value


def average(problem: Problem, z: Floats, found: tuple[Floats, Floats]) -> Average:
    """Averages the problem linearised at ``z``, where residuals and their derivatives to z are ``found``."""
    residuals, jacobian = found
    unit = np.linalg.norm(jacobian, axis=0)
    unit = np.where(unit > 0.0, unit, 1.0)
    step = -np.linalg.lstsq(jacobian / unit, residuals, rcond=None)[0] / unit if residuals.any() else np.zeros(len(z))
    names, priors = [unknown.name for unknown in problem.unknowns], problem.question.systematic
    at = [i for i, name in enumerate(names) if name in priors]
    if not at:
        return unaveraged(step)
    information, others = jacobian.T @ jacobian, [i for i in range(len(z)) if i not in at]
    inner = Spectrum(information[np.ix_(others, others)])
    inverse = inner.inverse()
    inverse[inner.lost, inner.lost] = 0.0
    gain = np.zeros((len(z), len(at)))
    gain[at], gain[others] = np.eye(len(at)), -inverse @ information[np.ix_(others, at)]
    full, there = schur_complement(information, at), (z + step - problem.prior[0])[at]
    groups = [list(priors).index(names[i]) for i in at]
    chances, means, covariances = _combinations(full, full @ there, np.array([priors[names[i]] for i in at]), groups)
    weights = np.exp(chances)
    mean = np.einsum("c,ci->i", weights, means)  # not by a product of matrices, whose last digit depends on threads
    away = means - mean
    covariance = np.einsum("c,cij->ij", weights, covariances) + np.einsum("c,ci,cj->ij", weights, away, away)
    return Average(step + gain @ (mean - there), at, gain, full, covariance, chances, means - there, covariances)


def unaveraged(step: Floats) -> Average:
    """A problem without systematic errors, or with all their priors in full."""
    none = np.zeros((0, 0))
    return Average(step, [], np.zeros((len(step), 0)), none, none, np.zeros(1), np.zeros((1, 0)), np.zeros((1, 0, 0)))


def _combinations(full: Floats, score: Floats, priors: Floats, groups: Sequence[int]) -> tuple[Floats, Floats, Floats]:
    """Logarithms of the probabilities of all combinations, with the means and covariances of the errors.

    Errors of one group are present together, with the same share of their priors.
    """
    data = full - np.diag(priors**-2.0)
    before = np.log([ABSENT, *[(1.0 - ABSENT) / len(SHARES)] * len(SHARES)])
    combinations = np.array(list(itertools.product(range(len(before)), repeat=max(groups) + 1)))
    d = np.array([0.0, *SHARES])[combinations][:, groups] * priors
    inner = d[:, :, None] * data * d[:, None, :] + np.eye(len(priors))
    covariances = d[:, :, None] * np.linalg.inv(inner) * d[:, None, :]
    means = covariances @ score
    logs = before[combinations].sum(axis=1) - 0.5 * np.linalg.slogdet(inner)[1] + 0.5 * means @ score
    logs -= logs.max()
    return logs - np.log(np.exp(logs).sum()), means, covariances
