"""Identifiability of each parameter, and of combinations of them, from a Fisher information matrix.

**Singular.** The matrix is scaled to a unit diagonal, C = D^−½ M D^−½, so that units do not matter. An eigenvalue of C
below 1e-14 times its size is zero to rounding. Relative errors of the sensitivities enter squared: those of the exact
brake, about 1e-9, change C by 1e-18. So a larger eigenvalue is that of a direction that changes the data.

**Not identified.** A finite bound may be useless. A parameter is identified if the least standard deviation of its
estimate is below 100 % of its value, or below the gross error of one with a unit. Beyond it the data do not determine
the order of magnitude, and the linearisation of the bound does not hold.

A singular matrix has the worst values and a finding for each parameter, never a NaN.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from emb_bench.brake.parameters import PARAMETERS, UNITS, quantity, renamed
from emb_bench.config.machine import Machine
from emb_bench.information.symmetric import SINGULAR, Floats
from emb_runtime.errors import UsageError

TRADED_OFF = 0.95  # Correlation above which two parameters trade off
GROSS: Mapping[str, float] = {name: row.gross for name, row in PARAMETERS.items()}
"""Error above which an unknown is not identified: relative, or in its unit."""
NEWS = 0.9  # Ratio to the prior deviation above which the data have added nothing

TOUCHED = 1e-6  # share of a flat direction above which a parameter belongs to it
_ROUNDING = 1e-14  # of an eigenvector, times the distance of its eigenvalue from the others


class Spectrum:
    """Eigenvalues of M scaled to a unit diagonal, accurate for parameters of any scale.

    Parameters without any information are separate: a flat direction is a combination of the others.
    """

    def __init__(self, matrix: Any) -> None:
        m = np.asarray(matrix, dtype=np.float64)
        if m.ndim != 2 or m.shape[0] != m.shape[1] or not np.isfinite(m).all() or (np.diag(m) < 0.0).any():
            raise UsageError("expected a square, finite Fisher information matrix with no negative diagonal element")
        self.matrix = m
        self.dead = np.diag(m) == 0.0
        self._unit = np.where(self.dead, 1.0, np.sqrt(np.diag(m)))
        scaled = m / np.outer(self._unit, self._unit)
        values, vectors = np.linalg.eigh(scaled[np.ix_(~self.dead, ~self.dead)])
        keep = values > SINGULAR * len(m)
        everywhere = np.zeros((len(m), len(values)))
        everywhere[~self.dead] = vectors
        self._values, self._vectors = values[keep], everywhere[:, keep]
        self._flat = everywhere[:, ~keep].T if keep.all() else self._parted(everywhere[:, ~keep].T)
        self.lost = self.dead | (self._flat != 0.0).any(axis=0)
        self.singular = bool(self.lost.any())

    def _parted(self, rows: Floats) -> Floats:
        """A basis of the flat combinations, with zeros for parameters that do not belong to them."""
        flat = _echelon(rows)
        # A share counts if it is large in the scaled matrix, or large in the parameters and above rounding.
        shares = np.abs(flat / self._unit)
        large = shares > TOUCHED * np.linalg.norm(shares, axis=1, keepdims=True)
        touched = large & (np.abs(flat) > _ROUNDING / min(self._values, default=1.0)) | (np.abs(flat) > TOUCHED)
        return np.where(touched, flat, 0.0)

    def log_det(self) -> float:
        """D: log |M|, −inf if it is singular."""
        if self.singular:
            return -math.inf
        return float(np.log(self._values).sum() + 2.0 * np.log(self._unit).sum())

    def inverse(self) -> Floats:
        """M⁻¹; where M is singular, the pseudo-inverse with inf on the diagonal of each unidentified parameter."""
        inverse: Floats = (self._vectors / self._values) @ self._vectors.T / np.outer(self._unit, self._unit)
        inverse[self.lost, self.lost] = math.inf
        return inverse

    def sandwich(self, scatter: Floats) -> Floats:
        """M⁻¹ S M⁻¹ with the ``scatter`` S of scores; inf on the diagonal of each unidentified parameter."""
        inverse = self.inverse()
        inverse[self.lost, self.lost] = 0.0
        result: Floats = inverse @ scatter @ inverse
        result[self.lost, self.lost] = math.inf
        return result

    def flat_directions(self) -> list[Floats]:
        """Unit vectors along which M is zero: of the parameters without information, then of combinations."""
        alone = np.eye(len(self.matrix))[self.dead]
        return [unit_vector(v / self._unit) for v in (*alone, *self._flat)]

    def correlation(self) -> Floats:
        """Correlations of the estimates.

        Between parameters that the data do not identify it is the limit for a prior that vanishes: that of the flat
        directions they share, and 0 where they share none.
        """
        covariance = (self._vectors / self._values) @ self._vectors.T
        flat = self._flat.T @ np.linalg.pinv(self._flat.T)
        both = np.outer(self.lost, self.lost)
        covariance = np.where(both, flat, np.where(self.lost[:, None] | self.lost, 0.0, covariance))
        scale = np.sqrt(np.where(np.diag(covariance) > 0.0, np.diag(covariance), 1.0))
        result: Floats = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
        np.fill_diagonal(result, 1.0)
        return result


def _echelon(rows: Floats) -> Floats:
    """Echelon basis of the same row space: each row has a one where all the others have a zero.

    It separates flat directions without a common parameter, of which an eigenvalue routine returns any mixture.
    """
    result, used = rows.copy(), set[int]()
    for i in range(len(result)):
        free = [j for j in range(result.shape[1]) if j not in used]
        remaining = np.abs(result[i:, free])
        row, column = np.unravel_index(int(remaining.argmax()), remaining.shape)
        pivot = free[int(column)]
        used.add(pivot)
        result[[i, i + int(row)]] = result[[i + int(row), i]]
        result[i] /= result[i, pivot]
        others = np.arange(len(result)) != i
        result[others] -= np.outer(result[others, pivot], result[i])
    return result


def unit_vector(v: Floats) -> Floats:
    """Unit vector along ``v``, its largest element positive."""
    result: Floats = v / np.linalg.norm(v) * np.sign(v[np.argmax(np.abs(v))])
    return result


def combination(direction: Mapping[str, float]) -> str:
    """A direction as a sum of its parameters."""
    return " ".join(f"{share:+.3g} {name}" for name, share in direction.items() if abs(share) > TOUCHED)


def schur_complement(matrix: Any, index: Sequence[int]) -> Floats:
    """Information on some parameters with the others as nuisances: M_aa − M_ab M_bb⁻¹ M_ba.

    By the pseudo-inverse: nuisances may be unidentified.
    """
    m = np.asarray(matrix, dtype=np.float64)
    others = [i for i in range(len(m)) if i not in index]
    if not others:
        return m[np.ix_(index, index)]
    unit = np.sqrt(np.where(np.diag(m) > 0.0, np.diag(m), 1.0))
    scaled = m / np.outer(unit, unit)
    cross = scaled[np.ix_(index, others)]
    inner = np.linalg.pinv(scaled[np.ix_(others, others)], rcond=SINGULAR * len(m), hermitian=True)
    of_index = unit[list(index)]
    result: Floats = (scaled[np.ix_(index, index)] - cross @ inner @ cross.T) * np.outer(of_index, of_index)
    return result


class Doubt(StrEnum):
    """Reason that a parameter is not identified, by the information or by the estimate."""

    NO_INFORMATION = "no_information"
    ONLY_COMBINED = "only_combined"  # Only a combination with others is identified
    NOTHING_NEW = "nothing_new"  # Beyond the prior
    TOO_WIDE = "too_wide"  # The deviation is at least the value or the gross error
    FLAT = "flat"  # The likelihood profile is open at both ends
    OPEN_BELOW = "open_below"  # At one end
    OPEN_ABOVE = "open_above"
    CUT = "cut"  # The profile ends where another parameter is at the border of its search
    AT_BORDER = "at_border"  # Of the search
    CONTAINS_ZERO = "contains_zero"  # Its interval


class Border(StrEnum):
    """Place of a value outside of its range or near its end."""

    BELOW = "below"
    AT_LOWER = "at_lower"  # Within a deviation of the lower end
    AT_UPPER = "at_upper"
    ABOVE = "above"


@dataclass(frozen=True)
class Finding:
    """Identifiability of one parameter."""

    name: str
    deviation: float
    """Least standard deviation of an estimate, relative or in the parameter's unit; inf if it is not identified."""
    doubts: tuple[Doubt, ...] = ()  # Reasons that it is not identified; empty if it is
    traded_with: Mapping[str, float] = field(default_factory=dict)  # Correlations beyond ``TRADED_OFF``, by name
    border: Border | None = None
    unit: str = ""  # Of ``deviation``; empty if it is relative

    @property
    def identified(self) -> bool:
        """Returns True if the data identify it."""
        return not self.doubts


@dataclass(frozen=True)
class Direction:
    """A combination of parameters that changes the data little or not at all."""

    shares: Mapping[str, float]  # Unit vector, in relative parameters and in the units of the others
    deviation: float  # Least standard deviation along it; inf if the data do not change


@dataclass(frozen=True)
class Identifiability:
    """Identifiability of all parameters from the data."""

    findings: tuple[Finding, ...]
    directions: tuple[Direction, ...]  # Directions that are not identified, or with a deviation above a gross error
    left_to_prior: tuple[Mapping[str, float], ...]  # Combinations that only the prior identifies

    @property
    def identified(self) -> bool:
        """Returns True if all parameters are identified."""
        return all(finding.identified for finding in self.findings)

    def renamed(self, machine: Machine | None) -> Identifiability:
        """Findings with the names and units of a machine."""
        findings = []
        for finding in self.findings:
            name, unit = quantity(machine, finding.name)
            traded = renamed(finding.traded_with, machine)
            findings.append(replace(finding, name=name, traded_with=traded, unit=unit if finding.unit else ""))
        directions = tuple(
            replace(direction, shares=renamed(direction.shares, machine)) for direction in self.directions
        )
        return Identifiability(tuple(findings), directions, tuple(renamed(s, machine) for s in self.left_to_prior))


def identifiability(
    matrix: Any, params: Sequence[str], prior: Any = None, borders: Mapping[str, tuple[float, float]] | None = None
) -> Identifiability:
    """Identifiability of each parameter from a physical FIM.

    Args:
        matrix: FIM with the prior in it, shape (len(params), len(params)), relative parameters.
        params: names of its rows.
        prior: FIM of the prior, a part of ``matrix``.
        borders: distance of a parameter's value to the lower and to the upper border of its range, in the same
            relative units, negative if it lies outside.
    """
    spectrum = Spectrum(matrix)
    correlation = spectrum.correlation()
    before = np.full(len(params), math.inf) if prior is None else np.sqrt(np.diag(Spectrum(prior).inverse()))
    deviations = np.sqrt(np.diag(spectrum.inverse()))
    findings = []
    for i, name in enumerate(params):
        deviation = float(deviations[i])
        doubt = None
        if spectrum.dead[i]:
            doubt = Doubt.NO_INFORMATION
        elif spectrum.lost[i]:
            doubt = Doubt.ONLY_COMBINED
        elif deviation >= NEWS * before[i]:
            doubt = Doubt.NOTHING_NEW
        elif deviation >= GROSS.get(name, 1.0):
            doubt = Doubt.TOO_WIDE
        others = {} if spectrum.lost[i] else {n: float(c) for n, c in zip(params, correlation[i], strict=True)}
        findings.append(
            Finding(
                name=name,
                deviation=deviation,
                doubts=() if doubt is None else (doubt,),
                traded_with={n: c for n, c in others.items() if n != name and abs(c) > TRADED_OFF},
                border=_border(deviation, (borders or {}).get(name)),
                unit=UNITS.get(name, ""),
            )
        )
    return Identifiability(
        tuple(findings), tuple(_unidentified(spectrum, params)), _left_to_prior(spectrum, params, prior)
    )


def _left_to_prior(spectrum: Spectrum, params: Sequence[str], prior: Any) -> tuple[Mapping[str, float], ...]:
    """Directions that are flat in the data alone and not in the prior."""
    if prior is None:
        return ()
    before = np.asarray(prior, dtype=np.float64)
    data = spectrum.matrix - before
    dead = np.diag(data) <= SINGULAR * np.diag(spectrum.matrix)  # a difference of equals is rounding
    data[dead, :] = 0.0
    data[:, dead] = 0.0
    flat = Spectrum(data).flat_directions()
    return tuple(dict(zip(params, v.tolist(), strict=True)) for v in flat if v @ before @ v > 0.0)


def _border(deviation: float, distances: tuple[float, float] | None) -> Border | None:
    if distances is None or math.isinf(deviation):
        return None
    sides = ((Border.BELOW, Border.AT_LOWER), (Border.ABOVE, Border.AT_UPPER))
    for (beyond, at), distance in zip(sides, distances, strict=True):
        if distance <= deviation:
            return beyond if distance < 0.0 else at
    return None


def _unidentified(spectrum: Spectrum, params: Sequence[str]) -> list[Direction]:
    """Flat directions, then those with a deviation above a gross error."""
    found = [
        Direction(dict(zip(params, v.tolist(), strict=True)), math.inf)
        for v in spectrum.flat_directions()
        if np.count_nonzero(np.abs(v) > TOUCHED) > 1
    ]
    index = np.flatnonzero(~spectrum.lost)
    gross = np.array([GROSS.get(params[int(i)], 1.0) for i in index])
    if not len(index):
        return found
    variances, vectors = np.linalg.eigh(spectrum.inverse()[np.ix_(index, index)] / np.outer(gross, gross))
    for variance, vector in zip(variances[::-1], vectors.T[::-1], strict=True):
        if variance < 1.0:
            break
        along = np.zeros(len(params))
        along[index] = gross * vector
        length = float(np.linalg.norm(along))
        found.append(
            Direction(dict(zip(params, unit_vector(along).tolist(), strict=True)), length * math.sqrt(variance))
        )
    return found
