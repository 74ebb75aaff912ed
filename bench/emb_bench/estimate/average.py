"""Average over whether each systematic error is there (docs/explanation/estimation.md).

A bench has no certain error with the probability ``ABSENT``; else the error is Gaussian, of a deviation that is one of
``SHARES`` of its prior's: a spike and a slab (Mitchell and Beauchamp, Journal of the American Statistical Association
83, 1988). For given deviations the estimate is Gaussian in the linearised problem, and all of them count with their
probabilities given the experiment (Bayesian model averaging: Hoeting, Madigan, Raftery and Volinsky, Statistical
Science 14, 1999).

Let M be the information with all priors in full, C its inverse, and S the prior deviations of the errors η. The samples
have the information A = C_ηη⁻¹ − S⁻² on η, and the score b = C_ηη⁻¹ η̂. With the deviations D, the errors have the
covariance V = D (1 + D A D)⁻¹ D and the mean V b, and D counts as before times |1 + D A D|^−½ exp(½ bᵀ V b). All other
unknowns follow the errors by regression.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from emb_bench.brake.motion import Floats
from emb_bench.estimate.prediction import Problem
from emb_bench.information.identifiability import Spectrum, schur_complement

ABSENT = 5.0 / 6.0  # Probability, before any experiment, that a bench does not have a certain systematic error
SHARES = (1e-3, 1e-2, 0.1, 1.0)  # Deviations of an error that is there, over that of its prior


class Average(NamedTuple):
    """A linearised problem as it is averaged over combinations of errors, each with deviations of its own."""

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
        """Root mean squares of effects' biases of the unknowns, with the signs of positive ones', and of their sizes.

        Shapes (effects, p) and (effects,).
        """
        moved, information, score, deviations, present, besides = map(np.array, zip(*effects, strict=True))
        there, sizes = moved[:, self.errors], deviations[:, None, :]
        own = there @ self.full
        spread = np.einsum("cij,ej->eci", self.covariances, own)
        seen = np.einsum("ei,ei->e", own, there)[:, None] - np.einsum("ei,eci->ec", own, spread)
        informations = (information[:, None] + np.maximum(seen, 0.0))[:, :, None]
        scores = (score[:, None] + own @ self.shifts.T)[:, :, None]
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
    """An effect that is not estimated, beside the fit with all priors in full."""

    moved: Floats  # Change of the unknowns by an effect of size 1, shape (p,)
    information: float  # On its size
    score: float  # Of the residuals
    deviations: Floats  # Those that its prior may have, as many as of any other effect
    present: float  # Probability before the experiment that it is there
    besides: Floats  # Further bias of each unknown, which adds to its size


def average(problem: Problem, z: Floats, found: tuple[Floats, Floats]) -> Average:
    """Averages the problem linearised at ``z``, where residuals and their derivatives to z are ``found``."""
    residuals, jacobian = found
    unit = np.linalg.norm(jacobian, axis=0)
    unit = np.where(unit > 0.0, unit, 1.0)
    step = -np.linalg.lstsq(jacobian / unit, residuals, rcond=None)[0] / unit if residuals.any() else np.zeros(len(z))
    names, priors = [unknown.name for unknown in problem.unknowns], problem.asked.systematic
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
    """Logarithms of the probabilities of all combinations, and means and covariances of the errors by each.

    Errors of one group are there together, at one share of their priors.
    """
    data = full - np.diag(priors**-2.0)
    before = np.log([ABSENT, *[(1.0 - ABSENT) / len(SHARES)] * len(SHARES)])
    chosen = np.array(list(itertools.product(range(len(before)), repeat=max(groups) + 1)))
    d = np.array([0.0, *SHARES])[chosen][:, groups] * priors
    inner = d[:, :, None] * data * d[:, None, :] + np.eye(len(priors))
    covariances = d[:, :, None] * np.linalg.inv(inner) * d[:, None, :]
    means = covariances @ score
    logs = before[chosen].sum(axis=1) - 0.5 * np.linalg.slogdet(inner)[1] + 0.5 * means @ score
    logs -= logs.max()
    return logs - np.log(np.exp(logs).sum()), means, covariances
