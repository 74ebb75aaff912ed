"""Change of the parameters since an earlier estimate.

Two estimates differ by chance, by as much as their deviations; a parameter has drifted if it differs by more. With
k parameters compared at once each has to pass the quantile for 1 - 0.05/k (Bonferroni), so that nothing is called a
drift in 95 % of campaigns in which nothing has changed. A model that did not fit, or another one, moves parameters too:
then the change is reported as one that may be the model's.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from scipy import special

from emb_bench.estimate.records import Estimate
from emb_bench.experiment.theta import MAX_JSON_BYTES
from emb_runtime.config.validation import Rules, Table, shown
from emb_runtime.errors import UsageError
from emb_runtime.system.input_file import read_text

LEVEL = 0.05  # Chance that anything at all is called a drift where there is none
SMALLEST = 1e-200  # Smallest value that another one is compared with relatively
LONG = 80  # Most characters shown of a text in the document
RULES = Rules(UsageError, LONG, remedy="write it with emb-replay estimate --json")


class Doubt(StrEnum):
    """Reason why a change may be one of the model instead of one of the brake."""

    DID_NOT_FIT = "the model did not fit then"
    DOES_NOT_FIT = "the model does not fit now"
    OTHER_MODEL = "the model was another one then"


@dataclass(frozen=True)
class Drift:
    """One parameter now and then."""

    name: str
    unit: str  # Of the values and their standard deviations
    relative: bool  # True if the change is relative to the value
    last: float
    last_deviation: float  # Standard deviation; inf if it was not identified
    now: float
    deviation: float  # Standard deviation now
    relative_change: float  # (now - last) / abs(last); of an unknown with a unit now - last
    sigmas: float  # The change in standard deviations of the difference; 0 if one of the two was not identified
    drifted: bool
    detectable: float
    """Smallest change that would count as a drift, relative or in the parameter's unit; inf where not comparable."""
    since: tuple[str, ...]  # Names of the records of the earlier estimate; empty if it names none
    doubts: tuple[Doubt, ...]  # Reasons why the drift may be one of the model; empty if there is no drift
    last_model: str  # Model of the earlier estimate


def read_last(path: Path) -> dict[str, Any]:
    """Document of an earlier estimate, as written by ``emb-replay estimate --json`` or ``emb-replay report``.

    Raises:
        UsageError: the file cannot be read, or is no such document.
    """
    try:
        found = json.loads(read_text(path, MAX_JSON_BYTES))
    except OSError as err:
        raise UsageError(f"--last {path}: {err.strerror}") from err
    except (ValueError, RecursionError) as err:  # JSONDecodeError, UnicodeDecodeError, a number of 5,000 digits
        raise UsageError(f"--last {path}: expected the JSON of an earlier estimate, and it is none") from err
    if isinstance(found, dict) and isinstance(found.get("estimate"), dict):
        found = found["estimate"]  # a report has more around it
    _values(found, f"--last {path}")
    return dict(found)


def drifts(now: Estimate, last: Mapping[str, Any]) -> tuple[Drift, ...]:
    """Compare what all records share with an earlier estimate, as far as both have it.

    Args:
        now: the estimate.
        last: document of an earlier one.

    Raises:
        UsageError: it is no such document, or has no parameter in common with this one.
    """
    then = _values(last)
    common = [i for i in now.shared() if i in now.wanted() and now.labels[i] in then]
    if not common:
        raise UsageError(
            f"nothing to compare: the earlier estimate is of {_printable(', '.join(then))}, this one of "
            f"{', '.join(now.labels)}"
        )
    limit = float(special.ndtri(1.0 - 0.5 * LEVEL / len(common)))
    since, doubts, model = _since(last), _doubts(now, last), _printable(str(last.get("model")))
    deviations = now.deviations()
    found = []
    for i in common:
        name, relative, (_, unit, factor) = now.labels[i], now.unknowns[i].relative, now.shown[i]
        value = float(now.values[i]) * factor
        deviation = float(deviations[i]) * (abs(value) if relative else factor)
        before, deviation_before = then[name]
        both, change = math.hypot(deviation_before, deviation), value - before
        size = abs(before) if relative else 1.0
        sigmas = change / both if 0.0 < both < math.inf else 0.0
        drifted = abs(sigmas) > limit
        found.append(
            Drift(
                name=name,
                unit=unit,
                relative=relative,
                last=before,
                last_deviation=deviation_before,
                now=value,
                deviation=deviation,
                relative_change=change / size,
                sigmas=sigmas,
                drifted=drifted,
                detectable=limit * both / size,
                since=since,
                doubts=doubts if drifted else (),
                last_model=model,
            )
        )
    return tuple(found)


def comparable(now: Estimate, last: Mapping[str, Any]) -> str:
    """Reasons why a change since an earlier estimate may be one of the model; empty if there is none."""
    return "; ".join(_doubts(now, last))


def _since(last: Mapping[str, Any]) -> tuple[str, ...]:
    records = last.get("records")
    entries = records if isinstance(records, list) else []
    return tuple(_printable(r["name"]) for r in entries if isinstance(r, dict) and isinstance(r.get("name"), str))


def _printable(text: str) -> str:
    """Text of another file, as it can stand in a line."""
    return "".join(c if c.isprintable() else "?" for c in text[-LONG:])


def _doubts(now: Estimate, last: Mapping[str, Any]) -> tuple[Doubt, ...]:
    reasons = {
        Doubt.DID_NOT_FIT: last.get("model_fits") is not True,
        Doubt.DOES_NOT_FIT: not now.validation.fits,
        Doubt.OTHER_MODEL: last.get("model") != now.plant.name,
    }
    return tuple(doubt for doubt, holds in reasons.items() if holds)


def _values(last: object, source: str = "the earlier estimate") -> dict[str, tuple[float, float]]:
    """Values and standard deviations by name; a deviation that is null is infinite."""
    document = Table(source, "", last, RULES)
    parameters = document.table("parameters")
    if not parameters.names():
        raise document.fail("parameters", "expected what was estimated, and there is nothing")
    found = {}
    for name in parameters.names():
        entry = parameters.table(name)
        value, relative = entry.number("value"), entry.get("deviation_relative", "true or false")
        if not isinstance(relative, bool):
            raise entry.fail("deviation_relative", f"expected true or false, got {shown(relative)}")
        if relative and abs(value) < SMALLEST:
            raise entry.fail("deviation", "expected one that is relative only to a value not zero")
        spread = math.inf
        if entry.get("deviation") is not None:
            spread = entry.number("deviation", lambda d: d >= 0.0, "a number that is not negative")
        found[name] = (value, spread * abs(value) if relative else spread)
    return found
