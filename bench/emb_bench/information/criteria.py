"""Optimality criteria D, A and E of a Fisher information matrix: values, of one or of many, and gradients.

D is log |M|, A is tr M⁻¹, E is λ_min (Atkinson, Donev and Tobias, Optimum Experimental Designs, with SAS, 2007, chapter
10); D of some parameters, with the others as nuisances, is called Ds. There are three ways to compute them:

- :func:`criteria` and :func:`criteria_series` for reports: accurate for parameters of any scale; a singular matrix has
  the worst values, never a NaN;
- :class:`Criterion` for searches: a concave function φ with its gradient, which is not zero at a singular matrix;
- :mod:`emb_bench.information.symmetric` for compiled loops over small matrices: the criteria and φ from a Cholesky
  factor.

All φ are logarithms: a difference of 0.1 has the same weight for each criterion. Concavity gives the tangent bound φ(M)
≤ φ(M₀) + tr(∇φ(M₀) (M − M₀)), which the search uses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from emb_bench.brake.parameters import renamed
from emb_bench.config.machine import Machine
from emb_bench.information.identifiability import TOUCHED, Spectrum, schur_complement, unit_vector
from emb_bench.information.symmetric import (
    LOG_DET,
    LOG_LAMBDA_MIN,
    MINUS_LOG_TRACE,
    SINGULAR,
    Floats,
)
from emb_runtime.errors import UsageError

Name = Literal["D", "A", "E"]

FLOOR = 1e-13
"""Eigenvalues below this share of the largest count as this share, so that φ has a gradient at a singular start."""


@dataclass(frozen=True)
class Criteria:
    """Criteria of one FIM. Higher is better for D and E, lower for A and the condition number.

    A singular FIM has the worst values: −inf, inf, 0, inf. A nearly singular one has finite values; whether its
    parameters are identified is decided by :func:`~emb_bench.information.identifiability.identifiability`.
    """

    log_det: float  # D: log |M|; of a subset Ds: log of the determinant of its Schur complement
    trace_inverse: float  # A: tr M⁻¹
    lambda_min: float  # E: smallest eigenvalue of M
    condition: float  # Modified E: largest over smallest eigenvalue
    singular: bool  # True if a combination of parameters does not change the data, to rounding
    weakest: Mapping[str, float]  # Combination of relative parameters with the largest variance, unit vector
    flat: tuple[Mapping[str, float], ...]
    """Combinations that are not identified at all, as unit vectors; empty unless singular."""

    def renamed(self, machine: Machine | None) -> Criteria:
        """Criteria with a machine's names of the unknowns."""
        flat = tuple(renamed(direction, machine) for direction in self.flat)
        return replace(self, weakest=renamed(self.weakest, machine), flat=flat)


def criteria(matrix: Any, params: Sequence[str], interest: Sequence[str] | None = None) -> Criteria:
    """D, A, E, condition number and the worst identified combination of an FIM, or of a subset of its parameters.

    Parameters that are not of ``interest`` are nuisances: the criteria are of the Schur complement (Ds-optimality).
    """
    names = list(params if interest is None else interest)
    if not names or not set(names) <= set(params):
        raise UsageError(f"expected some of {', '.join(params)}, got {', '.join(names) or 'none'}")
    index = [list(params).index(name) for name in names]
    spectrum = Spectrum(matrix)
    if spectrum.lost[index].any():
        parts = [v[index] for v in spectrum.flat_directions()]
        # A barely lost parameter may have small shares only: then the direction with the largest one counts.
        directions = [d for d in parts if (np.abs(d) > TOUCHED).any()] or [max(parts, key=lambda d: np.abs(d).max())]
        flat = tuple(dict(zip(names, unit_vector(d).tolist(), strict=True)) for d in directions)
        return Criteria(-math.inf, math.inf, 0.0, math.inf, True, flat[0], flat)
    inverse = spectrum.inverse()[np.ix_(index, index)]
    found, (_, vectors) = _of_covariance(inverse), np.linalg.eigh(inverse)
    largest = float(np.linalg.eigvalsh(schur_complement(spectrum.matrix, index))[-1])
    return Criteria(
        log_det=float(found.log_det) if len(index) < len(params) else spectrum.log_det(),
        trace_inverse=float(found.trace_inverse),
        lambda_min=float(found.lambda_min),
        condition=largest / float(found.lambda_min),
        singular=False,
        weakest=dict(zip(names, unit_vector(vectors[:, -1]).tolist(), strict=True)),
        flat=(),
    )


class Series(NamedTuple):
    """D, E and A of each matrix, as :class:`Criteria` has them; each of shape (m,)."""

    log_det: Floats
    lambda_min: Floats
    trace_inverse: Floats


def _of_covariance(covariance: Floats) -> Series:
    """The criteria of regular matrices from their inverses, shape (..., p, p) to (...)."""
    scale = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    scaled = covariance / (scale[..., :, None] * scale[..., None, :])
    log_det = -(np.linalg.slogdet(scaled)[1] + 2.0 * np.log(scale).sum(axis=-1))
    lambda_min = np.asarray(1.0 / np.linalg.eigvalsh(covariance)[..., -1], np.float64)
    return Series(log_det, lambda_min, np.trace(covariance, axis1=-2, axis2=-1))


def criteria_series(matrices: Floats, params: Sequence[str], interest: Sequence[str]) -> Series:
    """D, E and A of many FIMs, such as those after each sample of an experiment: :func:`criteria` to rounding."""
    index = [list(params).index(name) for name in interest]
    diagonals = np.diagonal(matrices, axis1=1, axis2=2)
    found = Series(*(np.full(len(matrices), worst) for worst in (-math.inf, 0.0, math.inf)))
    # A parameter of interest without information gives the worst values at once: that of many first samples.
    sound = np.isfinite(matrices).all(axis=(1, 2)) & (diagonals >= 0.0).all(axis=1)
    remaining = ~(sound & (diagonals[:, index] == 0.0).any(axis=1))
    full = np.flatnonzero(sound & (diagonals > 0.0).all(axis=1))
    unit = np.sqrt(diagonals[full])
    values, vectors = np.linalg.eigh(matrices[full] / (unit[:, :, None] * unit[:, None, :]))
    regular = (values > SINGULAR * len(params)).all(axis=1)
    full, unit, values, vectors = full[regular], unit[regular], values[regular], vectors[regular]
    rows = vectors[:, index]  # of interest
    inverse = (rows / values[:, None, :]) @ rows.transpose(0, 2, 1) / (unit[:, index, None] * unit[:, None, index])
    for numbers, of_regular in zip(found, _of_covariance(inverse), strict=True):
        numbers[full] = of_regular
    if len(index) == len(params):
        found.log_det[full] = 2.0 * np.log(unit).sum(axis=1) + np.log(values).sum(axis=1)
    remaining[full] = False
    for k in np.flatnonzero(remaining).tolist():  # nearly singular, or wrong
        one = criteria(matrices[k], params, interest)
        found.log_det[k], found.lambda_min[k], found.trace_inverse[k] = one.log_det, one.lambda_min, one.trace_inverse
    return found


@dataclass(frozen=True)
class Criterion:
    """One of the criteria D, A and E: a concave function of the Fisher information, which a search maximises."""

    name: Name

    def phi(self, m: Floats, softness: float = 0.0) -> Floats:
        """φ of matrices, shape (..., p, p) to (...): log |M|, −log tr M⁻¹, log λ_min.

        With a softness above 0, E is the log of Kiefer's criterion Φ_p with p = 1/softness, (Σ λ_i^−p)^(−1/p), which is
        smooth where eigenvalues cross (Ann. Statist. 2, 1974).
        """
        values = _eigenvalues(m)
        if self.name == "D":
            result = np.log(values).sum(axis=-1)
        elif self.name == "A":
            result = -np.log((1.0 / values).sum(axis=-1))
        else:
            result = np.log(values[..., 0])
            if softness > 0.0:
                result = result - softness * np.log(((values[..., :1] / values) ** (1.0 / softness)).sum(axis=-1))
        return np.asarray(result)

    def gradient(self, m: Floats) -> Floats:
        """∇φ of one matrix, positive semidefinite, shape (p, p); for E at a multiple eigenvalue, one of many."""
        values, vectors = np.linalg.eigh(m)
        values = np.maximum(values, FLOOR * values[-1])
        if self.name == "A":
            shares = values**-2.0 / (1.0 / values).sum()
        elif self.name == "E":
            shares = np.where(np.arange(len(values)) == 0, 1.0 / values[0], 0.0)
        else:
            shares = 1.0 / values
        slope: Floats = (vectors * shares) @ vectors.T
        return slope

    @property
    def compiled(self) -> int:
        """Number of φ for compiled loops, see :func:`emb_bench.information.symmetric.phi`."""
        return {"D": LOG_DET, "A": MINUS_LOG_TRACE, "E": LOG_LAMBDA_MIN}[self.name]

    def value(self, phi: float) -> float:
        """The criterion itself: log |M|, tr M⁻¹ or λ_min."""
        return float({"D": phi, "A": np.exp(-phi), "E": np.exp(phi)}[self.name])

    @property
    def label(self) -> str:
        """Name of the value."""
        return {"D": "log det M", "A": "tr M^-1", "E": "lambda_min"}[self.name]


def distances(matrices: Floats, other: Floats) -> Floats:
    """Largest |log vᵀMv − log vᵀM'v| over all v, of each of some FIMs M, shape (count, p, p), and another one M'.

    This is the largest |log λ| of their generalised eigenvalues: 0.1 if one has 10 % more information on some
    combination of parameters than the other.
    """
    values, vectors = np.linalg.eigh(other)
    root = vectors / np.sqrt(np.maximum(values, max(FLOOR * values[-1], 1e-300)))
    ratios = _eigenvalues(root.T @ np.nan_to_num(matrices) @ root)
    return np.asarray(np.abs(np.log(ratios)).max(axis=-1))


def _eigenvalues(m: Floats) -> Floats:
    values = np.linalg.eigvalsh(m)
    floored: Floats = np.maximum(values, np.maximum(FLOOR * values[..., -1:], 1e-300))
    return floored
