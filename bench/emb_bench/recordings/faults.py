"""Faults of a recording and its map, looked for before anything is estimated: each a row of a table.

Times that make no grid, an angle that wraps around and special values are refused, with the row of the file. A
contradiction of the equations of motion, which holds for any friction, refuses nothing; it is named first where the
model does not fit. Pure functions of arrays and the map.

The equations are those of spans of a few samples: second differences of the angle against those of the double integral
of the torque. They are exact for any motion between the samples, and linear in the parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from emb_bench.recordings.map_file import RecordingMap
from emb_runtime.errors import UsageError

Floats = NDArray[np.float64]

HUGE = 1e30  # In any unit
EQUAL = 0.05  # Share of rows with the time of the row before from which on the times do not tell the samples apart
SPARSE = 1.5  # Distance of the rows, in sample times that the map gives, from which on the two contradict each other
FAR = 20.0  # Distance of a special value from the others, in their spread
APART = 3.0  # Distance of a number from all others, in their width, from which on it is a special one
SHORT = 10  # Most rows in a row that have a special value
MOST_VALUES = 20  # Numbers that come again after a jump, which are tried as special values
RARE = 0.05  # Largest share of special values
ALIKE = 0.05  # Relative difference of jumps of one period
PERIODS = (*(2.0 * math.pi / n for n in range(1, 13)), *(2.0**bits for bits in range(8, 33)))
"""Usual ones besides those of two digits, which a jump says less exactly."""
SPANS = (5, 10, 20, 40)  # Samples of a span: the shortest whose changes the noise does not hide
SIGNIFICANT = 30.0  # Least change over a span, in standard deviations of the sensor
MOST = 100_000  # Samples that the equations are tried on
LATEST = 100  # Largest delay that is looked for [samples], in a recording that is ten times as long
EARLY, LATE = -0.1, 0.9  # Delays that can be estimated [samples]
BETTER = 0.5  # Share of the squares that another delay must leave
NONZERO = 10.0  # Least coefficient, in its standard deviations
WRONG = 3.0  # Ratio of the torque found to that of the given k_m and J from which on a unit is wrong
SCALED = 1.2  # Ratio of the travels by angle and by velocity from which on their scales contradict each other
FACTOR = 10.0  # Values beyond a guess by this factor are not searched
SPECIAL = tuple(
    sign * number / unit
    for number in (
        99.0,
        999.0,
        9999.0,
        99999.0,
        *(2.0**bits - k for bits in (7, 8, 10, 12, 15, 16, 31, 32) for k in (0, 1)),
    )
    for unit in ((1.0, 10.0, 100.0, 1000.0) if number > 5000.0 else (1.0,))
    for sign in (1.0, -1.0)
)
"""Numbers with which a recorder says that it has none, besides those beyond all others: all nines, the ends of bits."""


Of = TypeVar("Of")
Found = Mapping[str, object] | None
"""Numbers and texts of a fault, by their places in its sentence; None where there is none."""
Checks = Mapping[Callable[[Of], Found], str]
"""Tests for faults, with the sentence that names each; the most important first."""


def found_by(checks: Checks[Of], of: Of) -> Iterator[str]:
    """Each fault in words."""
    for check, sentence in checks.items():
        if (found := check(of)) is not None:
            yield sentence.format(**found)


def require(checks: Checks[Series], s: Series, source: str) -> None:
    """Refuse the first fault of a signal; messages call the file ``source``."""
    for sentence in found_by(checks, s):
        raise UsageError(f"{source}: {sentence}")


# ---- times and values ----


class Series(NamedTuple):
    """One signal as it was read; row 1 is the first after the head."""

    name: str
    rows: NDArray[np.int64]
    times: Floats  # [s]
    values: Floats  # In the unit of the column
    tick: float = 1.0  # Time of one count of the column of times [s]
    sample_time: float = 0.0  # As the map gives it [s]
    noise: float = 0.0  # Standard deviation, in the unit of the column
    wrap: float = 0.0  # Period of an angle, as the map gives it
    rates: Floats | None = None  # Velocity of an angle at its samples, in units of the column per second

    def at(self, k: int) -> dict[str, object]:
        """Places of a fault between the samples k and k + 1."""
        return {"name": self.name, "row": self.rows[k], "next": self.rows[k] + 1, "last": self.rows[-1]}


def _is_apart(s: Series) -> Found:
    """A single time that is out of order between two that are in order."""
    steps = np.diff(s.times)
    back = int(np.argmax(steps < 0.0)) if (steps < 0.0).any() else 0
    for k in (back, back + 1):  # the one before the step back is too late, or the one after it too early
        if 0 < k < len(steps) and 0.0 < s.times[k + 1] - s.times[k - 1] < abs(min(steps[k - 1], steps[k])):
            return s.at(k) | {"time": s.times[k], "before": s.times[k - 1], "after": s.times[k + 1]}
    return None


def _begins_anew(s: Series) -> Found:
    back = np.flatnonzero(np.diff(s.times) < 0.0)
    if not len(back):
        return None
    k, after = int(back[0]), s.times[back[0] + 1 : back[0] + 1 + SHORT]
    if after.max() >= s.times[k] or after.max() == after.min() or (np.diff(after[:3]) < 0.0).any():
        return None
    period = (s.times[k] - s.times[k + 1] + np.median(np.abs(np.diff(s.times)))) / s.tick
    return s.at(k) | {"time": s.times[k], "period": period}


def _runs_backwards(s: Series) -> Found:
    back = np.flatnonzero(np.diff(s.times) < 0.0)
    return s.at(back[0]) | {"time": s.times[back[0]], "then": s.times[back[0] + 1]} if len(back) else None


def _is_equal(s: Series) -> Found:
    same = np.flatnonzero(np.diff(s.times) == 0.0)
    return s.at(same[0]) | {"same": len(same), "all": len(s.times)} if len(same) > EQUAL * len(s.times) else None


def _jumps(s: Series) -> Found:
    steps = np.diff(s.times)
    k = int(np.argmax(steps))
    rest = s.times[-1] - s.times[0] - steps[k]
    return s.at(k) | {"by": steps[k]} if steps[k] > max(rest, 100.0 * float(np.median(steps))) else None


def _is_sparse(s: Series) -> Found:
    apart = float(np.median(np.diff(s.times)))
    return {"apart": apart, "given": s.sample_time} if 0.0 < s.sample_time * SPARSE < apart else None


TIMES: Checks[Series] = {
    _is_apart: "the time is {time:.10g} s in row {row}, between {before:.10g} and {after:.10g} s: leave that row out "
    "of the file",
    _begins_anew: "the time begins anew after row {row}, at {time:.10g} s: of a counter, [timing] wrap = {period:.10g} "
    "continues it; of two recordings, [file] rows = [1, {row}] or [{next}, {last}] is one of them",
    _runs_backwards: "the time runs backwards after row {row}, from {time:.10g} to {then:.10g} s: sort the rows, or "
    "read those before with [file] rows = [1, {row}]",
    _is_equal: "{same} of {all} rows have the same time as the row before, the first one row {next}, and it does not "
    "tell them apart: where the rows are evenly apart, leave [timing] column out and give sample_time",
    _jumps: "the time jumps by {by:.6g} s after row {row}: [file] rows = [1, {row}] or [{next}, {last}] is one "
    "recording",
    _is_sparse: "the rows are {apart:.6g} s apart, where [timing] sample_time says {given:g} s",
}


def _is_huge(s: Series) -> Found:
    huge = np.abs(s.values) > HUGE
    k = int(np.argmax(huge))
    return s.at(k) | {"value": s.values[k]} if huge.any() else None


def _is_alone(s: Series) -> Found:
    """The lowest or the highest number, where it lies apart from all others. A command, without noise, may jump."""
    for value in (s.values.min(), s.values.max()):
        alone = s.values == value
        if s.noise and alone.sum() <= 0.5 * len(alone):
            low, high = s.values[~alone].min(), s.values[~alone].max()
            if min(abs(value - low), abs(value - high)) > APART * max(high - low, 10.0 * s.noise):
                return _outliers(s, alone, low, high)
    return None


def _is_special(s: Series) -> Found:
    """Values beyond all others, special numbers, or one number that comes again and again between others."""
    low, middle, high = np.percentile(s.values, (5.0, 50.0, 95.0))
    spreads = np.abs(s.values - middle) / max(high - low, 10.0 * s.noise, 1e-300)
    if not s.noise:  # a command may jump
        far = (spreads > 1000.0) | (spreads > FAR) & np.isin(s.values, SPECIAL)
    else:
        far = spreads > FAR
        steps = np.abs(np.diff(s.values))
        after, counts = np.unique(s.values[1:][steps > FAR * np.percentile(steps, 80.0)], return_counts=True)
        special = np.unique(s.values[np.isin(s.values, (0.0, *SPECIAL))])
        for value in (*special, *after[counts > 1][:MOST_VALUES]):
            far |= _between(s, s.values == value)
    return _outliers(s, far, low, high) if 0 < far.sum() <= RARE * len(far) and high > low else None


def _outliers(s: Series, far: NDArray[np.bool_], low: float, high: float) -> Found:
    """Values that are apart from the others, most of which are between low and high."""
    k, others, margin = int(np.argmax(far)), s.values[~far], 0.1 * (high - low)
    ends = {"low": others.min() - margin, "high": others.max() + margin}
    return s.at(k) | ends | {"count": far.sum(), "value": s.values[k]}


def _between(s: Series, special: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Short runs of special samples that lie apart from the sample before and the one after, where these two agree."""
    found, edges = np.zeros(len(special), np.bool_), np.flatnonzero(np.diff(np.pad(special, 1).astype(np.int8)))
    usual = 10.0 * s.noise + 3.0 * float(np.percentile(np.abs(np.diff(s.values)), 80.0))
    for begin, end in edges.reshape(-1, 2).tolist():
        if begin > 0 and end < len(special) and end - begin <= SHORT:
            before, after, value = s.values[begin - 1], s.values[end], s.values[begin]
            away = min(abs(before - value), abs(after - value))
            found[begin:end] = away > 5.0 * max(usual * (end - begin + 1), abs(after - before))
    return found


SPECIAL_SENTENCE = (
    "{count} values of {name} are apart from all others, the first one {value:.10g} in row {row}: where "
    "they say that there is no value, special = [{value:.10g}], or range = [{low:.4g}, {high:.4g}], of the signal "
    "leaves them out"
)
VALUES: Checks[Series] = {
    _is_huge: "{name} is {value:.4g} in row {row}, beyond any measurement: range = [LOW, HIGH] of the signal leaves "
    "such out",
    _is_alone: SPECIAL_SENTENCE,
    _is_special: SPECIAL_SENTENCE,
}


def _off(s: Series) -> Floats:
    """Distance of each step of the angle from that of steps around, or of its velocity if that says it better."""
    steps, apart = np.diff(s.values), np.diff(s.times)
    rates = np.pad(steps / np.where(apart > 0.0, apart, np.inf), 2, mode="edge")
    expected = [np.median(np.lib.stride_tricks.sliding_window_view(rates, 5), axis=1)]
    if s.rates is not None:
        expected.append(0.5 * (s.rates[1:] + s.rates[:-1]))
    off = min((np.abs(steps - rate * apart) for rate in expected), key=lambda row: float(np.median(row)))
    return np.where(apart < 1.5 * np.median(apart), off, 0.0)


def _beyond_period(s: Series) -> Found:
    low, high = s.values.min(), s.values.max()
    return {"name": s.name, "low": low, "high": high, "wrap": s.wrap} if 0.0 < 1.1 * s.wrap < high - low else None


def _wraps(s: Series) -> Found:
    off = _off(s)
    far = off > 0.5 * off.max()
    if not far.any():
        return None
    period, extent = float(np.median(off[far])), float(np.ptp(s.values))
    step = 1.5 * float((s.values == np.rint(s.values)).all())  # Of counts, and half of one for rounding
    among = (*PERIODS, *([extent + 1.0] if step else []), float(f"{period:.2g}"))
    exact = next((p for p in among if abs(p - period) < max(1e-3 * p, step)), 0.0)
    if not exact and far.sum() < 2:
        return None
    period = exact or period
    alike = (np.abs(off[far] - period) < ALIKE * period).all() and (off[~far] < 0.4 * period).all()
    usual = float(np.median(np.abs(np.diff(s.values)))) + 10.0 * s.noise
    if not (alike and period > 5.0 * usual and 0.8 * period < extent < 1.05 * period):
        return None
    return s.at(int(np.argmax(far))) | {"period": period, "count": far.sum()}


def _is_set(s: Series) -> Found:
    off = _off(s)
    far = off > max(20.0 * float(np.percentile(off, 99.0)), 0.05 * float(np.ptp(s.values)), 20.0 * s.noise)
    k = int(np.argmax(far))
    return s.at(k) | {"value": s.values[k], "then": s.values[k + 1], "count": far.sum()} if far.any() else None


WRAPPED: Checks[Series] = {
    _is_huge: VALUES[_is_huge],
    _beyond_period: "{name} goes from {low:.6g} to {high:.6g}, further than wrap = {wrap:.6g} says: expected its "
    "period in the column's unit; range = [LOW, HIGH] leaves single values out",
}
ANGLES: Checks[Series] = {
    _is_huge: VALUES[_is_huge],
    _is_alone: SPECIAL_SENTENCE,
    _wraps: "{name} jumps by {period:.10g} after row {row}, {count} times in all: it wraps around after a period; "
    "wrap = {period:.10g} of the signal continues it",
    _is_special: SPECIAL_SENTENCE,
    _is_set: "{name} jumps from {value:.6g} to {then:.6g} after row {row}, {count} times in all, as no motion does: "
    "was it set anew? [file] rows = [1, {row}] or [{next}, {last}] is one recording; range = [LOW, HIGH] of the signal "
    "leaves single values out",
}


# ---- the equations ----


@dataclass(frozen=True, eq=False)
class Equation:
    """Second differences of the angle over spans of a recording, and of the double integrals of its torques."""

    recording_map: RecordingMap
    samples: Floats  # Angle and velocity on the grid, NaN where lost, shape (n + 1, 2)
    t_s: float  # Sample time [s]
    response: Floats  # Second differences of the angle, shape (m,)
    loads: Mapping[str, Floats]  # Regressors of friction, spring and a constant, by their parameters, shape (m,) each
    drive: Floats  # Double integral of the driving current or torque, at each sample, shape (n + 1,)
    span: int  # [samples]
    complete: NDArray[np.bool_]  # Spans without a lost sample
    basis: Floats  # Orthonormal basis of the loads, shape (m, loads)
    latest: int  # Largest delay that is looked for [samples]

    def driven(self, delay: float) -> Floats:
        """Double integral of the drive over each span, ``delay`` samples late."""
        at = np.arange(len(self.drive), dtype=np.float64)
        return _second(np.interp(at - delay, at, self.drive), self.span)[self.complete]

    def correlation(self, delay: float) -> float:
        """Partial correlation of the angle with the drive, ``delay`` samples late, given all loads."""
        response, driven = (row - self.basis @ (self.basis.T @ row) for row in (self.response, self.driven(delay)))
        size = float(np.linalg.norm(response) * np.linalg.norm(driven))
        return float(response @ driven) / size if size > 0.0 else 0.0

    @cached_property
    def best(self) -> tuple[float, float]:
        """Delay of the drive with the largest correlation [samples], and that correlation."""
        coarse = max(range(-self.latest, self.latest + 1), key=self.correlation)
        near = np.linspace(coarse - 1.0, coarse + 1.0, 21).tolist()
        return max(((delay, self.correlation(delay)) for delay in near), key=lambda pair: pair[1])


def equation_of(samples: Floats, currents: Floats, t_s: float, recording_map: RecordingMap) -> Equation | None:
    """The equation of a recording; None where nothing moves by more than its noise, or too little of it is left."""
    n, noise = min(len(currents), MOST), recording_map.signals.angle.noise
    raw = samples[: n + 1, 0]
    there = np.isfinite(raw)
    angle = np.interp(np.arange(n + 1), np.flatnonzero(there), raw[there])
    for span in SPANS:
        response = _second(angle, span)
        complete = ~np.isnan(_second(raw, span))
        if complete.sum() > 10 * span and math.sqrt(float(np.mean(response[complete] ** 2))) > SIGNIFICANT * noise:
            break
    else:
        return None
    travel = np.diff(angle)
    half = span // 2
    around = np.convolve(travel, np.ones(2 * half + 1), "same")
    turning = np.where(np.abs(around) > 5.0 * noise, np.sign(around), 0.0)
    middle = 0.5 * (angle[1:] + angle[:-1])
    loads = {
        "T_c": _double(-turning, t_s),
        "f_v": np.concatenate([[0.0], np.cumsum(-(middle - angle[0]) * t_s)]),
        "offset": _double(np.ones(n), t_s),
    }
    if "k_1" in recording_map.machine.parameters:
        loads["k_1"] = _double(-np.maximum(middle, 0.0), t_s)
    latest = max(min(LATEST, n // 10), 2)
    complete[:latest] = complete[-latest:] = False  # a delayed torque there is not in the recording
    second = {name: _second(load, span)[complete] for name, load in loads.items()}
    drive = _double(np.nan_to_num(currents[:n]), t_s)
    basis = np.linalg.qr(np.stack([*second.values()], axis=1))[0]
    return Equation(recording_map, samples, t_s, response[complete], second, drive, span, complete, basis, latest)


def _second(row: Floats, span: int) -> Floats:
    return row[2 * span :] - 2.0 * row[span:-span] + row[: -2 * span]


def _double(rate: Floats, t_s: float) -> Floats:
    """Double integral at each sample of a rate that is constant within each period."""
    first = np.cumsum(rate) * t_s
    result: Floats = np.concatenate([[0.0], np.cumsum(first - 0.5 * rate * t_s) * t_s])
    return result


def _travels(e: Equation) -> tuple[float, float]:
    """Correlation of the travel over spans with the integrated velocity, and their ratio; NaN without a velocity."""
    angle, velocity = e.samples.T
    if e.recording_map.signals.velocity is None:  # it was derived
        return math.nan, math.nan
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * e.t_s
    integrated = np.lib.stride_tricks.sliding_window_view(steps, e.span).sum(axis=1)
    travelled = angle[e.span :] - angle[: -e.span]
    integrated, travelled = (row[np.isfinite(integrated) & np.isfinite(travelled)] for row in (integrated, travelled))
    if not len(travelled):
        return math.nan, math.nan
    moved, size = float(travelled @ travelled), float(integrated @ integrated)
    both = float(integrated @ travelled)
    return (both / math.sqrt(moved * size), both / size) if moved * size > 0.0 else (0.0, 0.0)


def _velocity_against(e: Equation) -> Found:
    return {} if _travels(e)[0] < -0.9 else None


def _velocity_differs(e: Equation) -> Found:
    return {} if abs(_travels(e)[0]) < 0.5 else None


def _velocity_scaled(e: Equation) -> Found:
    correlation, ratio = _travels(e)
    return {"ratio": ratio} if correlation > 0.95 and not 1.0 / SCALED < ratio < SCALED else None


def _driven_against(e: Equation) -> Found:
    return {"by": e.recording_map.signals.acting} if e.correlation(0.0) < -0.5 and e.best[1] < 0.8 else None


def _is_late(e: Equation) -> Found:
    best, correlation = e.best
    rest, now = 1.0 - correlation**2, 1.0 - max(e.correlation(0.0), 0.0) ** 2
    if EARLY < best < LATE or abs(best) > e.latest or correlation < 0.8 or rest > BETTER * now:
        return None
    by, how = e.recording_map.signals.acting, "late" if best > 0.0 else "early"
    return {
        "by": by,
        "samples": abs(best),
        "how": how,
        "delay": e.recording_map.signals.given[by].delay + best * e.t_s,
    }


def _coefficients(e: Equation) -> tuple[dict[str, float], dict[str, float]]:
    """Significant coefficients of the equation at the best delay, divided by J; and the parameters in the map."""
    names, columns = ["k_m", *e.loads], np.stack([e.driven(e.best[0]), *e.loads.values()], axis=1)
    found = np.linalg.lstsq(columns, e.response, rcond=None)[0]
    spread = float(np.mean((e.response - columns @ found) ** 2))
    sure = NONZERO * np.sqrt(np.abs(np.diag(np.linalg.pinv(columns.T @ columns))) * spread)
    significant = {name: c for name, c, least in zip(names, found.tolist(), sure.tolist(), strict=True) if c > least}
    machine = e.recording_map.machine
    return significant, ({} if "k_m" in machine.guess.given else {"k_m": 1.0}) | machine.known.given


def _driven_scaled(e: Equation) -> Found:
    significant, known = _coefficients(e)
    if not {"J", "k_m"} <= {*known} or "k_m" not in significant:
        return None
    ratio = significant["k_m"] * known["J"] / known["k_m"]
    return {"by": e.recording_map.signals.acting, "ratio": ratio} if not 1.0 / WRONG < ratio < WRONG else None


def _is_far(e: Equation) -> Found:
    """Guesses that are beyond the search."""
    significant, known = _coefficients(e)
    inertia = known.get("J") or next((known[name] / c for name, c in significant.items() if name in known), math.nan)
    gears = {"k_1": known.get("gamma", 1.0)}
    values = {"J": inertia} | {name: share * inertia / gears.get(name, 1.0) for name, share in significant.items()}
    wrong = {
        name: values[name]
        for name, guess in e.recording_map.machine.guess.given.items()
        if name in values and abs(math.log(values[name] / guess)) > math.log(FACTOR)
    }
    shown = ", ".join(f"{name} = {value:.2g}" for name, value in wrong.items())
    return {"names": " and ".join(wrong), "values": shown} if wrong else None


EQUATIONS: Checks[Equation] = {
    _velocity_against: "the velocity is against the angle: sign = -1 for one of the two",
    _velocity_differs: "the velocity is not that of the angle: check the columns, or leave that of the velocity out",
    _velocity_scaled: "the angle goes {ratio:.4g} times as far as the velocity says: check unit, scale and the times; "
    "scale of [signals.velocity] times {ratio:.4g} agrees",
    _driven_against: "the motion is against the {by}: sign = -1 for it, or for angle and velocity",
    _is_late: "the {by} acts {samples:.1f} samples {how}, more than is searched: delay = {delay:.2g} in [signals.{by}] "
    "says so",
    _driven_scaled: "the angle moves {ratio:.2g} times as far as the {by} drives it with the known k_m and J: check "
    "the units and scales of angle and {by}, and [machine.known]",
    _is_far: f"the guess of {{names}} is too far off: only a factor of {FACTOR:g} about it is searched; the recording "
    "says about {values}",
}


def contradictions(samples: Floats, currents: Floats, t_s: float, recording_map: RecordingMap) -> tuple[str, ...]:
    """Contradictions of a map by its recording, the cause of others first.

    Samples on the grid and what acted in each period, as the map says; shapes (n + 1, 2) and (n,), sample time in s.
    """
    equation = equation_of(samples, currents, t_s, recording_map)
    return () if equation is None else tuple(found_by(EQUATIONS, equation))
