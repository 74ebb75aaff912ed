"""Steps of a commissioning, one after the other: each from what those before it have found.

A pure state machine: :func:`next_step` gives what is to be done, :func:`judged` compares a finding with the data sheet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from emb_bench.commission.bench_file import (
    contradiction,
    learning_possible,
    measured_ranges,
    not_inside,
    outside,
)
from emb_bench.commission.records import (
    CurrentCheck,
    Findings,
    FirstMove,
    Identification,
    Kind,
    Rest,
    Step,
    Window,
)
from emb_bench.config.bench import Bench
from emb_runtime.errors import BenchFileError, SafetyStopError

LISTENING = 4.0  # Time to listen [s]: the noise is to be known better than by the residuals of an experiment
CHAIN = 0.2  # Duration of the run with 0 A [s]
CURRENT_CHECK = 0.2  # Duration of the check of the current [s]
BELOW = 0.5  # Current of that check, as a share of the least that could move any brake of the data sheet
FIRST_MOVE = 1.3  # Largest current of the first move, in multiples of what moves every brake of the data sheet
MOVES = 1.3  # Current of the free stroke, in multiples of what moved this one
SCALE_ERROR = 0.2  # By which reported and commanded current, or angle and velocity, may differ in scale
LAG_ERROR = 0.05  # By which the time constant of the current loop may exceed the data sheet's
NOISE_EXCESS = 1.1  # Noise at rest over the data sheet's, at most: a deviation of 1000 samples is known to 3 %
AT_REST = 8.0  # Standard deviations of the angle's noise within which the brake has not moved
WIDENING = (
    ("5-free-stroke", "the free stroke and the contact", 1.0, 30.0, 0.4, 5.0),
    ("6-small", "a small experiment", 2.0, 80.0, 0.6, 12.0),
    ("7-medium", "a medium experiment", 3.5, 200.0, 0.7, 30.0),
    ("8-large", "a large experiment", math.inf, 400.0, 0.7, math.inf),
)
"""Name, words, current in multiples of that of the free stroke, speed [rad/s], share of the free stroke, angle."""
AT_BORDER = 0.1  # Share of a border of the data sheet within which a parameter may be what is wrong there
REACH = 0.7  # Share of the upper angle limit that an experiment goes to
NEARLY = 1.5  # Mean square of the residuals, in variances of the noise at rest, up to which a model almost fits
FULL_SPEED = 0.8  # Share of the speed limit of the last run
FULL = "9-full"
AGAIN = "and begin again in another folder"


def next_step(sheet: Bench, work: Bench, found: Findings, done: Sequence[str]) -> Step | None:
    """The next step; None after the last one.

    Args:
        sheet: bench file with the data sheet's ranges.
        work: bench file that the steps run with.
        found: so far.
        done: names of the completed steps.
    """
    for step in (_listen(work), _chain(work), _current(work), _first_move(work)):
        if step.name not in done:
            return step
    for row in WIDENING:
        if row[0] not in done:
            return _experiment(work, found, *row)
    return None if FULL in done else _full(sheet)


def judged(step: Step, finding: object, sheet: Bench, found: Findings) -> Findings:
    """Findings with those of one more step.

    Args:
        step: that was done.
        finding: by its log.
        sheet: bench file with the data sheet's ranges.
        found: before it.

    Raises:
        SafetyStopError: it contradicts the data sheet, so that nothing more may be done; the message says how.
        BenchFileError: a parameter lies outside of the data sheet's range.
    """
    match finding:
        case Rest():
            _judge_rest(finding, sheet)
            return replace(found, rest=finding)
        case CurrentCheck():
            _judge_current(finding, sheet)
            return replace(found, current=finding)
        case FirstMove():
            _judge_first_move(finding, sheet)
            return replace(found, first_move=finding)
        case Identification() if step.final:
            _judge_last(finding, found, sheet)
        case Identification():
            _judge_ranges(finding, sheet, is_first=found.identified is None)
            _judge_delays(finding, sheet)
            return replace(found, identified=finding)
    return found


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


def break_away(bench: Bench) -> tuple[float, float]:
    """Least and greatest current that moves some brake of a bench's set from the origin [A]."""
    box = bench.range_set(bench.shield.ranges)
    return box.low.T_c / box.high.k_m, bench.shield.break_away * box.high.T_c / box.low.k_m


# --- the steps ------------------------------------------------------------------------------------------------------


def _listen(work: Bench) -> Step:
    window = Window(*work.limits.angle, work.limits.velocity)
    return Step("1-listen", Kind.REST, "listen, send nothing", "nothing", 0.0, LISTENING, window)


def _chain(work: Bench) -> Step:
    window = Window(*work.limits.angle, work.limits.velocity)
    return Step("2-zero", Kind.CHAIN, "the whole chain with 0 A", "noise and clock at rest", 0.0, CHAIN, window)


def _current(work: Bench) -> Step:
    amplitude = BELOW * break_away(work)[0]
    pattern = [amplitude * sign for sign in (1, -1, 1, 1, -1, -1, 1, -1, -1, 1) for _ in range(5)]
    return Step(
        "3-current",
        Kind.CURRENT,
        f"sign, scale and latency of the current with {1e3 * amplitude:.0f} mA, which moves no brake of the data sheet",
        "least friction and strongest motor of the data sheet",
        amplitude,
        CURRENT_CHECK,
        Window(-work.shield.home_angle, work.shield.home_angle, work.shield.home_velocity),
        tuple(pattern * 4),
    )


def _first_move(work: Bench) -> Step:
    most = min(FIRST_MOVE * break_away(work)[1], work.limits.current)
    quarter = work.timing.horizon // 5
    ramp = [most * (k + 1) / quarter for k in range(quarter)]
    return Step(
        "4-first-move",
        Kind.FIRST_MOVE,
        f"a current that rises to {most:.2f} A at most until the brake moves, in either direction",
        "greatest friction and weakest motor of the data sheet; sign and scale of the current",
        most,
        work.timing.duration,
        Window(-1.0, 1.0, 10.0),
        (*ramp, *[0.0] * (quarter // 5), *[-value for value in ramp], 0.0),
    )


def _experiment(
    work: Bench, found: Findings, name: str, words: str, multiple: float, speed: float, stroke: float, highest: float
) -> Step:
    move, one = found.first_move, found.identified
    assert move is not None
    limit = min(multiple * (MOVES * max(move.up, move.down)), work.limits.current)
    window = Window(stroke * work.limits.angle[0], min(highest, REACH * work.limits.angle[1]), speed)
    rests_on = "the currents of the first move" if one is None else f"the estimate so far (model {one.model})"
    learns = _assumptions_hold(found, work) and learning_possible(work)
    return Step(
        name,
        Kind.EXPERIMENT,
        f"{words}: {limit:.2f} A, {window.lowest:.1f} to {window.highest:.1f} rad, {speed:g} rad/s",
        rests_on + ("; with the learning shield, as it contradicts nothing that this assumes" if learns else ""),
        limit,
        work.timing.duration,
        window,
        _alternating(limit, work.timing.horizon),
        learns=learns,
    )


def _full(sheet: Bench) -> Step:
    limits = sheet.limits
    window = Window(0.7 * limits.angle[0], REACH * limits.angle[1], FULL_SPEED * limits.velocity)
    return Step(
        FULL,
        Kind.EXPERIMENT,
        f"an experiment with the bench file that was found: {limits.current:g} A, up to {window.highest:.0f} rad and "
        f"{window.speed:.0f} rad/s",
        "all of it",
        limits.current,
        sheet.timing.duration,
        window,
        _alternating(limits.current, sheet.timing.horizon),
        final=True,
    )


def _alternating(current: float, horizon: int) -> tuple[float, ...]:
    """Currents of both signs and several sizes, out and back, in about four fifths of an experiment."""
    shares = ((1.0, 0.12), (-1.0, 0.12), (0.7, 0.1), (-0.7, 0.1), (1.0, 0.08), (0.5, 0.06), (-1.0, 0.14))
    currents = [current * share for share, part in shares for _ in range(round(part * horizon))]
    return (*currents, 0.0)


def _assumptions_hold(found: Findings, work: Bench) -> bool:
    """True if nothing that was found contradicts what the learning shield assumes."""
    one = found.identified
    if one is None or found.current is None:
        return False
    late = found.current.delay + one.measurement_delay
    plain = one.fits and late == 0 and one.current_lag[1] == 0.0 and not one.features
    return plain and not not_inside(work, one)


# --- comparison with the data sheet: comparisons are this way round for NaN ------------------------------------------


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise SafetyStopError(message)


def _judge_rest(rest: Rest, sheet: Bench) -> None:
    for name, got, most, unit in (
        ("angle", rest.noise.angle, sheet.noise.angle, "rad"),
        ("velocity", rest.noise.velocity, sheet.noise.velocity, "rad/s"),
    ):
        _require(
            got <= NOISE_EXCESS * most,
            f"the {name} scatters by {got:.3g} {unit} at rest, the data sheet's bench file has {most:.3g}, and the "
            f"shield would allow for too little: correct noise.{name} {AGAIN}",
        )
    _require(
        abs(rest.period / sheet.timing.sample_time - 1.0) <= 0.01,
        f"a sample comes every {rest.period:.6g} s by the node's clock, expected {sheet.timing.sample_time:g} s",
    )


def _judge_current(check: CurrentCheck, sheet: Bench) -> None:
    _require(
        abs(check.scale - 1.0) <= SCALE_ERROR,
        f"the drive reports {check.scale:.3g} A for 1 A commanded: sign or scale of its current is wrong",
    )
    _require(
        check.moved <= AT_REST * sheet.noise.angle,
        f"the brake moved by {check.moved:.3g} rad under a current that moves no brake of the data sheet: friction is "
        f"lower or the motor stronger (T_c and k_m in [ranges.{sheet.shield.ranges}]), or something else turns it",
    )
    _require(
        check.delay <= sheet.shield.frame_age[1],
        f"commands act {check.delay} samples late, and the data sheet's bench file allows for "
        f"{sheet.shield.frame_age[1]}: correct shield.frame_age {AGAIN}",
    )


def _judge_first_move(move: FirstMove, sheet: Bench) -> None:
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


def _judge_ranges(one: Identification, sheet: Bench, *, is_first: bool) -> None:
    """Refuse an estimate outside of the data sheet's ranges.

    The first estimate of a model that only almost fits does not count: a single small experiment does not tell features
    of the friction apart. Of such a model, another constant may be wrong too.
    """
    names = outside(sheet, one)
    if names and one.fits:
        raise BenchFileError(contradiction(sheet, one, names))
    if names and not is_first and one.ratio <= NEARLY:
        raise SafetyStopError("; or ".join((contradiction(sheet, one, names), *one.objections)))


def _judge_delays(one: Identification, sheet: Bench) -> None:
    late, allowed = one.command_delay + one.measurement_delay, sheet.shield.frame_age[1]
    _require(
        late <= allowed,
        f"answers act {late} samples late ({one.command_delay} of the command, {one.measurement_delay} of the "
        f"measurement), and the data sheet's bench file allows for {allowed}: correct shield.frame_age {AGAIN}",
    )
    slowest = (1.0 + LAG_ERROR) * sheet.shield.current_lag
    _require(
        not (one.fits and one.current_lag[0] > slowest),
        f"the current lags by {one.current_lag[0]:.3g} s at least, and the data sheet's bench file allows for "
        f"{sheet.shield.current_lag:g} s: correct shield.current_lag {AGAIN}",
    )


def _judge_last(last: Identification, found: Findings, sheet: Bench) -> None:
    """Compare the run with the bench file that was found with the ranges in it."""
    assert found.identified is not None
    for name, (low, high) in measured_ranges(sheet, found.identified).items():
        got = last.intervals[name]
        _require(
            not last.fits or (got[1] >= low and got[0] <= high),
            f"by the run with the bench file that was found {name} is {got[0]:.4g} to {got[1]:.4g} {last.units[name]}, "
            f"in the file {low:.4g} to {high:.4g}: the brake is not the one of the steps before, or changes",
        )
