"""Force steps of a controller without a force sensor: with nominal parameters, and with those estimated from one run.

    python benchmarks/clamping_force.py [--brakes 500] [--seed 1] [--plants exact load cubic]

Brakes within ±50 %, whose inertia, scale of the angle and encoder's offset are wrong by draws from the priors of the
bench file. The shipped actor drives each in one run of ``emb-run --iface sim``, ``emb-replay estimate`` estimates from
its log, and the controller tightens to the forces ``STEPS``, one after the other, on a brake of
``benchmarks.independent_simulator``, which shares no code with the estimators. It moves the angle that belongs to a
force along a smooth reference, with the torques of inertia, clamp and friction as a feed-forward, and corrects the rest
by proportion and derivative. A force's error is that at the end of its step.

The bound of an error is the total of ``force`` of :func:`emb_bench.analysis.clamping.clamping` at the angle of the
step. A row has the brakes that the model fits, the 95 % quantiles of the errors, their ratio, and how often the bounds
held; below it, how often the totals of force, holding current and friction band held the true ones. The two
steps of one brake are not independent, and count as if they were.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

sys.path.insert(0, str(Path(__file__).parents[1]))  # the simulator is a neighbour

from benchmarks.independent_simulator import Brake, brake_of, clamped
from benchmarks.interval_coverage import share
from emb_bench import api
from emb_bench.analysis.clamping import clamping
from emb_bench.analysis.study import Study
from emb_bench.brake.forces import clamping_force, decay, sliding_torque, static_torque
from emb_bench.config.bench import Bench, load_bench
from emb_bench.config.plants import Mechanics, Plant
from emb_bench.parallel import processes
from emb_bench.sim.simulated_brake import BrakeToSimulate, gaussian_noise
from emb_bench.sim.transport import open_brake
from emb_runtime.cli.experiment import experiment
from emb_runtime.cli.options import parser, prepare
from emb_runtime.cli.session import Console
from emb_runtime.config.bench import BrakeParameters

STEPS = (800.0, 400.0)  # [N]
RAMP, HOLD = 500, 100  # Samples of a step: moving, then at rest
STIFFNESS, DAMPING = 0.5, 0.01  # Of the controller [A/rad], [A·s/rad]
QUANTITIES = ("force", "current", "friction")
PLANTS = {"exact": "", "load": "", "cubic": "quadratic,cubic"}
"""Plants, and what is estimated beside the four parameters: a wrong scale of the angle bends the clamping force."""


class Believed(NamedTuple):
    """Parameters and offsets that the controller is told."""

    brake: BrakeParameters
    mechanics: Mechanics
    offset: float = 0.0  # Of the encoder [rad]
    current_offset: float = 0.0  # [A]


class Truth(NamedTuple):
    """A brake and what is wrong with its sensors."""

    brake: BrakeParameters
    scale: float  # Of the angle that is shown
    offset: float  # Of the encoder [rad]


class Outcome(NamedTuple):
    """One brake."""

    fits: bool
    nominal: Sequence[float]  # Errors of the force with nominal parameters, of each step [N]
    estimated: Sequence[float] = ()  # The same with estimated ones
    bounds: Sequence[float] = ()  # Of those [N]
    inside: Sequence[Sequence[bool]] = ()  # True if the total of each quantity held the true one, at each step


def drawn(bench: Bench, rng: np.random.Generator) -> Truth:
    """A brake within ±50 %; its errors are from their priors."""
    factors, (inertia, scale, offset) = rng.uniform(0.5, 1.5, 4).tolist(), rng.standard_normal(3).tolist()
    priors, p = bench.systematic, bench.brake
    names = ("k_m", "k_1", "T_c", "f_v")
    four = {name: getattr(p, name) * factor for name, factor in zip(names, factors, strict=True)}
    brake = p._replace(J=p.J * (1.0 + priors.inertia * inertia), **four)
    return Truth(brake, 1.0 + priors.angle_scale * scale, priors.offset * offset)


def seen(truth: Truth, plant: Plant) -> tuple[BrakeParameters, Plant]:
    """The brake that moves by itself as the encoder shows the true one to move."""
    p, m, s = truth.brake, plant.mechanics, truth.scale
    turned = m._replace(
        quadratic=m.quadratic / s, cubic=m.cubic / s**2, stribeck_velocity=m.stribeck_velocity * s
    )  # fmt: skip
    instruments = plant.instruments._replace(encoder_offset=truth.offset)
    return p._replace(k_m=p.k_m * s, T_c=p.T_c * s), Plant(plant.name, turned, instruments)


def estimated(bench: Bench, plant: Plant, truth: Truth, seed: int) -> Study:
    """The estimate from one run with the shipped actor."""
    theta, shown = seen(truth, plant)
    to_drive = BrakeToSimulate(theta, shown, gaussian_noise(bench.noise, seed), seed, charge=False)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "run.mcap"
        plan = prepare(parser().parse_args(["--iface", "sim", "--log", str(log)]))
        experiment(plan, log, Console(), open_brake(to_drive, plan.bench))
        return api.estimate(log, model=plant.name, nuisance=PLANTS[plant.name] or None)


def angle_of(p: BrakeParameters, m: Mechanics, force: float) -> float:
    """Angle of a force [rad]."""
    return float(brentq(lambda x: clamping_force(m, p, x, 0.0) - force, 0.0, 200.0, xtol=1e-9))


def steps(told: Believed, brake: Brake, bench: Bench, seed: int) -> list[float]:
    """Errors of the force at the end of each step [N]."""
    p, m, t_s = told.brake, told.mechanics, bench.timing.sample_time
    ends = [0.0, *(angle_of(p, m, force) for force in STEPS)]

    def current(angle: float, velocity: float, k: int) -> float:
        step, at = divmod(k, RAMP + HOLD)
        r, begin, way = min((at + 0.5) / RAMP, 1.0), ends[step], ends[step + 1] - ends[step]
        x = begin + way * r**3 * (10.0 - 15.0 * r + 6.0 * r * r)  # no jump in speed and acceleration
        v = way / (RAMP * t_s) * 30.0 * r * r * (1.0 - r) ** 2
        a = way / (RAMP * t_s) ** 2 * 60.0 * r * (1.0 - r) * (1.0 - 2.0 * r)
        force = clamping_force(m, p, max(x, 0.0), 0.0)
        friction = np.sign(way) * sliding_torque(m, p, abs(v), force, decay(m, v) if v else 1.0)
        requested = (p.J * a + p.gamma * force + friction) / p.k_m - told.current_offset
        requested += STIFFNESS * (x - (angle - told.offset)) + DAMPING * (v - velocity)
        return float(np.clip(requested, -bench.limits.current, bench.limits.current))

    periods = RAMP + HOLD
    forces = clamped(brake, bench, current, periods * len(STEPS), np.random.default_rng([seed, 1]))
    return [float(forces[(i + 1) * periods - 1]) - force for i, force in enumerate(STEPS)]


def outcome(bench: Bench, plant: Plant, seed: int) -> Outcome:
    """One brake, controlled with nominal and with estimated parameters."""
    truth, m = drawn(bench, np.random.default_rng(seed)), plant.mechanics
    p = truth.brake
    real = brake_of(bench, plant, np.ones(4))
    real = replace(real, k_m=p.k_m, k_1=p.k_1, t_c=p.T_c, f_v=p.f_v, inertia=p.J)
    real = replace(real, encoder_offset=truth.offset, angle_scale=truth.scale - 1.0)
    nominal = steps(Believed(bench.brake, m), real, bench, seed)
    study = estimated(bench, plant, truth, seed)
    if study.clamping is None:
        return Outcome(False, nominal)
    e = study.estimate
    errors = e.problem.at(e.z, 0).errors
    told = Believed(e.theta, e.problem.mechanics(e.z), errors.offset or 0.0, errors.current_offset)
    found = [clamping(e, angle_of(told.brake, told.mechanics, force)) for force in STEPS]
    inside = []
    for one in filter(None, found):
        force = clamping_force(m, p, one.angle / truth.scale, 0.0)
        true = force, p.gamma * force / p.k_m, static_torque(m, p, force) / p.gamma
        inside.append(
            [abs(getattr(one, n).value - t) <= getattr(one, n).total for n, t in zip(QUANTITIES, true, strict=True)]
        )
    return Outcome(
        True, nominal, steps(told, real, bench, seed), [one.force.total for one in filter(None, found)], inside
    )


def report(name: str, outcomes: Sequence[Outcome]) -> None:
    """The row of one plant."""
    fits = [one for one in outcomes if one.fits]
    before, after, bounds = (np.abs([getattr(one, n) for one in fits]) for n in ("nominal", "estimated", "bounds"))
    last = [float(np.quantile(errors, 0.95)) for errors in (before, after)]
    print(f"plant {name}: fits {share(len(fits), len(outcomes))}")
    print(f"  95 % of the errors: nominal {last[0]:.4g} N, estimated {last[1]:.4g} N, ratio {last[1] / last[0]:.3f}")
    print(f"  bound held {share(int((after <= bounds).sum()), after.size)}; median {np.median(bounds):.3g} N")
    inside = np.array([one.inside for one in fits])
    for i, quantity in enumerate(QUANTITIES):
        print(f"    total of {quantity} {share(int(inside[:, :, i].sum()), inside[:, :, i].size)}", flush=True)


def main() -> None:
    """Print a row for each plant, and one for all."""
    p = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    p.add_argument("--brakes", type=int, default=500, help="of each plant (default: %(default)s)")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--plants", nargs="+", choices=PLANTS, default=[*PLANTS])
    arguments = p.parse_args()
    bench, every = load_bench(), []
    with processes() as pool:
        for number, name in enumerate(arguments.plants):
            every += (
                rows := played(bench, bench.plant(name), arguments.seed + 10_000 * number, arguments.brakes, pool)
            )
            report(name, rows)
    report("all", every)


def played(bench: Bench, plant: Plant, first: int, count: int, pool: Executor) -> list[Outcome]:
    """Outcomes of some brakes of one plant."""
    return list(pool.map(partial(outcome, bench, plant), range(first, first + count), chunksize=5))


if __name__ == "__main__":
    main()
