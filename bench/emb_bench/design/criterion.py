"""The criteria of a design, all as logarithms: concave functions φ of the Fisher information with their gradients.

D, A, E and Ds (Atkinson, Donev and Tobias, Optimum Experimental Designs, with SAS, 2007, chapter 10). In logarithms
they share a scale: 0.1 is worth as much, whatever the criterion. Concavity gives the tangent bound
φ(M) ≤ φ(M₀) + tr(∇φ(M₀) (M − M₀)), on which both the search and the estimate of what is left rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, get_args

import numpy as np

from emb_bench.information.packed import Floats
from emb_runtime.errors import UsageError

Name = Literal["D", "A", "E", "Ds"]
NAMES: tuple[Name, ...] = get_args(Name)

FLOOR = 1e-13
"""Eigenvalues below this share of the largest count as this share: a singular start still has a slope to climb."""


class Concave(Protocol):
    """What a search maximises: a concave function of the Fisher information."""

    def phi(self, m: Floats) -> Floats:
        """Its value at one or many matrices, shape (..., p, p) to (...)."""
        ...

    def gradient(self, m: Floats) -> Floats:
        """Its gradient at one matrix, shape (p, p)."""
        ...


@dataclass(frozen=True)
class Criterion:
    """One of the criteria of :data:`NAMES`."""

    name: Name
    wanted: tuple[int, ...]
    """Rows of M that are wanted; the others are nuisances. All of them but for Ds."""

    def phi(self, m: Floats) -> Floats:
        """φ of matrices, shape (..., p, p) to (...): log |M|, −log tr M⁻¹, log λ_min, log |M/M_nuisance|."""
        if self.name == "Ds":
            rest = self._nuisances(m.shape[-1])
            return _log_det(m) - _log_det(m[..., rest[:, None], rest])
        values = _eigenvalues(m)
        if self.name == "D":
            result = np.log(values).sum(axis=-1)
        elif self.name == "A":
            result = -np.log((1.0 / values).sum(axis=-1))
        else:
            result = np.log(values[..., 0])
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
        if self.name == "Ds":
            rest = self._nuisances(len(m))
            slope[rest[:, None], rest] -= np.linalg.inv(m[rest[:, None], rest])
        return slope

    def value(self, phi: float) -> float:
        """The criterion in its own unit: log |M|, tr M⁻¹, λ_min, log of the determinant of the Schur complement."""
        return float({"D": phi, "A": np.exp(-phi), "E": np.exp(phi), "Ds": phi}[self.name])

    @property
    def label(self) -> str:
        """What the value is called."""
        return {"D": "log det M", "A": "tr M^-1", "E": "lambda_min", "Ds": "log det of the Schur complement"}[self.name]

    def _nuisances(self, size: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        return np.array([i for i in range(size) if i not in self.wanted], np.int64)


@dataclass(frozen=True)
class Tangent:
    """log tr(W M): what is maximised to see how far a tangent is from being touched elsewhere."""

    slope: Floats

    def phi(self, m: Floats) -> Floats:
        """Of one or many matrices."""
        return np.asarray(np.log(np.maximum((m * self.slope).sum(axis=(-2, -1)), 1e-300)))

    def gradient(self, m: Floats) -> Floats:
        """Its gradient."""
        result: Floats = self.slope / float((m * self.slope).sum())
        return result


def criterion(name: Name, params: Sequence[str], of: Sequence[str] = ()) -> Criterion:
    """A criterion by name.

    Args:
        name: D, A, E or Ds.
        params: the unknowns.
        of: for Ds, those that are wanted; the others are nuisances.

    Raises:
        UsageError: ``of`` does not go with the criterion, or is no proper subset of the unknowns.
    """
    if name != "Ds":
        if of:
            raise UsageError(f"a subset of the parameters goes with the criterion Ds, not with {name}")
        return Criterion(name, tuple(range(len(params))))
    unknown = [n for n in of if n not in params]
    if unknown or not of or len(set(of)) != len(of) or len(of) == len(params):
        raise UsageError(
            f"Ds needs some, but not all, of the parameters {', '.join(params)} as those that are wanted; "
            f"got {', '.join(of) or 'none'}"
        )
    return Criterion(name, tuple(sorted(params.index(n) for n in of)))


def _eigenvalues(m: Floats) -> Floats:
    values = np.linalg.eigvalsh(m)
    floored: Floats = np.maximum(values, np.maximum(FLOOR * values[..., -1:], 1e-300))
    return floored


def _log_det(m: Floats) -> Floats:
    total: Floats = np.log(_eigenvalues(m)).sum(axis=-1)
    return total
