"""A comparison on the same logs: a scipy script, lmfit, mujoco.sysid and ``emb-replay estimate``.

    python benchmarks/peers.py [--logs 20] [--first 9000] [--programs scipy ...] [--results FILE]

Brakes with an even seed are as the model says, with the four parameters within ±50 %; those with an odd one have one
error of ``ERRORS`` besides. Each is driven on the simulated bench as ``emb-run`` does it, and each program gets the
currents that acted, the samples and their noise. All fit ``exact``, the model without the error, from the nominal
values. The scipy script and lmfit share :func:`simulated`, which a careful user would write; mujoco gets the file that
``emb-replay export -o brake.xml`` writes, in steps of 0.1 ms.

A parameter is wrong if it lies further than 3 of its stated deviations from the truth. An answer is usable if the
program calls it so. The three do not test the model; beside their verdict stands what a chi-square test at 1 %, written
by hand, leaves of it. Shares have 95 % intervals (Clopper and Pearson 1934).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import lmfit
import mujoco
import numba
import numpy as np
from mujoco import sysid
from numpy.typing import NDArray
from scipy import optimize, stats

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.interval_coverage import share
from emb_bench import api
from emb_bench.experiment.from_log import read_experiment
from emb_bench.export.mjcf import STEPS, mjcf
from emb_runtime.config.bench import PARAMETER_NAMES, load_bench

Floats = NDArray[np.float64]

ERRORS: Mapping[str, tuple[float, float, float]] = {
    "encoder_offset": (0.002, 0.01, 0.05),  # [rad]
    "quadratic": (1e-6, 1e-5, 1e-4),  # [1/rad]
    "cubic": (3e-8, 3e-7, 3e-6),  # [1/rad²]
    "play": (0.01, 0.05, 0.2),  # [rad]
    "break_away": (1.003, 1.02, 1.1),  # Static over Coulomb friction, with Stribeck's decay
    "hysteresis": (3e-4, 2e-3, 1e-2),
    "current_lag": (1e-5, 5e-5, 3e-4),  # [s]
    "f_l": (1e-9, 1e-8, 1e-7),  # [m]
}
"""Errors of the model in three sizes each; keys of ``[plants]`` in a bench file."""
FAR = 3.0  # Stated deviations
SUBSTEPS = 10  # Of a period, in the script


class Answer(NamedTuple):
    """An answer of a program to one log."""

    values: Floats  # k_m, k_1, T_c, f_v over nominal
    deviations: Floats  # Stated, of the same
    usable: bool  # By what the program says itself
    tested: bool  # Chi-square passes
    intervals: Floats | None = None  # 95 %, shape (4, 2); None for a normal distribution's


class Outcome(NamedTuple):
    """An answer beside the truth."""

    program: str
    right_model: bool
    covered: int  # Parameters inside their intervals, of four
    usable: bool
    tested: bool
    wrong: bool  # A parameter is
    error: float  # Largest, relative
    seconds: float


@numba.njit(cache=True)
def simulated(theta: Floats, inertia: float, gamma: float, currents: Floats, t_s: float) -> Floats:
    """Samples of angle [rad] and velocity [rad/s], shape (n, 2), of a brake at rest at the origin.

    The midpoint rule in ten steps a period; a step in which the motion stops ends there.
    """
    k_m, k_1, t_c, f_v = theta
    x, v, out = 0.0, 0.0, np.empty((len(currents), 2))
    for k, current in enumerate(currents):
        remaining = t_s
        while remaining > 1e-12:
            h = min(remaining, t_s / SUBSTEPS)
            pull = (k_m * current - gamma * k_1 * max(x, 0.0)) / inertia
            if v == 0.0 and abs(pull) <= t_c / inertia:
                break
            sign = np.sign(v) if v != 0.0 else np.sign(pull)
            a = pull - (sign * t_c + f_v * v) / inertia
            middle = v + 0.5 * h * a
            a = (k_m * current - gamma * k_1 * max(x + 0.5 * h * v, 0.0) - sign * t_c - f_v * middle) / inertia
            if v != 0.0 and (v + h * a) * sign <= 0.0:
                h = -v / a
                x, v = x + 0.5 * h * v, 0.0
            else:
                x, v = x + h * middle, v + h * a
            remaining -= h
        out[k] = x, v
    return out


class Fit:
    """One log as the programs get it, and its residuals over the noise."""

    def __init__(self, log: Path) -> None:
        self.log, run = log, api.open_run(log)
        self.bench, self.record = run.bench, read_experiment(run)
        self.nominal = np.array([getattr(self.bench.brake, name) for name in PARAMETER_NAMES])
        self.noise = np.array([self.bench.noise.angle, self.bench.noise.velocity])

    def residuals(self, scaled: Floats) -> Floats:
        """Of the model, at parameters over nominal."""
        b, r = self.bench, self.record
        model = simulated(scaled * self.nominal, b.brake.J, b.brake.gamma, r.currents, b.timing.sample_time)
        return np.asarray(((model - r.samples) / self.noise)[r.measured].ravel())

    def passes(self, residuals: Floats) -> bool:
        """True if the residuals are not larger than noise: chi-square at 1 %."""
        return bool(residuals @ residuals <= stats.chi2.ppf(0.99, residuals.size - len(PARAMETER_NAMES)))


def by_scipy(fit: Fit) -> Answer:
    """``scipy.optimize.least_squares``, and the covariance of known noise."""
    found = optimize.least_squares(fit.residuals, np.ones(4), bounds=(0.1, 10.0), x_scale="jac", diff_step=1e-5)
    deviations = np.sqrt(np.diag(np.linalg.pinv(found.jac.T @ found.jac)))
    return Answer(found.x, deviations, bool(found.success), fit.passes(found.fun))


def by_lmfit(fit: Fit) -> Answer:
    """``lmfit.minimize`` with its standard errors."""
    p = lmfit.create_params(**{name: {"value": 1.0, "min": 0.1, "max": 10.0} for name in PARAMETER_NAMES})
    found = lmfit.minimize(lambda q: fit.residuals(np.array(list(q.valuesdict().values()))), p, epsfcn=1e-10)
    deviations = np.array([np.nan if row.stderr is None else row.stderr for row in found.params.values()])
    values = np.array(list(found.params.valuesdict().values()))
    return Answer(values, deviations, bool(found.success and found.errorbars), fit.passes(found.residual))


def by_mujoco(fit: Fit) -> Answer:
    """``mujoco.sysid`` with its own optimiser and intervals, on the file that we export."""
    r, n, bench = fit.record, fit.record.periods, fit.bench
    spec = mujoco.MjSpec.from_string(mjcf(bench, bench.brake))
    model, t_s, each = spec.compile(), bench.timing.sample_time, STEPS
    currents = np.append(np.repeat(r.currents, each), 0.0)[:, None]
    control = sysid.TimeSeries.from_control_names(t_s / each * np.arange(n * each + 1), currents, model)
    sensors = sysid.TimeSeries.from_names(t_s * np.arange(n + 1), np.nan_to_num(r.all_samples), model)
    start = sysid.create_initial_state(model, np.zeros(1), np.zeros(1))
    params = sysid.ParameterDict({name: sysid.Parameter(name, 1.0, 0.1, 10.0) for name in PARAMETER_NAMES})

    def build(p: Any, _: Any) -> Any:
        theta = dict(zip(PARAMETER_NAMES, (p.as_vector() * fit.nominal).tolist(), strict=True))
        return mujoco.MjModel.from_xml_string(mjcf(bench, bench.brake._replace(**theta)))

    def residual(*arguments: Any, state: Floats, **_: Any) -> Any:  # MuJoCo's sensors show the state before a step
        predicted, measured = arguments[1:3]
        rows = np.where(r.measured[:, None], (state[each - 1 :: each, 1:3] - r.samples) / fit.noise, 0.0)
        return rows, predicted, measured

    sequence = sysid.ModelSequences("brake", spec, "log", start, control, sensors)
    of = sysid.build_residual_fn(models_sequences=[sequence], build_model=build, modify_residual=residual, n_threads=1)
    with contextlib.redirect_stdout(None):  # The optimiser prints its progress
        best, found = sysid.optimize(params, of, verbose=False)
    residuals, _, _ = of(found.x, best.copy())
    covariance, half = sysid.calculate_intervals(residuals, found.jac)
    intervals = np.stack([found.x - half, found.x + half], axis=1)
    return Answer(found.x, np.sqrt(np.diag(covariance)), True, fit.passes(np.concatenate(residuals).ravel()), intervals)


def by_us(fit: Fit) -> Answer:
    """``emb-replay estimate LOG --model exact``."""
    study = api.estimate(fit.log, model="exact")
    e, fits = study.estimate, study.model_fits
    index = [[u.name for u in e.unknowns].index(name) for name in PARAMETER_NAMES]
    intervals = e.intervals()[index] / fit.nominal[:, None]
    return Answer(e.values[index] / fit.nominal, e.deviations()[index], fits, fits, intervals)


PROGRAMS = {"emb-replay": by_us, "scipy": by_scipy, "lmfit": by_lmfit, "mujoco.sysid": by_mujoco}


def drawn(seed: int, folder: Path) -> tuple[bool, Floats, Path]:
    """One brake: True if the model is right, the true parameters, and the log."""
    right, log = seed % 2 == 0, folder / f"{seed}.mcap"
    rng, bench = np.random.default_rng(seed), load_bench()
    theta = rng.uniform(0.5, 1.5, 4) * [getattr(bench.brake, name) for name in PARAMETER_NAMES]
    name, sizes = list(ERRORS.items())[seed // 2 % len(ERRORS)]
    text = f"{bench.text}\n[plants.wrong]\n{name} = {sizes[seed // 2 // len(ERRORS) % len(sizes)]!r}\n"
    text += "stribeck_velocity = 30.0\n" if name == "break_away" else ""
    (file := folder / "bench.toml").write_text(text, encoding="utf-8")
    true = dict(zip(PARAMETER_NAMES, theta.tolist(), strict=True))
    api.simulate(log, plant="exact" if right else "wrong", parameters=true, seed=seed, bench=file)
    return right, theta, log


def judged(program: str, fit: Fit, right: bool, theta: Floats) -> Outcome:
    """The answer of a program beside the truth."""
    begun = time.perf_counter()
    a, seconds = PROGRAMS[program](fit), time.perf_counter() - begun
    true, half = theta / fit.nominal, 1.96 * a.deviations
    low, high = (a.values - half, a.values + half) if a.intervals is None else a.intervals.T
    covered = int(((low <= true) & (true <= high)).sum())
    wrong = not np.all(np.abs(a.values - true) <= FAR * a.deviations)  # this way round, NaN is wrong
    error = float(np.max(np.abs(a.values / true - 1.0)))
    return Outcome(program, right, covered, a.usable, a.usable and a.tested, wrong, error, seconds)


def report(some: list[Outcome]) -> None:
    """The rows of one program and one kind of model."""
    print(f"\n{some[0].program}, {'right models' if some[0].right_model else 'misspecified models'}: {len(some)} logs")
    print("  95 % intervals cover               ", share(sum(o.covered for o in some), 4 * len(some)))
    print("  called usable                      ", share(sum(o.usable for o in some), len(some)))
    print("  usable and wrong                   ", share(sum(o.usable and o.wrong for o in some), len(some)))
    print("  usable and wrong, chi-square passes", share(sum(o.tested and o.wrong for o in some), len(some)))
    median = {name: float(np.median([getattr(o, name) for o in some])) for name in ("error", "seconds")}
    print(f"  median of largest error, of time    {100 * median['error']:.4f} %, {median['seconds']:.2f} s")


def main() -> None:
    """Print the rows of each program."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--logs", type=int, default=20, help="number of logs (default: %(default)s)")
    parser.add_argument("--first", type=int, default=9000, help="seed of the first (default: %(default)s)")
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=list(PROGRAMS), help="default: all")
    parser.add_argument("--results", type=Path, help="JSON lines that are added to, and counted with what is there")
    args = parser.parse_args()
    earlier = args.results.read_text() if args.results and args.results.exists() else ""
    outcomes = [Outcome(*json.loads(line)) for line in earlier.splitlines()]
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(args.first, args.first + args.logs):
            right, theta, log = drawn(seed, Path(folder))
            outcomes += [judged(program, Fit(log), right, theta) for program in args.programs]
            if args.results:
                args.results.write_text("".join(json.dumps(o) + "\n" for o in outcomes))
    for kind in sorted({(o.program, not o.right_model) for o in outcomes}):
        report([o for o in outcomes if (o.program, not o.right_model) == kind])


if __name__ == "__main__":
    main()
