"""Comparison of what was found with the data sheet: a contradiction ends the commissioning.

Comparisons are this way round for NaN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from emb_bench.brake.parameters import SI
from emb_bench.commission.records import CurrentCheck, FirstMove, Identification, Velocity
from emb_bench.config.bench import Bench
from emb_runtime.config.bench import Noise, Sensors
from emb_runtime.errors import BenchFileError, SafetyStopError
from emb_runtime.numbers import between, plain

SCALE_ERROR = 0.2  # By which reported and commanded current, or angle and velocity, may differ in scale
LAG_ERROR = 0.05  # By which the time constant of the current loop may exceed the data sheet's
NOISE_EXCESS = 1.1  # Noise at rest over the data sheet's, at most: a deviation of 1000 samples is known to 3 %
AT_REST = 8.0  # Standard deviations of the angle's noise within which the brake has not moved
AT_BORDER = 0.1  # Share of a border of the data sheet within which a parameter may be what is wrong there
NEARLY = 1.5  # Mean square of the residuals, in variances of the noise at rest, up to which a model almost fits
AGAIN = "and begin again in another folder"


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise SafetyStopError(message)


def check_noise(noise: Noise, sheet: Bench) -> None:
    """Refuse more noise at rest than the data sheet's; SafetyStopError."""
    for name, unit in (("angle", "rad"), ("velocity", "rad/s")):
        got, most = getattr(noise, name), getattr(sheet.noise, name)
        _require(
            got <= NOISE_EXCESS * most,
            f"the {name} scatters by {plain(got)} {unit} at rest, the data sheet's bench file has {plain(most)}, and "
            f"the shield would allow for too little: wait until the brake rests, or correct noise.{name} {AGAIN}",
        )


def check_current(check: CurrentCheck, sheet: Bench) -> None:
    """Refuse a current of a wrong sign or scale, a motion, and late commands; SafetyStopError."""
    _require(
        abs(check.scale - 1.0) <= SCALE_ERROR,
        f"the drive reports {plain(check.scale)} A for 1 A commanded: sign or scale of its current is wrong",
    )
    _require(
        check.moved <= AT_REST * sheet.noise.angle,
        f"the brake moved by {plain(check.moved)} rad under a current that moves no brake of the data sheet: friction "
        f"is lower or the motor stronger (T_c and k_m in [ranges.{sheet.shield.ranges}]), or something else turns it",
    )
    _require_early(check.delay, f"commands act {check.delay} samples late", sheet)


def _require_early(late: int, words: str, sheet: Bench) -> None:
    allowed = sheet.shield.frame_age[1]
    allows = f"the data sheet's bench file allows for {allowed}: correct shield.frame_age"
    _require(late <= allowed, f"{words}, and {allows} {AGAIN}")


def check_first_move(move: FirstMove, sheet: Bench) -> None:
    """Refuse a brake that did not move, and an angle that is not the velocity's integral; SafetyStopError."""
    _require(
        math.isfinite(move.up) and math.isfinite(move.down),
        "the brake did not move under a current that moves every brake of the data sheet: it is held or not connected, "
        "or friction is greater or the motor weaker "
        f"(T_c and k_m in [ranges.{sheet.shield.ranges}], shield.break_away)",
    )
    _require(
        abs(move.scale - 1.0) <= SCALE_ERROR,
        f"the angle travels {plain(move.scale)} times as far as by the velocity: a sign or scale of a sensor is wrong",
    )


def check_velocity(velocity: Velocity, declared: Sensors) -> None:
    """Refuse a velocity that an observer derives from the angle more slowly than is declared; SafetyStopError."""
    _require(
        not velocity.least or velocity.most >= (declared.bandwidth or math.inf),
        f"the velocity is {velocity}, and the bench file declares {declared}: declare velocity = "
        f'"observer" and observer_bandwidth = {velocity.least:.0f} in [sensors] {AGAIN}',
    )


def check_experiment(one: Identification, sheet: Bench, *, is_first: bool) -> None:
    """Compare an estimate with the data sheet.

    The first estimate of a model that only almost fits does not count: a single small experiment does not tell features
    of the friction apart. Of such a model, another constant may be wrong too.

    Raises:
        BenchFileError: a parameter lies outside of its range.
        SafetyStopError: it may do so, or a delay or lag is longer than the bench file allows for.
    """
    names = outside(sheet, one)
    if names and one.fits:
        raise BenchFileError(contradiction(sheet, one, names))
    if names and not is_first and one.ratio <= NEARLY:
        raise SafetyStopError("; or ".join((contradiction(sheet, one, names), *one.objections)))
    late = one.command_delay + one.measurement_delay
    delays = f"{one.command_delay} of the command, {one.measurement_delay} of the measurement"
    _require_early(late, f"answers act {late} samples late ({delays})", sheet)
    _require(
        not (one.fits and one.current_lag[0] > (1.0 + LAG_ERROR) * sheet.shield.current_lag),
        f"the current lags by {plain(one.current_lag[0])} s at least, and the data sheet's bench file allows for "
        f"{sheet.shield.current_lag:g} s: correct shield.current_lag {AGAIN}",
    )


def check_last(last: Identification, bench: Bench) -> None:
    """Compare the run with the bench file that was found with the ranges in it; SafetyStopError."""
    for name, got in last.intervals.items():
        low, high = sheet_range(bench, name)
        _require(
            not last.fits or (got[1] >= low and got[0] <= high),
            f"by the run with the bench file that was found {name} is {between(*got)} {SI[name]}, "
            f"in the file {plain(low, 4)} to {plain(high, 4)}: the brake is not that of the steps before, or changes",
        )


# --- parameters -----------------------------------------------------------------------------------------------------


def sheet_range(bench: Bench, name: str) -> tuple[float, float]:
    """Range of a parameter in the set of a bench's shield."""
    ends = bench.range_set(bench.shield.ranges)
    return getattr(ends.low, name), getattr(ends.high, name)


def outside(sheet: Bench, one: Identification) -> list[str]:
    """Parameters whose interval and the data sheet's range have nothing in common."""
    ranges = {name: sheet_range(sheet, name) for name in one.intervals}
    return [name for name, (low, high) in one.intervals.items() if high < ranges[name][0] or low > ranges[name][1]]


def not_inside(sheet: Bench, one: Identification, margin: float = 0.0) -> list[str]:
    """Parameters whose interval is not known, or not inside of the data sheet's range less a share of each border."""
    found = []
    for name, (low, high) in one.intervals.items():
        lowest, highest = sheet_range(sheet, name)
        if not ((1.0 + margin) * lowest <= low and high <= (1.0 - margin) * highest):  # this way round for NaN
            found.append(name)
    return found


def contradiction(sheet: Bench, one: Identification, names: Sequence[str]) -> str:
    """Words for parameters that may lie outside of the data sheet's ranges, and what to do."""
    values = []
    for name in names:
        lowest, highest = (plain(end, 5) for end in sheet_range(sheet, name))
        values.append(f"{name} is {between(*one.intervals[name])} {SI[name]} (data sheet {lowest} to {highest})")
    return (
        f"by the estimate {' and '.join(values)}: widen {', '.join(names)} in [ranges.{sheet.shield.ranges}] of the "
        "data sheet's bench file and begin again in another folder"
    )


def suspected(sheet: Bench, one: Identification | None) -> str:
    """Words for what is wrong in a data sheet where the brake moves as none of its set does."""
    others = (
        "J and gamma of [brake], at break_away, f_l, current_lag and frame_age of [shield], and whether the brake "
        "turns freely"
    )
    if one is None:
        return f"no parameter was found yet: look at all of [ranges.{sheet.shield.ranges}] first, then at {others}"
    if names := not_inside(sheet, one, AT_BORDER):
        return f"{contradiction(sheet, one, names)}; or look at {others}"
    return f"no parameter that was found lies near a border of [ranges.{sheet.shield.ranges}]: look at {others}"
