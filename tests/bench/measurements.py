"""Records of simulated brakes as an estimator takes them, without a bus."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from emb_bench import excitation
from emb_bench.brake.motion import advance, no_sensitivity, rest
from emb_bench.compiled import compiled
from emb_bench.config.bench import Bench
from emb_bench.config.plants import Instruments, Plant
from emb_bench.estimate.estimate import Estimate
from emb_bench.estimate.methods import method_of
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import EstimationProblem
from emb_bench.excitation import parse_excitation, run_excitation
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_bench.sim.instruments import MEMORY, measure, settle
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters

AT_REST = 7.0  # The start is the mean of about 50 samples: this many times better known than one

WALK = 10.0  # Of the disturbed brake's velocity [rad/s per root of a second]
FINE = 5  # Its kicks per period

Floats = NDArray[np.float64]


def currents_of(bench: Bench, text: str, brake: BrakeParameters | None = None) -> Floats:
    """What an excitation does under the shield on the exact brake, at full speed from the first sample on.

    A run proves its response first, at a speed that leaves the slow start of a chirp half of its travel.
    """
    mechanics = bench.plant("exact").mechanics
    with pytest.MonkeyPatch.context() as proven:
        proven.setattr(excitation, "unproven_law", lambda _, law: law)
        played = run_excitation(bench, parse_excitation(text, bench), mechanics, brake or bench.brake, shielded=True)
    return played.currents


def record(
    bench: Bench,
    plant: Plant,
    currents: Floats,
    *,
    brake: BrakeParameters | None = None,
    seed: int | None = 0,
    noise: float = 1.0,
    x0: tuple[float, float] = (0.0, 0.0),
) -> Experiment:
    """What a plant's instruments show of a brake under a sequence of currents.

    Args:
        bench: noise and sample time.
        plant: what moves and measures.
        currents: what acts, shape (n,).
        brake: nominal without.
        seed: of the errors; None for none.
        noise: their size, in the bench's.
        x0: where the brake begins.
    """
    t_s, instruments = bench.timing.sample_time, plant.instruments
    moving = replace(plant, instruments=Instruments())
    states = simulate(moving, Theta(brake or bench.brake, x0), planned(currents), t_s).states
    rng = np.random.default_rng(seed)
    size = 0.0 if seed is None else noise
    errors = size * rng.standard_normal((len(currents), 2)) * [bench.noise.angle, bench.noise.velocity]
    late = instruments.clock_jitter * rng.standard_normal(len(currents))
    slack = bench.noise.angle / AT_REST
    seen = x0[0] + instruments.encoder_offset + size * slack * float(rng.standard_normal())
    memory = np.zeros(MEMORY)
    settle(instruments, memory, x0[0])
    samples = np.empty((len(currents), 2))
    for k in range(len(currents)):
        acceleration = float(states[k + 1, 1] - states[k, 1]) / t_s
        (x1, x2), (e1, e2) = states[k + 1].tolist(), errors[k].tolist()
        samples[k] = measure(instruments, memory, t_s, x1, x2, acceleration, float(late[k]), e1, e2)
    return Experiment("simulated", currents, samples, seen, x0[1], slack, abs(seen) <= 4.0 * slack and x0[1] == 0.0)


def disturbed(
    bench: Bench, currents: Floats, brake: BrakeParameters, seed: int, walk: float = WALK, fine: int = FINE
) -> Experiment:
    """The exact brake whose velocity is kicked several times a period."""
    rng, t = np.random.default_rng(seed), bench.timing.sample_time / fine
    mechanics, move = bench.plant("exact").mechanics, compiled(advance)
    (chosen, s), x, states = no_sensitivity(()), rest(), np.empty((len(currents), 2))
    for k, u in enumerate(currents.tolist()):
        for kick in (walk * t**0.5 * rng.standard_normal(fine)).tolist():
            move(mechanics, brake, x, u, t, chosen, s)
            x[1] += kick
        states[k] = x[:2]
    noise = rng.standard_normal(states.shape) * [bench.noise.angle, bench.noise.velocity]
    return Experiment("disturbed", currents, states + noise, 0.0, 0.0, 0.0, True)


def fit(
    bench: Bench,
    plant: Plant | str,
    records: Sequence[Experiment],
    asked: EstimationProblem | None = None,
    *,
    method: str = "oem",
    starts: int = 1,
    seed: int = 0,
) -> Estimate:
    """An estimate, unless said otherwise of the four parameters, by output error, and from one start."""
    model = bench.plant(plant) if isinstance(plant, str) else plant
    return method_of(method)(bench, model, asked or EstimationProblem(), starts=starts, seed=seed).fit(records)


def problem_of(bench: Bench, names: tuple[str, ...], *records: Experiment, plant: str = "exact") -> Problem:
    """Problem of some unknowns."""
    return Problem(bench, bench.plant(plant), EstimationProblem(names), records)


def hard(bench: Bench) -> BrakeParameters:
    """A brake that a simulated search from the nominal one does not find under constant speed."""
    b = bench.brake
    return b._replace(k_m=0.99 * b.k_m, k_1=1.31 * b.k_1, T_c=1.35 * b.T_c, f_v=0.89 * b.f_v)


def coloured(bench: Bench) -> Experiment:
    """Record of a chirp whose errors are a moving average, of the bench's variance at each sample."""
    clean = record(bench, bench.plant("exact"), currents_of(bench, "chirp"), seed=None)
    white = np.random.default_rng(2).standard_normal((503, 2)) * [bench.noise.angle, bench.noise.velocity]
    errors = 0.5 * (white[:-3] + white[1:-2] + white[2:-1] + white[3:])
    return replace(clean, samples=clean.samples + errors)


def check_derivatives(residuals: Callable[[Floats], Floats], z: Floats, jacobian: Floats) -> None:
    """Asserts that derivatives are those of residuals by central differences."""
    for i in range(len(z)):
        h = 1e-5 * max(abs(float(z[i])), 0.1)
        up, down = z.copy(), z.copy()
        up[i] += h
        down[i] -= h
        differences = (residuals(up) - residuals(down)) / (2.0 * h)
        assert jacobian[:, i] == pytest.approx(differences, rel=1e-3, abs=1e-3 * np.abs(jacobian[:, i]).max())


def errors_in_sigmas(found: Estimate, brake: BrakeParameters) -> Floats:
    """How far an estimate's brake parameters lie from the truth, in the deviations that it claims."""
    own = [i for i, u in enumerate(found.unknowns) if u.name in PARAMETER_NAMES]
    true = np.array([getattr(brake, found.unknowns[i].name) for i in own])
    values = found.values[own]
    result: Floats = (values - true) / (found.deviations()[own] * np.abs(values))
    return result
