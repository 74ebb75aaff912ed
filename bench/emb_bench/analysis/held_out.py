"""Prediction of an experiment from an estimate of others, and parameters in which experiments differ.

In-sample residuals are smaller than the noise, most of all with a flexible model. The error e of a prediction is noise
plus the error of the parameters: with the estimate's covariance C and the sensitivities J, e^T (I + J C J^T)⁻¹ e is χ²
with as many degrees of freedom as samples. It equals the minimum of |e|² + δ^T C⁻¹ δ over the parameters' errors δ,
which is computed here by simulation, without linearisation. Each combination that is not identified, and each unknown
of the new experiment alone, costs a degree of freedom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import special

from emb_bench.analysis.records import Differing, HeldOut
from emb_bench.analysis.several_runs import apart_by, constancy
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import quantity
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.innovations import Filter
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.model_validation import taken
from emb_bench.estimate.output_error import searched
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.search import minimise
from emb_bench.estimate.windows import predict_windows
from emb_bench.experiment.experiment import Experiment
from emb_runtime.errors import UsageError

APART = 0.001  # False-alarm probability of differing parameters, all parameters together
LEVEL = 0.01  # False-alarm probability of all predictions together

GROUPS = 4  # Folds of the cross-validation: the time grows linearly with the number of experiments
_DETERMINED = 1e-7  # of the largest singular value, columns of unit length, above which a direction is determined


def held_out(e: Estimate, experiment: Experiment, *, among: int = 1) -> HeldOut:
    """Predict an experiment of the same brake from an estimate of others; ``among``: number of predictions tested."""
    level = LEVEL / among
    if e.method == "windows":
        return _windows_predicted(e, experiment, level)
    problem = replace(e.problem, question=replace(e.question, prior=None), experiments=(experiment,))
    index = [i for i, unknown in enumerate(problem.unknowns) if unknown.experiment is None]
    start = problem.nominal()
    start[index] = e.z[e.shared()]
    start = np.clip(start, *problem.bounds)
    at = start[index]
    prior = np.zeros((len(index), len(start)))
    prior[:, index] = _root(e.shared_information())
    weights = problem.weights(start)
    if experiment.gap_unknowns and e.method != "pem":
        problem = searched(problem, [start]).problem
    parts = _errors(e, problem, start, weights)

    def residuals(z: Floats) -> tuple[Floats, Floats]:
        errors, rows = parts(z)
        return np.concatenate([errors, prior[:, index] @ (z[index] - at)]), np.concatenate([rows, prior])

    end = minimise(problem, start, residuals)
    rows = residuals(end.z)[1]
    fitted = _rank(rows) - _rank(prior)
    samples = int(sum((root > 0.0).sum() for root in weights))
    measured = sum(root.size for root in weights)
    starts = len(rows) - len(prior) - measured
    if e.method != "pem":
        starts -= experiment.gap_unknowns
        fitted += taken(problem.gap_basis(end.z, weights), measured)
    freedom = max(samples + starts - fitted, 1)
    p_value = float(special.chdtrc(freedom, end.cost))
    return HeldOut(experiment.name, end.cost, freedom, p_value, p_value >= level)


def refit(e: Estimate, index: Sequence[int]) -> Estimate:
    """Estimate from the experiments ``index``, which may repeat, by the same method.

    Output error begins at the estimate ``e``. The model validation is that of ``e``.
    """
    problem, places = e.problem.subset(index)
    if e.method != "oem":
        return method_of(e.method)(e.bench, e.plant, e.question, starts=1).fit(problem.experiments)
    return searched(problem, [np.clip(e.z[places], *problem.bounds)]).finished(e.validation)


def leave_one_out(e: Estimate) -> tuple[HeldOut, ...]:
    """Cross-validation in ``GROUPS`` folds: each experiment is predicted from an estimate of the others."""
    count = len(e.experiments)
    if count < 2:
        raise UsageError(f"to predict each record from the others takes at least 2, got {count}")
    groups = min(count, GROUPS)
    others = [refit(e, [k for k in range(count) if k % groups != group]) for group in range(groups)]
    return tuple(held_out(others[i % groups], experiment, among=count) for i, experiment in enumerate(e.experiments))


def _windows_predicted(e: Estimate, experiment: Experiment, level: float) -> HeldOut:
    """Prediction of the windows of an experiment, each from its best start.

    The uncertainty of the parameters does not count: disturbances of the windows exceed it.
    """
    error, chi2, freedom = predict_windows(replace(e.problem, experiments=(experiment,)), e.values)
    p_value = float(special.chdtrc(freedom, chi2))
    return HeldOut(experiment.name, chi2, freedom, p_value, p_value >= level, error)


def _errors(
    e: Estimate, problem: Problem, z: Floats, weights: Sequence[Floats]
) -> Callable[[Floats], tuple[Floats, Floats]]:
    """Errors of the simulation, or of the filter for the prediction-error method."""
    if e.method != "pem":
        return lambda z: problem.jacobian(z, weights)
    filtered = Filter(problem, e.process_noise, e.load_noise)
    gains = filtered.gains(z, weights)
    return lambda z: filtered.jacobian(z, weights, gains)


def _root(information: Floats) -> Floats:
    """R with R^T R = M, a row of zeros for each direction that is not identified, shape (p, p)."""
    unit = np.sqrt(np.where(np.diag(information) > 0.0, np.diag(information), 1.0))
    values, vectors = np.linalg.eigh(information / np.outer(unit, unit))
    determined = np.where(values > _DETERMINED**2 * len(unit), values, 0.0)
    result: Floats = np.sqrt(determined)[:, None] * vectors.T * unit
    return result


def _rank(rows: Floats) -> int:
    lengths = np.linalg.norm(rows, axis=0)
    return int(np.linalg.matrix_rank(rows / np.where(lengths > 0.0, lengths, 1.0), tol=_DETERMINED * len(lengths)))


def apart(e: Estimate) -> tuple[Differing, ...]:
    """Parameters that differ between experiments, each of which fits alone; the most different first.

    Empty if the experiments fit together, if no more than half of them fit alone, or if no parameter differs.
    Experiments that do not fit alone are not compared.
    """
    if len(e.experiments) < 2 or e.validation.fits:
        return ()
    every = [
        method_of(e.method)(e.bench, e.plant, e.question, starts=1).fit([experiment]) for experiment in e.experiments
    ]
    alone = [one for one in every if one.validation.fits]
    if 2 * len(alone) <= max(len(every), 2):
        return ()
    found = []
    for name in e.question.params:
        at = [next(i for i, u in enumerate(one.unknowns) if u.name == name) for one in alone]
        values = np.array([one.values[i] for one, i in zip(alone, at, strict=True)])
        effects = [one.effects(i) for one, i in zip(alone, at, strict=True)]
        mean = {effect: tuple(np.mean([one[effect] for one in effects], axis=0).tolist()) for effect in effects[0]}
        between = [float(one.between_runs()[i]) for one, i in zip(alone, at, strict=True)]
        if not np.isfinite(between).all():
            continue
        deviations = [apart_by(d, one, mean) for d, one in zip(between, effects, strict=True)]
        scale = float(np.mean([one.scale[i] for one, i in zip(alone, at, strict=True)]))
        p_value = constancy(values.tolist(), [scale * d for d in deviations]).p_value
        if p_value < APART / len(e.question.params):
            in_order = iter(values.tolist())
            by_experiment = tuple(next(in_order) if one.validation.fits else math.nan for one in every)
            found.append(Differing(quantity(e.bench.machine, name).name, by_experiment, p_value))
    return tuple(sorted(found, key=lambda one: one.p_value))
