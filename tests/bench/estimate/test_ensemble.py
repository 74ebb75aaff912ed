from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emb_bench.estimate import ensemble
from emb_bench.estimate.ensemble import add_squares, minima, sums_of_squares, walkers
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import End, EstimationProblem, Record
from emb_bench.sim.open_loop import simulate
from emb_runtime.config.bench import Bench
from emb_runtime.errors import UsageError

from tests.bench.measurements import currents_of, fit, record  # isort: skip

estimate = partial(fit, method="ensemble")

Floats = NDArray[np.float64]

LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)


def sticking(bench: Bench) -> Record:
    """A push that the friction holds: T_c is at least so much, and may be anything above."""
    return record(bench, bench.plant("exact"), np.full(20, 0.4))


def quantiles(values: NDArray[Any], density: NDArray[Any]) -> Floats:
    """Of a density on a grid, by its cumulative sum."""
    mass = np.cumsum(density)
    result: Floats = np.interp(LEVELS, mass / mass[-1], values)
    return result


def test_where_the_posterior_is_gaussian_the_draws_have_the_covariance_of_the_bound(bench: Bench) -> None:
    plant, asked = bench.plant("exact"), EstimationProblem(("k_m", "T_c"))
    data = record(bench, plant, currents_of(bench, "chirp")[:120])
    found, best = (f(bench, plant, [data], asked, starts=2) for f in (estimate, fit))
    assert found.method == "ensemble"
    assert found.draws is not None
    assert found.draws.shape[0] > 1000
    relative = found.draws / best.values
    covariance = np.linalg.inv(best.information)
    scale = np.sqrt(np.diag(covariance))
    assert np.cov(relative.T) / np.outer(scale, scale) == pytest.approx(covariance / np.outer(scale, scale), abs=0.15)
    assert (np.abs(relative.mean(axis=0) - 1.0) < 0.15 * scale).all()
    assert found.deviations() == pytest.approx(best.deviations(), rel=0.1)
    assert found.values.tolist() == np.median(found.draws, axis=0).tolist()
    assert found.theta == bench.brake._replace(k_m=found.values[0], T_c=found.values[1])
    assert found.intervals() == pytest.approx(best.intervals(), abs=0.2 * float(np.max(scale * best.values)))
    assert found.validation == best.validation
    assert len(found.caveats) == 1
    assert "the prior is flat" in found.caveats[0]


def test_a_brake_that_sticks_bounds_its_friction_from_below_only(bench: Bench) -> None:
    """By brute force: the prior's Gaussian times the likelihood, on a grid of plain simulations."""
    plant, ranges, data = bench.plant("exact"), bench.range_set("pm50"), sticking(bench)
    found = estimate(bench, plant, [data], EstimationProblem(("T_c",), prior=ranges), starts=2)
    low, high = ranges.low.T_c, ranges.high.T_c
    grid = np.linspace(0.1 * bench.brake.T_c, 3.0 * bench.brake.T_c, 2001)
    still = simulate(plant.mechanics, bench.brake, data.currents, 1e-3).states[1:]
    assert not np.any(still)
    squares = []
    for t_c in grid.tolist():
        states = still
        if t_c < bench.brake.k_m * 0.4:
            states = simulate(plant.mechanics, bench.brake._replace(T_c=t_c), data.currents, 1e-3).states[1:]
        errors = (data.samples - states) / [bench.noise.angle, bench.noise.velocity]
        squares.append(float(np.sum(errors**2)))
    prior = 12.0 * ((grid - 0.5 * (low + high)) / (high - low)) ** 2
    exponent = -0.5 * (np.array(squares) + prior)
    expected = quantiles(grid, np.exp(exponent - exponent.max()))
    assert found.draws is not None
    drawn = np.quantile(found.draws[:, 0], LEVELS)
    assert drawn == pytest.approx(expected, abs=0.05 * float(expected[-1] - expected[0]))
    (below, above), middle = found.intervals()[0], found.values[0]
    assert above - middle > 1.3 * (middle - below)
    assert "Gaussian from the ranges 'pm50' for T_c" in found.caveats[0]


def test_in_two_dimensions_the_draws_fill_the_posterior_of_a_grid(bench: Bench) -> None:
    """What sticks is k_m u < T_c: a triangle."""
    plant, data = bench.plant("exact"), sticking(bench)
    b = bench.brake
    bounds = {"k_m": (0.5 * b.k_m, 2.0 * b.k_m), "T_c": (0.5 * b.T_c, 2.0 * b.T_c)}
    found = estimate(bench, plant, [data], EstimationProblem(("k_m", "T_c"), bounds=bounds), starts=2)
    problem = Problem(bench, plant, EstimationProblem(("k_m", "T_c")), (data,))
    weights = problem.weights(np.ones(2))
    grid = 0.5 + 1.5 * (np.arange(120) + 0.5) / 120.0
    places = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1).reshape(-1, 2)
    squares = sums_of_squares(problem, places, weights).reshape(120, 120)
    density = np.exp(-0.5 * (squares - squares.min()))
    assert found.draws is not None
    assert found.draws.shape[1] == 2
    for column, (axis, nominal) in enumerate(((1, b.k_m), (0, b.T_c))):
        expected = quantiles(grid, density.sum(axis=axis))
        assert np.quantile(found.draws[:, column] / nominal, LEVELS) == pytest.approx(expected, abs=0.06)


@pytest.mark.parametrize(
    ("names", "plant"),
    [
        (("k_m", "x1_0", "offset"), "exact"),
        (("k_1", "contact", "x1_0", "x2_0", "delay"), "exact"),
        (("k_m", "T_c"), "late"),
        (("J", "f_v"), "lag"),
        (("k_m", "f_v"), "observer"),
    ],
)
def test_sums_of_squares_are_those_of_the_residuals(bench: Bench, names: tuple[str, ...], plant: str) -> None:
    data = record(bench, bench.plant(plant), currents_of(bench, "chirp")[:200], x0=(0.3, 20.0))
    data.samples[[7, 8, 90]] = np.nan
    data = replace(data, late=1e-5 * np.random.default_rng(0).standard_normal(200))
    problem = Problem(bench, bench.plant(plant), EstimationProblem(names), (data, data))
    rng = np.random.default_rng(1)
    places = problem.nominal() + 0.1 * rng.random((3, len(problem.unknowns)))
    weights = problem.weights(places[0])
    expected = [float(np.sum(problem.jacobian(z, weights)[0] ** 2)) for z in places]
    assert sums_of_squares(problem, places, weights) == pytest.approx(expected, rel=1e-9)


def test_sums_of_squares_are_the_same_compiled_and_as_they_are(bench: Bench) -> None:
    data = sticking(bench)
    problem = Problem(bench, bench.plant("exact"), EstimationProblem(("k_m",)), (data,))
    z, weights = np.array([[0.9], [2.0]]), problem.weights(np.ones(1))
    brakes = np.array([bench.brake._replace(k_m=float(k) * bench.brake.k_m) for k in z[:, 0]])
    totals, nothing = np.zeros(2), np.zeros(2)
    arguments = (data.currents, 1e-3, 0, data.samples, np.zeros(20), weights[0], totals)
    add_squares(problem.plant.mechanics, brakes, np.zeros((2, 2)), nothing, nothing, *arguments)
    assert totals.tolist() == sums_of_squares(problem, z, weights).tolist()


def test_the_same_seed_draws_the_same_and_another_other_ones(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ensemble, "PERIODS", 32 * 400 * 60.0)
    data, asked = sticking(bench), EstimationProblem(("T_c",), prior=bench.range_set("pm50"))
    one, same, other = (estimate(bench, "exact", [data], asked, seed=seed).draws for seed in (3, 3, 4))
    assert one is not None
    assert same is not None
    assert other is not None
    assert one.tolist() == same.tolist()
    assert one[0].tolist() != other[0].tolist()


def test_where_the_model_does_not_fit_the_intervals_are_no_narrower_than_the_residuals_say(bench: Bench) -> None:
    data = record(bench, bench.plant("stribeck"), currents_of(bench, "chirp"))
    e = fit(bench, "exact", [data])
    assert not e.validation.fits
    draws = e.values * (1.0 + e.cramer_rao() * np.random.default_rng(0).standard_normal((20000, 4)))
    low, high = replace(e, draws=draws).intervals().T
    assert (high - low) / e.values == pytest.approx(2.0 * 1.96 * e.robust(), rel=0.05)
    assert (e.robust() > 2.0 * e.cramer_rao()).all()


def test_chains_that_are_too_short_are_said_to_be(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ensemble, "PERIODS", 32 * 20 * 60.0)
    found = estimate(bench, "exact", [sticking(bench)], EstimationProblem(("k_m", "T_c")))
    assert "may not have converged" in found.caveats[1]


def test_walkers_begin_around_every_minimum_within_reach_as_many_as_belong_there(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), currents_of(bench, "chirp")[:60])
    problem = Problem(bench, bench.plant("exact"), EstimationProblem(("f_v",)), (data,))
    weights = problem.weights(np.ones(1))
    f_v = bench.brake.f_v

    def end(share: float, cost: float) -> End:
        return End(cost, (share * f_v,), (f_v,), True, 1)

    places = minima(problem, [end(1.0, 10.0), end(1.0 + 1e-9, 10.1), end(2.0, 12.0), end(3.0, 60.0)], weights)
    assert [float(z[0]) for z, _, _ in places] == pytest.approx([1.0, 2.0])
    begin = walkers(problem, places, np.random.default_rng(0))
    deviations = [float(covariance[0, 0]) ** 0.5 for _, covariance, _ in places]
    masses = np.exp(-0.5 * np.array([10.0, 12.0])) * deviations
    expected = 32 * masses[0] / masses.sum()
    near = int(np.sum(np.abs(begin - 1.0) < np.abs(begin - 2.0)))
    assert begin.shape == (32, 1)
    assert abs(near - expected) <= 4.0
    low, high = problem.bounds
    assert ((begin >= low) & (begin <= high)).all()


def test_without_emcee_it_says_what_to_install(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "emcee", None)
    with pytest.raises(UsageError, match=r"needs emcee: pip install 'emb-excite\[bench\]'"):
        estimate(bench, "exact", [sticking(bench)], EstimationProblem(("T_c",)))
