"""The proof of the response: the figures of docs/explanation/sensor-monitor.md.

    python -m tests.searches.response [--brakes 500] [--experiments 60000] [--runs 500] [--seed 1]

First, responses that the bench file does not declare: observers, lags of the current, late frames and combinations. For
each, brakes of the shield's set (half of them its corners) under the shipped actor and under the other policies of
tests/searches/sensor_monitor.py, half of the experiments with lost samples and commands: how many pass a limit, how
many the proof or the sensor monitor ends, how many are proven. The same for declared observers, of the bandwidth that
is declared and of twice that. Then honest experiments with every plant of the bench and what it must declare, half on a
bench with a sensor and half with the shipped observer, where the plant permits one: how many the proof ends; when it
has proven the response; in how many periods its slower law changes a command. Last, whole runs of ``emb-run`` with
drawn brakes and the shipped actor: how many end naming the right key with a value that covers what is there.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import json
import math
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from benchmarks.policies import target_speeds
from emb_bench.brake.motion import STATES
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import Instruments, Mechanics
from emb_bench.sim.instruments import MEMORY as INSTRUMENTS_MEMORY
from emb_bench.sim.instruments import settle
from emb_bench.sim.simulated_brake import sent_current
from emb_runtime.cli.main import main as emb_run
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters, Sensors
from emb_runtime.estimator.kalman import Model, believed, follow, initial_state, make_model
from emb_runtime.estimator.speed_loop import current_for
from emb_runtime.policy.policy import load_policy, shipped_actor_path
from emb_runtime.safety.response import (
    CONTRADICTED,
    OPEN,
    PROVEN,
    ResponseModel,
    State,
    begin_response,
    response_model,
    take,
    unproven_law,
)
from emb_runtime.safety.sensor_monitor import HONEST, begin_monitor, judge, largest_current
from emb_runtime.safety.sensor_thresholds import SensorThresholds, sensor_thresholds
from emb_runtime.safety.shield import NO_PAST, Past
from emb_runtime.safety.shield_design import ShieldLaw, make_law
from emb_train.closed_loop import BENCH_CONDITIONS
from tests.benches import SENSOR_BENCH
from tests.searches.sensor_monitor import COMMAND_LOST, COVERED, MOVING, SAMPLE_LOST, Script, covered, draw, passed

Floats = NDArray[np.float64]

CHUNK: Final = 1000
GAIN: Final = BENCH_CONDITIONS.gain  # Of the speed loop
STOP: Final = 100  # Periods that are followed after a run has ended
LOWEST, HIGHEST, FASTEST, VERDICT, DISHONEST, PROVEN_AT, CHANGED = range(7)
COLUMNS: Final = CHANGED + 1

# Observer's bandwidth [rad/s], time constant of the current [s], samples by which commands and measurements are late.
Undeclared = tuple[float, float, int, int]
MUST: Final[dict[str, Undeclared]] = {
    "observer 800": (800.0, 0.0, 0, 0),
    "observer 1520": (1520.0, 0.0, 0, 0),
    "lag 2 ms": (0.0, 2e-3, 0, 0),
    "late 1 + 1": (0.0, 0.0, 1, 1),
}
GRID: Final[dict[str, Undeclared]] = {
    **{f"observer {w}": (float(w), 0.0, 0, 0) for w in (300, 500, 1200, 2000)},
    **{f"lag {ms:g} ms": (0.0, 1e-3 * ms, 0, 0) for ms in (0.5, 1.0, 3.0, 5.0)},
    **{f"late {n} + 0": (0.0, 0.0, n, 0) for n in (1, 2, 3, 4, 5)},
    "late 0 + 2": (0.0, 0.0, 0, 2),
    "late 1 + 0, lag 1 ms": (0.0, 1e-3, 1, 0),
    "late 1 + 0, observer 1520": (1520.0, 0.0, 1, 0),
    "lag 1 ms, observer 1000": (1000.0, 1e-3, 0, 0),
}
OBSERVERS: Final = 800.0, 1520.0, 3040.0
"""Least bandwidths that are declared [rad/s]"""


def fly(
    law: ShieldLaw,
    slow: ShieldLaw,
    limits: SensorThresholds,
    response: ResponseModel,
    mechanics: Mechanics,
    instruments: Instruments,
    model: Model,
    speeds: Floats,
    scripted: bool,
    script: Script,
    out: Floats,
) -> None:
    """Play each experiment of a script to its end, or to the first verdict against it and then to rest."""
    ts = law.sample_time
    x, instrument = np.zeros(STATES), np.zeros(INSTRUMENTS_MEMORY)
    for m in range(out.shape[0]):
        b, row = script.brakes[m], out[m]
        p = BrakeParameters(b[0], b[1], b[2], b[3], b[4], b[5])
        x[:], state = 0.0, initial_state(model)
        settle(instruments, instrument, 0.0)
        angle, velocity = script.errors[m, 0, 0] + instruments.encoder_offset, script.errors[m, 0, 1]
        monitor, proof = begin_monitor(angle, velocity), begin_response(response, angle, velocity)
        verdict, past, periods, obeyed, given, felt, wanted, rest = OPEN, NO_PAST, 0, False, 0.0, 0.0, 0.0, -1
        for k in range(law.steps):
            if periods == 0 and rest < 0:
                state = follow(model, state, angle, velocity, float(k), felt)
            if scripted:
                wanted = script.wanted[m, k]
            elif periods == 0 and rest < 0:
                wanted = current_for(model, state, believed(model, state), speeds[k], GAIN)
            limit = largest_current(law, limits, monitor, law.current)
            u, full = sent(law, slow, verdict != PROVEN and monitor.obeys, angle, velocity, wanted, past, k, limit)
            row[CHANGED] += 1.0 if u != full and not math.isnan(full) else 0.0
            if periods > 0 or script.losses[m, k] == COMMAND_LOST or rest >= 0:
                u = math.nan
            if periods == 0:
                obeyed, given = not math.isnan(u), 0.0 if math.isnan(u) else u
            periods += 1
            e = script.errors[m, k + 1]
            angle, velocity, felt, past = passed(law, mechanics, instruments, p, u, past, e, x, instrument)
            row[LOWEST], row[HIGHEST] = min(row[LOWEST], x[0]), max(row[HIGHEST], x[0])
            row[FASTEST] = max(row[FASTEST], abs(x[1]))
            if rest >= 0:
                rest += 1
                if rest > STOP:
                    break
                continue
            if script.losses[m, k] == SAMPLE_LOST and k < law.steps - 1:
                continue
            follows = obeyed and periods == 1
            monitor, found = judge(law, limits, monitor, periods * ts, angle, velocity, follows, given, felt)
            row[DISHONEST] = found != HONEST
            proof, verdict = judged(response, proof, verdict, follows, angle, velocity, given, k + 1, row)
            periods = 0
            if verdict == CONTRADICTED or row[DISHONEST] != 0.0:
                rest = 0


def judged(
    response: ResponseModel,
    proof: State,
    verdict: int,
    follows: bool,
    angle: float,
    velocity: float,
    given: float,
    samples: int,
    row: Floats,
) -> tuple[State, int]:
    """State and verdict of the proof after one more of so many samples."""
    if verdict == OPEN:
        proof, verdict = take(response, proof, follows, angle, velocity, given)
        row[VERDICT] = verdict
        if verdict == PROVEN:
            row[PROVEN_AT] = samples
    return proof, verdict


def sent(
    law: ShieldLaw,
    slow: ShieldLaw,
    unproven: bool,
    angle: float,
    velocity: float,
    wanted: float,
    past: Past,
    k: int,
    limit: float,
) -> tuple[float, float]:
    """Command [A] of the law that holds, and of the full one."""
    full, _ = sent_current(law, True, angle, velocity, wanted, past, k, limit)
    if not unproven:
        return full, full
    return sent_current(slow, True, angle, velocity, wanted, past, k, limit)[0], full


def results(bench: Bench, mechanics: Mechanics, instruments: Instruments, scripted: bool, script: Script) -> Floats:
    """Play a script; a row of results per experiment."""
    law, prior = make_law(bench), bench.range_set(bench.prior)
    out = np.zeros((len(script.brakes), COLUMNS))
    arguments: tuple[Any, ...] = (
        law,
        unproven_law(bench, law),
        sensor_thresholds(bench, law),
        response_model(bench, law),
        mechanics,
        instruments,
        make_model(bench, prior),
        target_speeds(load_policy(shipped_actor_path(), bench), bench),
        scripted,
        script,
        out,
    )
    compiled(fly)(*arguments)
    return out


def undeclared(bench: Bench, case: Undeclared, count: int, scripted: bool, rng: np.random.Generator) -> Floats:
    """Rows of results of experiments with a response that the bench does not declare."""
    observer, lag, commands, measurements = case
    exact = bench.plant("exact")
    instruments = exact.instruments._replace(
        command_delay=commands, measurement_delay=measurements, observer_bandwidth=observer
    )
    script = draw(rng, bench, count, "exact", policies=MOVING)
    return results(bench, exact.mechanics._replace(current_lag=lag), instruments, scripted, script)


def beyond(bench: Bench, r: Floats) -> Any:
    """Mask of the experiments that passed a limit."""
    low, high = bench.limits.angle
    return (r[:, LOWEST] < low) | (r[:, HIGHEST] > high) | (r[:, FASTEST] > bench.limits.velocity)


def declared(bench: Bench, plant: str) -> Bench:
    """The bench with everything declared that a plant needs."""
    bandwidth = bench.plant(plant).instruments.observer_bandwidth
    case = covered(bench, plant)
    return replace(case, sensors=Sensors("observer", bandwidth)) if bandwidth else case


def honest(bench: Bench, plant: str, count: int, rng: np.random.Generator) -> Floats:
    """Rows of results of experiments with a plant whose response is declared; every other chunk under the actor."""
    case, chosen, rows = declared(bench, plant), bench.plant(plant), []
    for turn, done in enumerate(range(0, count, CHUNK)):
        script = draw(rng, case, min(CHUNK, count - done), plant, policies=MOVING)
        script.errors[:, :, 2] = chosen.instruments.clock_jitter * rng.standard_normal(script.errors.shape[:2])
        rows.append(results(case, chosen.mechanics, chosen.instruments, turn % 2 == 1, script))
    return np.concatenate(rows)


# --- whole runs -----------------------------------------------------------------------------------------------------

Right = Callable[[str], bool]
NAMES: Final[dict[str, tuple[dict[str, Any], str, Right]]] = {
    "observer 800": ({"observer_bandwidth": 800.0}, r"observer_bandwidth = (\d+)", lambda v: 700 <= float(v) <= 800),
    "observer 1520": (
        {"observer_bandwidth": 1520.0},
        r"observer_bandwidth = (\d+)",
        lambda v: 1350 <= float(v) <= 1520,
    ),
    "lag 2 ms": ({"current_lag": 2e-3}, r"current_lag = ([\d.]+)", lambda v: 2e-3 <= float(v) <= 2.6e-3),
    "late 1 + 1": ({"command_delay": 1, "measurement_delay": 1}, r"frame_age = \[(\d, \d)\]", lambda v: v == "0, 2"),
}
"""Of a plant: what is not declared, the key in the detail, and whether its value covers what is there."""


def detail(arguments: Sequence[str], folder: Path) -> tuple[str, str]:
    """Result and detail of a run of ``emb-run`` in this process."""
    log, said = folder / "run.mcap", io.StringIO()
    log.unlink(missing_ok=True)
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        emb_run([*arguments, "--log", str(log), "--json"])
    document = json.loads(said.getvalue())
    return document["result"], document["detail"]


def named(bench: Bench, name: str, count: int, rng: np.random.Generator) -> tuple[int, int, int]:
    """Whole runs that end, that name the key, and that name it with a value that covers what is there."""
    plant, key, right = NAMES[name]
    settings = "\n".join(f"{what} = {value}" for what, value in plant.items())
    box, counts = bench.range_set(bench.shield.ranges), [0, 0, 0]
    with TemporaryDirectory() as name_of_folder:
        folder = Path(name_of_folder)
        sheet = folder / "bench.toml"
        sheet.write_text(f"{bench.text}\n[plants.undeclared]\n{settings}\n", encoding="utf-8")
        for _ in range(count):
            drawn = (f"{p}={rng.uniform(getattr(box.low, p), getattr(box.high, p)):.6g}" for p in PARAMETER_NAMES)
            options = ",".join(["plant=undeclared", f"seed={rng.integers(1_000_000)}", *drawn])
            result, text = detail(["--bench", str(sheet), "--iface", f"sim:{options}"], folder)
            found = re.search(key, text)
            counts[0] += result != "done"
            counts[1] += found is not None
            counts[2] += found is not None and right(found[1])
    return counts[0], counts[1], counts[2]


def cases(bench: Bench) -> list[tuple[str, Undeclared, Bench]]:
    """Name of each response of the first table, the response, and the bench that flies it."""
    found = [(name, case, bench) for name, case in {**MUST, **GRID}.items()]
    for w in OBSERVERS:
        of = replace(bench, sensors=Sensors("observer", w))
        found += [(f"observer {f * w:g}, declared {w:g}", (f * w, 0.0, 0, 0), of) for f in (1.0, 2.0)]
    return found


def share(count: int, total: int) -> str:
    """Count of a total, with the 95 % interval of the share."""
    low, high = stats.binomtest(count, total).proportion_ci(method="exact")
    return f"{count} of {total} ({low:.2%} to {high:.2%})"


def main() -> int:
    """Print the figures; 1 if a limit is passed, too many honest experiments are ended, or a key is not named."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--brakes", type=int, default=500, help="of each undeclared response (default: %(default)s)")
    p.add_argument("--experiments", type=int, default=60_000, help="honest ones (default: %(default)s)")
    p.add_argument("--runs", type=int, default=500, help="whole runs of each of four responses (default: %(default)s)")
    p.add_argument("--seed", type=int, default=1)
    arguments = p.parse_args()
    bench, rng = SENSOR_BENCH, np.random.default_rng(arguments.seed)
    fails = False
    if arguments.brakes:
        print("| response | policy | beyond the limits | ended by the proof | by the monitor | proven | fastest |")
        print("|---" * 7 + "|", flush=True)
    for name, case, of in cases(bench) if arguments.brakes else ():
        for scripted in (False, True):
            r = undeclared(of, case, arguments.brakes, scripted, rng)
            out = int(np.count_nonzero(beyond(bench, r)))
            fails |= out > 0
            late, proven = r[:, VERDICT] == CONTRADICTED, r[:, VERDICT] == PROVEN
            print(
                f"| {name} | {'others' if scripted else 'shipped'} | {share(out, len(r))} | {np.count_nonzero(late)} | "
                f"{np.count_nonzero(~late & (r[:, DISHONEST] != 0.0))} | {np.count_nonzero(proven)} | "
                f"{r[:, FASTEST].max():.0f} rad/s |",
                flush=True,
            )
    if arguments.experiments:
        fails |= show_honest((bench, load_bench()), arguments.experiments, rng)
    for name in NAMES if arguments.runs else ():
        ended, found, right = named(bench, name, arguments.runs, rng)
        fails |= right < 0.95 * arguments.runs
        print(
            f"{name}: {ended} of {arguments.runs} whole runs ended, {found} name the key, with a value that covers it "
            f"{share(right, arguments.runs)}",
            flush=True,
        )
    return int(fails)


def show_honest(benches: tuple[Bench, Bench], count: int, rng: np.random.Generator) -> bool:
    """Print how honest experiments fare; whether more of them are ended than the page says."""
    print(
        "\n| plant | experiments | ended by the proof | beyond | proven after: median | 95 % | 99 % | never | slower |"
    )
    print("|---" * 9 + "|", flush=True)
    ended, total, ms = 0, 0, benches[0].timing.sample_time * 1e3
    for plant, bench in itertools.product(COVERED, benches):
        r = honest(bench, plant, max(count // len(benches) // len(COVERED), 1), rng)
        alarms, at = int(np.count_nonzero(r[:, VERDICT] == CONTRADICTED)), r[r[:, PROVEN_AT] > 0.0, PROVEN_AT] * ms
        ended, total = ended + alarms, total + len(r)
        times = " | ".join(f"{q:.0f} ms" for q in np.quantile(at, (0.5, 0.95, 0.99))) if len(at) else "– | – | –"
        origin = declared(bench, plant).sensors.velocity
        print(
            f"| {plant}, {origin} | {len(r)} | {alarms} | {np.count_nonzero(beyond(bench, r))} | {times} | "
            f"{1.0 - len(at) / len(r):.1%} | {r[:, CHANGED].mean() * ms:.1f} ms |",
            flush=True,
        )
    low, high = stats.binomtest(ended, total).proportion_ci(method="exact")
    what = f"honest experiments over {len(COVERED)} plants, ended by the proof"
    print(f"{what}: {ended} of {total}, {low:.1e} to {high:.1e}")
    return bool(low > 1e-4)


if __name__ == "__main__":
    sys.exit(main())
