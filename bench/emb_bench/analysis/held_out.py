"""Prediction of a record that the estimate has not seen.

Residuals of what was estimated from are smaller than the noise, and a flexible model bends to them. The error of a
prediction is noise plus the error of the parameters: with the estimate's covariance C and the sensitivities J,
e^T (I + J C J^T)⁻¹ e is χ² with as many degrees of freedom as there are samples. It is the least of |e|² + δ^T C⁻¹ δ
over the parameters' errors δ, and that is how it is computed here, by simulation instead of J: the curvature of
the model counts. Each combination that is not identified, and each unknown of the new record alone, costs a degree of
freedom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from emb_bench.brake.motion import Floats
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

LEVEL = 0.01  # Chance of a false alarm with the right model, for all predictions together

GROUPS = 4  # Most estimates that leave records out: the time grows with the number of records, not with its square
_DETERMINED = 1e-7  # share of the largest singular value, columns of unit length, from which a direction is determined


@dataclass(frozen=True)
class HeldOut:
    """Prediction of a record that the estimate has not seen."""

    name: str
    chi2: float  # Weighted square of the prediction's errors, the uncertainty of the estimate taken into account
    freedom: int
    p_value: float  # Chance of a larger one if the model is right
    fits: bool
    error: float = math.nan  # Root mean square of the angle's error over windows [rad]; NaN for other methods

    @property
    def ratio(self) -> float:
        """χ²/n."""
        return self.chi2 / max(self.freedom, 1)


def held_out(e: Estimate, record: Experiment, *, among: int = 1) -> HeldOut:
    """Predict a record of the same brake from an estimate of others; ``among`` predictions share the false alarms."""
    level = LEVEL / among
    if e.method == "windows":
        return _windows_predicted(e, record, level)
    problem = replace(e.problem, asked=replace(e.asked, prior=None), records=(record,))
    index = [i for i, unknown in enumerate(problem.unknowns) if unknown.record is None]
    start = problem.nominal()
    start[index] = e.z[e.shared()]
    start = np.clip(start, *problem.bounds)
    at = start[index]
    known = np.zeros((len(index), len(start)))
    known[:, index] = _root(e.shared_information())
    weights = problem.weights(start)
    if record.gap_unknowns and e.method != "pem":
        problem = searched(problem, [start]).problem
    parts = _errors(e, problem, start, weights)

    def residuals(z: Floats) -> tuple[Floats, Floats]:
        errors, rows = parts(z)
        return np.concatenate([errors, known[:, index] @ (z[index] - at)]), np.concatenate([rows, known])

    end = minimise(problem, start, residuals)
    rows = residuals(end.z)[1]
    fitted = _rank(rows) - _rank(known)
    samples = int(sum((root > 0.0).sum() for root in weights))
    measured = sum(root.size for root in weights)
    starts = len(rows) - len(known) - measured
    if e.method != "pem":
        starts -= record.gap_unknowns
        fitted += taken(problem.gap_basis(end.z, weights), measured)
    freedom = max(samples + starts - fitted, 1)
    p_value = float(special.chdtrc(freedom, end.cost))
    return HeldOut(record.name, end.cost, freedom, p_value, p_value >= level)


def refit(e: Estimate, chosen: Sequence[int]) -> Estimate:
    """Estimates again from some of the records, any of them as often as it is to count, by the same method.

    Output error begins where the estimate is. The model validation is not repeated: it is that of the first estimate.
    """
    problem, own = e.problem.part(chosen)
    if e.method != "oem":
        return method_of(e.method)(e.bench, e.plant, e.asked, starts=1).fit(problem.records)
    return searched(problem, [np.clip(e.z[own], *problem.bounds)]).finished(e.validation)


def leave_one_out(e: Estimate) -> tuple[HeldOut, ...]:
    """Predict each record from an estimate of others, made by the same method.

    Of up to ``GROUPS`` records these are all others; of more, those that are not in its group, of ``GROUPS`` in turns.
    """
    count = len(e.records)
    if count < 2:
        raise UsageError(f"to predict each record from the others takes at least 2, got {count}")
    groups = min(count, GROUPS)
    others = [refit(e, [k for k in range(count) if k % groups != group]) for group in range(groups)]
    return tuple(held_out(others[i % groups], record, among=count) for i, record in enumerate(e.records))


def _windows_predicted(e: Estimate, record: Experiment, level: float) -> HeldOut:
    """Prediction of the windows of a record, each from the start that fits it best.

    What a window was disturbed by is not in the parameters, so that their uncertainty is not released.
    """
    error, chi2, freedom = predict_windows(replace(e.problem, records=(record,)), e.values)
    p_value = float(special.chdtrc(freedom, chi2))
    return HeldOut(record.name, chi2, freedom, p_value, p_value >= level, error)


def _errors(
    e: Estimate, problem: Problem, z: Floats, weights: Sequence[Floats]
) -> Callable[[Floats], tuple[Floats, Floats]]:
    """Errors of the simulation, or of the filter where the estimate is one of innovations."""
    if e.method != "pem":
        return lambda z: problem.jacobian(z, weights)
    filtered = Filter(problem, e.process_noise, e.load_noise)
    gains = filtered.gains(z, weights)
    return lambda z: filtered.jacobian(z, weights, gains)


def _root(information: Floats) -> Floats:
    """R with R^T R = M, a row of zeros for each direction that is not identified, shape (p, p)."""
    unit = np.sqrt(np.where(np.diag(information) > 0.0, np.diag(information), 1.0))
    values, vectors = np.linalg.eigh(information / np.outer(unit, unit))
    kept = np.where(values > _DETERMINED**2 * len(unit), values, 0.0)
    result: Floats = np.sqrt(kept)[:, None] * vectors.T * unit
    return result


def _rank(rows: Floats) -> int:
    lengths = np.linalg.norm(rows, axis=0)
    return int(np.linalg.matrix_rank(rows / np.where(lengths > 0.0, lengths, 1.0), tol=_DETERMINED * len(lengths)))
