"""Steps of a commissioning, each from what those before it have found, and their comparison with the data sheet."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnx
from onnx import numpy_helper

from emb_bench.brake.parameters import SI
from emb_bench.commission import examination
from emb_bench.commission.bench_file import contradiction, measured_ranges, not_inside, outside
from emb_bench.commission.records import CurrentCheck, Findings, FirstMove, Identification, Rest
from emb_bench.config.bench import Bench
from emb_runtime.errors import BenchFileError, SafetyStopError
from emb_runtime.policy.contract import CONTRACT_KEY, MIN_VECTORS, SAMPLE, Contract, PolicyLimits, Vector

LISTENING = 4.0  # Time to listen [s]: the noise is to be known better than by the residuals of an experiment
SHORT = 0.2  # Duration of the runs that move nothing [s]
BELOW = 0.5  # Current of the check of the current, as a share of the least that could move any brake of the data sheet
FIRST_MOVE = 1.3  # Largest current of the first move, in multiples of what moves every brake of the data sheet
MOVES = 1.3  # Current of the free stroke, in multiples of what moved this one
REACH = 0.7  # Share of the upper angle limit that an experiment goes to
FULL_SPEED = 0.8  # Share of the speed limit of the last run
SCALE_ERROR = 0.2  # By which reported and commanded current, or angle and velocity, may differ in scale
LAG_ERROR = 0.05  # By which the time constant of the current loop may exceed the data sheet's
NOISE_EXCESS = 1.1  # Noise at rest over the data sheet's, at most: a deviation of 1000 samples is known to 3 %
AT_REST = 8.0  # Standard deviations of the angle's noise within which the brake has not moved
AT_BORDER = 0.1  # Share of a border of the data sheet within which a parameter may be what is wrong there
NEARLY = 1.5  # Mean square of the residuals, in variances of the noise at rest, up to which a model almost fits
RECENT = 2  # Experiments that the parameters are estimated from: each is larger and tells more than those before it
AGAIN = "and begin again in another folder"
SIGNS = (1, -1, 1, 1, -1, -1, 1, -1, -1, 1)  # of the check of the current, five samples each
SHARES = ((1.0, 0.12), (-1.0, 0.12), (0.7, 0.1), (-0.7, 0.1), (1.0, 0.08), (0.5, 0.06), (-1.0, 0.14))
"""Currents of an experiment, out and back, as shares of its limit, and the share of its samples for each."""


class Window(NamedTuple):
    """Window of a step: outside of it no current flows that drives the brake farther out."""

    lowest: float  # Angle [rad]
    highest: float  # Angle [rad]
    speed: float  # [rad/s]


EVERYWHERE = Window(-math.inf, math.inf, math.inf)


@dataclass(frozen=True)
class Step:
    """One guarded run: what is done, and within which limits."""

    purpose: str  # Description of what is done, for the operator
    duration: float  # [s]
    stage: tuple[str, ...]  # Options of ``emb-run`` for what may be sent
    window: Window = EVERYWHERE
    currents: tuple[float, ...] = (0.0,)  # Wanted current by sample [A]; after the last one it stays


def break_away(bench: Bench) -> tuple[float, float]:
    """Least and greatest current that moves some brake of a bench's set from the origin [A]."""
    box = bench.range_set(bench.shield.ranges)
    return box.low.T_c / box.high.k_m, bench.shield.break_away * box.high.T_c / box.low.k_m


# --- the steps ------------------------------------------------------------------------------------------------------


def _listen(_work: Bench, _: Findings) -> Step:
    return Step("listen, send nothing", LISTENING, ("--read-only",))


def _chain(_work: Bench, _: Findings) -> Step:
    return Step("the whole chain with 0 A", SHORT, ("--zero",))


def _current(work: Bench, _: Findings) -> Step:
    amplitude = BELOW * break_away(work)[0]
    return Step(
        f"sign, scale and latency of the current with {1e3 * amplitude:.0f} mA, which moves no brake of the data sheet",
        SHORT,
        ("--limit", repr(amplitude)),  # no way home with a current whose sign and scale are not known yet
        Window(-work.shield.home_angle, work.shield.home_angle, work.shield.home_velocity),
        4 * tuple(amplitude * sign for sign in SIGNS for _ in range(5)),
    )


def _first_move(work: Bench, _: Findings) -> Step:
    most = min(FIRST_MOVE * break_away(work)[1], work.limits.current)
    fifth = work.timing.horizon // 5
    ramp = [most * (k + 1) / fifth for k in range(fifth)]
    return Step(
        f"a current that rises to {most:.2f} A at most until the brake moves, in either direction",
        work.timing.duration,
        ("--limit", repr(most), "--home"),
        Window(-1.0, 1.0, 10.0),
        (*ramp, *[0.0] * (fifth // 5), *[-value for value in ramp], 0.0),
    )


def _experiment(
    words: str, multiple: float, speed: float, stroke: float, highest: float, work: Bench, found: Findings
) -> Step:
    """An experiment with the data sheet's ranges.

    Args:
        words: what it is, for the operator.
        multiple: current, in multiples of that of the free stroke.
        speed: largest [rad/s].
        stroke: share of the free stroke, on the side away from the pads.
        highest: angle [rad].
        work: the bench of the steps.
        found: with the currents of the first move.
    """
    assert found.first_move is not None
    limit = min(multiple * MOVES * max(found.first_move.up, found.first_move.down), work.limits.current)
    window = Window(stroke * work.limits.angle[0], min(highest, REACH * work.limits.angle[1]), speed)
    return _excited(words, work, window, limit)


def _full(bench: Bench, _: Findings) -> Step:
    limits = bench.limits
    window = Window(0.7 * limits.angle[0], REACH * limits.angle[1], FULL_SPEED * limits.velocity)
    return _excited("an experiment with the new bench file", bench, window, limits.current)


def _excited(words: str, bench: Bench, window: Window, limit: float) -> Step:
    """Currents out and back, as :data:`SHARES` has them."""
    timing = bench.timing
    currents = (*(limit * share for share, part in SHARES for _ in range(round(part * timing.horizon))), 0.0)
    purpose = f"{words}: {limit:.2f} A, {window.lowest:.1f} to {window.highest:.1f} rad, {window.speed:g} rad/s"
    return Step(purpose, timing.duration, ("--limit", repr(limit), "--home"), window, currents)


# --- comparison with the data sheet: comparisons are this way round for NaN ------------------------------------------


def suspected(sheet: Bench, found: Findings) -> str:
    """Words for what is wrong in a data sheet where the brake moves as none of its set does."""
    one = found.identified
    others = (
        "look at J and gamma of [brake], at break_away, f_l, current_lag and frame_age of [shield], and whether the "
        "brake turns freely"
    )
    if one is not None and (names := outside(sheet, one)):
        return contradiction(sheet, one, names)
    if one is not None and (names := not_inside(sheet, one, AT_BORDER)):
        return f"{contradiction(sheet, one, names)}; or {others}"
    return f"no parameter that was found lies near a border of [ranges.{sheet.shield.ranges}]: {others}"


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise SafetyStopError(message)


def _judge_rest(rest: Rest, sheet: Bench, found: Findings) -> Findings:
    for name, unit in (("angle", "rad"), ("velocity", "rad/s")):
        got, most = getattr(rest.noise, name), getattr(sheet.noise, name)
        _require(
            got <= NOISE_EXCESS * most,
            f"the {name} scatters by {got:.3g} {unit} at rest, the data sheet's bench file has {most:.3g}, and the "
            f"shield would allow for too little: wait until the brake rests, or correct noise.{name} {AGAIN}",
        )
    _require(
        abs(rest.period / sheet.timing.sample_time - 1.0) <= 0.01,
        f"a sample comes every {rest.period:.6g} s by the node's clock, expected {sheet.timing.sample_time:g} s",
    )
    return replace(found, rest=rest)


def _judge_current(check: CurrentCheck, sheet: Bench, found: Findings) -> Findings:
    _require(
        abs(check.scale - 1.0) <= SCALE_ERROR,
        f"the drive reports {check.scale:.3g} A for 1 A commanded: sign or scale of its current is wrong",
    )
    _require(
        check.moved <= AT_REST * sheet.noise.angle,
        f"the brake moved by {check.moved:.3g} rad under a current that moves no brake of the data sheet: friction is "
        f"lower or the motor stronger (T_c and k_m in [ranges.{sheet.shield.ranges}]), or something else turns it",
    )
    _require_early(check.delay, f"commands act {check.delay} samples late", sheet)
    return replace(found, current=check)


def _require_early(late: int, words: str, sheet: Bench) -> None:
    allowed = sheet.shield.frame_age[1]
    allows = f"the data sheet's bench file allows for {allowed}: correct shield.frame_age"
    _require(late <= allowed, f"{words}, and {allows} {AGAIN}")


def _judge_first_move(move: FirstMove, sheet: Bench, found: Findings) -> Findings:
    _require(
        math.isfinite(move.up) and math.isfinite(move.down),
        "the brake did not move under a current that moves every brake of the data sheet: it is held or not connected, "
        "or friction is greater or the motor weaker "
        f"(T_c and k_m in [ranges.{sheet.shield.ranges}], shield.break_away)",
    )
    _require(
        abs(move.scale - 1.0) <= SCALE_ERROR,
        f"the angle travels {move.scale:.3g} times as far as by the velocity: a sign or scale of a sensor is wrong",
    )
    return replace(found, first_move=move)


def _judge_experiment(one: Identification, sheet: Bench, found: Findings) -> Findings:
    """Compare an estimate with the data sheet.

    The first estimate of a model that only almost fits does not count: a single small experiment does not tell features
    of the friction apart. Of such a model, another constant may be wrong too.
    """
    names = outside(sheet, one)
    if names and one.fits:
        raise BenchFileError(contradiction(sheet, one, names))
    if names and found.identified is not None and one.ratio <= NEARLY:
        raise SafetyStopError("; or ".join((contradiction(sheet, one, names), *one.objections)))
    late = one.command_delay + one.measurement_delay
    delays = f"{one.command_delay} of the command, {one.measurement_delay} of the measurement"
    _require_early(late, f"answers act {late} samples late ({delays})", sheet)
    _require(
        not (one.fits and one.current_lag[0] > (1.0 + LAG_ERROR) * sheet.shield.current_lag),
        f"the current lags by {one.current_lag[0]:.3g} s at least, and the data sheet's bench file allows for "
        f"{sheet.shield.current_lag:g} s: correct shield.current_lag {AGAIN}",
    )
    return replace(found, identified=one)


def _judge_last(last: Identification, sheet: Bench, found: Findings) -> Findings:
    """Compare the run with the bench file that was found with the ranges in it."""
    assert found.identified is not None
    for name, (low, high) in measured_ranges(sheet, found.identified).items():
        got = last.intervals[name]
        _require(
            not last.fits or (got[1] >= low and got[0] <= high),
            f"by the run with the bench file that was found {name} is {got[0]:.4g} to {got[1]:.4g} {SI[name]}, "
            f"in the file {low:.4g} to {high:.4g}: the brake is not the one of the steps before, or changes",
        )
    return found


# --- the table ------------------------------------------------------------------------------------------------------


class Row(NamedTuple):
    """One step: how it is made, how its log is examined, and how what was found compares with the data sheet.

    ``examine`` takes the log and those of the experiments before it; ``judge`` gives the findings with this one, or
    raises SafetyStopError or BenchFileError where it contradicts the data sheet, so that nothing more may be done.
    """

    make: Callable[[Bench, Findings], Step]
    examine: Callable[[Path, Sequence[Path], Bench, Findings], Any]
    judge: Callable[[Any, Bench, Findings], Findings]


def _identified(log: Path, before: Sequence[Path], sheet: Bench, found: Findings) -> Identification:
    assert found.rest is not None
    return examination.identify([*before, log][-RECENT:], sheet, found.rest.noise, found.identified)


def _moved(log: Path, _before: Sequence[Path], _sheet: Bench, found: Findings) -> FirstMove:
    assert found.rest is not None
    return examination.first_move(log, found.rest.noise)


EXPERIMENTS = {
    "5-free-stroke": partial(_experiment, "the free stroke and the contact", 1.0, 30.0, 0.4, 5.0),
    "6-small": partial(_experiment, "a small experiment", 2.0, 80.0, 0.6, 12.0),
    "7-medium": partial(_experiment, "a medium experiment", 3.5, 200.0, 0.7, 30.0),
    "8-large": partial(_experiment, "a large experiment", math.inf, 400.0, 0.7, math.inf),
}
FULL = "9-full"
STEPS: Mapping[str, Row] = {
    "1-listen": Row(_listen, lambda log, _, sheet, _found: examination.at_rest(log, sheet), _judge_rest),
    "2-zero": Row(_chain, lambda *_: None, lambda _finding, _sheet, found: found),
    "3-current": Row(_current, lambda log, *_: examination.current(log), _judge_current),
    "4-first-move": Row(_first_move, _moved, _judge_first_move),
    **{name: Row(make, _identified, _judge_experiment) for name, make in EXPERIMENTS.items()},
    FULL: Row(_full, lambda log, _, *rest: _identified(log, (), *rest), _judge_last),
}
"""The steps in their order."""


# --- their policies -------------------------------------------------------------------------------------------------


GRAPH = """
<ir_version: 10, opset_import: ["" : 20]>
commissioning (float[1, 3] inputs) => (float[1, 1] outputs) {
  angle = Gather <axis = 1> (inputs, first)
  velocity = Gather <axis = 1> (inputs, second)
  time = Gather <axis = 1> (inputs, third)
  step = Mul (time, rate)
  whole = Round (step)
  number = Cast <to = 7> (whole)
  place = Clip (number, begin, last)
  wanted = Gather <axis = 0> (currents, place)
  above = Greater (angle, highest)
  fast_up = Greater (velocity, speed)
  no_more_up = Or (above, fast_up)
  upper = Where (no_more_up, zero, most)
  below = Less (angle, lowest)
  slowest = Neg (speed)
  fast_down = Less (velocity, slowest)
  no_more_down = Or (below, fast_down)
  least = Neg (most)
  lower = Where (no_more_down, zero, least)
  raised = Max (wanted, lower)
  outputs = Min (raised, upper)
}
"""
"""The current of the step, cut to zero on the side that leads out of the window."""


def policy_file(step: Step, bench: Bench) -> bytes:
    """The policy of a step, for a bench: its current, but none that drives the brake farther out of the window."""
    currents, rate = np.asarray(step.currents, np.float32), 1.0 / bench.timing.sample_time
    numbers = {**step.window._asdict(), "rate": rate, "zero": 0.0, "most": bench.limits.current}
    constants = {name: np.array([value], np.float32) for name, value in numbers.items()}
    constants |= {"first": np.array([0]), "second": np.array([1]), "third": np.array([2])}
    constants |= {"begin": np.array(0), "last": np.array(len(currents) - 1), "currents": currents}
    model = onnx.parser.parse_model(GRAPH)
    model.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in constants.items())
    places = np.linspace(0, len(currents) - 1, MIN_VECTORS).astype(int)
    contract = Contract(
        kind="current",
        inputs=SAMPLE,
        limits=PolicyLimits(bench.limits.current, bench.limits.angle, bench.limits.velocity),
        sample_time=bench.timing.sample_time,
        horizon=bench.timing.horizon,
        vectors=tuple(Vector((0.0, 0.0, float(k / rate)), (float(currents[k]),)) for k in places),
        provenance={"commissioning": step.purpose},
    )
    model.metadata_props.add(key=CONTRACT_KEY, value=contract.to_json())
    data: bytes = model.SerializeToString()
    return data
