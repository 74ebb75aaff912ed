"""The verdict on each parameter, in words: what it is, whether it is identified, what would help, what has changed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from emb_bench.brake.unknowns import UNITS
from emb_bench.criteria import GROSS
from emb_bench.estimate.advice import HELPS, Advice, spread
from emb_bench.estimate.drift import Drift
from emb_bench.estimate.profile import Profile, between
from emb_bench.estimate.records import Estimate

SI = {"k_m": "N·m/A", "k_1": "N/rad", "T_c": "N·m", "f_v": "N·m·s/rad", "J": "kg·m²"}
"""Units of the brake's parameters."""
LOPSIDED = 1.2
"""Longer side of an interval over half its width from which on both ends are named."""


@dataclass(frozen=True)
class Conclusion:
    """What is known of one parameter."""

    label: str
    value: float
    """SI units."""
    unit: str
    interval: tuple[float, float]
    """95 %: of the profile if there is one and the model fits, else of the estimate; infinite where open. SI units."""
    of_interest: bool
    """Whether it was asked for, and is no nuisance."""
    told: bool
    """Whether it is identified."""
    words: str
    """The same for a person, without the label."""


def unit_of(name: str) -> str:
    """The SI unit of an unknown."""
    return SI.get(name) or UNITS[name]


def conclude(
    e: Estimate, profiles: Sequence[Profile], advice: Sequence[Advice], drifts: Sequence[Drift]
) -> tuple[Conclusion, ...]:
    """What is known of each unknown.

    Args:
        e: the estimate.
        profiles: any that there are.
        advice: what would help, best first.
        drifts: what has changed.
    """
    findings = {finding.name: finding for finding in e.verdict().findings}
    of_profile = {p.label: p for p in profiles}
    changes = {drift.name: drift for drift in drifts}
    found = []
    rows = zip(e.unknowns, e.labels, e.values.tolist(), e.intervals().tolist(), e.deviations().tolist(), strict=True)
    for unknown, label, value, (low, high), deviation in rows:
        interval, reasons = (low, high), []
        if (finding := findings.get(label)) is not None:
            reasons += [finding.why_not] if finding.why_not else []
        elif deviation >= GROSS.get(unknown.name, 1.0):
            reasons.append("its deviation is no smaller than a gross error")
        if (one := of_profile.get(label)) is not None:
            # A profile takes the bench's noise for true, so that it says too much of a model that does not fit.
            interval = one.interval if e.misfit.fits or one.shape != "closed" else interval
            reasons += [] if one.shape == "closed" else [f"its profile is {one.shape}"]
        certain = "identified" if e.misfit.fits else "identified if the model were right"
        unit, told, of_interest = unit_of(unknown.name), not reasons, unknown.name in e.asked.params
        words = [
            f"{_amount(value, interval)} {unit}",
            certain if told else f"NOT identified: {', '.join(reasons)}",
        ]
        if not math.isfinite(deviation):
            words.append("the value is one of many")
        if finding is not None and finding.traded_with:
            words.append(f"traded off with {', '.join(finding.traded_with)}")
        if label in e.at_bound:
            words.append("AT THE BORDER of what is searched")
        if of_interest:
            words += _help(e, label, advice, told)
        if label in changes:
            words.append(changes[label].words)
        found.append(Conclusion(label, value, unit, interval, of_interest, told, "; ".join(words)))
    return tuple(found)


def _amount(value: float, interval: tuple[float, float]) -> str:
    """A value and its interval, to the digits that the interval allows."""
    low, high = interval
    if math.isinf(low) and math.isinf(high):
        return f"{value:.4g}, any value,"
    if math.isinf(low):
        return f"{value:.4g}, below {high:.4g},"
    if math.isinf(high):
        return f"{value:.4g}, above {low:.4g},"
    half = 0.5 * (high - low)
    digits = 3 if half <= 0.0 or value == 0.0 else 2 + math.ceil(math.log10(max(abs(value) / half, 1.0)))
    if half > 0.0 and max(high - value, value - low) > LOPSIDED * half:
        return f"{value:.{digits}g}, {between(low, high)},"
    return f"{value:.{digits}g} ± {half:.2g}"


def _help(e: Estimate, label: str, advice: Sequence[Advice], told: bool) -> list[str]:
    """The first advice that helps this one."""
    for one in advice:
        before, after = one.before.get(label, 0.0), one.after.get(label, math.inf)
        if after <= HELPS * before and not math.isinf(after):
            return [f"one more run of {one.excitation} would tell it to {spread(label, after)}"]
    return [] if told or e.method == "rls" else ["no reference excitation tells it"]
