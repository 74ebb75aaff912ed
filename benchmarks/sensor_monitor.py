"""False alarms and detection of the sensor monitor: the figures of docs/explanation/sensor-monitor.md.

    python benchmarks/sensor_monitor.py [--experiments 1000000] [--faulty 400] [--seed 0]

Flies honest brakes of the set through the shield and the monitor, by each plant that the shield covers, and counts the
alarms; then brakes whose sensors or motor are at fault, and prints how far they get until the run and their motion end.
Nothing but the monitor judges here: not the plausibility of each sample, not the limits, not the node.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))  # the drawing of policies and brakes lives with the tests

from emb_bench.brake.motion import SENSITIVE, STATES
from emb_bench.compiled import compiled
from emb_bench.sim.closed_loop import pass_period
from emb_bench.sim.instruments import MEMORY as INSTRUMENTS_MEMORY
from emb_bench.sim.instruments import command, settle
from emb_runtime.config.bench import Bench, BrakeParameters, Ranges, load_bench
from emb_runtime.config.plants import Instruments, Mechanics
from emb_runtime.safety.sensor_monitor import (
    CONFIRMED,
    DOWN_FROM,
    HONEST,
    MEMORY,
    MOTION_DOWN,
    MOTION_UP,
    TRAVEL_DOWN,
    TRAVEL_UP,
    UP_FROM,
    VELOCITY,
    begin,
    judge,
    largest_current,
)
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield import NO_PAST, damped_current, shield, window
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
    periodic,
    wait_then_push,
    white,
)

Floats = NDArray[np.float64]
Codes = NDArray[np.int64]
Generator = np.random.Generator

CHUNK = 5000
STOP = 300  # periods in which the node brings the brake to rest
DUTY_PERIOD = 20  # samples

POLICIES = (bang_bang, constant, white, levels, chatter, far_then_reverse, periodic, wait_then_push, few_reversals, nothing)
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
# Columns of a result row.
VERDICT, STEP, TRAVEL, MOTION, CONFIRMED_AT, LOWEST, HIGHEST, FASTEST, HALTED_LOWEST, HALTED_HIGHEST, HALTED_FASTEST = range(11)


class Script(NamedTuple):
    """What was drawn for a chunk of experiments; the first axis counts them, the second samples."""

    brakes: Floats
    wanted: Floats
    """[A]."""
    errors: Floats
    """Of angle [rad], velocity [rad/s] and instant [s]."""
    losses: Codes
    kinds: Codes
    """What is at fault."""
    sizes: Floats
    duties: Floats
    onsets: Codes
    """Sample with which the fault begins."""


def lie(kind: int, size: float, ts: float, told: Floats, angle: float, velocity: float, before: float) -> None:
    """What faulty sensors say, in place: ``told`` is angle, velocity and the error so far.

    Args:
        kind: what is at fault.
        size: of the fault.
        ts: sample time [s].
        told: [angle, velocity, sum], changed.
        angle: honest [rad].
        velocity: honest [rad/s].
        before: honest angle one sample before [rad].
    """
    if kind == ANGLE_DRIFT or kind == BOTH_OFFSET:
        told[2] += size * ts
    if kind == BOTH_SCALE:
        told[2] += (size - 1.0) * (angle - before)
    told[0], told[1] = angle + told[2], velocity
    if kind == VELOCITY_OFFSET or kind == BOTH_OFFSET:
        told[1] += size
    if kind == VELOCITY_SCALE or kind == BOTH_SCALE:
        told[1] *= size
    if kind == ANGLE_REVERSED or kind == BOTH_REVERSED:
        told[0] = -angle
    if kind == VELOCITY_REVERSED or kind == BOTH_REVERSED:
        told[1] = -velocity


def fly(
    law: ShieldLaw,
    limits: SensorThresholds,
    mechanics: Mechanics,
    instruments: Instruments,
    script: Script,
    first: bool,
    out: Floats,
) -> None:
    """Fly each experiment of a script, until its end or the monitor's verdict, and let the node bring it to rest.

    Args:
        law: the shield's.
        limits: of the monitor.
        mechanics: how the brakes move.
        instruments: what lies between them and the bus.
        script: what was drawn.
        first: whether there is a gentle first move.
        out: becomes a row of results per experiment.
    """
    ts = law.sample_time
    memory, instrument = np.zeros(MEMORY), np.zeros(INSTRUMENTS_MEMORY)
    x, told = np.zeros(STATES), np.zeros(3)
    no_unknowns, no_sensitivity = np.zeros(0, np.int64), np.zeros((0, SENSITIVE))
    for m in range(out.shape[0]):
        b = script.brakes[m]
        p = BrakeParameters(b[0], b[1], b[2], b[3], b[4], b[5])
        kind, sign = script.kinds[m], -1.0 if script.kinds[m] == MOTOR_REVERSED else 1.0
        row = out[m]
        row[:] = 0.0
        row[STEP], row[CONFIRMED_AT] = law.steps, -1.0
        x[:], told[:] = 0.0, 0.0
        settle(instruments, instrument, 0.0)
        angle = script.errors[m, 0, 0] + instruments.encoder_offset
        velocity = script.errors[m, 0, 1]
        lie(kind if script.onsets[m] == 0 else NOTHING, script.sizes[m], ts, told, angle, velocity, angle)
        begin(memory, told[0], told[1])
        past = NO_PAST
        periods, obeyed, sent, felt = 0, False, 0.0, 0.0
        verdict = HONEST
        for k in range(law.steps):
            limit = largest_current(limits, memory, law.current) if first else law.current
            u, _ = shield(law, told[0], told[1], script.wanted[m, k], past, k)
            if not -limit <= u <= limit:
                u = min(max(u, -limit), limit)
                low, high = window(law, told[0], told[1], past)
                if not low <= u <= high:
                    u = math.nan
            if periods > 0 or script.losses[m, k] == COMMAND_LOST:
                u = math.nan
            own = damped_current(told[1] if kind in (VELOCITY_REVERSED, BOTH_REVERSED) else x[1], law.current, law.damping_velocity)
            if periods == 0:
                obeyed, sent = not math.isnan(u), 0.0 if math.isnan(u) else u
            periods += 1
            asked = command(instruments, instrument, u)
            felt = own if math.isnan(asked) else asked
            past = (0.0 if math.isnan(u) else u, past[0], past[1], past[2], past[3])
            e = script.errors[m, k + 1]
            before = angle
            angle, velocity = pass_period(
                mechanics, instruments, p, ts, sign * felt, (e[0], e[1], e[2]), x, no_unknowns, no_sensitivity, instrument
            )
            row[LOWEST], row[HIGHEST] = min(row[LOWEST], x[0]), max(row[HIGHEST], x[0])
            row[FASTEST] = max(row[FASTEST], abs(x[1]))
            since = k + 1 - script.onsets[m]
            on = since >= 0 and since % DUTY_PERIOD < script.duties[m] * DUTY_PERIOD
            frozen_angle, frozen_velocity = told[0], told[1]
            lie(kind if on else NOTHING, script.sizes[m], ts, told, angle, velocity, before)
            if on and (kind == ANGLE_FROZEN or kind == BOTH_FROZEN):
                told[0] = frozen_angle
            if on and (kind == VELOCITY_FROZEN or kind == BOTH_FROZEN):
                told[1] = frozen_velocity
            if script.losses[m, k] == SAMPLE_LOST and k < law.steps - 1:
                continue
            verdict = judge(law, limits, memory, periods * ts, told[0], told[1], obeyed and periods == 1, sent, felt)
            periods = 0
            travel = max(
                memory[TRAVEL_UP] - limits.lag * abs(memory[VELOCITY] - memory[UP_FROM]),
                memory[TRAVEL_DOWN] - limits.lag * abs(memory[VELOCITY] - memory[DOWN_FROM]),
            )
            row[TRAVEL] = max(row[TRAVEL], travel / limits.travel)
            row[MOTION] = max(row[MOTION], max(memory[MOTION_UP], memory[MOTION_DOWN]) / limits.motion)
            if row[CONFIRMED_AT] < 0.0 and memory[CONFIRMED] != 0.0:
                row[CONFIRMED_AT] = k + 1
            if verdict != HONEST:
                row[VERDICT], row[STEP] = verdict, k + 1
                break
        row[HALTED_LOWEST], row[HALTED_HIGHEST], row[HALTED_FASTEST] = row[LOWEST], row[HIGHEST], row[FASTEST]
        for _ in range(STOP if verdict != HONEST else 0):
            seen = -x[1] if kind == VELOCITY_REVERSED or kind == BOTH_REVERSED else x[1]
            own = damped_current(seen, law.current, law.damping_velocity)
            pass_period(
                mechanics, instruments, p, ts, sign * own, (0.0, 0.0, 0.0), x, no_unknowns, no_sensitivity, instrument
            )
            row[HALTED_LOWEST], row[HALTED_HIGHEST] = min(row[HALTED_LOWEST], x[0]), max(row[HALTED_HIGHEST], x[0])
            row[HALTED_FASTEST] = max(row[HALTED_FASTEST], abs(x[1]))


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
    nominal: bool = False,
) -> Script:
    """A chunk of experiments: brakes of the set (half of them its corners), policies, noise and losses.

    Args:
        rng: draws.
        bench: the bench.
        m: experiments.
        plant: which brake of the bench.
        kind: what is at fault.
        size: of the fault.
        duty: share of the time in which it acts.
        onset: first samples between which it begins.
        nominal: the nominal brake only, and no losses.
    """
    n, limit = bench.timing.horizon, bench.limits.current
    chosen = rng.integers(0, len(POLICIES), m)
    wanted = np.empty((m, n))
    for j, policy in enumerate(POLICIES):
        where = np.flatnonzero(chosen == j)
        wanted[where] = limit * policy(rng, len(where), n)
    shape = (m, n + 1, 2)
    flat = rng.random((m, 1, 1)) < 0.5
    unit = np.where(flat, rng.uniform(-math.sqrt(3.0), math.sqrt(3.0), shape), rng.standard_normal(shape))
    errors = np.zeros((m, n + 1, 3))
    errors[:, :, :2] = unit * [bench.noise.angle, bench.noise.velocity]
    brakes = draw_brakes(rng, _with_stiffness_inside(bench, plant), m)
    losses = np.zeros((m, n), np.int64)
    if nominal:
        brakes[:] = bench.brake
    else:
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


def _with_stiffness_inside(bench: Bench, plant: str) -> Ranges:
    """The shield's set, with k_1 so that F_cl / x of a plant's curve and hysteresis stays inside it."""
    box, farthest = bench.range_set(bench.shield.ranges), bench.limits.angle[1]
    m = bench.plant(plant).mechanics
    steeper = 1.0 + m.quadratic * farthest + m.cubic * farthest * farthest
    low = box.low._replace(k_1=box.low.k_1 / (1.0 - m.hysteresis))
    return replace(box, low=low, high=box.high._replace(k_1=box.high.k_1 / (steeper * (1.0 + m.hysteresis))))


def results(bench: Bench, script: Script, plant: str = "euler", jitter: float = 0.0, first: bool = True) -> Floats:
    """Fly a script with a plant of the bench; a row of results per experiment."""
    law = make_law(bench)
    chosen = bench.plant(plant)
    out = np.zeros((len(script.brakes), 11))
    compiled(fly)(law, sensor_thresholds(bench, law), chosen.mechanics, chosen.instruments, script, first, out)
    return out


COVERED: dict[str, dict[str, Any]] = {
    "euler": {},
    "exact": {},
    "karnopp": {"break_away": 1.2},
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
WEIGHT = {"euler": 4, "exact": 2}
"""Shares of the experiments; one for the others."""


def covered(bench: Bench, plant: str) -> Bench:
    """The bench with a shield that covers a plant."""
    return replace(bench, shield=replace(bench.shield, **COVERED[plant]))


def tail(values: Floats, rate: float = 1e-6) -> float:
    """Level that a maximum passes with the probability ``rate``, by an exponential fit to its largest thousandth."""
    ordered = np.sort(values)
    k = max(len(ordered) // 1000, 20)
    base = ordered[-k]
    return float(base + (ordered[-k:] - base).mean() * math.log(k / len(ordered) / rate))


def show_false_alarms(bench: Bench, n: int, seed: int) -> None:
    """Alarms on honest experiments, and the tails of what is summed up, in shares of the thresholds."""
    print("Honest experiments: alarms; largest sums and their level of 1e-6, in shares of the thresholds; confirmed after")
    print(f"  {'plant':12s} {'experiments':>11s} {'alarms':>6s} {'travel':>7s} {'1e-6':>6s} {'motion':>7s} {'1e-6':>6s} {'median, 99 % [ms]':>18s} {'never':>6s}")
    rng = np.random.default_rng(seed)
    total = sum(WEIGHT.get(plant, 1) for plant in COVERED)
    for plant in COVERED:
        case = covered(bench, plant)
        count = max(n * WEIGHT.get(plant, 1) // total, 1)
        rows = []
        for begin_at in range(0, count, CHUNK):
            script = draw(rng, case, min(CHUNK, count - begin_at), plant)
            script.errors[:, :, 2] = bench.plant(plant).instruments.clock_jitter * rng.standard_normal(script.errors.shape[:2])
            rows.append(results(case, script, plant))
        r = np.concatenate(rows)
        at = r[r[:, CONFIRMED_AT] > 0.0, CONFIRMED_AT] * case.timing.sample_time * 1e3
        alarms = np.flatnonzero(r[:, VERDICT] != HONEST)
        print(
            f"  {plant:12s} {len(r):11d} {len(alarms):6d} {r[:, TRAVEL].max():7.3f} {tail(r[:, TRAVEL]):6.3f} "
            f"{r[:, MOTION].max():7.3f} {tail(r[:, MOTION]):6.3f} {np.median(at):8.0f} {np.quantile(at, 0.99):9.0f} "
            f"{1.0 - len(at) / len(r):6.1%}  {np.unique(r[alarms, VERDICT], return_counts=True) if len(alarms) else ''}",
            flush=True,
        )
