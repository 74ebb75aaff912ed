"""Bench files of a commissioning: the working file of its steps, and its result.

Both begin as a copy of the data sheet's file. A comment behind each changed number gives its source.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any

import tomlkit
from tomlkit import TOMLDocument

from emb_bench.brake.parameters import SI
from emb_bench.commission.examination import MARGIN
from emb_bench.commission.records import Findings, Identification, Velocity, sheet_range
from emb_bench.config.bench import Bench, parse_bench
from emb_bench.config.plants import FASTEST_LOOP, SHORTEST_LAG
from emb_runtime.config.bench import PARAMETER_NAMES
from emb_runtime.config.typed import parse_toml
from emb_runtime.errors import BenchFileError
from emb_runtime.numbers import between, plain
from emb_runtime.safety.shield_design import SLOWEST_OBSERVER, make_law

SHEET, MEASURED = "sheet", "measured"  # Names of the sets of ranges
WRITTEN = "# Written by emb-commission from a data sheet's bench file. SI units."
"""Mark of a bench file of a commissioning."""
HEAD = f"#:schema ./bench.schema.json\n{WRITTEN}\n# A number without a source behind it is from that file.\n"
UNEXPLAINED = (
    9.0  # Mean square of the residuals, in variances of the noise at rest, above which the sheet's ranges stay
)
WIDENED = 0.1  # Share of its value by which a range exceeds the interval: brakes change as they warm and wear
WIDENED_MISFIT = 0.25  # Share where the residuals contradict every model
NOISE_WIDENED = 1.2  # Factor from a measured standard deviation to the written one
LAG_WIDENED = 1.25  # Factor from the interval of the current loop's time constant to the written bound
NARROWEST, STEP_DOWN = 10.0, 5.0  # Smallest upper angle limit that is tried, and the step between tries [rad]


def working_text(sheet: Bench, velocity: Velocity | None = None) -> str:
    """Bench file of the steps: the data sheet's, with the largest angle limit for which its ranges have a shield.

    Args:
        sheet: the data sheet's bench file.
        velocity: source of the velocity, as found by the free stroke; None before it. If the sheet does not declare the
            source, the slowest observer is then assumed, if there is a shield for it.
    """
    document = _draft(sheet)
    if velocity is not None:
        _put_velocity(document, velocity, "5-free-stroke.mcap")
    elif "sensors" not in document:
        slowest = SLOWEST_OBSERVER / sheet.timing.sample_time
        document.add("sensors", tomlkit.table())
        _put(document, "sensors.velocity", "observer", "assumed until it is measured; not in the data sheet")
        _put(document, "sensors.observer_bandwidth", slowest, "the slowest for which there is a shield")
        with suppress(BenchFileError):
            return _text(document)
        document = _draft(sheet)
    return _text(document)


def found_text(sheet: Bench, found: Findings, logs: str) -> str:
    """Resulting bench file; its comments name ``logs`` as the source.

    Raises:
        BenchFileError: an interval is not inside of the data sheet's range, or no shield covers the ranges.
    """
    current, one = found.current, found.identified
    if names := one.not_inside(sheet):
        raise BenchFileError(one.contradiction(sheet, names))
    document, by_fit = _draft(sheet), f"model {one.model}, {logs}"
    for name in PARAMETER_NAMES:
        low, high, reason = measured_range(sheet, one, name)
        _put(document, f"brake.{name}", _rounded(min(max(one.values[name], low), high)), by_fit)
        interval = f"{between(*one.intervals[name])} {SI[name]}"
        origin = f"total (95 %) without J: {interval}; {reason}"
        _put(document, f"ranges.{MEASURED}.{name}", [low, high], origin)
    document["ranges"][MEASURED].add(tomlkit.nl())
    for name in ("angle", "velocity"):
        at_rest, moving = getattr(found.noise, name), getattr(one.noise, name)
        origin = f"at rest {plain(at_rest)}, of the residuals {plain(moving)}; the larger times {NOISE_WIDENED:g}"
        _put(document, f"noise.{name}", _rounded(NOISE_WIDENED * max(at_rest, moving), up=True), origin)
    age = current.latest + one.measurement_delay
    origin = f"commands act {current.delay} to {current.latest} samples late, measurements {one.measurement_delay}"
    _put(document, "shield.frame_age", [min(age, sheet.shield.frame_age[0]), age], origin)
    _put_velocity(document, one.velocity, logs)
    lag = min(sheet.shield.current_lag, _rounded(LAG_WIDENED * one.current_lag[1], up=True))
    origin = f"total (95 %) up to {plain(one.current_lag[1])} s, times {LAG_WIDENED:g}, at most the data sheet's"
    _put(document, "shield.current_lag", lag, origin)
    _put(document, "shield.ranges", MEASURED, "the measured ones")
    plant: dict[str, float | int] = {name: _rounded(value) for name, value in one.features.items()}
    if (lag := _rounded(0.5 * sum(one.current_lag))) >= SHORTEST_LAG:
        plant["current_lag"] = lag
    if one.velocity.bandwidth:
        plant["observer_bandwidth"] = _rounded(min(one.velocity.bandwidth, FASTEST_LOOP))
    plant |= {"command_delay": current.delay, "measurement_delay": one.measurement_delay}
    for name, value in plant.items():
        _put(document, f"plants.{MEASURED}.{name}", value, by_fit)
    return _text(document)


def measured_range(sheet: Bench, one: Identification, name: str) -> tuple[float, float, str]:
    """Written range of a parameter, and its reason: the interval, widened and limited to the data sheet's range.

    The data sheet's range is kept if no model fits. For the shield k_1 is the clamping force divided by the angle, so a
    curve and a hysteresis of the force widen its range. Play changes the clamping force as a friction does, so with
    play T_c keeps the data sheet's range.
    """
    lowest, highest = sheet_range(sheet, name)
    if not one.fits and one.ratio > UNEXPLAINED:
        times = math.sqrt(one.ratio)
        reason = f"no model explains the experiments; residuals {plain(times)} times the noise: the data sheet's"
        return lowest, highest, reason
    if name == "T_c" and "play" in one.features:
        return lowest, highest, "the data sheet's, as play acts as friction"
    share = WIDENED if one.fits else WIDENED_MISFIT
    reason = f"widened by {share:.0%}{'' if one.fits else ' as no model fits'}"
    low, high = one.intervals[name]
    low, high = low - share * one.values[name], high + share * one.values[name]
    if name == "k_1" and {"quadratic", "cubic", "hysteresis"} & {*one.features}:
        least, greatest = _secants(sheet, one)
        low, high = least * low, greatest * high
        reason += ", and by the curve and hysteresis of the force"
    low, high = max(lowest, _rounded(low)), min(highest, _rounded(high, up=True))
    return low, high, f"{reason}, at most the data sheet's"


def _secants(sheet: Bench, one: Identification) -> tuple[float, float]:
    """Least and greatest clamping force over k_1 times the angle, up to the limit."""
    quadratic, cubic = one.features.get("quadratic", 0.0), one.features.get("cubic", 0.0)
    hysteresis, highest = one.features.get("hysteresis", 0.0), sheet.limits.angle[1]
    curve = [1.0 + quadratic * x + cubic * x * x for x in (highest * k / 20 for k in range(21))]
    return min(curve) * (1.0 - hysteresis), max(curve) * (1.0 + hysteresis)


def _rounded(value: float, *, up: bool = False) -> float:
    """To five digits, down or up, so that a range stays at least as wide."""
    if value == 0.0 or not math.isfinite(value):
        return value
    scale = 10.0 ** (4 - math.floor(math.log10(abs(value))))
    return float(f"{(math.ceil if up else math.floor)(value * scale) / scale:.5g}")


# --- documents ------------------------------------------------------------------------------------------------------


def _draft(sheet: Bench) -> TOMLDocument:
    """The data sheet's document with its ranges as one complete set."""
    document = parse_toml(sheet.text, sheet.name, BenchFileError)
    document["ranges"] = {SHEET: {name: list(sheet_range(sheet, name)) for name in PARAMETER_NAMES}}
    document["shield"] = {**document["shield"], "ranges": SHEET}
    document.pop("estimator", None)  # its default is the shield's ranges
    document.get("plants", {}).pop(MEASURED, None)  # of an earlier commissioning, whose result can be a data sheet
    return tomlkit.parse(tomlkit.dumps(document))


def _put(document: TOMLDocument, path: str, value: Any, origin: str) -> None:
    """Set the value of ``table.key``, with its source as a comment."""
    *tables, key = path.split(".")
    table: Any = document
    for name in tables:
        table = table.setdefault(name, {})
    table[key] = tomlkit.item(value).comment(origin)


def _put_velocity(document: TOMLDocument, velocity: Velocity, logs: str) -> None:
    """Set the source of the velocity, as measured in ``logs``."""
    document.pop("sensors", None)
    document.add("sensors", tomlkit.table())
    _put(document, "sensors.velocity", velocity.sensors.velocity, f"measured with {logs}: {velocity}")
    if velocity.least:
        origin = f"{MARGIN:.0%} of the slowest that cannot be excluded, at most 3/sample_time"
        _put(document, "sensors.observer_bandwidth", _rounded(velocity.least), origin)


def _text(document: TOMLDocument) -> str:
    """Text of a document, its upper angle limit lowered to the largest for which there is a shield.

    Raises:
        BenchFileError: there is none.
    """
    low, high = document.unwrap()["limits"]["angle"]
    highest, refusal = high, None
    while True:
        try:
            make_law(parse_bench(tomlkit.dumps(document), "the bench of a commissioning"))
        except BenchFileError as err:
            refusal = refusal or err
            highest -= STEP_DOWN
            if not highest >= NARROWEST:
                raise refusal from None
            origin = f"{high:g} rad by the data sheet; the largest for which a shield covers the ranges"
            _put(document, "limits.angle", [low, highest], origin)
        else:
            return f"{HEAD}\n{tomlkit.dumps(document)}"
