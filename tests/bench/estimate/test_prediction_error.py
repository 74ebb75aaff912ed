from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg, stats

from emb_bench.config.bench import Bench
from emb_bench.estimate.effects import with_systematic
from emb_bench.estimate.innovations import Filter
from emb_bench.estimate.output_error import search
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import EstimationProblem
from emb_bench.estimate.search import converge, minimise
from emb_bench.experiment.experiment import Experiment
from emb_runtime.config.bench import PARAMETER_NAMES

from tests.bench.measurements import (  # isort: skip
    WALK,
    check_derivatives,
    coloured,
    currents_of,
    disturbed,
    errors_in_sigmas,
    fit,
    problem_of,
    record,
)

estimate = partial(fit, method="pem")

Floats = NDArray[np.float64]

LOAD = 0.1  # Random walk of a load, as a current [A per root of a second]
DRAWS = 16
CASES = [
    (PARAMETER_NAMES, "exact"),
    ((*PARAMETER_NAMES, "x1_0", "x2_0", "offset"), "exact"),
    (("k_1", "contact", "x1_0", "delay"), "exact"),
    (("delay", "f_v", "J"), "stribeck"),
    (("k_m", "T_c", "offset"), "late"),
    (("k_m", "f_v"), "observer"),
    (("k_m", "k_1"), "lag"),
    (("f_v", "current_offset", "velocity_gain"), "exact"),
]
AWAY = {"delay": 0.3, "contact": 0.2, "current_offset": 0.1, "velocity_gain": 0.02}
"""What is added to those unknowns, where derivatives are compared."""


def known_start(data: Experiment) -> Experiment:
    """The same, not to be questioned."""
    return replace(data, slack=0.0)


@pytest.mark.parametrize(("names", "plant"), CASES)
def test_without_disturbance_and_with_a_known_start_innovations_are_output_errors(
    bench: Bench, names: tuple[str, ...], plant: str
) -> None:
    data = known_start(record(bench, bench.plant(plant), currents_of(bench, "chirp")))
    samples = data.samples.copy()
    samples[[3, 50, 51]] = np.nan
    stamps = 1e-5 * np.random.default_rng(0).standard_normal(500)
    problem = problem_of(bench, names, replace(data, samples=samples, late=stamps), plant=plant)
    away = np.array([0.0 if n == "delay" else AWAY.get(n, 0.0) for n in names])
    z = problem.coordinates(1.02 * problem.values(problem.nominal())) + away
    weights = problem.weights(z)
    errors, jacobian = problem.jacobian(z, weights)
    gains = (found := Filter(problem, 0.0)).gains(z, weights)
    innovations, derivatives = found.jacobian(z, weights, gains)
    assert not np.any(gains[0][:, :, :2])
    assert innovations == pytest.approx(errors, rel=1e-9, abs=1e-9)
    assert derivatives == pytest.approx(jacobian, rel=1e-9, abs=1e-9 * np.abs(jacobian).max())
    assert found.deviance(z, weights) == pytest.approx(float(errors @ errors), rel=1e-9)


def test_commands_that_act_early_do_so_in_the_filter_as_in_the_simulation(bench: Bench) -> None:
    data = known_start(record(bench, bench.plant("exact"), currents_of(bench, "chirp")))
    problem = problem_of(bench, ("k_m", "delay"), data)
    k_m = math.log(1.01 * bench.brake.k_m)
    z = np.array([k_m, -0.05])
    weights, found = problem.weights(z), Filter(problem, 0.0)
    errors, _ = problem.jacobian(z, weights)
    assert found.jacobian(z, weights, found.gains(z, weights))[0] == pytest.approx(errors, rel=1e-9, abs=1e-9)
    walking = Filter(problem, WALK)
    gains = walking.gains(z, weights)
    late = walking.jacobian(np.array([k_m, 0.05]), weights, gains)[0]
    none, derivatives = walking.jacobian(np.array([k_m, 0.0]), weights, gains)
    early, _ = walking.jacobian(z, weights, gains)
    assert early == pytest.approx(none - 0.05 * derivatives[:, 1], rel=1e-9, abs=1e-9)
    assert np.linalg.norm(late - none + early - none) < 0.05 * np.linalg.norm(late - none)


@pytest.mark.parametrize("load", [0.0, 0.3])
@pytest.mark.parametrize(("names", "plant"), CASES)
def test_derivatives_are_those_of_the_innovations_with_the_gains_held(
    bench: Bench, names: tuple[str, ...], plant: str, load: float
) -> None:
    data = record(bench, bench.plant(plant), currents_of(bench, "chirp")[:200], x0=(0.3, 20.0))
    problem = problem_of(bench, names, data, plant=plant)
    z = problem.coordinates(1.03 * problem.values(problem.nominal())) + np.array([AWAY.get(n, 0.0) for n in names])
    weights, found = problem.weights(z), Filter(problem, 3.0, load)
    gains = found.gains(z, weights)
    assert np.any(gains[0][:, :, :2])
    _, jacobian = found.jacobian(z, weights, gains)
    check_derivatives(lambda z: found.jacobian(z, weights, gains)[0], z, jacobian)


@pytest.mark.parametrize("load", [0.0, 0.3])
def test_where_the_brake_is_linear_it_is_the_kalman_filter_of_the_books(bench: Bench, load: float) -> None:
    """Forward in contact; matrices, an exponential, Van Loan's integral of the noise and the Cholesky factor."""
    b, t_s, n = bench.brake, bench.timing.sample_time, 60
    currents = 1.2 + 0.5 * np.sin(np.arange(float(n)) / 4.0)
    data = known_start(record(bench, bench.plant("exact"), currents))
    samples = data.samples.copy()
    samples[[10, 30, 31]] = np.nan
    problem = problem_of(bench, ("k_m",), replace(data, samples=samples))
    a = np.array([[0.0, 1.0, 0.0], [-b.gamma * b.k_1 / b.J, -b.f_v / b.J, b.k_m / b.J], [0.0, 0.0, 0.0]])
    block = np.zeros((4, 4))
    block[:3, :3], block[1, 3] = a, 1.0
    transition = linalg.expm(block * t_s)
    walk = np.diag([0.0, WALK**2, load**2])
    van_loan = linalg.expm(np.block([[-a, walk], [np.zeros((3, 3)), a.T]]) * t_s)
    spread = van_loan[3:, 3:].T @ van_loan[:3, 3:]
    seen = np.eye(2, 3)
    noise = np.diag([bench.noise.angle**2, bench.noise.velocity**2])
    x, p, expected, growth = np.zeros(3), np.zeros((3, 3)), np.zeros((n, 2)), 0.0
    for k in range(n):
        x = transition[:3, :3] @ x + transition[:3, 3] * (b.k_m * currents[k] - b.T_c) / b.J
        p = transition[:3, :3] @ p @ transition[:3, :3].T + spread
        if np.isfinite(samples[k, 0]):
            whole = seen @ p @ seen.T + noise
            surprise = samples[k] - seen @ x
            expected[k] = linalg.solve_triangular(np.linalg.cholesky(whole), surprise, lower=True)
            growth += float(np.linalg.slogdet(whole)[1] - np.linalg.slogdet(noise)[1])
            gain = p @ seen.T @ np.linalg.inv(whole)
            x, p = x + gain @ surprise, p - gain @ whole @ gain.T
    z = problem.nominal()
    weights, found = problem.weights(z), Filter(problem, WALK, load)
    errors, _ = found.jacobian(z, weights, found.gains(z, weights))
    # The noise of a period is taken as that of free motion, which is right to f_v T / J.
    assert errors.reshape(n, 2) == pytest.approx(expected, abs=5e-3)
    assert found.deviance(z, weights) == pytest.approx(float(np.sum(expected**2)) + growth, rel=1e-3)


@pytest.mark.slow
def test_on_a_disturbed_brake_the_estimate_is_as_good_as_it_says_and_output_error_is_not(bench: Bench) -> None:
    brake = bench.brake._replace(f_v=3e-5)
    currents, plant = currents_of(bench, "chirp", brake)[:300], bench.plant("exact")
    true = np.array([getattr(brake, name) for name in PARAMETER_NAMES])
    errors, inside, walks, blind, fits = [], [], [], [], 0
    for seed in range(DRAWS):
        data = disturbed(bench, currents, brake, seed)
        found = estimate(bench, plant, [data])
        errors.append((found.values - true) / (found.cramer_rao() * found.values))
        low, high = found.intervals().T
        inside.append((low <= true) & (true <= high))
        if seed < 6:
            other = fit(bench, plant, [data])
            assert not other.validation.fits
            low, high = other.intervals().T
            blind.append((low <= true) & (true <= high))
        walks.append(found.process_noise)
        fits += found.validation.fits
        assert found.validation.disturbance is not None
    squares = np.mean(np.square(errors), axis=0)
    low, high = stats.chi2.ppf([0.0005, 0.9995], DRAWS) / DRAWS
    assert ((low < squares) & (squares < high)).all(), squares
    assert np.mean(inside) >= stats.binom.ppf(0.001, 4 * DRAWS, 0.95) / (4 * DRAWS)
    assert np.mean(blind) < 0.6
    assert fits >= DRAWS - 1
    assert np.mean(walks) == pytest.approx(WALK, rel=0.1)


def test_systematic_errors_are_estimated_along_on_a_disturbed_brake(bench: Bench) -> None:
    currents, errors = currents_of(bench, "chirp"), {"offset": 0.01, "current_offset": 0.03, "velocity_gain": 0.01}
    moved = disturbed(bench, currents + errors["current_offset"], bench.brake, 6)
    samples = moved.samples * [1.0, 1.0 + errors["velocity_gain"]] + [errors["offset"], 0.0]
    data = replace(moved, currents=currents, samples=samples, angle=errors["offset"], slack=1e-4, from_origin=False)
    plant = bench.plant("exact")
    asked = with_systematic(EstimationProblem(), bench, plant)
    found = estimate(bench, plant, [data], asked)
    assert found.validation.fits, found.validation.alarming
    true = bench.brake._asdict() | errors | {"x1_0": 0.0, "delay": 0.0}
    scale = np.array([abs(true[u.name]) if u.relative else 1.0 for u in found.unknowns])
    off = (found.values - np.array([true[u.name] for u in found.unknowns])) / (found.cramer_rao() * scale)
    assert (np.abs(off) < 4.0).all(), off
    assert {u.name for u in found.unknowns} == {*PARAMETER_NAMES, "x1_0", "delay", *errors}
    assert not estimate(bench, plant, [data]).validation.fits


@pytest.mark.parametrize("seed", [1, 2])
def test_a_load_that_walks_is_told_from_a_velocity_that_does(bench: Bench, seed: int) -> None:
    """The load as a current that acts besides."""
    currents, plant, rng = currents_of(bench, "chirp"), bench.plant("exact"), np.random.default_rng(seed)
    load = np.cumsum(LOAD * bench.timing.sample_time**0.5 * rng.standard_normal(len(currents)))
    data = replace(record(bench, plant, currents + load, seed=seed), currents=currents)
    found = estimate(bench, plant, [data])
    assert found.validation.fits
    assert found.process_noise == 0.0
    assert found.load_noise == pytest.approx(LOAD, rel=0.4)
    assert (np.abs(errors_in_sigmas(found, bench.brake)) < 4.5).all()
    assert found.validation.disturbance is not None
    assert found.validation.disturbance.load == found.load_noise


def test_on_a_brake_that_nothing_disturbs_it_is_output_error(bench: Bench) -> None:
    plant, currents, still, alarms = bench.plant("exact"), currents_of(bench, "chirp"), 0, 0
    for seed in range(3):
        data = record(bench, plant, currents, seed=seed)
        found = estimate(bench, plant, [data])
        other = fit(bench, plant, [data])
        alarms += not found.validation.fits
        if found.process_noise == found.load_noise == 0.0:
            still += 1
            assert found.values == pytest.approx(other.values, rel=1e-6)
            assert found.cramer_rao() == pytest.approx(other.cramer_rao(), rel=1e-4)
        assert (np.abs(errors_in_sigmas(found, bench.brake)) < 4.5).all()
    assert alarms <= 1
    assert still >= 1  # half of them, if the likelihood is as the books say
    assert found.method == "pem"


@pytest.mark.parametrize("plant", ["stribeck", "hysteresis", pytest.param("late", marks=pytest.mark.slow)])
def test_what_the_model_lacks_is_not_taken_for_a_good_fit(bench: Bench, plant: str) -> None:
    data = record(bench, bench.plant(plant), currents_of(bench, "chirp"))
    found = estimate(bench, "exact", [data])
    assert not found.validation.fits
    assert max(found.process_noise, found.load_noise) > 0.0


def test_coloured_noise_is_an_alarm_for_a_method_that_whitens(bench: Bench) -> None:
    found = estimate(bench, "exact", [coloured(bench)])
    assert any(name.startswith("whiteness") for name in found.validation.alarming)


def test_several_disturbed_records_with_their_own_starts_are_followed_together(bench: Bench) -> None:
    currents, plant = currents_of(bench, "chirp")[:300], bench.plant("exact")
    records = [replace(disturbed(bench, currents, bench.brake, seed), slack=1e-4) for seed in (1, 2)]
    records[1].samples[[40, 41, 42]] = np.nan
    found = estimate(bench, plant, records, EstimationProblem(nuisances=("x1_0",)), starts=2)
    assert found.labels == (*PARAMETER_NAMES, "x1_0[0]", "x1_0[1]")
    true = [*(getattr(bench.brake, name) for name in PARAMETER_NAMES), 0.0, 0.0]
    low, high = found.intervals().T
    assert (np.abs(found.values - true) < 2.5 * (high - low) / 2.0).all()
    assert np.isnan(found.residuals[1][[40, 41, 42]]).all()
    assert len(found.ends) == 2
    assert found.ends[0].start.tolist() != found.ends[1].start.tolist()


def test_a_start_that_was_seen_but_is_not_certain_is_one_that_the_samples_may_correct(bench: Bench) -> None:
    """As if it were unknown, with the measurement before the experiment as a prior."""
    plant = bench.plant("exact")
    data = record(bench, plant, currents_of(bench, "chirp")[:200], x0=(0.5, 0.0), seed=4)
    assert not data.from_origin
    blind, asked = (
        Problem(bench, plant, EstimationProblem(), (data,)),
        Problem(bench, plant, EstimationProblem(nuisances=("x1_0",)), (data,)),
    )
    z = converge(Filter(blind, 0.0), blind.nominal()).z
    free = search(asked, asked.nominal(), asked.weights(asked.nominal())).z
    assert z == pytest.approx(free[:4], rel=1e-5)


def test_a_trial_step_at_which_the_filter_diverges_is_one_that_is_not_taken(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp"))
    problem = problem_of(bench, PARAMETER_NAMES, data)
    start = problem.nominal()

    def diverging(z: Floats) -> tuple[Floats, Floats]:
        far = 1e200 if z[0] > start[0] + 0.2 else 1.0
        return far * (z - start - 0.5), far * np.eye(len(z))

    end = minimise(problem, start, diverging)
    assert end.z[0] <= start[0] + 0.2
    assert math.isfinite(end.cost)
