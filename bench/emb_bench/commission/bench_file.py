"""Bench files of a commissioning: the one that its steps run with, and the one that it finds.

A file is made from the data sheet's; each number that is not the sheet's has its origin behind it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import tomlkit

from emb_bench.brake.parameters import SI
from emb_bench.commission.records import CurrentCheck, Findings, Identification
from emb_bench.config.bench import Bench, parse_bench
from emb_bench.config.plants import SHORTEST_LAG
from emb_runtime.config.bench import LEARNING, PARAMETER_NAMES
from emb_runtime.config.typed import parse_toml
from emb_runtime.errors import BenchFileError
from emb_runtime.safety.shield_design import make_law

SHEET, MEASURED = "sheet", "measured"  # Names of the sets of ranges
WRITTEN = "Written by emb-commission from a data sheet's bench file. SI units."
"""First line of a bench file of a commissioning."""
WIDENED = 0.1  # Share of its value by which a range exceeds the interval: brakes change as they warm and wear
WIDENED_MISFIT = 0.25  # Share where the residuals contradict every model
UNEXPLAINED = 9.0  # Mean square of the residuals, in variances of the noise at rest, from which on nothing is explained
NOISE_WIDENED = 1.2  # Factor from a standard deviation that was measured to the one that is written
LAG_WIDENED = 1.25  # Factor from the interval of the current loop's time constant to the bound that is written
NARROWEST, STEP_DOWN = 10.0, 5.0  # Least upper angle limit that is tried, and by how much each try is lower [rad]
SHEETS = "the data sheet's"


def working_text(sheet: Bench) -> str:
    """Bench file that the steps run with: the data sheet's, its angle as far as its ranges have a shield."""
    draft = _Draft(sheet)
    draft.limit_angle()
    return str(draft)


def found_text(sheet: Bench, found: Findings, logs: Mapping[str, str]) -> str:
    """Bench file that is found; names of logs by their kind: ``rest``, ``current``, ``experiments``."""
    rest, current, one = found.rest, found.current, found.identified
    assert rest is not None
    assert current is not None
    assert one is not None
    draft, how = _Draft(sheet), f"output error, model {one.model}, {logs['experiments']}"
    draft.origins |= dict.fromkeys(("limits.current", "limits.angle", "limits.velocity"), SHEETS)
    for name, (low, high) in measured_ranges(sheet, one).items():
        draft.put(f"brake.{name}", _rounded(min(max(one.values[name], low), high)), how)
        draft.put(f"ranges.{MEASURED}.{name}", [low, high], _origin_of_range(sheet, one, name, (low, high)))
    for name in ("angle", "velocity"):
        at_rest, moving = getattr(rest.noise, name), getattr(one.noise, name)
        draft.put(
            f"noise.{name}",
            _rounded(NOISE_WIDENED * max(at_rest, moving), up=True),
            f"at rest {at_rest:.3g} ({logs['rest']}), in motion {moving:.3g} (residuals); the larger times "
            f"{NOISE_WIDENED:g}",
        )
    age = current.delay + current.uncertain + one.measurement_delay
    unsure = f", and {current.uncertain} as the drive does not say which command it obeyed" if current.uncertain else ""
    draft.put(
        "shield.frame_age",
        [min(age, sheet.shield.frame_age[0]), age],
        f"commands {current.delay} samples late by the node's reports ({logs['current']}), measurements "
        f"{one.measurement_delay} by the best fit{unsure}",
    )
    slowest = one.current_lag[1]
    draft.put(
        "shield.current_lag",
        min(sheet.shield.current_lag, _rounded(LAG_WIDENED * slowest, up=True)),
        f"95 % up to {slowest:.3g} s ({how}), times {LAG_WIDENED:g}, at most {SHEETS}"
        if slowest > 0.0
        else "the experiments ask for none",
    )
    draft.document["shield"]["ranges"] = MEASURED
    draft.origins |= dict.fromkeys(("shield.break_away", "shield.f_l"), f"{SHEETS} bound: not measured by itself")
    draft.origins["systematic.offset"] = f"contact found at {one.contact[0]:.4g} to {one.contact[1]:.4g} rad"
    draft.document.setdefault("plants", {})[MEASURED] = _plant(one, current)
    draft.limit_angle()
    return str(draft)


def _origin_of_range(sheet: Bench, one: Identification, name: str, measured: tuple[float, float]) -> str:
    if _is_unexplained(one):
        return f"{SHEETS}: no model explains the experiments; residuals {math.sqrt(one.ratio):.3g} times the noise"
    low, high = one.intervals[name]
    origin = f"95 %: {low:.5g} to {high:.5g}, widened by {_widening(one):.0%} of the value"
    origin += "" if one.fits else " as no model fits"
    if name == "k_1" and _secants(sheet, one) != (1.0, 1.0):
        origin += ", and by the curve and hysteresis of the force"
    if name == "T_c" and "play" in one.features:
        origin += ", and by the play"
    sides = zip(("below", "above"), measured, _range(sheet, name), strict=True)
    cut = " and ".join(side for side, written, border in sides if written == border)
    return f"{origin}, cut {cut} to {SHEETS} range" if cut else origin


def _plant(one: Identification, current: CurrentCheck) -> dict[str, float | int]:
    """The brake and its instruments as they were found, to simulate and to evaluate with."""
    found: dict[str, float | int] = {name: _rounded(value) for name, value in one.features.items()}
    if (lag := _rounded(0.5 * (one.current_lag[0] + one.current_lag[1]))) >= SHORTEST_LAG:
        found["current_lag"] = lag
    if one.jitter > 0.0:
        found["clock_jitter"] = _rounded(one.jitter)
    delays = {"command_delay": current.delay, "measurement_delay": one.measurement_delay}
    return found | {name: delay for name, delay in delays.items() if delay}


# --- ranges ---------------------------------------------------------------------------------------------------------


def measured_ranges(sheet: Bench, one: Identification) -> dict[str, tuple[float, float]]:
    """Ranges that are written: the intervals, widened and cut to the data sheet's; the data sheet's if no model fits.

    The shield takes k_1 as the clamping force over the angle: a curve and a hysteresis that were found widen its range.
    What play takes from the clamping force or adds to it acts as less or more friction.
    """
    if names := not_inside(sheet, one):
        raise BenchFileError(contradiction(sheet, one, names))
    found = {}
    for name in PARAMETER_NAMES:
        lowest, highest = found[name] = _range(sheet, name)
        if _is_unexplained(one):
            continue
        low, high = one.intervals[name]
        aside = _widening(one) * one.values[name]
        low, high = low - aside, high + aside
        if name == "k_1":
            least, greatest = _secants(sheet, one)
            low, high = least * low, greatest * high
        if name == "T_c":
            low, high = low - _by_play(sheet, one), high + _by_play(sheet, one)
        found[name] = max(lowest, _rounded(low)), min(highest, _rounded(high, up=True))
    return found


def outside(sheet: Bench, one: Identification) -> list[str]:
    """Parameters whose interval and the data sheet's range have nothing in common."""
    return [
        name
        for name, (low, high) in one.intervals.items()
        if high < _range(sheet, name)[0] or low > _range(sheet, name)[1]
    ]


def not_inside(sheet: Bench, one: Identification, margin: float = 0.0) -> list[str]:
    """Parameters whose interval is not known, or not inside of the data sheet's range less a share of each border."""
    found = []
    for name, (low, high) in one.intervals.items():
        lowest, highest = _range(sheet, name)
        if not ((1.0 + margin) * lowest <= low and high <= (1.0 - margin) * highest):  # this way round for NaN
            found.append(name)
    return found


def contradiction(sheet: Bench, one: Identification, names: Sequence[str]) -> str:
    """Words for parameters that may lie outside of the data sheet's ranges, and what to do."""
    values = []
    for name in names:
        (low, high), (lowest, highest) = one.intervals[name], _range(sheet, name)
        values.append(f"{name} is {low:.5g} to {high:.5g} {SI[name]} (data sheet {lowest:.5g} to {highest:.5g})")
    return (
        f"by the estimate {' and '.join(values)}: widen {', '.join(names)} in [ranges.{sheet.shield.ranges}] of the "
        "data sheet's bench file and begin again in another folder"
    )


def _is_unexplained(one: Identification) -> bool:
    return not one.fits and one.ratio > UNEXPLAINED


def _widening(one: Identification) -> float:
    return WIDENED if one.fits else WIDENED_MISFIT


def _secants(sheet: Bench, one: Identification) -> tuple[float, float]:
    """Least and greatest clamping force over k_1 times the angle, up to the limit."""
    quadratic, cubic = one.features.get("quadratic", 0.0), one.features.get("cubic", 0.0)
    hysteresis, highest = one.features.get("hysteresis", 0.0), sheet.limits.angle[1]
    curve = [1.0 + quadratic * x + cubic * x * x for x in (highest * k / 20 for k in range(21))]
    return min(curve) * (1.0 - hysteresis), max(curve) * (1.0 + hysteresis)


def _by_play(sheet: Bench, one: Identification) -> float:
    """Largest torque by which the clamping force differs, through play, from that at the angle [N·m]."""
    quadratic, cubic = one.features.get("quadratic", 0.0), one.features.get("cubic", 0.0)
    highest = sheet.limits.angle[1]
    steepest = one.values["k_1"] * (1.0 + highest * (2.0 * quadratic + 3.0 * cubic * highest))
    return 0.5 * one.features.get("play", 0.0) * sheet.brake.gamma * steepest


def _range(sheet: Bench, name: str) -> tuple[float, float]:
    ends = sheet.range_set(sheet.shield.ranges)
    return getattr(ends.low, name), getattr(ends.high, name)


def _rounded(value: float, *, up: bool = False) -> float:
    """To five digits, down or up, so that a range holds what it held."""
    if value == 0.0 or not math.isfinite(value):
        return value
    scale = 10.0 ** (4 - math.floor(math.log10(abs(value))))
    return float(f"{(math.ceil if up else math.floor)(value * scale) / scale:.5g}")


# --- documents ------------------------------------------------------------------------------------------------------


class _Draft:
    """The data sheet's document with its ranges as one whole set, without the learning shield, and what changes."""

    def __init__(self, sheet: Bench) -> None:
        self.document = parse_toml(sheet.text)
        self.origins: dict[str, str] = {}  # By the path of an entry, ``table.key``
        self.document["ranges"] = {SHEET: {name: list(_range(sheet, name)) for name in PARAMETER_NAMES}}
        shield = self.document["shield"]
        self.document["shield"] = {key: value for key, value in shield.items() if key not in LEARNING}
        self.document["shield"]["ranges"] = SHEET
        self.document.pop("estimator", None)  # it begins with the shield's ranges

    def put(self, path: str, value: Any, origin: str) -> None:
        *tables, key = path.split(".")
        table = self.document
        for name in tables:
            table = table.setdefault(name, {})
        table[key], self.origins[path] = value, origin

    def limit_angle(self) -> None:
        """Lower the upper angle limit to the largest for which there is a shield."""
        low, own = self.document["limits"]["angle"]
        problem = self._shield_problem()
        if problem is None:
            return
        for steps in range(1, int((own - NARROWEST) / STEP_DOWN) + 1):
            origin = f"{own:g} rad by the data sheet; the largest for which a shield covers the ranges"
            self.put("limits.angle", [low, own - steps * STEP_DOWN], origin)
            if self._shield_problem() is None:
                return
        raise problem

    def _shield_problem(self) -> BenchFileError | None:
        try:
            make_law(parse_bench(tomlkit.dumps(self.document), "the bench of a commissioning"))
        except BenchFileError as err:
            return err
        return None

    def __str__(self) -> str:
        """TOML, with its origin behind each entry that has one and is there."""
        written = tomlkit.parse(tomlkit.dumps(self.document))
        for path, origin in self.origins.items():
            *tables, key = path.split(".")
            table: Any = written
            for name in tables:
                table = table.get(name, {})
            if key in table:
                table.value.item(key).comment(origin)
        return f"# {WRITTEN}\n# A number without an origin behind it is that file's.\n\n{tomlkit.dumps(written)}"
