"""False alarms of the motion balance and of the rest after it: the figures of docs/explanation/sensor-monitor.md.

    python -m tests.searches.motion_balance [--experiments 300000] [--seed 1]

Plays honest experiments with every plant of the bench, with brakes of the shield's set, noise, lost samples and
commands, jitter and delays, as tests/searches/sensor_monitor.py draws them; policies are the shipped actor, that of
``--quick``, and those drawn there; an experiment has 500, 250 or 100 samples. Then with declared observers, as fast as
declared and twice that. For each plant: alarms, and the largest unexplained velocity and distance of the spring's
origin as shares of what is allowed; experiments that end at home and are not said to, and that show a speed beyond the
limits, of those that keep them. Then the node stops the brake, as late as its watchdog lets it: the longest time until
it is idle (NOT_AT_REST beyond 1.5 s), and how often the velocity that it then measures is taken for a motion. Last: how
often the estimator's model does not fit, as it must for brakes of another kind: it ends no run.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from benchmarks.policies import target_speeds
from emb_bench.brake.motion import STATES
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Instruments, Mechanics
from emb_bench.sim.instruments import MEMORY as INSTRUMENTS_MEMORY
from emb_bench.sim.instruments import settle
from emb_bench.sim.node import REST_TIME, REST_TRAVEL
from emb_bench.sim.simulated_brake import sent_current
from emb_runtime.can.messages import load_layout
from emb_runtime.config.bench import BrakeParameters, Sensors
from emb_runtime.control.loop import STOP_LISTEN_NS
from emb_runtime.control.start_conditions import Bounds
from emb_runtime.estimator.kalman import Model, believed, fits, follow, initial_state, make_model
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.records import NodeState, SensorSample
from emb_runtime.safety.motion_balance import (
    REST_SAMPLES,
    BalanceModel,
    balance_model,
    begin_balance,
    origin,
    steady_motion,
    take,
    unexplained,
)
from emb_runtime.safety.sensor_monitor import begin_monitor, judge, largest_current
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield import NO_PAST, damped_current
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from emb_train.closed_loop import BENCH_CONDITIONS
from tests.benches import SENSOR_BENCH
from tests.searches.sensor_monitor import COMMAND_LOST, COVERED, SAMPLE_LOST, Script, covered, draw, moved, passed, tail

Floats = NDArray[np.float64]

CHUNK = 1000
GAIN: Final = BENCH_CONDITIONS.gain  # Of the speed loop
LENGTHS = (500, 500, 250, 100)
PLANTS = (*(name for name in COVERED if name != "observer"), "play")
DECLARED = {
    f"observer of {factor * least:.0f}, {least:.0f} declared": (least, factor * least)
    for least in (800.0, 1520.0, 3040.0)
    for factor in (1.0, 2.0)
}
"""Least and true bandwidth [rad/s]."""
LARGEST, JUDGED, ORIGIN, REST, DOUBTED, SPEED, SHOWN, TRUE, FIRST_VELOCITY = 0, 1, 2, 3, 4, 5, 6, 8, 10
"""Columns of a row of results: REST in periods; SPEED is the largest that was shown; two columns each for angle and
velocity at the end, as shown and in truth."""
COLUMNS = FIRST_VELOCITY + REST_SAMPLES
STATUS_PERIODS = 100  # Most samples that a node at rest sends until its status says why it stopped


class Stop(NamedTuple):
    """What the node does by itself once a run has ended."""

    late: int  # Periods until it stops: no stop frame came
    current_step: float  # [A]
    rest_travel: float  # [rad]
    rest_periods: int  # Periods within the travel after which it is idle
    listened: int  # Periods in which the loop listens for that


def fly(
    law: ShieldLaw,
    limits: SensorThresholds,
    balance: BalanceModel,
    mechanics: Mechanics,
    instruments: Instruments,
    model: Model,
    speeds: Floats,
    scripted: bool,
    script: Script,
    stop: Stop,
    out: Floats,
) -> None:
    """Play each experiment of a script to its end, whatever the monitor or the balance says, and to its rest."""
    ts = law.sample_time
    x, instrument = np.zeros(STATES), np.zeros(INSTRUMENTS_MEMORY)
    for m in range(out.shape[0]):
        b = script.brakes[m]
        p = BrakeParameters(b[0], b[1], b[2], b[3], b[4], b[5])
        x[:], state = 0.0, initial_state(model)
        settle(instruments, instrument, 0.0)
        angle, velocity = script.errors[m, 0, 0] + instruments.encoder_offset, script.errors[m, 0, 1]
        monitor = begin_monitor(angle, velocity)
        sums = begin_balance(angle, velocity)
        past, periods, obeyed, sent, felt, wanted = NO_PAST, 0, False, 0.0, 0.0, 0.0
        for k in range(law.steps):
            if periods == 0:
                state = follow(model, state, angle, velocity, float(k), felt)
            if scripted:
                wanted = script.wanted[m, k]
            elif periods == 0:
                wanted = current_for(model, state, believed(model, state), speeds[k], GAIN)
            limit = largest_current(law, limits, monitor, law.current)
            u, _ = sent_current(law, True, angle, velocity, wanted, past, k, limit)
            if periods > 0 or script.losses[m, k] == COMMAND_LOST:
                u = math.nan
            if periods == 0:
                obeyed, sent = not math.isnan(u), 0.0 if math.isnan(u) else u
            periods += 1
            e = script.errors[m, k + 1]
            angle, velocity, felt, past = passed(law, mechanics, instruments, p, u, past, e, x, instrument)
            if script.losses[m, k] == SAMPLE_LOST and k < law.steps - 1:
                continue
            out[m, SPEED] = max(out[m, SPEED], abs(velocity))
            follows = obeyed and periods == 1
            monitor, _ = judge(law, limits, monitor, periods * ts, angle, velocity, follows, sent, felt)
            sums = take(balance, sums, follows, angle, velocity, felt)
            if sums.samples == 0:
                found, most = unexplained(balance, sums)
                out[m, LARGEST] = max(out[m, LARGEST], found / most)
            periods = 0
        out[m, SHOWN], out[m, SHOWN + 1], out[m, TRUE], out[m, TRUE + 1] = angle, velocity, x[0], x[1]
        found, most = unexplained(balance, sums)
        out[m, LARGEST], out[m, JUDGED] = max(out[m, LARGEST], found / most), found / most > 0.0
        place, most = origin(balance, sums)
        out[m, ORIGIN] = abs(place) / most if out[m, JUDGED] else 0.0
        out[m, DOUBTED] = not fits(state)
        halt(law, mechanics, instruments, p, stop, m, script, x, instrument, out[m])


def halt(
    law: ShieldLaw,
    mechanics: Mechanics,
    instruments: Instruments,
    p: BrakeParameters,
    stop: Stop,
    m: int,
    script: Script,
    x: Floats,
    instrument: Floats,
    row: Floats,
) -> None:
    """Let the node brake until it is idle, and measure on until it has said why it stopped."""
    place, resting, idle, newest, n = x[0], 0, -1, 0, script.losses.shape[1]
    for k in range(stop.listened):
        u = damped_current(x[1], law.current, law.damping_velocity)
        u = round(u / stop.current_step) * stop.current_step if idle < 0 else 0.0
        e = script.errors[m, n - k % n]
        _, velocity = moved(mechanics, instruments, p, law.sample_time, u, e, x, instrument)
        if script.losses[m, n - 1 - k % n] != SAMPLE_LOST:
            row[FIRST_VELOCITY + newest % REST_SAMPLES] = velocity
            newest += 1
        if k < stop.late:
            place = x[0]
        elif abs(x[0] - place) > stop.rest_travel:
            place, resting = x[0], 0
        else:
            resting += 1
        if idle < 0 and resting >= stop.rest_periods:
            idle = k + 1
        if idle >= 0 and k + 1 - idle >= m % STATUS_PERIODS:
            break
    row[REST] = stop.listened + 1 if idle < 0 else idle
    kept = row[FIRST_VELOCITY:].copy()
    for i in range(REST_SAMPLES):  # oldest first
        row[FIRST_VELOCITY + i] = kept[(newest + i) % REST_SAMPLES]


def results(bench: Bench, name: str, count: int, rng: np.random.Generator) -> Floats:
    """Rows of results of so many experiments: half of them under a shipped actor."""
    plant = "observer" if name in DECLARED else name
    case, chosen = covered(bench, plant) if plant in COVERED else bench, bench.plant(plant)
    if name in DECLARED:
        least, true = DECLARED[name]
        case = replace(bench, sensors=Sensors("observer", least))
        chosen = replace(chosen, instruments=chosen.instruments._replace(observer_bandwidth=true))
    law, prior = make_law(case), bench.range_set(bench.prior)
    model = make_model(case, prior)
    actors = [target_speeds(load_policy(shipped_actor_path(quick), bench), bench) for quick in (False, True)]
    stop = Stop(
        late=math.ceil(case.node.watchdog / law.sample_time - 1e-9),
        current_step=load_layout().command.signal("Current").factor,
        rest_travel=REST_TRAVEL,
        rest_periods=math.ceil(REST_TIME / law.sample_time - 1e-9),
        listened=int(STOP_LISTEN_NS / 1e9 / law.sample_time),
    )
    rows = []
    for turn in range(0, count, CHUNK):
        script = draw(rng, case, min(CHUNK, count - turn), plant)
        script.errors[:, :, 2] = chosen.instruments.clock_jitter * rng.standard_normal(script.errors.shape[:2])
        speeds = actors[int(rng.integers(len(actors)))]
        out = np.zeros((len(script.brakes), COLUMNS))
        arguments: tuple[Any, ...] = (
            law._replace(steps=int(rng.choice(LENGTHS))),
            sensor_thresholds(case, law),
            balance_model(case),
            chosen.mechanics,
            chosen.instruments,
            model,
            speeds,
            bool(rng.integers(2)),
            script,
            stop,
            out,
        )
        compiled(fly)(*arguments)
        rows.append(out)
    return np.concatenate(rows)


def at_home(bench: Bench, r: Floats) -> tuple[int, int]:
    """Experiments that end at home and are not said to, and that are said to and do not."""
    bounds, home = Bounds(bench), bench.shield
    said = [
        bounds.is_home(SensorSample(0, angle, velocity, 0, 0, 0.0, 0, NodeState.ACTIVE))
        for angle, velocity in r[:, SHOWN : SHOWN + 2].tolist()
    ]
    there = (abs(r[:, TRUE]) <= home.home_angle) & (abs(r[:, TRUE + 1]) <= home.home_velocity)
    return int(np.count_nonzero(there & ~np.array(said))), int(np.count_nonzero(~there & np.array(said)))


def main() -> int:
    """Print the table; 1 if a share of false alarms is above its limit beyond chance."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--experiments", type=int, default=300_000, help="over all plants (default: %(default)s)")
    p.add_argument("--seed", type=int, default=1, help="0 is the one that the thresholds were chosen with")
    arguments = p.parse_args()
    bench, rng = SENSOR_BENCH, np.random.default_rng(arguments.seed)
    each, totals = (
        max(arguments.experiments // len(names := (*PLANTS, *DECLARED)), 1),
        dict.fromkeys(("unexplained", "too fast", "not home", "not at rest", "in motion", "model does not fit"), 0),
    )
    judged = total = 0
    print(
        "| plant | experiments | judged | alarms | share allowed | level of 1e-6 | of the origin | level | too fast | "
        "home, not said | said, not home | longest until idle [s] | not idle | in motion | model does not fit |"
    )
    print("|---" * 15 + "|", flush=True)
    fastest = bench.limits.velocity + bench.shield.noise_sigmas * bench.noise.velocity
    for plant in names:
        r = results(bench, plant, each, rng)
        share, origins = r[:, LARGEST], r[:, ORIGIN]
        found, used = int(np.count_nonzero((share > 1.0) | (origins > 1.0))), int(np.count_nonzero(r[:, JUDGED]))
        longest = int(STOP_LISTEN_NS / 1e9 / bench.timing.sample_time)
        restless = int(np.count_nonzero(r[:, REST] > longest))
        moving = sum(steady_motion([*map(float, v)], bench.noise.velocity) != 0.0 for v in r[:, FIRST_VELOCITY:])
        doubted, fast = (int(np.count_nonzero(column)) for column in (r[:, DOUBTED], r[:, SPEED] > fastest))
        missed, mistaken = at_home(bench, r)
        for name, count in zip(totals, (found, fast, missed, restless, moving, doubted), strict=True):
            totals[name] += count
        judged, total = judged + used, total + len(r)
        print(
            f"| {plant} | {len(r)} | {used} | {found} | {share.max():.2f} | {tail(share):.2f} | "
            f"{origins.max():.2f} | {tail(origins):.2f} | {fast} | {missed} | {mistaken} | "
            f"{r[:, REST].max() * bench.timing.sample_time:.3f} | {restless} | {moving} | {doubted} |",
            flush=True,
        )
    print(f"\n{judged} of {total} experiments are judged by the balance")
    above = False
    for name, count in totals.items():
        low, high = stats.binomtest(count, total).proportion_ci(method="exact")
        what = f"honest experiments over {len(names)} plants: {name}"
        limit = "–" if name == "model does not fit" else "1e-4"
        above = above or (limit != "–" and low > 1e-4)
        print(f"| {what} | {limit} | {count} of {total}, {low:.1e} to {high:.1e} |")
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main())
