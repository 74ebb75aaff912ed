"""Suspects: score tests of effects that the model lacks or holds fixed, and the uncertainty budget.

Rao's score test of one effect: the residuals projected on the effect's regressor, orthogonal to all estimated columns,
are standard normal if the model is right. The test of an effect that is never negative is one-sided. The effects are
the rows of :mod:`emb_bench.estimate.effects`.

The same numbers give the uncertainty budget: the bias of each unknown by an unmodelled effect, given the prior of the
bench file and the residuals (:mod:`emb_bench.estimate.average`). A constant that is never exact is present with
certainty, any other effect with the probability ``PRESENT``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import special

from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import CURVED, PARAMETERS
from emb_bench.config.machine import Machine
from emb_bench.estimate.average import SHARES, Average, Influence, average, unaveraged
from emb_bench.estimate.derived_velocity import derived
from emb_bench.estimate.effects import DRIFTS, EFFECTS, LAGGING, Prediction, possible, regressors
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import Cause, Contribution, JointScore, ModelValidation, Suspect
from emb_runtime.config.bench import PARAMETER_NAMES

PRESENT = 0.5  # Prior probability that a brake has a given effect that is not certain

DISTURBED = 10.0
"""Factor on the prior deviations of drifts if a disturbance was found: it may be a drift, which the random walk of a
filter absorbs without an alarm."""

ALIKE = 0.8  # Ratio of two scores above which the suspects are about equally significant
EXPLAINS = 3.0  # Score above which a fixed parameter may explain a misfit [standard deviations]
DISTINGUISHED = 2.0  # Difference of two suspects' squared scores below which they are hardly distinguished

DEPENDENT = 1e-6  # relative norm of a projected regressor below which it depends on the others


class Lacking(NamedTuple):
    """Columns of k effects that a model lacks, as long as the m residuals."""

    names: tuple[str, ...]
    beside: Floats  # Orthogonal to all fitted columns, shape (k, m); zero for a dependent one
    moved: Floats  # Bias of the p unknowns per unit of each, shape (k, p)


def lacking(found: Mapping[str, Floats], basis: Floats, inverse: Floats) -> Lacking:
    """Projects the columns found on the complement of the fitted ones, and computes the biases.

    ``basis``: orthonormal basis of all fitted columns; ``inverse``: pseudo-inverse of the Jacobian.
    """
    rows = np.array([*found.values()]).reshape(-1, len(basis))
    beside = np.array([row - basis @ (basis.T @ row) for row in rows]).reshape(rows.shape)
    beside[np.linalg.norm(beside, axis=1) <= DEPENDENT * np.linalg.norm(rows, axis=1)] = 0.0
    return Lacking(tuple(found), beside, np.array([inverse @ row for row in rows]))


def score(
    problem: Problem,
    z: Floats,
    linearised: tuple[Floats, Floats],
    basis: Floats,
    prediction: Prediction,
    ratio: float,
    *,
    disturbed: bool = False,
) -> tuple[tuple[Suspect, ...], tuple[Contribution, ...], JointScore | None]:
    """Score tests of the effects that are not estimated, most significant first; their budget; the joint test.

    ``linearised``: residuals at the estimate and their derivatives to z. ``basis``: orthonormal basis of all fitted
    columns. ``ratio``: χ²/n, by which the variance of the noise may exceed the bench's. ``disturbed``: True if a
    disturbance was found.
    """
    errors, jacobian = linearised
    names = tuple(name for name, row in EFFECTS.items() if row.tested or name in problem.question.unmodelled)
    found = lacking(regressors(problem, z, prediction, jacobian, names), basis, basis_and_inverse(jacobian)[1])
    scores = np.array([row @ errors for row in found.beside])
    squares = np.array([np.linalg.norm(row) ** 2 for row in found.beside])
    budget = budget_of(
        problem, average(problem, z, linearised), found, squares, scores, DISTURBED if disturbed else 1.0
    )
    tested = [i for i, name in enumerate(found.names) if EFFECTS[name].tested and squares[i] > 0.0]
    if not tested:
        return (), budget, None
    curve = [i for i in tested if found.names[i] in CURVED]
    both = float(np.sum((basis_and_inverse(found.beside[curve].T)[0].T @ errors) ** 2)) if curve else 0.0
    suspects = []
    for i in tested:
        name, amount, sigmas = found.names[i], float(scores[i] / squares[i]), float(scores[i] / squares[i] ** 0.5)
        away = sigmas / max(ratio, 1.0) ** 0.5
        p = float(special.ndtr(-away) if EFFECTS[name].positive else 2.0 * special.ndtr(-abs(away)))
        low, high = possible(name, problem.bench)
        size, fall = sigmas / max(ratio, 1e-300) ** 0.5, both if i in curve else sigmas**2
        suspects.append(Suspect(name, amount, size, p, possible=low < amount < high, fall=fall))
    together = [i for i in tested if not EFFECTS[found.names[i]].alone]
    axes, values, _ = np.linalg.svd(
        (found.beside[together] / np.sqrt(squares[together])[:, None]).T, full_matrices=False
    )
    axes = axes[:, values > 1e-3]
    statistic, rank = float(np.sum((axes.T @ errors) ** 2)), axes.shape[1]
    p_value = float(special.chdtrc(rank, statistic / max(ratio, 1.0)))
    return _with_observer(_ranked(suspects), problem), budget, JointScore(statistic, rank, p_value)


def cause(m: ModelValidation, machine: Machine | None) -> Cause | None:
    """The effect that explains a misfit, or most of it; None without a significant one.

    The ``machine`` is that of a bench without a brake. Parameters that are not estimated come first. A score test is
    linear: of an effect that explains only a part of the misfit the amount is unreliable, and an impossible amount does
    not exclude the effect.
    """
    if m.fits:
        return None
    usual = PARAMETER_NAMES if machine is None else machine.unknown
    fixed = [s for s in m.suspects if s.name in usual and abs(s.sigmas) >= EXPLAINS]
    lagging = [s for s in m.suspects if s.observer and f"score of {s.name}" in m.alarming]
    for s in (*lagging, *fixed):
        return _cause(m, s, possible=True)._replace(fixed=tuple(one.name for one in fixed))
    found = [s for s in m.suspects if s.name in CURVED or (f"score of {s.name}" in m.alarming and s.name != LAGGING)]
    if not any(f"score of {s.name}" in m.alarming for s in found):
        return None
    possible = [s for s in found if s.possible or s.name in CURVED]
    # An effect that explains all of the misfit, or a misfit without alarm by χ², needs a possible amount.
    if explaining := [s for s in found if _share(m, s) in (None, 1.0)]:
        possible = found = [s for s in possible if s in explaining]
    if not found:
        return None
    most = max(s.fall for s in found)
    alike = [s for s in possible if s.fall >= ALIKE**2 * most]
    best = max(s.fall for s in alike or found) - DISTINGUISHED * m.ratio
    # A recording cannot be repeated: of equally significant effects one that can be estimated is preferred.
    named = [s for s in alike if machine is not None and s.name in PARAMETERS]
    first = [*named, *(s for s in alike or found if s.fall >= best)][0]
    return _cause(m, first, possible=first in possible)


def _cause(m: ModelValidation, s: Suspect, *, possible: bool) -> Cause:
    square = s.fall / max(m.ratio, 1e-300)
    return Cause(s, square**0.5, _share(m, s), square - s.sigmas**2 > DISTINGUISHED, possible)


def _share(m: ModelValidation, s: Suspect) -> float | None:
    """Share of the misfit that an effect explains, as in :class:`Cause`."""
    if "size" not in m.alarming:
        return None
    ratio = (m.chi2 - s.fall) / max(m.freedom - 1, 1)
    return 1.0 if ratio <= m.expected[1] else min(s.fall / (m.chi2 - m.freedom), 0.999)


def basis_and_inverse(jacobian: Floats) -> tuple[Floats, Floats]:
    """An orthonormal basis and the pseudo-inverse of a tall matrix whose columns differ in scale."""
    lengths = np.linalg.norm(jacobian, axis=0)
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    basis, triangle = np.linalg.qr(jacobian / lengths)
    return basis, np.linalg.pinv(triangle) @ basis.T / lengths[:, None]


def budget_of(
    problem: Problem, averaged: Average, found: Lacking, squares: Floats, scores: Floats, drifting: float = 1.0
) -> tuple[Contribution, ...]:
    """Uncertainty budget of the unmodelled effects; the biases of untested ones are with all priors in full.

    From the ``squares`` of their projected columns and the ``scores`` of the residuals; the prior deviations of drifts
    are ``drifting`` times those of the bench file.
    """
    priors, budget = problem.question.unmodelled, dict[str, Contribution]()
    influences = {
        name: _influence(
            problem, name, priors[name] * (drifting if name in DRIFTS else 1.0), found.moved[i], square, scored
        )
        for i, (name, square, scored) in enumerate(zip(found.names, squares.tolist(), scores.tolist(), strict=True))
        if name in priors
    }
    for way, is_tested in ((averaged, True), (unaveraged(averaged.step), False)):
        names = [name for name in influences if EFFECTS[name].tested is is_tested]
        biases, sizes = way.biases([influences[name] for name in names]) if names else ((), ())
        for name, bias, size in zip(names, biases, sizes, strict=True):
            budget[name] = Contribution(name, tuple(bias.tolist()), float(size))
    return tuple(budget[name] for name in influences)


def _influence(
    problem: Problem, name: str, prior: float, moved: Floats, information: float, scored: float
) -> Influence:
    """An effect with the prior deviation ``prior`` of its size."""
    # The fit gives the value in the middle of a drift; the interval has to cover the start and the end.
    ends = np.array([0.5 if f"{u.name}_drift" == name else 0.0 for u in problem.unknowns])
    if name == "J":  # all torques scale with it, fixed ones as well: the residuals do not change
        moved, information, scored = np.array([float(u.name in PARAMETER_NAMES) for u in problem.unknowns]), 0.0, 0.0
    sizes, present = (np.ones(len(SHARES)), 1.0) if EFFECTS[name].is_certain else (np.array(SHARES), PRESENT)
    return Influence(moved, information, scored, prior * sizes, present, ends)


def _ranked(found: Sequence[Suspect]) -> tuple[Suspect, ...]:
    """Most significant first; those that are hardly distinguished in the order of ``EFFECTS``."""

    def rank(s: Suspect) -> tuple[float, float]:
        """Without the last digits, which differ between processors."""
        suspicion = s.sigmas if EFFECTS[s.name].positive else abs(s.sigmas)
        return float(f"{s.p_value:.6g}"), -float(f"{suspicion:.6g}")

    ordered = sorted(found, key=rank)
    least = ordered[0].sigmas ** 2 - DISTINGUISHED
    alike = [s for s in ordered if s.sigmas**2 >= least and s.p_value < 0.5]
    alike.sort(key=lambda s: list(EFFECTS).index(s.name))
    return (*alike, *(s for s in ordered if s not in alike))


def _with_observer(found: tuple[Suspect, ...], problem: Problem) -> tuple[Suspect, ...]:
    """Suspects with the observer that derives the velocity, if an experiment shows one; its lag comes first."""
    observed = problem.plant.instruments.observer_bandwidth > 0.0
    if observed or (observer := derived(problem.experiments, problem.bench.timing.sample_time)) is None:
        return found
    ordered = sorted(found, key=lambda s: s.name != LAGGING)
    return tuple(
        replace(s, p_value=observer.p_value, possible=True, observer=observer) if s.name == LAGGING else s
        for s in ordered
    )
