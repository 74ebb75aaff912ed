"""Estimates by output error, of features of the mechanics too: of known brakes, with derivatives by differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from emb_bench.config.bench import Bench
from emb_bench.estimate.output_error import search, start_points
from emb_bench.estimate.prediction import Problem
from emb_bench.estimate.records import EstimationProblem
from emb_bench.experiment.experiment import Experiment, planned
from emb_bench.experiment.simulate import Theta, simulate
from emb_bench.information.fisher import uniform_prior
from emb_runtime.config.bench import PARAMETER_NAMES, BrakeParameters
from emb_runtime.errors import LogError, UsageError
from tests.bench.flows import fisher
from tests.bench.measurements import (
    check_derivatives,
    currents_of,
    errors_in_sigmas,
    fit,
    hard,
    problem_of,
    record,
)

DRAWS = 100


def brake_of(bench: Bench, **factors: float) -> BrakeParameters:
    return bench.brake._replace(**{name: getattr(bench.brake, name) * f for name, f in factors.items()})


def exactly(
    bench: Bench, text: str = "chirp", brake: BrakeParameters | None = None, seed: int | None = 0
) -> Experiment:
    return record(bench, bench.plant("exact"), currents_of(bench, text, brake), brake=brake, seed=seed)


@pytest.mark.slow
def test_the_estimate_is_unbiased_and_as_good_as_the_bound_allows_and_its_intervals_cover(bench: Bench) -> None:
    plant, brake = bench.plant("exact"), brake_of(bench, k_m=1.1, T_c=0.8, f_v=1.3)
    currents = currents_of(bench, "chirp", brake)
    bounds = fisher(bench, brake, currents, kind="physical", plant=plant).cramer_rao()
    true = np.array([getattr(brake, name) for name in PARAMETER_NAMES])
    found = [fit(bench, plant, [record(bench, plant, currents, brake=brake, seed=seed)]) for seed in range(DRAWS)]
    errors = np.array([(e.values - true) / true for e in found]) / list(bounds.values())
    low, high = stats.chi2.ppf([0.0005, 0.9995], DRAWS) / DRAWS
    ratios = (errors**2).mean(axis=0)
    assert ((low < ratios) & (ratios < high)).all(), ratios
    assert (np.abs(errors.mean(axis=0)) < 3.0 / np.sqrt(DRAWS)).all()
    inside = [(e.intervals()[:, 0] <= true) & (true <= e.intervals()[:, 1]) for e in found]
    assert (np.abs(np.mean(inside, axis=0) - 0.95) < 3.3 * np.sqrt(0.05 * 0.95 / DRAWS)).all()
    robust = np.mean([e.robust() for e in found], axis=0) / list(bounds.values())
    assert robust == pytest.approx(np.ones(4), abs=0.1)
    assert np.mean([not e.validation.fits for e in found]) <= 0.04


def test_where_the_output_is_linear_in_the_unknowns_it_is_weighted_least_squares(bench: Bench) -> None:
    """Forward motion in contact: angle and velocity are affine in k_m and T_c."""
    plant, currents = bench.plant("exact"), 1.2 + 0.5 * np.sin(np.arange(60.0) / 4.0)
    data = record(bench, plant, currents)

    def shown(k_m: float, t_c: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        p = bench.brake._replace(k_m=k_m, T_c=t_c)
        return simulate(plant, Theta(p), planned(currents), bench.timing.sample_time).states[1:].ravel()

    k_m, t_c = bench.brake.k_m, bench.brake.T_c
    origin = shown(k_m, t_c)
    steps = [0.2 * k_m, -0.2 * t_c]
    columns = np.stack([shown(k_m + steps[0], t_c) - origin, shown(k_m, t_c + steps[1]) - origin], axis=1) / steps
    root = np.tile([1.0 / bench.noise.angle, 1.0 / bench.noise.velocity], 60)
    step = np.linalg.lstsq(columns * root[:, None], (data.samples.ravel() - origin) * root, rcond=None)[0]
    covariance = np.linalg.inv((columns * root[:, None]).T @ (columns * root[:, None]))
    found = fit(bench, plant, [data], EstimationProblem(("k_m", "T_c")), starts=3)
    assert found.values == pytest.approx([k_m + step[0], t_c + step[1]], rel=1e-8)
    assert found.cramer_rao() * found.values == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-6)
    assert found.theta == bench.brake._replace(k_m=found.values[0], T_c=found.values[1])


def test_a_command_that_acts_a_fraction_of_a_period_late_is_one_that_acts_late_on_a_finer_grid(bench: Bench) -> None:
    currents = currents_of(bench, "chirp")
    fine = np.repeat(currents, 10)
    fine = np.concatenate([np.zeros(3), fine])[: len(fine)]
    states = simulate(bench.plant("exact"), Theta(bench.brake), planned(fine), 1e-4).states[::10]
    problem = problem_of(bench, ("delay",), exactly(bench))
    assert problem.predict(np.array([0.3]), 0).states == pytest.approx(states, rel=1e-9, abs=1e-9)
    noise = np.random.default_rng(0).standard_normal((500, 2)) * [bench.noise.angle, bench.noise.velocity]
    data = Experiment("late", currents, states[1:] + noise, 0.0, 0.0, 0.0, True)
    found = fit(bench, "exact", [data], EstimationProblem(nuisances=("delay",)), starts=2)
    assert found.validation.fits
    assert abs(found.values[4] - 0.3) < 4.0 * found.deviations()[4] < 0.01


def test_samples_count_at_the_instants_that_the_node_stamped(bench: Bench) -> None:
    """The truth comes from a grid that is a hundred times finer."""
    plant, currents = bench.plant("exact"), currents_of(bench, "chirp")
    fine = simulate(plant, Theta(bench.brake), planned(np.repeat(currents, 100)), 1e-5).states
    rng = np.random.default_rng(0)
    steps = rng.integers(-3, 4, size=500)
    steps[-1] = 0
    seen = fine[100 * np.arange(1, 501) + steps]
    samples = seen + rng.standard_normal((500, 2)) * [bench.noise.angle, bench.noise.velocity]
    blind = Experiment("off the grid", currents, samples, 0.0, 0.0, 0.0, True)
    assert not fit(bench, plant, [blind]).validation.fits
    found = fit(bench, plant, [replace(blind, late=1e-5 * steps.astype(np.float64))])
    assert found.validation.fits
    assert (np.abs(errors_in_sigmas(found, bench.brake)) < 4.0).all()


def test_a_lost_sample_changes_nothing_but_its_information(bench: Bench) -> None:
    plant, data, lost = bench.plant("exact"), exactly(bench, seed=None), [5, 77, 78, 400]
    samples = data.samples.copy()
    samples[lost] = np.nan
    whole = fit(bench, plant, [data])
    partial = fit(bench, plant, [replace(data, samples=samples)])
    nominal = [getattr(bench.brake, name) for name in PARAMETER_NAMES]
    assert whole.values == pytest.approx(nominal, rel=1e-9)
    assert partial.values == pytest.approx(nominal, rel=1e-9)
    s = simulate(plant, Theta(bench.brake), planned(data.currents), 0.001, PARAMETER_NAMES).sensitivities[lost]
    gone = np.einsum("kin,kjn,n->ij", s, s, [bench.noise.angle**-2, bench.noise.velocity**-2])
    assert whole.information - partial.information == pytest.approx(gone, rel=1e-5, abs=1e-8 * gone.max())
    assert np.isnan(partial.residuals[0][lost]).all()


def test_what_is_in_a_sample_that_was_lost_in_part_does_not_count(bench: Bench) -> None:
    data = exactly(bench)
    one, other = data.samples.copy(), data.samples.copy()
    one[30], other[30] = [np.nan, np.nan], [np.nan, 1e6]
    found = [fit(bench, "exact", [replace(data, samples=s)]).values for s in (one, other)]
    assert found[0].tolist() == found[1].tolist()


def test_from_several_starts_the_global_minimum_is_found_where_one_search_ends_in_a_local_one(bench: Bench) -> None:
    plant, brake = bench.plant("exact"), hard(bench)
    data = exactly(bench, "constant-speed:turn=0.15", brake)
    problem = problem_of(bench, PARAMETER_NAMES, data)
    alone = search(problem, problem.nominal(), problem.weights(problem.nominal()))
    found = fit(bench, plant, [data], starts=8)
    assert alone.cost > 1000.0 * found.ends[0].cost
    assert found.validation.fits
    assert (np.abs(errors_in_sigmas(found, brake)) < 4.0).all()
    costs = [end.cost for end in found.ends]
    assert costs == sorted(costs)
    assert costs[-1] > 1000.0 * costs[0]
    origins = {tuple(end.start) for end in found.ends}
    assert len(origins) == 8
    assert tuple(problem.nominal()) in origins


def test_if_no_start_leads_to_a_model_that_fits_one_that_follows_the_measured_brake_does(bench: Bench) -> None:
    plant, brake = bench.plant("exact"), hard(bench)
    found = fit(bench, plant, [exactly(bench, "constant-speed:turn=0.15", brake)])
    assert found.validation.fits
    assert len(found.ends) == 2
    nominal = found.problem.nominal().tolist()
    assert found.ends[0].start.tolist() == found.ends[1].start.tolist() == nominal
    assert found.ends[0].evaluations > found.ends[1].evaluations
    assert found.ends[1].cost > 1000.0 * found.ends[0].cost
    easy = fit(bench, plant, [exactly(bench)])
    assert len(easy.ends) == 1


def test_a_search_ends_at_the_border_of_a_tenth_of_nominal(bench: Bench) -> None:
    plant, data, b = bench.plant("exact"), exactly(bench), bench.brake
    off = replace(bench, brake=b._replace(f_v=12.0 * b.f_v))
    held = fit(off, plant, [data], starts=2)
    assert held.values[3] == pytest.approx(1.2 * b.f_v, rel=1e-4)
    assert held.values[3] >= 1.2 * b.f_v
    assert held.at_bound == ("f_v",)
    assert not fit(bench, plant, [data], starts=2).at_bound


def test_the_same_seed_begins_at_the_same_points_all_within_the_ranges(bench: Bench) -> None:
    problem = problem_of(bench, PARAMETER_NAMES, exactly(bench))
    one, same, other = (np.array([problem.values(z) for z in start_points(problem, 20, seed)]) for seed in (3, 3, 4))
    assert one.tolist() == same.tolist()
    assert (one[1:] != other[1:]).all()
    ranges = bench.range_set(bench.shield.ranges)
    low, high = (np.array([getattr(side, n) for n in PARAMETER_NAMES]) for side in (ranges.low, ranges.high))
    assert ((one >= low) & (one <= high)).all()
    assert (np.ptp(one, axis=0) > 0.8 * (high - low)).all()


def test_records_share_the_brake_and_have_their_own_start(bench: Bench) -> None:
    plant, brake = bench.plant("exact"), brake_of(bench, f_v=1.4)
    starts = [(0.5, 0.0), (-0.3, 0.0)]
    chirp, square = currents_of(bench, "chirp", brake), currents_of(bench, "square", brake)
    records = [
        record(bench, plant, u, brake=brake, x0=x0, seed=5) for u, x0 in zip((chirp, square), starts, strict=True)
    ]
    asked = EstimationProblem(nuisances=("x1_0",))
    found = fit(bench, plant, records, asked)
    assert found.labels == (*PARAMETER_NAMES, "x1_0[0]", "x1_0[1]")
    assert found.validation.fits
    assert (np.abs(found.values[4:] - [0.5, -0.3]) < 4.0 * found.deviations()[4:]).all()
    assert [f.name for f in found.identifiability().findings] == list(PARAMETER_NAMES)
    alone = [fit(bench, plant, [r], asked) for r in records]
    shared = sum(np.linalg.inv(np.linalg.inv(e.information)[:4, :4]) for e in alone)
    assert np.linalg.inv(np.linalg.inv(found.information)[:4, :4]) == pytest.approx(shared, rel=0.05)


def test_where_each_record_started_can_be_all_that_is_asked(bench: Bench) -> None:
    plant, currents = bench.plant("exact"), currents_of(bench, "chirp")
    records = [record(bench, plant, currents, x0=(x1, 0.0), seed=n) for n, x1 in enumerate((0.5, -0.3))]
    found = fit(bench, plant, records, EstimationProblem(("x1_0",)))
    assert (np.abs(found.values - [0.5, -0.3]) < 4.0 * found.deviations()).all()
    assert found.theta == bench.brake
    assert found.identifiability().findings == ()


@pytest.mark.parametrize("method", ["oem", "pem"])
def test_a_velocity_that_an_observer_derived_from_the_angle_does_not_count(bench: Bench, method: str) -> None:
    plant = bench.plant("observer")
    data = record(bench, plant, currents_of(bench, "chirp"))
    spoilt = np.stack([data.samples[:, 0], np.full(500, 7.0)], axis=1)
    found = [fit(bench, plant, [d], method=method) for d in (data, replace(data, samples=spoilt))]
    assert found[0].values.tolist() == found[1].values.tolist()
    assert found[0].validation.fits
    assert (np.abs(errors_in_sigmas(found[0], bench.brake)) < 4.5).all()
    assert list(found[0].validation.whiteness) == ["angle"]
    assert found[0].validation.freedom == 496


def test_where_the_clock_jitters_fast_samples_count_less(bench: Bench) -> None:
    plant, brake = bench.plant("jitter"), brake_of(bench, k_m=0.9, f_v=1.2)
    found = fit(bench, plant, [record(bench, plant, currents_of(bench, "chirp"), brake=brake)], starts=2)
    assert found.validation.fits
    assert (np.abs(errors_in_sigmas(found, brake)) < 4.0).all()
    ideal = fit(bench, "exact", [exactly(bench, brake=brake)])
    assert (found.cramer_rao() > 1.5 * ideal.cramer_rao()).all()


def test_what_the_data_do_not_tell_is_said_and_a_prior_settles_it(bench: Bench) -> None:
    """Under a current that never turns k_m and T_c are nearly one number, and a few samples do not part them."""
    plant = bench.plant("exact")
    data = record(bench, plant, np.full(40, 2.0))
    blind = fit(bench, plant, [data], EstimationProblem(("k_m", "T_c")), starts=2)
    assert [finding.identified for finding in blind.identifiability().findings] == [False, False]
    assert np.isinf(blind.cramer_rao()).all()
    ranges = bench.range_set("pm50")
    found = fit(bench, plant, [data], EstimationProblem(("k_m", "T_c"), prior=ranges), starts=2)
    assert np.isfinite(found.cramer_rao()).all()
    scale = found.values / [bench.brake.k_m, bench.brake.T_c]
    prior = uniform_prior(ranges, ("k_m", "T_c"), bench.brake) * np.outer(scale, scale)
    assert found.prior == pytest.approx(prior, rel=1e-12)
    assert len(found.identifiability().left_to_prior) == 1
    torque = 2.0 * found.values[0] - found.values[1]
    assert torque == pytest.approx(2.0 * bench.brake.k_m - bench.brake.T_c, rel=1e-3)


def test_the_rest_before_the_experiment_is_a_measurement_of_where_it_started(bench: Bench) -> None:
    plant, names = bench.plant("exact"), (*PARAMETER_NAMES, "x1_0")
    data = record(bench, plant, currents_of(bench, "chirp"), x0=(0.4, 0.0), seed=None)
    found = fit(bench, plant, [data], EstimationProblem(names))
    asleep = fit(bench, plant, [replace(data, slack=0.0)], EstimationProblem(names))
    gained = found.information - asleep.information
    assert gained == pytest.approx(np.diag([0.0] * 4 + [data.slack**-2]), abs=1e-4 * gained.max())


def test_what_cannot_be_estimated_from_so_little_is_refused(bench: Bench) -> None:
    data = exactly(bench)
    none = replace(data, samples=np.full((500, 2), np.nan))
    for records, starts, message in (([], 1, "one record"), ([data], 0, "1 start")):
        with pytest.raises(UsageError, match=message):
            fit(bench, "exact", records, starts=starts)
    with pytest.raises(LogError, match="too few"):
        fit(bench, "exact", [none])
    with pytest.raises(UsageError, match="varies in the ranges"):
        EstimationProblem(("k_m",), prior=bench.range_set("viscous"))


OF = {
    "stribeck": ("break_away", "stribeck_velocity"),
    "load": ("break_away", "stribeck_velocity", "f_l"),
    "cubic": ("quadratic", "cubic"),
    "hysteresis": ("hysteresis",),
    "play": ("play",),
    "lag": ("current_lag",),
}
"""Features of the shipped bench's plants."""


@pytest.mark.parametrize("plant", OF)
def test_features_are_estimated_with_a_plant_that_lacks_them(bench: Bench, plant: str) -> None:
    data = record(bench, bench.plant(plant), currents_of(bench, "chirp"), seed=3)
    e = fit(bench, "exact", [data], EstimationProblem(PARAMETER_NAMES, OF[plant]))
    assert e.validation.fits
    true = bench.brake._asdict() | bench.plant(plant).mechanics._asdict()
    deviations = e.cramer_rao() * e.scale
    for unknown, value, deviation in zip(e.unknowns, e.values.tolist(), deviations.tolist(), strict=True):
        assert abs(value - true[unknown.name]) < 4.0 * deviation
        assert deviation < 0.3 * true[unknown.name]
    for name, value in zip(OF[plant], e.values[len(PARAMETER_NAMES) :].tolist(), strict=True):
        assert getattr(e.plant.mechanics, name) == value


SYSTEMATIC = ("offset", "current_offset", "delay", "velocity_gain")
AWAY = {"x1_0": 0.02, "offset": 0.01, "contact": 0.2, "current_offset": 0.03, "delay": 0.3, "velocity_gain": 0.01}
"""Values of those unknowns at which derivatives are compared."""


@pytest.mark.parametrize(
    ("plant", "names", "delay"),
    [
        ("exact", (*PARAMETER_NAMES, "x1_0", "x2_0", "offset"), 0.3),
        ("exact", ("k_1", "contact", "x1_0", "delay"), 0.3),
        ("stribeck", ("delay", "f_v", "J"), 0.3),
        ("late", ("k_m", "T_c", "offset"), 0.3),
        ("euler", ("k_m", "contact"), 0.3),
        *((plant, (*PARAMETER_NAMES, *features), 0.3) for plant, features in OF.items()),
        ("rough", ("break_away", "stribeck_velocity", "f_l", "quadratic", "hysteresis", "current_lag"), 0.3),
        *(
            (plant, ("k_m", "f_v", "x1_0", *SYSTEMATIC), d)
            for plant in ("exact", "late", "offset")
            for d in (-0.04, 0.3)
        ),
    ],
)
def test_derivatives_are_finite_differences_of_the_residuals(
    bench: Bench, plant: str, names: tuple[str, ...], delay: float
) -> None:
    model = bench.plant(plant)
    data = record(bench, model, currents_of(bench, "multisine")[:150], x0=(0.3, 20.0))
    asked = EstimationProblem(names, systematic=dict.fromkeys({*SYSTEMATIC} & {*names}, 0.1))
    problem = Problem(bench, model, asked, (data,))
    away = np.array([(AWAY | {"delay": delay}).get(u.name, 0.0) for u in problem.unknowns])
    z = problem.coordinates(1.03 * problem.values(problem.nominal())) + away
    weights = problem.weights(z)
    check_derivatives(lambda z: problem.jacobian(z, weights)[0], z, problem.jacobian(z, weights)[1])


def test_unknowns_that_a_plant_cannot_have_are_refused(bench: Bench) -> None:
    data = record(bench, bench.plant("exact"), np.ones(50))
    for plant, names, reason in (
        ("euler", ("cubic",), "expected a plant that is solved exactly"),
        ("euler", ("delay",), "delay"),
        ("lag", ("delay",), "delay"),
        ("exact", ("stribeck_velocity",), "estimate break_away too"),
        ("exact", ("hysteresis", "play"), "play does not go with hysteresis"),
        ("hysteresis", ("play",), "play does not go with hysteresis"),
        ("play", ("hysteresis",), "play does not go with hysteresis"),
    ):
        with pytest.raises(UsageError, match=f"plant '{plant}': .*{reason}"):
            fit(bench, plant, [data], EstimationProblem(("k_m",), names))
