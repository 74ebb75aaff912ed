"""The verdict on each parameter, in words: what it is, whether it is identified, what would help, what has changed.

**What counts as identified**, here and in every command that estimates: the Fisher information tells it
(:mod:`emb_bench.information.criteria`), and its 95 % interval is closed, does not contain zero and does not come from
an estimate at the border of what is searched. The interval is that of the likelihood profile where there is one
(:func:`emb_bench.analysis.profile.profiles` says where there has to be). Zero is excluded of what is relative to its
value; an angle or a delay may be zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from emb_bench.analysis.drift import Drift
from emb_bench.analysis.profile import Profile
from emb_bench.analysis.recommendation import HELPS, PRECISE, Advice, spread
from emb_bench.brake.parameters import SI
from emb_bench.estimate.records import Estimate, Unknown
from emb_bench.information.criteria import GROSS, Finding
from emb_bench.numbers import around, between, plain

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
    """95 %: of the profile if output error has one and fits, else of the estimate; infinite where open. SI units."""
    of_interest: bool
    """Whether it was asked for, and is no nuisance."""
    told: bool
    """Whether it is identified."""
    why_not: str
    """Empty if it is."""
    words: str
    """The same for a person, without the label."""


def conclude(
    e: Estimate,
    profiles: Sequence[Profile],
    advice: Sequence[Advice],
    drifts: Sequence[Drift],
    *,
    predicts: bool = True,
) -> tuple[Conclusion, ...]:
    """What is known of each unknown.

    Args:
        e: the estimate.
        profiles: at least those that :func:`emb_bench.analysis.profile.profiles` asks for.
        advice: what would help, best first.
        drifts: what has changed.
        predicts: whether the estimate predicts what it was not fitted to.
    """
    findings = {finding.name: finding for finding in e.verdict().findings}
    of_profile = {p.label: p for p in profiles}
    changes = {drift.name: drift for drift in drifts}
    if e.misfit.fits and predicts:
        certain = "identified"
    else:
        certain = "identified, but biased" if e.method == "rls" else "identified if the model were right"
    found = []
    rows = zip(e.unknowns, e.labels, e.values.tolist(), e.intervals().tolist(), e.deviations().tolist(), strict=True)
    for unknown, label, value, (low, high), deviation in rows:
        finding, one = findings.get(label), of_profile.get(label)
        interval = (low, high)
        # A profile is of output error and takes the bench's noise for true: it says too much of a model that does not
        # fit, and lies elsewhere than what another method found.
        if one is not None and (one.shape != "closed" or (e.misfit.fits and e.method == "oem")):
            interval = one.interval
        why_not = "; ".join(_doubts(e, unknown, label, deviation, interval, finding, one))
        words = [
            amount(value, interval, SI[unknown.name]),
            f"NOT identified: {why_not}" if why_not else certain,
        ]
        if not math.isfinite(deviation):
            words.append("the value is one of many")
        if finding is not None and finding.traded_with and deviation > PRECISE * GROSS.get(unknown.name, 1.0):
            words.append(f"traded off with {', '.join(finding.traded_with)}")
        of_interest = unknown.name in e.asked.params
        if of_interest:
            words += _help(e, label, advice, not why_not)
        if label in changes:
            words.append(changes[label].words)
        found.append(
            Conclusion(label, value, SI[unknown.name], interval, of_interest, not why_not, why_not, "; ".join(words))
        )
    return tuple(found)


def _doubts(
    e: Estimate,
    unknown: Unknown,
    label: str,
    deviation: float,
    interval: tuple[float, float],
    finding: Finding | None,
    profile: Profile | None,
) -> list[str]:
    """Why an unknown is not identified; nothing if it is."""
    said = []
    if finding is not None:
        said += [finding.why_not] if finding.why_not else []
    elif deviation >= GROSS.get(unknown.name, 1.0):
        said.append("its deviation is no smaller than a gross error")
    if profile is not None and profile.shape != "closed":
        said.append(f"its profile is {profile.shape}")
    if label in e.at_bound:
        said.append("its value is AT THE BORDER of what is searched")
    if not said and unknown.relative and interval[0] <= 0.0 <= interval[1]:
        said.append("its interval contains zero")
    return said


def amount(value: float, interval: tuple[float, float], unit: str) -> str:
    """A value, its unit and its interval, to the digits that the interval allows."""
    low, high = interval
    shown = f"{plain(value, 4)} {unit}"
    if math.isinf(low) and math.isinf(high):
        return f"{shown} (any value)"
    if math.isinf(low):
        return f"{shown} (below {plain(high, 4)})"
    if math.isinf(high):
        return f"{shown} (above {plain(low, 4)})"
    half = 0.5 * (high - low)
    if half > 0.0 and max(high - value, value - low) > LOPSIDED * half:
        return f"{shown} ({between(low, high)})"
    return f"{around(value, half)} {unit}"


def _help(e: Estimate, label: str, advice: Sequence[Advice], told: bool) -> list[str]:
    """The first advice that helps this one."""
    for one in advice:
        before, after = one.before.get(label, 0.0), one.after.get(label, math.inf)
        if after <= HELPS * before and not math.isinf(after):
            return [f"one more run of {one.excitation} would tell it to {spread(label, after)}"]
    return [] if told or e.method == "rls" else ["no reference excitation tells it"]
