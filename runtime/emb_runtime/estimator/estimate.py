"""An estimate as plain data by name, and in words.

Every uncertainty has one of two names; both are half of a 95 % interval (k = 2). *Repeatability* is the scatter of
further runs by the sensors' noise, *total* the distance from the true value. A part of the total does not depend on the
run.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from emb_runtime.config.bench import PARAMETER_NAMES, Systematic
from emb_runtime.numbers import around, in_percent

LOST = "ESTIMATE_LOST"  # Code of the event after which a run has no estimate: it was not finite
NORMAL_95 = 1.959963984540054  # Standard deviations that 95 % of a Gaussian lie within
UNITS = {"k_m": "N·m/A", "k_1": "N/rad", "T_c": "N·m", "f_v": "N·m·s/rad"}  # Of the parameters
SCALED = ("k_m", "T_c")  # Parameters that an error of the angle's scale moves
DOMINANT = 0.005  # Error of J, a standard deviation, from which on little else is in a total
UNKNOWN = Systematic(inertia=0.0, angle_scale=0.0, time_scale=0.0)  # Where there is no bench file
NO_FIT = "THE MODEL DOES NOT FIT: friction, a delay or a sensor differs from the model"


def systematic_part(errors: Systematic) -> dict[str, float]:
    """Part of each parameter's total that does not depend on the run, as a share of the parameter.

    If all torques and J are scaled alike, the motion is the same: each parameter has the relative error of J. An angle
    that is shown too large by some share makes k_m and T_c too large by it, and a current k_m too small. A clock that
    is slow by some share makes f_v too large by it, and the others by twice of it. No record determines any of them:
    all add to the total with their priors, in quadrature.
    """
    return {
        name: NORMAL_95
        * math.hypot(
            errors.inertia,
            errors.angle_scale if name in SCALED else 0.0,
            errors.current_scale if name == "k_m" else 0.0,
            errors.time_scale * (1.0 if name == "f_v" else 2.0),
        )
        for name in PARAMETER_NAMES
    }


def by_name(numbers: Sequence[float], errors: Systematic) -> dict[str, dict[str, Any]]:
    """Value, standard deviation, repeatability, least total and unit of each parameter that is estimated.

    The ``numbers`` are those of :attr:`emb_runtime.estimator.estimator.Estimator.estimate`.
    """
    prior = systematic_part(errors)
    return {
        name: {
            "value": value,
            "deviation": deviation,
            "repeatability": NORMAL_95 * deviation,
            "total": math.hypot(NORMAL_95 * deviation, prior[name] * value),
            "unit": UNITS[name],
        }
        for name, value, deviation in zip(PARAMETER_NAMES, numbers, numbers[len(PARAMETER_NAMES) :], strict=False)
        if deviation > 0.0
    }


def total(repeatability: Mapping[str, float], errors: Systematic) -> str:
    """The total in words, from the ``repeatability`` of parameters as shares of them and their :func:`systematic_part`.

    ``total about 2 %, as J is known to 1 %``; empty where there is none.
    """
    systematic = systematic_part(errors)
    shares = [math.hypot(share, systematic[name]) for name, share in repeatability.items() if math.isfinite(share)]
    prior, cause = max(
        (errors.inertia, "J"),
        (errors.angle_scale, "the angle's scale"),
        (errors.current_scale, "the current's scale"),
        (errors.time_scale, "the clock"),
    )
    if not (shares and prior):
        return ""
    ends = dict.fromkeys(in_percent(share).removesuffix(" %") for share in (min(shares), max(shares)))
    about = "about" if errors.inertia >= DOMINANT else "at least"
    return f"total {about} {' to '.join(ends)} %, as {cause} is known to {in_percent(prior)}"


def rows(estimate: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Of each quantity of a :func:`by_name` its name, its value with its repeatability, and the latter in percent."""
    for name, one in estimate.items():
        half = one["repeatability"]
        share = in_percent(half / abs(one["value"])) if one["value"] else ""
        yield name, f"{around(one['value'], half)} {one['unit']}", f"repeatability ± {share}" if share else ""


def shares(estimate: Mapping[str, Any]) -> dict[str, float]:
    """Repeatability of each quantity of a :func:`by_name`, as a share of its value."""
    return {name: one["repeatability"] / abs(one["value"]) for name, one in estimate.items() if one["value"]}


def words(estimate: Mapping[str, Any], of_total: str, *, fits: bool) -> list[str]:
    """Lines on a :func:`by_name` for a person; ``of_total`` is that of :func:`total`."""
    lines = ["running estimate ± repeatability (95 %, k=2), valid if the model is right"]
    found = list(rows(estimate))
    width = max((len(value) for _, value, _ in found), default=0)
    lines += [] if fits else [f"  {NO_FIT}"]
    lines += [f"  {name} = {value:{width}}   {share}".rstrip() for name, value, share in found]
    return lines + ([f"  {of_total}"] if fits and of_total else [])
