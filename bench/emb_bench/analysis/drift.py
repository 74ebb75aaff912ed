"""Change of the parameters since an earlier estimate.

A parameter has drifted if its change is significant against the deviations of both estimates. Errors common to both
(inertia, scale of the angle, effects of the brake that bias both values alike) are no part of these deviations. Of k
parameters each is tested at the level 0.05/k (Bonferroni), so that in 95 % of comparisons without a change no drift is
reported. A model that does not fit, or another model, changes parameters as well; the report then adds that the change
may be the model's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
from scipy import special

from emb_bench.analysis.several_runs import apart_by
from emb_bench.estimate.estimate import Estimate
from emb_bench.logs.estimates import LONG, read_document
from emb_runtime.errors import UsageError
from emb_runtime.system.terminal import one_line

LEVEL = 0.05  # False-alarm probability of all parameters together
SMALLEST = 1e-200  # Smallest value that another one is compared with relatively


class Entry(msgspec.Struct, frozen=True):
    """One parameter of an earlier estimate."""

    value: float
    deviation_relative: bool
    deviation_between_runs: Annotated[float, msgspec.Meta(ge=0.0)] | None = None
    """Relative or in the value's unit; None: unknown."""
    effects: dict[str, tuple[float, float]] = msgspec.field(default_factory=dict)
    """Biases that are part of it, in the same unit, and sizes of the effects, by name."""

    def __post_init__(self) -> None:
        """Refuse a share of nothing."""
        if self.deviation_relative and abs(self.value) < SMALLEST:
            raise ValueError("expected a deviation that is relative only to a value not zero")

    @property
    def absolute(self) -> float:
        """Standard deviation in the value's unit; inf if it was not identified."""
        spread = math.inf if self.deviation_between_runs is None else self.deviation_between_runs
        return spread * self.unit

    @property
    def unit(self) -> float:
        """Unit of its deviation and biases, in the value's unit."""
        return abs(self.value) if self.deviation_relative else 1.0


class Named(msgspec.Struct, frozen=True):
    """One record of an earlier estimate."""

    name: str


class Earlier(msgspec.Struct, frozen=True):
    """The compared part of an earlier estimate."""

    parameters: Annotated[dict[str, Entry], msgspec.Meta(min_length=1)]
    model: str = ""
    model_fits: bool = False
    records: tuple[Named, ...] = ()


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


def read_last(path: Path) -> Earlier:
    """An earlier estimate, as written by ``emb-replay estimate --json`` or, in a report, by ``emb-replay report``.

    Raises:
        UsageError: the file cannot be read, or is no such document.
    """
    try:
        return read_document(path, Earlier, f"--last {path}")
    except OSError as err:
        raise UsageError(f"--last {path}: {err.strerror}") from err


def earlier(e: Estimate, record: str) -> Earlier:
    """An estimate of one record, by its name, as the earlier one of a comparison."""
    between = e.between_runs().tolist()
    entries = {
        e.labels[i]: Entry(float(e.values[i]), e.unknowns[i].relative, between[i], dict(e.effects(i)))
        for i in e.requested()
    }
    return Earlier(entries, e.plant.name, e.validation.fits, (Named(record),))


def drifts(now: Estimate, last: Earlier) -> tuple[Drift, ...]:
    """Compare the shared unknowns with those of an earlier estimate, as far as both have them."""
    then = last.parameters
    common = [i for i in now.shared() if i in now.requested() and now.labels[i] in then]
    if not common:
        raise UsageError(
            f"nothing to compare: the earlier estimate is of {one_line(', '.join(then), LONG)}, this one of "
            f"{', '.join(now.labels)}"
        )
    limit = float(special.ndtri(1.0 - 0.5 * LEVEL / len(common)))
    since = tuple(one_line(record.name[-LONG:]) for record in last.records)
    deviations = now.between_runs()
    found = []
    for i in common:
        name, relative, unit = now.labels[i], now.unknowns[i].relative, now.quantities[i].unit
        value = float(now.values[i])
        deviation = float(deviations[i]) * (abs(value) if relative else 1.0)
        before, deviation_before = then[name].value, then[name].absolute
        effects = {effect: (float(now.scale[i]) * bias, size) for effect, (bias, size) in now.effects(i).items()}
        other = {effect: (then[name].unit * bias, size) for effect, (bias, size) in then[name].effects.items()}
        in_both = {effect: one for effect, one in other.items() if effect in effects}
        both = math.hypot(apart_by(deviation, effects, other), apart_by(deviation_before, other, in_both))
        change = value - before
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
            )
        )
    return tuple(found)
