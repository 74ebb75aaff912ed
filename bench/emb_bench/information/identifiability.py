"""Identifiability of each parameter, and of combinations of them, from a Fisher information matrix.

**What counts as singular.** The matrix is scaled to a unit diagonal, C = D^−½ M D^−½, so that units do not matter. An
eigenvalue of C below 1e-14 times its size is what rounding leaves of zero. Errors of the sensitivities enter squared:
those of the exact brake, about 1e-9 of the sensitivity, would have to grow a hundredfold to lift an eigenvalue that is
zero above that, and one that is not zero and not below it stands for a direction whose trace they do not make up.

**What counts as not identified.** A bound can be finite and worthless. A parameter is identified if the least standard
deviation of its estimate is below 100 % of its value, or below the gross error of one with a unit. Beyond
that not even its order of magnitude follows from the data, and the linearisation that the bound rests on does not hold.

A singular matrix has the worst values there are and a verdict, never a NaN.
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

TRADED_OFF = 0.95  # Correlation from which on two estimates are traded off against each other
GROSS: Mapping[str, float] = {name: row.gross for name, row in PARAMETERS.items()}
"""Error at which an unknown is of no use: of its value, or in its unit."""
NEWS = 0.9  # Share of the deviation known beforehand above which the data have added nothing

TOUCHED = 1e-6  # share of a flat direction from which on a parameter belongs to it
_ROUNDING = 1e-14  # of an eigenvector, times the distance of its eigenvalue from the others


class Spectrum:
    """Eigenvalues of M scaled to a unit diagonal: as accurate as M allows whatever its scales are.

    Parameters without any information are kept apart, so that a flat direction is a combination of the others.
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
        self._values, self._kept = values[keep], everywhere[:, keep]
        self._flat = everywhere[:, ~keep].T if keep.all() else self._parted(everywhere[:, ~keep].T)
        self.lost = self.dead | (self._flat != 0.0).any(axis=0)
        self.singular = bool(self.lost.any())

    def _parted(self, rows: Floats) -> Floats:
        """A basis of the flat combinations, without the parameters that do not belong to them."""
        flat = _echelon(rows)
        # A share counts if it is large in the scaled matrix, or among parameters and more than rounding in the matrix.
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
        inverse: Floats = (self._kept / self._values) @ self._kept.T / np.outer(self._unit, self._unit)
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

        Between parameters that the data do not identify it is the limit for a prior that vanishes: that of the
        flat directions they share, and 0 where they share none.
        """
        covariance = (self._kept / self._values) @ self._kept.T
        flat = self._flat.T @ np.linalg.pinv(self._flat.T)
        both = np.outer(self.lost, self.lost)
        covariance = np.where(both, flat, np.where(self.lost[:, None] | self.lost, 0.0, covariance))
        scale = np.sqrt(np.where(np.diag(covariance) > 0.0, np.diag(covariance), 1.0))
        result: Floats = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
        np.fill_diagonal(result, 1.0)
        return result


def _echelon(rows: Floats) -> Floats:
    """Echelon basis of the same row space: each row has a one where all the others have a zero.

    Of two flat directions without a parameter in common an eigenvalue routine returns any mixture; this parts them.
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
    """A direction as a sum, without what does not belong to it."""
    return " ".join(f"{share:+.3g} {name}" for name, share in direction.items() if abs(share) > TOUCHED)


def schur_complement(matrix: Any, index: Sequence[int]) -> Floats:
    """Information on some parameters when the others are unknown too: M_aa − M_ab M_bb⁻¹ M_ba.

    Nuisances that the data do not identify cost no more than those that they do.
    """
    m = np.asarray(matrix, dtype=np.float64)
    others = [i for i in range(len(m)) if i not in index]
    if not others:
        return m[np.ix_(index, index)]
    unit = np.sqrt(np.where(np.diag(m) > 0.0, np.diag(m), 1.0))
    scaled = m / np.outer(unit, unit)
    cross = scaled[np.ix_(index, others)]
    inner = np.linalg.pinv(scaled[np.ix_(others, others)], rcond=SINGULAR * len(m), hermitian=True)
    kept = unit[list(index)]
    result: Floats = (scaled[np.ix_(index, index)] - cross @ inner @ cross.T) * np.outer(kept, kept)
    return result


class Doubt(StrEnum):
    """Reason that a parameter is not identified: by the information, or by what an estimate adds to it."""

    NO_INFORMATION = "no_information"
    ONLY_COMBINED = "only_combined"  # With other parameters
    NOTHING_NEW = "nothing_new"  # To what was known before
    TOO_WIDE = "too_wide"  # The deviation is no smaller than the value or a gross error
    FLAT = "flat"  # Its likelihood profile is, or is open at one end
    OPEN_BELOW = "open_below"
    OPEN_ABOVE = "open_above"
    CUT = "cut"  # The profile ends where another parameter is at the border of its search
    AT_BORDER = "at_border"  # Of the search
    CONTAINS_ZERO = "contains_zero"  # Its interval


class Border(StrEnum):
    """Place of a value that is not well inside its range."""

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
    """A combination of parameters that can change with little or no trace in the data."""

    shares: Mapping[str, float]  # Unit vector, in relative parameters and in the units of the others
    deviation: float  # Least standard deviation along it; inf if it leaves no trace at all


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

    def shown(self, machine: Machine | None) -> Identifiability:
        """Findings by the names and in the units of a machine."""
        findings = []
        for finding in self.findings:
            name, unit = quantity(machine, finding.name)
            traded = renamed(finding.traded_with, machine)
            findings.append(replace(finding, name=name, traded_with=traded, unit=unit if finding.unit else ""))
        directions = tuple(
            replace(direction, shares=renamed(direction.shares, machine)) for direction in self.directions
        )
        return Identifiability(tuple(findings), directions, tuple(renamed(s, machine) for s in self.left_to_prior))


def judge(
    matrix: Any, params: Sequence[str], prior: Any = None, borders: Mapping[str, tuple[float, float]] | None = None
) -> Identifiability:
    """Judges from a physical FIM which parameters the data identify.

    Args:
        matrix: FIM with the prior in it, shape (len(params), len(params)), relative parameters.
        params: what to call its rows.
        prior: the part of it that was known beforehand.
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
    """Flat directions of the data alone, without those that the prior does not identify either."""
    if prior is None:
        return ()
    known = np.asarray(prior, dtype=np.float64)
    data = spectrum.matrix - known
    dead = np.diag(data) <= SINGULAR * np.diag(spectrum.matrix)  # a difference of equals is rounding
    data[dead, :] = 0.0
    data[:, dead] = 0.0
    flat = Spectrum(data).flat_directions()
    return tuple(dict(zip(params, v.tolist(), strict=True)) for v in flat if v @ known @ v > 0.0)


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
    known = np.flatnonzero(~spectrum.lost)
    gross = np.array([GROSS.get(params[int(i)], 1.0) for i in known])
    if not len(known):
        return found
    variances, vectors = np.linalg.eigh(spectrum.inverse()[np.ix_(known, known)] / np.outer(gross, gross))
    for variance, vector in zip(variances[::-1], vectors.T[::-1], strict=True):
        if variance < 1.0:
            break
        along = np.zeros(len(params))
        along[known] = gross * vector
        length = float(np.linalg.norm(along))
        found.append(
            Direction(dict(zip(params, unit_vector(along).tolist(), strict=True)), length * math.sqrt(variance))
        )
    return found
