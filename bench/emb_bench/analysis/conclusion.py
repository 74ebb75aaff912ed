"""Conclusion on each parameter: value, interval, identified or not.

**Identified**, here and in every command that estimates, is a parameter that the Fisher information identifies
(:mod:`emb_bench.information.identifiability`) with an estimate inside the search range and a closed 95 % interval
without zero. The interval is that of the likelihood profile, if there is one
(:func:`emb_bench.analysis.profile.profiles` selects the parameters that need one). Unknowns with a unit, such as an
angle or a delay, may be zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from emb_bench.analysis.drift import Drift
from emb_bench.analysis.records import Profile
from emb_bench.brake.motion import Floats
from emb_bench.brake.parameters import least
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.intervals import bounded
from emb_bench.estimate.intervals import interval as with_profile
from emb_bench.estimate.records import NORMAL_95, Unknown
from emb_bench.information.identifiability import GROSS, Doubt, Finding, Spectrum
from emb_runtime.config.bench import PARAMETER_NAMES

PRECISE = 0.01
"""Deviation, over the value or the gross error, above which a trade-off with another parameter is reported."""


class Standing(StrEnum):
    """Degree to which a value can be trusted."""

    IDENTIFIED = "identified"
    BIASED = "identified, but biased"
    IF_MODEL_RIGHT = "identified if the model is right"
    NOT_IDENTIFIED = "NOT identified"


@dataclass(frozen=True)
class Conclusion:
    """Conclusion on one parameter."""

    finding: Finding
    """Finding of the Fisher information, with the doubts of the estimate; trade-offs above ``PRECISE``."""
    value: float  # In ``unit``
    unit: str  # SI, or of the machine that is no brake (:func:`emb_bench.brake.parameters.quantity`)
    interval: tuple[float, float]
    """95 % interval by the rules of :mod:`emb_bench.estimate.intervals`, infinite where open. In ``unit``."""
    repeatability: float
    """Half of the 95 % interval by the sensors' noise alone: scatter of further runs. In ``unit``."""
    of_interest: bool  # True if it is a parameter of interest, not a nuisance
    standing: Standing
    drift: Drift | None = None
    outside: tuple[float, float] | None = None
    """Range, in ``unit``, for which the shield guarantees the limits, if no part of the interval is in it."""

    @property
    def label(self) -> str:
        """Name of the parameter; of one of several experiments its number, too."""
        return self.finding.name

    @property
    def identified(self) -> bool:
        """Returns True if it is identified."""
        return self.finding.identified


def conclude(
    e: Estimate,
    profiles: Sequence[Profile],
    drifts: Sequence[Drift],
    *,
    predicts: bool = True,
) -> tuple[Conclusion, ...]:
    """Conclusions on the requested unknowns, with the profiles of :func:`profile.profiles`."""
    findings = {finding.name: finding for finding in e.identifiability().findings}
    of_profile = {p.label: p for p in profiles}
    changes = {drift.name: drift for drift in drifts}
    certain = Standing.IDENTIFIED
    if not (e.validation.fits and predicts):
        certain = Standing.BIASED if e.method == "rls" else Standing.IF_MODEL_RIGHT
    found = []
    columns = (
        e.unknowns,
        e.quantities,
        e.labels,
        e.values.tolist(),
        e.intervals().tolist(),
        e.between_runs().tolist(),
        noise_deviations(e).tolist(),
        e.scale.tolist(),
    )
    for unknown, quantity, label, value, (low, high), deviation, noise, scale in zip(*columns, strict=True):
        if unknown.name in e.question.default_nuisances:
            continue
        one, interval = of_profile.get(label), (low, high)
        if one is not None:
            averaged = bool(e.question.systematic) and one.agrees  # over errors whose priors the profile has in full
            holds, biased = e.validation.fits and e.method == "oem" and not averaged, bool(e.unmodelled_bias().any())
            interval = with_profile(interval, one.interval, closed=one.doubt is None, holds=holds, biased=biased)
        interval = bounded(interval, value, least(unknown.name))
        gross = GROSS.get(unknown.name, 1.0)
        finding = findings.get(label)
        if finding is None:  # of a single experiment
            doubts = (Doubt.TOO_WIDE,) if deviation >= gross else ()
            finding = Finding(label, deviation, doubts, unit="" if unknown.relative else quantity.unit)
        finding = replace(
            finding,
            doubts=finding.doubts + _further_doubts(e, unknown, label, interval, one, finding),
            traded_with=finding.traded_with if deviation > PRECISE * gross else {},
        )
        found.append(
            Conclusion(
                finding=finding,
                value=value,
                unit=quantity.unit,
                interval=interval,
                repeatability=NORMAL_95 * noise * scale,
                of_interest=unknown.name in e.question.params,
                standing=certain if finding.identified else Standing.NOT_IDENTIFIED,
                drift=changes.get(label),
                outside=_range_missed(e, unknown, interval),
            )
        )
    return tuple(found)


def _range_missed(e: Estimate, unknown: Unknown, interval: tuple[float, float]) -> tuple[float, float] | None:
    """Range of a parameter in the shield's set [SI units]; None if a part of the interval is in it."""
    if e.bench.machine is not None or unknown.name not in PARAMETER_NAMES:
        return None
    ranges = e.bench.range_set(e.bench.shield.ranges)
    low, high = (float(getattr(end, unknown.name)) for end in (ranges.low, ranges.high))
    return (low, high) if interval[1] < low or interval[0] > high else None


def noise_deviations(e: Estimate) -> Floats:
    """Standard deviations by the sensors' noise alone, relative or in the unknown's unit; inf if not identified.

    With the covariance C of the estimate and the information Λ of the samples, repeated runs scatter with C Λ C, for
    the quantity with a prior is the same in every run. It is at most C, which includes the errors.
    """
    spectrum = Spectrum(e.information)
    variances = np.diag(spectrum.sandwich(e.samples))
    deviations: Floats = np.sqrt(np.clip(variances, 0.0, np.diag(spectrum.inverse())))
    return deviations


def _further_doubts(
    e: Estimate,
    unknown: Unknown,
    label: str,
    interval: tuple[float, float],
    profile: Profile | None,
    finding: Finding,
) -> tuple[Doubt, ...]:
    """Reasons that an unknown is not identified beside those of the information."""
    doubts = [] if profile is None or profile.doubt is None else [profile.doubt]
    if doubts in ([Doubt.OPEN_BELOW], [Doubt.OPEN_ABOVE]) and interval == (-math.inf, math.inf):
        doubts = [Doubt.FLAT]
    if label in e.at_bound:
        doubts.append(Doubt.AT_BORDER)
    if not doubts and finding.identified and unknown.relative and interval[0] <= 0.0 <= interval[1]:
        doubts.append(Doubt.CONTAINS_ZERO)
    return tuple(doubts)
