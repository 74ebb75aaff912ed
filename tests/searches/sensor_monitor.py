"""False alarms and detection of the sensor monitor: the figures of docs/explanation/sensor-monitor.md.

    python -m tests.searches.sensor_monitor [--experiments 1000000] [--faulty 400] [--seed 0]

Flies honest brakes of the set through the shield and the monitor, by each plant that the shield covers, and counts the
alarms; then brakes whose sensors or motor are at fault, and prints how far they get until the run and their motion end.
Nothing but the monitor judges here: not the plausibility of each sample, not the limits, not the node.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from emb_bench.brake.motion import SENSITIVE, STATES
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import Instruments, Mechanics
from emb_bench.sim.instruments import MEMORY as INSTRUMENTS_MEMORY
from emb_bench.sim.instruments import command, settle
from emb_bench.sim.simulated_brake import pass_period, sent_current
from emb_runtime.config.bench import BrakeParameters, Sensors
from emb_runtime.safety.sensor_monitor import (
    HONEST,
    begin_monitor,
    coasting_time,
    judge,
    lag_angle,
    largest_current,
    unseen_speed,
)
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield import NO_PAST, Past, damped_current
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from tests.properties.shield_search import (
    bang_bang,
    chatter,
    constant,
    draw_brakes,
    far_then_reverse,
    few_reversals,
    levels,
    nothing,
    of_plant,
    periodic,
    wait_then_push,
    white,
    within_stiffness,
)

Floats = NDArray[np.float64]
Codes = NDArray[np.int64]
Generator = np.random.Generator

CHUNK = 5000
STOP = 300  # periods in which the node brings the brake to rest
DUTY_PERIOD = 20  # samples

FULL_CURRENT = (bang_bang, constant, far_then_reverse, few_reversals)
MOVING = (*FULL_CURRENT, white, levels, chatter, periodic, wait_then_push)
POLICIES = (*MOVING, nothing)
Policies = tuple[Callable[[Generator, int, int], Floats], ...]
# What happens to a period.
OBEYED, COMMAND_LOST, SAMPLE_LOST = range(3)
# What is at fault.
(
    NOTHING,
    ANGLE_DRIFT,
    VELOCITY_OFFSET,
    VELOCITY_SCALE,
    BOTH_OFFSET,
    BOTH_SCALE,
    MOTOR_REVERSED,
    ANGLE_REVERSED,
    VELOCITY_REVERSED,
    BOTH_REVERSED,
    ANGLE_FROZEN,
    VELOCITY_FROZEN,
    BOTH_FROZEN,
) = range(13)
# Columns of a result row; the last two are each followed by a highest angle: where the node brakes at once, and where a
# brake that moves against the current is left to friction first.
VERDICT, STEP, TRAVEL, MOTION, SHOWN_AT, LOWEST, HIGHEST, FASTEST, HALTED = range(9)
COASTED = HALTED + 2
COLUMNS = COASTED + 2


class Script(NamedTuple):
    """Draws for a chunk of experiments; the first axis counts them, the second samples."""

    brakes: Floats
    wanted: Floats  # [A]
    errors: Floats  # Of angle [rad], velocity [rad/s] and instant [s]
    losses: Codes
    kinds: Codes  # Fault of each
    sizes: Floats
    duties: Floats
    onsets: Codes  # Sample with which the fault begins


def lie(kind: int, size: float, ts: float, told: Floats, angle: float, velocity: float, before: float) -> None:
    """Readings of faulty sensors, in place: ``told`` is angle [rad], velocity [rad/s] and the angle's error so far."""
    if kind in (ANGLE_DRIFT, BOTH_OFFSET):
        told[2] += size * ts
    if kind == BOTH_SCALE:
        told[2] += (size - 1.0) * (angle - before)
    frozen_angle, frozen_velocity = told[0], told[1]
    told[0], told[1] = angle + told[2], velocity
    if kind in (VELOCITY_OFFSET, BOTH_OFFSET):
        told[1] += size
    if kind in (VELOCITY_SCALE, BOTH_SCALE):
        told[1] *= size
    if kind in (ANGLE_REVERSED, BOTH_REVERSED):
        told[0] = -angle
    if kind in (VELOCITY_REVERSED, BOTH_REVERSED):
        told[1] = -velocity
    if kind in (ANGLE_FROZEN, BOTH_FROZEN):
        told[0] = frozen_angle
    if kind in (VELOCITY_FROZEN, BOTH_FROZEN):
        told[1] = frozen_velocity


def moved(
    mechanics: Mechanics,
    instruments: Instruments,
    p: BrakeParameters,
    ts: float,
    current: float,
    errors: Floats,
    x: Floats,
    instrument: Floats,
) -> tuple[float, float]:
    """Measured angle [rad] and velocity [rad/s] at the end of a sample period, see :func:`pass_period`."""
    none, e = np.zeros(0, np.int64), (errors[0], errors[1], errors[2])
    return pass_period(mechanics, instruments, p, ts, current, e, x, none, np.zeros((0, SENSITIVE)), instrument)


def passed(
    law: ShieldLaw,
    mechanics: Mechanics,
    instruments: Instruments,
    p: BrakeParameters,
    u: float,
    past: Past,
    errors: Floats,
    x: Floats,
    instrument: Floats,
) -> tuple[float, float, float, Past]:
    """A period in which the node is sent ``u`` [A], NaN for nothing.

    Returns:
        Measured angle [rad] and velocity [rad/s] at its end, the current that acted [A], and the commands sent so far.
    """
    asked = command(instruments, instrument, u)
    felt = damped_current(x[1], law.current, law.damping_velocity) if math.isnan(asked) else asked
    angle, velocity = moved(mechanics, instruments, p, law.sample_time, felt, errors, x, instrument)
    return angle, velocity, felt, (0.0 if math.isnan(u) else u, past[0], past[1], past[2], past[3])


def fly(
    law: ShieldLaw,
    limits: SensorThresholds,
    mechanics: Mechanics,
    instruments: Instruments,
    script: Script,
    first: bool,
    out: Floats,
) -> None:
    """Fly each experiment, until its end or the monitor's verdict, and to rest; ``first`` limits the first move."""
    ts = law.sample_time
    instrument = np.zeros(INSTRUMENTS_MEMORY)
    x, halted, told = np.zeros(STATES), np.zeros(STATES), np.zeros(3)
    for m in range(out.shape[0]):
        b = script.brakes[m]
        p = BrakeParameters(b[0], b[1], b[2], b[3], b[4], b[5])
        kind, sign = script.kinds[m], -1.0 if script.kinds[m] == MOTOR_REVERSED else 1.0
        row = out[m]
        row[:] = 0.0
        row[STEP], row[SHOWN_AT] = law.steps, -1.0
        x[:], told[:] = 0.0, 0.0
        settle(instruments, instrument, 0.0)
        angle = script.errors[m, 0, 0] + instruments.encoder_offset
        velocity = script.errors[m, 0, 1]
        lie(kind if script.onsets[m] == 0 else NOTHING, script.sizes[m], ts, told, angle, velocity, angle)
        state = begin_monitor(told[0], told[1])
        past = NO_PAST
        periods, obeyed, sent, felt = 0, False, 0.0, 0.0
        verdict = HONEST
        for k in range(law.steps):
            limit = largest_current(law, limits, state, law.current) if first else law.current
            u, _ = sent_current(law, True, told[0], told[1], script.wanted[m, k], past, k, limit)
            if periods > 0 or script.losses[m, k] == COMMAND_LOST:
                u = math.nan
            own = damped_current(
                told[1] if kind in (VELOCITY_REVERSED, BOTH_REVERSED) else x[1], law.current, law.damping_velocity
            )
            if periods == 0:
                obeyed, sent = not math.isnan(u), 0.0 if math.isnan(u) else u
            periods += 1
            asked = command(instruments, instrument, u)
            felt = own if math.isnan(asked) else asked
            past = (0.0 if math.isnan(u) else u, past[0], past[1], past[2], past[3])
            e = script.errors[m, k + 1]
            before = angle
            angle, velocity = moved(mechanics, instruments, p, ts, sign * felt, e, x, instrument)
            row[LOWEST], row[HIGHEST] = min(row[LOWEST], x[0]), max(row[HIGHEST], x[0])
            row[FASTEST] = max(row[FASTEST], abs(x[1]))
            since = k + 1 - script.onsets[m]
            on = since >= 0 and since % DUTY_PERIOD < script.duties[m] * DUTY_PERIOD
            lie(kind if on else NOTHING, script.sizes[m], ts, told, angle, velocity, before)
            if script.losses[m, k] == SAMPLE_LOST and k < law.steps - 1:
                continue
            follows = obeyed and periods == 1
            state, verdict = judge(law, limits, state, periods * ts, told[0], told[1], follows, sent, felt)
            periods = 0
            travel = max(
                state.travel.up - lag_angle(limits, state.velocity - state.up_from),
                state.travel.down - lag_angle(limits, state.down_from - state.velocity),
            )
            row[TRAVEL] = max(row[TRAVEL], travel / limits.travel)
            row[MOTION] = max(row[MOTION], max(state.motion.up, state.motion.down) / limits.motion)
            if row[SHOWN_AT] < 0.0 and state.obeys:
                row[SHOWN_AT] = k + 1
            if verdict != HONEST:
                row[VERDICT], row[STEP] = verdict, k + 1
                break
        if verdict != HONEST:
            halted[:] = x
            halt(law, mechanics, instruments, p, kind, 0.0, halted, instrument, row, HALTED)
            unseen = unseen_speed(law, limits, state)
            waits = coasting_time(law, told[0], told[1], unseen) if not state.obeys else 0.0
            halt(law, mechanics, instruments, p, kind, waits, x, instrument, row, COASTED)


def halt(
    law: ShieldLaw,
    mechanics: Mechanics,
    instruments: Instruments,
    p: BrakeParameters,
    kind: int,
    waits: float,
    x: Floats,
    instrument: Floats,
    row: Floats,
    column: int,
) -> None:
    """Let a brake go without a current for some time, then let its node brake; its extremes go to ``row``."""
    row[column], row[column + 1] = row[LOWEST], row[HIGHEST]
    for k in range(STOP):
        seen = -x[1] if kind in (VELOCITY_REVERSED, BOTH_REVERSED, MOTOR_REVERSED) else x[1]
        u = 0.0 if k * law.sample_time < waits else damped_current(seen, law.current, law.damping_velocity)
        moved(mechanics, instruments, p, law.sample_time, u, np.zeros(3), x, instrument)
        row[column], row[column + 1] = min(row[column], x[0]), max(row[column + 1], x[0])


def draw(
    rng: Generator,
    bench: Bench,
    m: int,
    plant: str = "euler",
    *,
    kind: int = NOTHING,
    size: float = 0.0,
    duty: float = 1.0,
    onset: int = 0,
    policies: Policies = POLICIES,
) -> Script:
    """A chunk of experiments: brakes of the set (half of them its corners), policies, noise and losses.

    A fault of some kind and size begins up to the sample ``onset`` and acts for a share ``duty`` of the time.
    """
    n, limit = bench.timing.horizon, bench.limits.current
    chosen = rng.integers(0, len(policies), m)
    wanted = np.empty((m, n))
    for j, policy in enumerate(policies):
        where = np.flatnonzero(chosen == j)
        wanted[where] = limit * policy(rng, len(where), n)
    shape = (m, n + 1, 2)
    flat = rng.random((m, 1, 1)) < 0.5
    unit = np.where(flat, rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), shape), rng.standard_normal(shape))
    errors = np.zeros((m, n + 1, 3))
    errors[:, :, :2] = unit * [bench.noise.angle, bench.noise.velocity]
    box, farthest = bench.range_set(bench.shield.ranges), bench.limits.angle[1]
    brakes = draw_brakes(rng, within_stiffness(box, of_plant(bench.plant(plant).mechanics), farthest), m)
    losses = np.zeros((m, n), np.int64)
    rate = np.where(rng.random((m, 1)) < 0.5, 0.0, 0.2 * rng.random((m, 1)) ** 3)
    losses[rng.random((m, n)) < rate] = COMMAND_LOST
    losses[rng.random((m, n)) < rate] = SAMPLE_LOST
    return Script(
        brakes=brakes,
        wanted=wanted,
        errors=errors,
        losses=losses,
        kinds=np.full(m, kind),
        sizes=np.full(m, size),
        duties=np.full(m, duty),
        onsets=rng.integers(0, onset + 1, m),
    )


def results(bench: Bench, script: Script, plant: str = "euler", first: bool = True) -> Floats:
    """Fly a script with a plant of the bench; a row of results per experiment."""
    law = make_law(bench)
    chosen = bench.plant(plant)
    out = np.zeros((len(script.brakes), COLUMNS))
    compiled(fly)(law, sensor_thresholds(bench, law), chosen.mechanics, chosen.instruments, script, first, out)
    return out


COVERED: dict[str, dict[str, Any]] = {
    "euler": {},
    "exact": {},
    "stribeck": {"break_away": 1.2},
    "load": {"break_away": 1.2, "f_l": 2e-6},
    "cubic": {},
    "hysteresis": {},
    "lag": {"current_lag": 0.002},
    "late": {"frame_age": (2, 2)},
    "offset": {},
    "jitter": {},
    "observer": {},
    "rough": {"break_away": 1.2, "f_l": 1e-6, "current_lag": 0.002},
}
"""Plants of the bench, and what its shield must declare to cover them."""
WEIGHT = {"euler": 4, "exact": 2}  # Shares of the experiments; one for the others


def covered(bench: Bench, plant: str) -> Bench:
    """The bench with a shield that covers a plant; a lag, or frames two samples late, leave no observer."""
    declared = COVERED[plant]
    sensors = Sensors() if {"current_lag", "frame_age"} & declared.keys() else bench.sensors
    return replace(bench, shield=bench.shield._replace(**declared), sensors=sensors)


def tail(values: Floats, rate: float = 1e-6) -> float:
    """Level that a maximum passes with the probability ``rate``, by an exponential fit to its largest thousandth."""
    ordered = np.sort(values)
    k = max(len(ordered) // 1000, 20)
    base = ordered[-k]
    return float(base + (ordered[-k:] - base).mean() * math.log(k / len(ordered) / rate))


def show_false_alarms(bench: Bench, n: int, seed: int) -> int:
    """Alarms on honest experiments, which are counted, and the tails of the sums, in shares of the thresholds."""
    alarms = 0
    print(
        "Honest experiments: alarms; largest sums and their level of 1e-6, in shares of the thresholds; sign seen after"
    )
    print("| plant | experiments | alarms | travel | 1e-6 | motion | 1e-6 | sign shown: median | 99 % | never |")
    print("|---|---|---|---|---|---|---|---|---|---|", flush=True)
    rng = np.random.default_rng(seed)
    total = sum(WEIGHT.get(plant, 1) for plant in COVERED)
    for plant in COVERED:
        case = covered(bench, plant)
        jitter = bench.plant(plant).instruments.clock_jitter
        count = max(n * WEIGHT.get(plant, 1) // total, 1)
        rows = []
        for done in range(0, count, CHUNK):
            script = draw(rng, case, min(CHUNK, count - done), plant)
            script.errors[:, :, 2] = jitter * rng.standard_normal(script.errors.shape[:2])
            rows.append(results(case, script, plant))
        r = np.concatenate(rows)
        travel, motion = r[:, TRAVEL], r[:, MOTION]
        alarms += int(np.count_nonzero(r[:, VERDICT]))
        at = r[r[:, SHOWN_AT] > 0.0, SHOWN_AT] * case.timing.sample_time * 1e3
        print(
            f"| {plant} | {len(r)} | {np.count_nonzero(r[:, VERDICT])} | {travel.max():.2f} | {tail(travel):.2f} | "
            f"{motion.max():.2f} | {tail(motion):.2f} | {np.median(at):.0f} ms | "
            f"{np.quantile(at, 0.99):.0f} ms | {1.0 - len(at) / len(r):.1%} |",
            flush=True,
        )
    what = f"sensor monitor: {n:,} honest experiments over {len(COVERED)} plants"
    print(f"| {what}: with an alarm | 1 of 10,000 | {alarms} |")
    return alarms


FAULTS: dict[str, tuple[int, tuple[float, ...], int]] = {
    "angle drifts [rad/s]": (ANGLE_DRIFT, (5, 10, 20, 30, 45, 100, -30), 250),
    "velocity is off [rad/s]": (VELOCITY_OFFSET, (5, 10, 20, 40, 100, -40), 250),
    "velocity is scaled": (VELOCITY_SCALE, (0.3, 0.5, 0.8, 0.9, 1.1, 1.5, 3), 250),
    "both are scaled": (BOTH_SCALE, (0.3, 0.4, 0.5, 0.7, 1.5, 2, 3), 0),
    "both drift alike [rad/s]": (BOTH_OFFSET, (5, 20, 40, 100), 250),
    "motor reversed": (MOTOR_REVERSED, (1,), 0),
    "angle reversed": (ANGLE_REVERSED, (1,), 0),
    "velocity reversed": (VELOCITY_REVERSED, (1,), 0),
    "both reversed": (BOTH_REVERSED, (1,), 0),
    "angle frozen": (ANGLE_FROZEN, (1,), 250),
    "velocity frozen": (VELOCITY_FROZEN, (1,), 250),
    "both frozen": (BOTH_FROZEN, (1,), 250),
    "both frozen from the start": (BOTH_FROZEN, (1,), 0),
}
"""Kind and sizes of each fault, and the last sample with which it may begin."""
DUTIES = (0.1, 0.5, 0.9)
MAY_HIDE = ("both are scaled", "both drift alike [rad/s]")  # As another brake of the set, or until it rests
SMALL = 5  # rad/s, of an angle that drifts or a velocity that is off


def show_detection(bench: Bench, n: int, seed: int) -> bool:
    """Time to detection, and where the true brake has been, by the kind and the size of a fault.

    Returns:
        Whether one that acts all the time at full current stays unseen more often than the page says.
    """
    hides = False
    rng = np.random.default_rng(seed)
    ms = bench.timing.sample_time * 1e3
    print(f"\nFaults, {n} brakes of the set each: policies that use the full current, then any policy that moves")
    print("| fault | size | duty | seen | median | 90 % | true angle | speed | any: seen | 90 % | true angle | speed |")
    print("|---|---|---|---|---|---|---|---|---|---|---|---|", flush=True)
    for name, (kind, sizes, onset) in FAULTS.items():
        cases = [(size, 1.0) for size in sizes]
        if kind in (ANGLE_DRIFT, VELOCITY_OFFSET, VELOCITY_SCALE):
            cases += [(sizes[3], duty) for duty in DUTIES]
        for size, duty in cases:
            line = f"| {name} | {size:g} | {duty:.0%} |"
            for policies in (FULL_CURRENT, MOVING):
                script = draw(rng, bench, n, kind=kind, size=size, duty=duty, onset=onset, policies=policies)
                r = results(bench, script)
                line += _detected(r, script.onsets, ms, median=policies is FULL_CURRENT)
                if policies is FULL_CURRENT and duty == 1.0 and size != SMALL and name not in MAY_HIDE:
                    hides |= bool(np.mean(r[:, VERDICT] != HONEST) < 0.98)
            print(line, flush=True)
    return hides


def show_polarity(bench: Bench, n: int, seed: int) -> bool:
    """Angles and speeds that a brake with a wrong sign reaches: with and without losses, limit and coasting.

    Returns:
        Whether more than one in 10,000 passes 10 rad where nothing is lost.
    """
    runs = beyond = 0
    rng = np.random.default_rng(seed)
    print(
        f"\nWrong signs, {n} brakes of the set each, any policy that moves: 90 % stay within, share beyond 10 rad; "
        "where nothing is lost also the largest angle and speed"
    )
    print("| plant | wrong sign of | as it runs, nothing lost | as it runs | node brakes at once | 6 A at once |")
    print("|---|---|---|---|---|---|", flush=True)
    for plant in ("euler", "exact", "late", "lag", "observer"):
        case = covered(bench, plant)
        for name in ("motor reversed", "angle reversed", "velocity reversed", "both reversed"):
            script = draw(rng, case, n, plant, kind=FAULTS[name][0], size=1.0, policies=MOVING)
            whole = script._replace(losses=np.zeros_like(script.losses))
            lossless, lossy = results(case, whole, plant), results(case, script, plant)
            at_once = results(case, script, plant, first=False)
            reached = [(lossless, COASTED), (lossy, COASTED), (lossy, HALTED), (at_once, COASTED)]
            far = [np.maximum(-r[:, at], r[:, at + 1]) for r, at in reached]
            cells = [f"{np.quantile(a, 0.9):.2f} rad, {np.mean(a > 10.0):.2%}" for a in far]
            cells[0] += f"; {far[0].max():.1f} rad, {lossless[:, FASTEST].max():.0f} rad/s"
            print(f"| {plant} | {name.removesuffix(' reversed')} | {' | '.join(cells)} |", flush=True)
            runs, beyond = runs + n, beyond + int(np.count_nonzero(far[0] > 10.0))
    return beyond > 1e-4 * runs


def _detected(r: Floats, onsets: Codes, ms: float, *, median: bool) -> str:
    seen = r[:, VERDICT] != HONEST
    took = (r[seen, STEP] - onsets[seen]) * ms
    times = [0.5, 0.9] if median else [0.9]
    quantiles = "".join(f" {q:.0f} ms |" for q in np.quantile(took, times)) if seen.any() else " |" * len(times)
    reached = f"{r[:, LOWEST].min():.2f} .. {r[:, HIGHEST].max():.2f} | {r[:, FASTEST].max():.0f}"
    return f" {seen.mean():.0%} |{quantiles} {reached} |"


def main() -> int:
    """Print all figures; 1 if an honest sensor is blamed, a faulty one hides, or a wrong sign is driven, too often."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--experiments", type=int, default=1_000_000, help="honest ones, over all plants")
    parser.add_argument("--faulty", type=int, default=2000, help="experiments for each fault")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bench", help="another bench file")
    arguments = parser.parse_args()
    bench = load_bench(arguments.bench)
    limits = sensor_thresholds(bench, make_law(bench))
    print(f"seed {arguments.seed}; thresholds: " + ", ".join(f"{k} {v:g}" for k, v in limits._asdict().items()))
    fails = show_detection(bench, arguments.faulty, arguments.seed)
    fails |= show_polarity(bench, arguments.faulty, arguments.seed)
    fails |= show_false_alarms(bench, arguments.experiments, arguments.seed) > 1e-5 * arguments.experiments
    return 1 if fails else 0


if __name__ == "__main__":
    sys.exit(main())
