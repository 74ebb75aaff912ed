"""What a current sequence tells about the brake's parameters: sensitivities, Fisher information, criteria.

Two Fisher informations live here and are never mixed:

- ``physical``: S^T R⁻¹ S with S and R in the same units. The only one with a Cramér-Rao bound.
- ``weighted``: the thesis's (eq. 4.18-4.21, 5.12): outputs divided by 100 rad and 500 rad/s, R left as it is. A reward,
  and comparable with the thesis.

**Which samples count.** A sequence of n currents u_0..u_{n−1} moves the brake from the known state x_0 to x_n, and the
samples y_1..y_n after each step count. y_0 tells nothing, for its sensitivity is zero (eq. 4.26).

Parameters are relative (eq. 4.17), to their true values θ or to the nominal ones; each result says which. Everything
here is numpy and plain Python and runs on the base install.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from emb_bench.brake.euler import sensitivity_step, step
from emb_bench.packed import SINGULAR, Floats, add_increment, log_det, pack, packed_size, unpack
from emb_runtime.bench import PARAMETER_NAMES, Bench, BrakeParameters, Limits, Noise, Ranges
from emb_runtime.errors import UsageError

Kind = Literal["physical", "weighted"]
NormaliseBy = Literal["true", "nominal"]

_TOUCHED = 1e-6  # share of a flat direction from which on a parameter belongs to it


class Weights(NamedTuple):
    """What a squared sensitivity of each output is worth: the diagonal of D_y⁻¹ R⁻¹ D_y⁻¹."""

    angle: float
    """[1/rad²] if physical."""
    velocity: float
    """[s²/rad²] if physical."""


def physical_weights(noise: Noise) -> Weights:
    """R⁻¹ of the sensors, in SI units."""
    return Weights(noise.angle**-2, noise.velocity**-2)


def thesis_weights(noise: Noise, limits: Limits) -> Weights:
    """The thesis's weights (eq. 5.3, 5.11): 100 and 1/250000 for its bench. Not an information on any scale."""
    angle, velocity = max(-limits.angle[0], limits.angle[1]), limits.velocity
    return Weights((angle * noise.angle) ** -2, (velocity * noise.velocity) ** -2)


def weights_of(bench: Bench, kind: Kind) -> Weights:
    """The weights of one kind of Fisher information on a bench."""
    return physical_weights(bench.noise) if kind == "physical" else thesis_weights(bench.noise, bench.limits)


def parameter_indices(params: Sequence[str]) -> tuple[int, ...]:
    """Indices in ``PARAMETER_NAMES`` of the named parameters.

    Raises:
        UsageError: no name, an unknown name, or one that comes twice.
    """
    known = ", ".join(PARAMETER_NAMES)
    if not params:
        raise UsageError(f"expected at least one parameter of {known}")
    for name in params:
        if name not in PARAMETER_NAMES:
            raise UsageError(f"'{name}' is no parameter of the brake; expected some of {known}")
    if len(set(params)) < len(params):
        raise UsageError(f"a parameter comes twice in {', '.join(params)}")
    return tuple(PARAMETER_NAMES.index(name) for name in params)


def trajectory(
    p: BrakeParameters, currents: Sequence[float] | Floats, t_s: float, x0: tuple[float, float] = (0.0, 0.0)
) -> Floats:
    """States of the Euler brake under a sequence of currents; limits are not applied.

    Args:
        p: the brake.
        currents: current of each step [A], length n.
        t_s: time step [s].
        x0: angle [rad] and velocity [rad/s] at the start.

    Returns:
        Shape (n + 1, 2): angle [rad] and velocity [rad/s], the start first.

    Raises:
        UsageError: ``currents`` is not one row of finite numbers.
    """
    x1, x2 = x0
    states = [(x1, x2)]
    for u in _finite(currents):
        x1, x2 = step(p, x1, x2, u, t_s)
        states.append((x1, x2))
    return np.array(states)


def sensitivities(
    p: BrakeParameters,
    currents: Sequence[float] | Floats,
    t_s: float,
    params: Sequence[str] = PARAMETER_NAMES,
    x0: tuple[float, float] = (0.0, 0.0),
) -> Floats:
    """Sensitivities of the samples y_1..y_n to the relative parameters, θ_i ∂x/∂θ_i at the θ of ``p`` (eq. 4.25).

    Args:
        p: the brake.
        currents: current of each step [A], length n.
        t_s: time step [s].
        params: names, any subset of ``PARAMETER_NAMES`` in any order.
        x0: known angle [rad] and velocity [rad/s] at the start; its sensitivity is zero.

    Returns:
        Shape (n, len(params), 2): of the angle [rad] and of the velocity [rad/s].

    Raises:
        UsageError: ``currents`` is not one row of finite numbers, or a parameter is unknown.
    """
    indices = parameter_indices(params)
    applied = _finite(currents)
    result = np.empty((len(applied), len(indices), 2))
    x1, x2 = x0
    now = [(0.0, 0.0)] * len(indices)
    for k, u in enumerate(applied):
        now = [sensitivity_step(p, x1, x2, u, t_s, s1, s2, i) for i, (s1, s2) in zip(indices, now, strict=True)]
        x1, x2 = step(p, x1, x2, u, t_s)
        result[k] = now
    return result


def _finite(currents: Sequence[float] | Floats) -> list[float]:
    row = np.asarray(currents, dtype=np.float64)
    if row.ndim != 1:
        raise UsageError(f"expected one row of currents, got an array of shape {row.shape}")
    if not np.isfinite(row).all():
        raise UsageError(f"expected finite currents, got {row[~np.isfinite(row)][0]} at step {_first_bad(row)}")
    values: list[float] = row.tolist()
    return values


def _first_bad(row: Floats) -> int:
    return int(np.argmin(np.isfinite(row)))


def relative_to(p: BrakeParameters, reference: BrakeParameters, params: Sequence[str]) -> Floats:
    """Factors that turn sensitivities relative to ``p`` into ones relative to ``reference`` (eq. 4.17).

    Returns:
        Shape (len(params),): θ_ref,i / θ_i.
    """
    return np.array([getattr(reference, name) / getattr(p, name) for name in params])


def information_over_time(s: Floats, weights: Weights, start: Any = None, measured: Any = None) -> Floats:
    """The FIM after each sample (eq. 4.21, 4.37): each sample adds a matrix of rank two at most, one per output.

    Args:
        s: sensitivities, shape (n, p, 2).
        weights: :func:`physical_weights` or :func:`thesis_weights`.
        start: FIM before the first sample, shape (p, p): a prior, or :func:`epsilon_identity`; zero without (eq. 4.27).
        measured: n booleans, False for a sample that was lost: the brake moved on, but nobody saw it.

    Returns:
        Shape (n, p, p); the last one is the FIM of the whole sequence.
    """
    count, size, _ = s.shape
    total = np.zeros(packed_size(size)) if start is None else pack(start)
    history = np.empty((count, total.size))
    for k in range(count):
        if measured is None or measured[k]:
            add_increment(total, s[k], weights.angle, weights.velocity)
        history[k] = total
    return unpack(history, size)


def epsilon_identity(size: int, epsilon: float) -> Floats:
    """The thesis's start of the FIM, ε I (eq. 4.28): every eigenvalue of the sum grows by ε (eq. 4.34)."""
    return epsilon * np.eye(size)


def uniform_prior(ranges: Ranges, params: Sequence[str], reference: BrakeParameters) -> Floats:
    """The FIM that knowing a range is worth: 1/variance of the uniform distribution on it, relative to ``reference``.

    Unlike ε I it has a meaning: log |M| starts at what is known beforehand. It stands for a Gaussian prior of the same
    variance (a uniform one has no Fisher information of its own), so that it is an approximation, not a bound.
    ±50 % are worth 12.

    Returns:
        Diagonal, shape (len(params), len(params)).

    Raises:
        UsageError: a parameter does not vary in these ranges.
    """
    parameter_indices(params)
    diagonal = []
    for name in params:
        width = getattr(ranges.high, name) - getattr(ranges.low, name)
        if width == 0.0:
            raise UsageError(f"{name} does not vary in the ranges '{ranges.name}': leave it out of the parameters")
        diagonal.append(12.0 * (getattr(reference, name) / width) ** 2)
    return np.diag(diagonal)


@dataclass(frozen=True)
class Criteria:
    """How much an FIM tells, as single numbers. Higher is better for D and E, lower for A and the condition number.

    A singular FIM has the worst values there are: −inf, inf, 0, inf.
    """

    log_det: float
    """D: log |M|."""
    trace_inverse: float
    """A: tr M⁻¹."""
    lambda_min: float
    """E: smallest eigenvalue of M."""
    condition: float
    """Largest over smallest eigenvalue."""
    singular: bool
    """Whether, to rounding, some combination of parameters leaves no trace in the data."""
    weakest: Mapping[str, float]
    """The combination of relative parameters that is told worst, as a unit vector."""
    flat: tuple[Mapping[str, float], ...]
    """If singular, the combinations that are not told at all, as unit vectors."""

    def verdict(self) -> str:
        """One line for a person."""
        if self.singular:
            return f"singular: the data do not tell {'; nor '.join(map(_combination, self.flat))}"
        return f"every parameter is told; worst: {_combination(self.weakest)}"


def _combination(direction: Mapping[str, float]) -> str:
    return " ".join(f"{share:+.3g} {name}" for name, share in direction.items() if abs(share) > _TOUCHED)


@dataclass(frozen=True, eq=False)
class Fisher:
    """A Fisher information matrix and everything that it means."""

    kind: Kind
    normalise_by: NormaliseBy
    params: tuple[str, ...]
    theta: BrakeParameters
    """The brake at which it was computed."""
    matrix: Floats
    """Shape (len(params), len(params)), prior included; dimensionless if physical."""
    prior: Floats | None
    """What it started from, of the same shape."""

    def criteria(self) -> Criteria:
        """D, A, E and the verdict."""
        return criteria(self.matrix, self.params)

    def cramer_rao(self) -> dict[str, float]:
        """Least standard deviation of an unbiased estimate of each parameter, relative to what ``normalise_by`` says.

        inf for a parameter that the data do not tell. With a prior it is the spread after a
        Gaussian one of the same variance, to first order, and no bound.

        Raises:
            UsageError: this is the weighted FIM, which bounds nothing.
        """
        if self.kind != "physical":
            raise UsageError(
                f"a Cramér-Rao bound needs the physical Fisher information; the {self.kind} one mixes units"
            )
        deviations = np.sqrt(np.diag(_Spectrum(self.matrix).inverse()))
        return dict(zip(self.params, deviations.tolist(), strict=True))


def fisher(
    bench: Bench,
    p: BrakeParameters,
    currents: Sequence[float] | Floats,
    *,
    kind: Kind,
    normalise_by: NormaliseBy,
    params: Sequence[str] = PARAMETER_NAMES,
    x0: tuple[float, float] = (0.0, 0.0),
    prior: Floats | None = None,
    measured: Any = None,
) -> Fisher:
    """The Fisher information that a sequence of currents draws from a brake.

    Args:
        bench: its noise, limits, sample time and nominal brake.
        p: the brake, whose parameters are the true ones.
        currents: current of each step [A], length n; samples y_1..y_n count.
        kind: ``physical`` or ``weighted``.
        normalise_by: parameters relative to their ``true`` or ``nominal`` values.
        params: names of the unknown parameters; the others are known.
        x0: known angle [rad] and velocity [rad/s] at the start.
        prior: FIM before the first sample, normalised in the same way.
        measured: n booleans, False for a lost sample.

    Raises:
        UsageError: ``currents`` is not one row of finite numbers, or a parameter is unknown.
    """
    s = sensitivities(p, currents, bench.timing.sample_time, params, x0)
    if normalise_by == "nominal":
        s *= relative_to(p, bench.brake, params)[:, None]
    history = information_over_time(s, weights_of(bench, kind), prior, measured)
    size = len(params)
    before = np.zeros((size, size)) if prior is None else np.asarray(prior, dtype=np.float64)
    return Fisher(kind, normalise_by, tuple(params), p, history[-1] if len(history) else before, prior)


class _Spectrum:
    """Eigenvalues of M scaled to a unit diagonal, C = D^−½ M D^−½: as accurate as M allows whatever its scales are."""

    def __init__(self, matrix: Any) -> None:
        m = np.asarray(matrix, dtype=np.float64)
        if m.ndim != 2 or m.shape[0] != m.shape[1] or not np.isfinite(m).all() or (np.diag(m) < 0.0).any():
            raise UsageError("expected a square, finite Fisher information matrix with no negative diagonal element")
        self.scale = np.sqrt(np.diag(m))
        known = self.scale > 0.0
        self._unit = np.where(known, self.scale, 1.0)
        self.values, self.vectors = np.linalg.eigh(m / np.outer(self._unit, self._unit))
        self.flat = self.values <= SINGULAR * len(m)
        self.singular = bool(self.flat.any())

    def inverse(self) -> Floats:
        """M⁻¹; where M is singular, the pseudo-inverse with inf on the diagonal of each parameter that is not told."""
        kept = self.vectors[:, ~self.flat]
        inverse: Floats = (kept / self.values[~self.flat]) @ kept.T / np.outer(self._unit, self._unit)
        lost = (np.abs(self.vectors[:, self.flat]) > _TOUCHED).any(axis=1)
        inverse[lost, lost] = math.inf
        return inverse

    def flat_directions(self) -> list[Floats]:
        """Unit vectors of relative parameters along which M is zero."""
        return [_unit_vector(v / self._unit) for v in self.vectors[:, self.flat].T]

    def weakest(self) -> Floats:
        """Unit vector of relative parameters along which M is smallest."""
        return self.flat_directions()[0] if self.singular else _unit_vector(np.linalg.eigh(self.inverse())[1][:, -1])


def _unit_vector(v: Floats) -> Floats:
    """Of length one, its largest element positive."""
    result: Floats = v / np.linalg.norm(v) * np.sign(v[np.argmax(np.abs(v))])
    return result


def criteria(matrix: Any, params: Sequence[str]) -> Criteria:
    """D, A, E, condition number and the least told combination of an FIM.

    Args:
        matrix: FIM, shape (len(params), len(params)).
        params: what to call its rows.

    Raises:
        UsageError: the matrix is not square, not finite, or has a negative diagonal element.
    """
    spectrum = _Spectrum(matrix)
    weakest, *flat = (
        dict(zip(params, v.tolist(), strict=True)) for v in (spectrum.weakest(), *spectrum.flat_directions())
    )
    if spectrum.singular:
        return Criteria(-math.inf, math.inf, 0.0, math.inf, True, weakest, tuple(flat))
    inverse = spectrum.inverse()
    smallest = 1.0 / float(np.linalg.eigvalsh(inverse)[-1])
    return Criteria(
        log_det=float(np.log(spectrum.values).sum() + 2.0 * np.log(spectrum.scale).sum()),
        trace_inverse=float(np.trace(inverse)),
        lambda_min=smallest,
        condition=float(np.linalg.eigvalsh(np.asarray(matrix, dtype=np.float64))[-1]) / smallest,
        singular=False,
        weakest=weakest,
        flat=(),
    )


@dataclass(frozen=True, eq=False)
class NormalisedFisher:
    """The running normalisation M̄_k = α_k M_k (eq. 4.35): |M̄_k| stays near |M_init|, the step rewards are unchanged.

    α_k is chosen so that |α_k M_{k−1}| = |M_init|. Eq. 4.39 prints this with M̄_{k−1} and α_k; it has to be the ratio
    α_k / α_{k−1} that equals (|M_init| / |M̄_{k−1}|)^{1/n}, else |M̄_k| grows as the square root of |M_k|. In eq. 4.36,
    third line, α_k|M_k| is meant as |α_k M_k|.
    """

    matrix: Floats
    """M̄_k, shape (n, n)."""
    log_det: float
    """log |M̄_k|."""
    log_alpha: float
    """log α_k."""
    initial_log_det: float
    """log |M_init|."""

    @classmethod
    def start(cls, initial: Floats) -> NormalisedFisher:
        """Begin at a non-singular FIM, ε I (eq. 4.28) or a prior.

        Raises:
            UsageError: it is singular, and so has no logarithm to start from.
        """
        value = _log_det(initial)
        if value == -math.inf:
            raise UsageError("the initial Fisher information is singular: begin at epsilon_identity or uniform_prior")
        return cls(np.array(initial, dtype=np.float64), value, 0.0, value)

    def add(self, increment: Floats) -> tuple[NormalisedFisher, float]:
        """Add one sample's information (eq. 4.38).

        Args:
            increment: of the FIM itself, not normalised, shape (n, n).

        Returns:
            The next normalised FIM, and the step reward r_k = log |M_k| − log |M_{k−1}| (eq. 4.13, 4.36).
        """
        log_ratio = (self.initial_log_det - self.log_det) / len(self.matrix)
        log_alpha = self.log_alpha + log_ratio
        matrix = math.exp(log_ratio) * self.matrix + math.exp(log_alpha) * increment
        value = _log_det(matrix)
        return NormalisedFisher(matrix, value, log_alpha, self.initial_log_det), value - self.initial_log_det


def _log_det(matrix: Floats) -> float:
    return log_det(pack(matrix), np.empty(matrix.shape))
