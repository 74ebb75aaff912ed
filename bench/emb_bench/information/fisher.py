"""Fisher information of a sequence of currents about a brake.

There are two kinds, which are never mixed:

- ``physical``: S^T R⁻¹ S with S and R in the same units. Only this kind has a Cramér-Rao bound.
- ``weighted``: the thesis's (eq. 4.18-4.21, 5.12), with outputs divided by 100 rad and 500 rad/s, and R unchanged. It
is a
  reward, comparable with the thesis.

Parameters are relative to their values θ (eq. 4.17). Unknowns that are not the brake's parameters have units
(:data:`emb_bench.brake.parameters.UNITS`). Everything here is numpy and plain Python and runs on the base install.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from emb_bench.config.bench import Bench
from emb_bench.config.plants import Instruments
from emb_bench.information.criteria import Criteria, criteria
from emb_bench.information.identifiability import Identifiability, Spectrum, identifiability
from emb_bench.information.symmetric import Floats, pack, unpack, upper
from emb_bench.sim.open_loop import check_unknowns
from emb_runtime.config.bench import BrakeParameters, Limits, Noise, Ranges
from emb_runtime.errors import UsageError

Kind = Literal["physical", "weighted"]


class Weights(NamedTuple):
    """Weights of the squared sensitivities of each output: the diagonal of D_y⁻¹ R⁻¹ D_y⁻¹."""

    angle: float  # [1/rad²] if physical
    velocity: float  # [s²/rad²] if physical


def physical_weights(noise: Noise) -> Weights:
    """R⁻¹ of the sensors, in SI units."""
    return Weights(noise.angle**-2, noise.velocity**-2)


def thesis_weights(noise: Noise, limits: Limits) -> Weights:
    """The thesis's weights (eq. 5.3, 5.11): 100 and 1/250000 for its bench. Not an information on any scale."""
    angle, velocity = max(-limits.angle[0], limits.angle[1]), limits.velocity
    return Weights((angle * noise.angle) ** -2, (velocity * noise.velocity) ** -2)


def weights_of(bench: Bench, kind: Kind) -> Weights:
    """The weights of one kind of Fisher information on a bench with the thesis's instruments."""
    return physical_weights(bench.noise) if kind == "physical" else thesis_weights(bench.noise, bench.limits)


def weights_along(bench: Bench, kind: Kind, instruments: Instruments, states: Floats) -> Floats:
    """The weights of each sample of a run, with the effects of the instruments.

    An error σ_t of the instant of sampling adds the change of the output in that time to its variance: R_eff = σ² + (ẏ
    σ_t)², with the velocity of the sample and the mean acceleration of the period before. A velocity that an observer
    derives from the angles has no information besides theirs: its weight is zero. The weighted information is the
    thesis's, without effects of the instruments.

    The states are those at all n + 1 instants; the weights, shape (n, 2), have the units of :class:`Weights`.
    """
    result = np.tile(weights_of(bench, kind), (len(states) - 1, 1))
    if kind == "physical" and instruments.clock_jitter > 0.0:
        acceleration = np.diff(states[:, 1]) / bench.timing.sample_time
        slopes = np.stack([states[1:, 1], acceleration], axis=1)
        result = 1.0 / (1.0 / result + (slopes * instruments.clock_jitter) ** 2)
    if kind == "physical" and instruments.observer_bandwidth > 0.0:
        result[:, 1] = 0.0
    return result


def information_over_time(s: Floats, weights: Weights | Floats, start: Any = None, measured: Any = None) -> Floats:
    """The FIM after each sample (eq. 4.21, 4.37): each sample adds a matrix of rank two at most, one per output.

    Args:
        s: sensitivities, shape (n, p, 2).
        weights: of all samples, or those of each one, shape (n, 2), from :func:`weights_along`.
        start: FIM before the first sample, shape (p, p): a prior or the thesis's ε I; zero without (eq. 4.27).
        measured: n booleans, False for a lost sample.

    Returns:
        Shape (n, p, p); the last one is the FIM of the sequence.
    """
    count, size, _ = s.shape
    each = np.broadcast_to(np.asarray(weights, dtype=np.float64), (count, 2))
    first, second = upper(size)
    angle, velocity = s[:, :, 0], s[:, :, 1]
    steps = each[:, :1] * angle[:, first] * angle[:, second] + each[:, 1:] * velocity[:, first] * velocity[:, second]
    if measured is not None:
        steps[~np.asarray(measured, dtype=np.bool_)] = 0.0
    if start is not None and count:
        steps[0] += pack(start)
    return unpack(np.cumsum(steps, axis=0), size)


def information_of_range(low: Any, high: Any) -> Any:
    """Information of a prior range: 1/variance of the uniform distribution on it, 12/(high - low)²."""
    return 12.0 / (high - low) ** 2


def uniform_prior(ranges: Ranges, params: Sequence[str], reference: BrakeParameters) -> Floats:
    """FIM of a prior range (:func:`information_of_range`), relative to ``reference``: 12 for ±50 %.

    It is that of a Gaussian prior of the same variance, an approximation and no bound: a uniform prior has no Fisher
    information.

    Returns:
        Diagonal, shape (len(params), len(params)).
    """
    check_unknowns(params)
    diagonal = []
    for name in params:
        low, high = (getattr(end, name, 0.0) for end in (ranges.low, ranges.high))
        if low == high:
            raise UsageError(f"{name} does not vary in the ranges '{ranges.name}': leave it out of the parameters")
        diagonal.append(getattr(reference, name) ** 2 * information_of_range(low, high))
    return np.diag(diagonal)


@dataclass(frozen=True, eq=False)
class Fisher:
    """Fisher information matrix with its parameters, scaling, brake and prior."""

    kind: Kind
    params: tuple[str, ...]
    theta: BrakeParameters  # The brake at which it was computed
    matrix: Floats  # Shape (len(params), len(params)), prior included; dimensionless if physical
    prior: Floats | None  # Prior information in ``matrix``, of the same shape; None without a prior
    plant: str  # Name of that brake's plant in the bench
    nuisances: tuple[str, ...] = ()  # Those of ``params`` that are not of interest

    @property
    def interest(self) -> tuple[str, ...]:
        """The parameters of interest."""
        return tuple(name for name in self.params if name not in self.nuisances)

    def criteria(self) -> Criteria:
        """D, A, E and the condition number of the parameters of interest; with nuisances those of a subset (Ds)."""
        return criteria(self.matrix, self.params, self.interest)

    def cramer_rao(self) -> dict[str, float]:
        """Cramér-Rao bound on the standard deviation of each unknown, with all others unknown.

        Relative, or in the unknown's unit; inf if the data do not identify it. With a prior it is the posterior
        deviation for a Gaussian prior of the same variance, to first order, and no bound.
        """
        deviations = np.sqrt(np.diag(self.covariance()))
        return dict(zip(self.params, deviations.tolist(), strict=True))

    def covariance(self) -> Floats:
        """M⁻¹ (``Spectrum.inverse`` of ``identifiability``); its diagonal has the squares of :meth:`cramer_rao`."""
        self._physical()
        return Spectrum(self.matrix).inverse()

    def correlation(self) -> Floats:
        """Correlations of the estimates, shape (len(params), len(params)), see :meth:`Spectrum.correlation`."""
        self._physical()
        return Spectrum(self.matrix).correlation()

    def identifiability(self, ranges: Ranges | None = None) -> Identifiability:
        """Identifiability of each parameter, with prior ``ranges`` of its value."""
        self._physical()
        return identifiability(self.matrix, self.params, self.prior, _borders(self.params, self.theta, ranges))

    def _physical(self) -> None:
        if self.kind != "physical":
            raise UsageError(
                f"a Cramér-Rao bound needs the physical Fisher information; the {self.kind} one mixes units"
            )


def _borders(params: Sequence[str], theta: BrakeParameters, ranges: Ranges | None) -> dict[str, tuple[float, float]]:
    """Relative distances of each parameter that varies to its lowest and its highest value."""
    found: dict[str, tuple[float, float]] = {}
    if ranges is None:
        return found
    for name in params:
        low, high = getattr(ranges.low, name, 0.0), getattr(ranges.high, name, 0.0)
        if low < high:
            value = getattr(theta, name)
            found[name] = (value - low) / value, (high - value) / value
    return found
